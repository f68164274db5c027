"""Proposal densities q(candidate | position) of the Metropolis-Hastings sampler."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from fmu.samplers.loop.settings import Scale, cholesky_factor, fits, positive_scale, vector
from fmu.types import FloatArray


class Proposal(Protocol):
    """A conditional density q(candidate | position), in the scaled units of run.py.

    A frozen dataclass whose fields can be written as JSON is recorded with the trace.
    """

    def sample(self, rng: np.random.Generator, position: FloatArray) -> FloatArray:
        """Draw one candidate a chain; both arrays are ``(chains, ndim)``."""
        ...

    def log_ratio(self, candidate: FloatArray, position: FloatArray) -> FloatArray:
        """Return log q(position | candidate) − log q(candidate | position), shape ``(chains,)``."""
        ...


@dataclass(frozen=True)
class RandomWalk:
    """Gaussian random walk: candidate = position + N(0, S). Symmetric.

    Parameters
    ----------
    scale : float, vector (ndim,) or matrix (ndim, ndim)
        A standard deviation for all coordinates, one for each, or the covariance matrix S.

    Raises
    ------
    ValueError
        If `scale` is not positive (definite) and finite.
    """

    scale: Any = 0.01
    _factor: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        scale: Scale = positive_scale("scale", self.scale, matrix=True)
        object.__setattr__(self, "scale", scale)
        array = np.asarray(scale)
        object.__setattr__(self, "_factor", cholesky_factor("scale", array) if array.ndim == 2 else array)

    def sample(self, rng: np.random.Generator, position: FloatArray) -> FloatArray:
        """Draw position + L z with z standard normal and L Lᵀ = S."""
        factor = fits("scale", self._factor, position.shape[-1])
        z = rng.standard_normal(position.shape)
        return position + (z @ factor.T if factor.ndim == 2 else factor * z)

    def log_ratio(self, candidate: FloatArray, position: FloatArray) -> FloatArray:
        """Return 0: q(a | b) = q(b | a)."""
        return np.zeros(len(position))


@dataclass(frozen=True)
class LogNormalWalk:
    """Multiplicative random walk above `origin`: candidate − origin = (position − origin) exp(s z), z ~ N(0, 1).

    Asymmetric: q(x' | x) = N(log x'; log x, s²)/x', so that log q(x | x') − log q(x' | x) = Σ log(x'/x),
    x measured from the origin.

    Parameters
    ----------
    scale : float or vector (ndim,)
        Standard deviation s of the logarithm.
    origin : float or vector (ndim,)
        Below every position; the lower bound is 0 in the unit box.

    Raises
    ------
    ValueError
        If `scale` is not positive and finite, or a position is not above `origin`.
    """

    scale: Any = 0.2
    origin: Any = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "scale", positive_scale("scale", self.scale, matrix=False))
        origin = np.asarray(self.origin, dtype=float)
        object.__setattr__(self, "origin", vector("origin", origin) if origin.ndim else float(origin))

    def sample(self, rng: np.random.Generator, position: FloatArray) -> FloatArray:
        """Multiply the distance from the origin by a log-normal factor."""
        scale, origin = (fits(name, getattr(self, name), position.shape[-1]) for name in ("scale", "origin"))
        if np.any(position <= origin):
            raise ValueError(f"origin: must be below every position (got {self.origin} and a position at it)")
        return origin + (position - origin) * np.exp(scale * rng.standard_normal(position.shape))

    def log_ratio(self, candidate: FloatArray, position: FloatArray) -> FloatArray:
        """Return Σ log((candidate − origin)/(position − origin))."""
        origin = np.asarray(self.origin)
        with np.errstate(divide="ignore"):  # a factor that underflows: candidate at the origin, never accepted
            return np.sum(np.log(candidate - origin) - np.log(position - origin), axis=-1)


@dataclass(frozen=True)
class Independence:
    """Candidates from N(mean, covariance) whatever the position, e.g. a Laplace approximation. Asymmetric.

    Parameters
    ----------
    mean : vector (ndim,)
    covariance : matrix (ndim, ndim)

    Raises
    ------
    ValueError
        If `mean` is not finite or `covariance` not symmetric positive definite of the same size.
    """

    mean: Any
    covariance: Any
    _factor: FloatArray = field(init=False, repr=False, compare=False)
    _inverse_factor: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mean", vector("mean", self.mean))
        factor = cholesky_factor("covariance", np.asarray(self.covariance, dtype=float))
        fits("covariance", factor, len(self.mean))
        object.__setattr__(self, "covariance", positive_scale("covariance", self.covariance, matrix=True))
        object.__setattr__(self, "_factor", factor)
        object.__setattr__(self, "_inverse_factor", np.linalg.inv(factor))

    def sample(self, rng: np.random.Generator, position: FloatArray) -> FloatArray:
        """Draw mean + L z with z standard normal and L Lᵀ = covariance."""
        mean = fits("mean", self.mean, position.shape[-1])
        return mean + rng.standard_normal(position.shape) @ self._factor.T

    def log_ratio(self, candidate: FloatArray, position: FloatArray) -> FloatArray:
        """Return log g(position) − log g(candidate), g the Gaussian."""
        return self._log_density(position) - self._log_density(candidate)

    def _log_density(self, x: FloatArray) -> FloatArray:
        z = (x - np.asarray(self.mean)) @ self._inverse_factor.T
        return -0.5 * np.sum(z * z, axis=-1)
