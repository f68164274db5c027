"""The density prior · likelihood^t of many replicas, each with an inverse temperature t of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from fmu.posterior.scaled import ScaledDensity
from fmu.types import FloatArray, IntArray, LogDensity


@dataclass(frozen=True)
class Points:
    """Positions with what makes every tempered density there: arrays of one leading shape.

    Attributes
    ----------
    position : ndarray, shape (..., ndim)
    log_prior, log_likelihood : ndarray, shape (...)
        The likelihood is ``-inf`` where it is not finite.
    prior_gradient, likelihood_gradient : ndarray, shape (..., ndim), or None
        None where the kernel needs no gradients.
    """

    position: FloatArray
    log_prior: FloatArray
    log_likelihood: FloatArray
    prior_gradient: FloatArray | None = None
    likelihood_gradient: FloatArray | None = None

    def each(self, change: Callable[[FloatArray], FloatArray]) -> Points:
        """Return the points with every array changed alike."""
        arrays = [getattr(self, field.name) for field in fields(self)]
        changed: list[Any] = [None if a is None else change(a) for a in arrays]
        return Points(*changed)

    def put(self, where: Any, others: Points) -> None:
        """Overwrite the points at the index `where`."""
        for field in fields(self):
            array = getattr(self, field.name)
            if array is not None:
                array[where] = getattr(others, field.name)

    def log_prob(self, t: FloatArray) -> FloatArray:
        """Return log prior + t · log likelihood; at t = 0 the prior, whatever the likelihood."""
        return self.log_prior + np.where(t > 0.0, t, 1.0) * np.where(t > 0.0, self.log_likelihood, 0.0)

    def gradient(self, t: FloatArray) -> FloatArray | None:
        """Return the gradient of `log_prob`, for t > 0."""
        if self.prior_gradient is None or self.likelihood_gradient is None:
            return None
        return self.prior_gradient + t[..., None] * self.likelihood_gradient


def stacked(parts: list[Points]) -> Points:
    """Return points one after another along the first axis."""
    columns = [[getattr(part, field.name) for part in parts] for field in fields(Points)]
    arrays: list[Any] = [None if column[0] is None else np.concatenate(column) for column in columns]
    return Points(*arrays)


class PriorAndLikelihood:
    """A density taken apart, in the coordinates that the samplers see.

    Parameters
    ----------
    density : LogDensity
        With ``log_prior``, ``log_likelihood`` and ``sample_prior``, and ``log_prior_and_grad`` for gradients; or
        the scaled view of one.
    with_gradients : bool

    Raises
    ------
    ValueError
        If the density lacks one of them.
    """

    def __init__(self, density: LogDensity, with_gradients: bool) -> None:
        self.scaled = density if isinstance(density, ScaledDensity) else None
        self.density: Any = density.density if isinstance(density, ScaledDensity) else density
        self.ndim, self.lower, self.upper = density.ndim, density.lower, density.upper
        self.with_gradients = with_gradients
        self.solves_per_gradient = int(getattr(self.density, "solves_per_gradient", 1))
        needed = ["log_prior", "log_likelihood", "sample_prior", *["log_prior_and_grad"] * with_gradients]
        missing = [name for name in needed if not hasattr(self.density, name)]
        if missing:
            lacking = f"got one without {', '.join(missing)}"
            raise ValueError(f"problem: tempering needs a density with {', '.join(needed)} ({lacking})")

    @property
    def solves_each(self) -> int:
        """What one of `points` costs in solves."""
        return self.solves_per_gradient if self.with_gradients else 1

    def points(self, u: FloatArray) -> Points:
        """Evaluate prior and likelihood at u, shape (n, ndim), in one batch, and the gradients if need be."""
        theta = u if self.scaled is None else self.scaled.to_theta(u)
        if not self.with_gradients:
            return Points(u, self.density.log_prior(theta), _known(self.density.log_likelihood(theta)))
        scale = 1.0 if self.scaled is None else self.scaled.scale
        prior, prior_gradient = self.density.log_prior_and_grad(theta)
        value, gradient = self.density.log_prob_and_grad(theta)
        return Points(u, prior, _known(value - prior), prior_gradient * scale, (gradient - prior_gradient) * scale)

    def sample_prior(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw from the prior, shape (n, ndim)."""
        theta = np.asarray(self.density.sample_prior(rng, n), dtype=float)
        u = theta if self.scaled is None else self.scaled.to_scaled(theta)
        return np.clip(u, self.lower, self.upper)


class TemperedDensity:
    """The tempered densities of replicas, for one step of a kernel, which remembers what it evaluated last.

    Parameters
    ----------
    parts : PriorAndLikelihood
    t : ndarray, shape (replicas,)
        Inverse temperatures, above 0.
    start : Points
        Where the replicas are, leading shape (replicas,).
    """

    def __init__(self, parts: PriorAndLikelihood, t: FloatArray, start: Points) -> None:
        self.parts, self.t, self.start = parts, t, start
        self.ndim, self.lower, self.upper = parts.ndim, parts.lower, parts.upper
        self.solves_per_gradient = parts.solves_per_gradient
        self.last = start.each(np.copy)

    def of_chains(self, chain: Any) -> TemperedOfChains:
        """Return the densities of some replicas."""
        return TemperedOfChains(self, chain)

    def log_prob(self, u: Any) -> Any:
        """Return the log-densities at u, shape (replicas, ndim), one point each."""
        return self.of_chains(slice(None)).log_prob(u)

    def log_prob_and_grad(self, u: Any) -> tuple[Any, Any]:
        """Return `log_prob` and its gradient."""
        return self.of_chains(slice(None)).log_prob_and_grad(u)

    def at(self, position: FloatArray) -> tuple[Points, IntArray]:
        """Return what is known where the replicas have arrived, and the solves that this took.

        None at all, for a kernel ends where it was or at the point that it evaluated last. Only an interval of
        the coordinate-wise slice that is given up leaves a replica where the axis before had brought it.
        """
        n_solves = np.zeros(len(position), dtype=np.int64)
        points = self.last.each(np.copy)
        stayed = np.all(position == self.start.position, axis=1)
        points.put(stayed, self.start.each(lambda a: a[stayed]))
        unknown = np.any(position != points.position, axis=1)
        if unknown.any():
            points.put(unknown, self.parts.points(position[unknown]))
            n_solves[unknown] = self.parts.solves_each
        return points, n_solves


@dataclass(frozen=True)
class TemperedOfChains:
    """The tempered densities of the replicas that the index `chain` picks, in the order of the points."""

    whole: TemperedDensity
    chain: Any

    @property
    def ndim(self) -> int:
        """Number of coordinates."""
        return self.whole.ndim

    @property
    def lower(self) -> FloatArray:
        """The box."""
        return self.whole.lower

    @property
    def upper(self) -> FloatArray:
        """The box."""
        return self.whole.upper

    def log_prob(self, u: Any) -> Any:
        """Return the log-densities at u, shape (n, ndim)."""
        points = self._evaluated(u)
        return points.log_prob(self.whole.t[self.chain])

    def log_prob_and_grad(self, u: Any) -> tuple[Any, Any]:
        """Return `log_prob` and its gradient."""
        points, t = self._evaluated(u), self.whole.t[self.chain]
        return points.log_prob(t), points.gradient(t)

    def _evaluated(self, u: FloatArray) -> Points:
        points = self.whole.parts.points(u)
        self.whole.last.put(self.chain, points)
        return points


def _known(log_likelihood: FloatArray) -> FloatArray:
    """Return the log-likelihood with −inf where the model failed."""
    return np.where(np.isfinite(log_likelihood), log_likelihood, -np.inf)
