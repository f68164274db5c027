"""The tempered densities prior · likelihood^t of many replicas, each with its own inverse temperature t."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fmu.posterior.scaled import ScaledDensity
from fmu.samplers.kernel import Index, Target
from fmu.samplers.trajectory import ExactGradient
from fmu.types import FloatArray, IntArray, LogDensity


class Points(NamedTuple):
    """Positions with log-priors and log-likelihoods, from which any tempered density can be computed.

    Attributes
    ----------
    position : ndarray, shape (..., ndim)
    log_prior, log_likelihood : ndarray, shape (...)
        A log-likelihood that is not finite is replaced by ``-inf``.
    prior_gradient, likelihood_gradient : ndarray, shape (..., ndim), or None
        None if the kernel needs no gradients.
    """

    position: FloatArray
    log_prior: FloatArray
    log_likelihood: FloatArray
    prior_gradient: FloatArray | None = None
    likelihood_gradient: FloatArray | None = None

    def each(self, change: Callable[..., FloatArray], *others: Points) -> Points:
        """Return points whose arrays are the results of `change`; an array that is None stays None.

        `change` is called with each array of these points and the corresponding arrays of `others`.
        """
        changed: Any = (None if a is None else change(a, *b) for a, *b in zip(self, *others, strict=True))
        return Points(*changed)

    def put(self, where: Index, others: Points) -> None:
        """Overwrite the points at index `where` with `others`."""
        for array, values in zip(self, others, strict=True):
            if array is not None:
                array[where] = values

    def log_prob(self, t: FloatArray) -> FloatArray:
        """Return log-prior + t · log-likelihood, shape (...).

        At t = 0 this is the log-prior, even where the log-likelihood is −inf.
        """
        return self.log_prior + np.where(t > 0.0, t, 1.0) * np.where(t > 0.0, self.log_likelihood, 0.0)

    def gradient(self, t: FloatArray) -> FloatArray | None:
        """Return the gradient of `log_prob` for t > 0, shape (..., ndim), or None if there are no gradients."""
        if self.prior_gradient is None or self.likelihood_gradient is None:
            return None
        return self.prior_gradient + t[..., None] * self.likelihood_gradient


class PriorAndLikelihood:
    """A density's prior and likelihood, evaluated separately in the samplers' coordinates.

    Parameters
    ----------
    density : LogDensity
        A density with ``log_prior``, ``log_likelihood`` and ``sample_prior`` and, if gradients are needed, with
        ``log_prior_and_grad`` and ``log_prob_and_grad``; or the `ScaledDensity` of such a density.
    with_gradients : bool
        Whether gradients are needed.

    Raises
    ------
    ValueError
        If the density lacks one of these methods.
    """

    def __init__(self, density: LogDensity, with_gradients: bool) -> None:
        self.given, self.with_gradients = density, with_gradients
        self.scaled = density if isinstance(density, ScaledDensity) else None
        self.density: Any = density if self.scaled is None else self.scaled.density
        needed = [
            "log_prior",
            "log_likelihood",
            "sample_prior",
            *["log_prior_and_grad", "log_prob_and_grad"] * with_gradients,
        ]
        missing = [name for name in needed if not hasattr(self.density, name)]
        if missing:
            lacking = f"got one without {', '.join(missing)}"
            raise ValueError(f"problem: tempering needs a density with {', '.join(needed)} ({lacking})")
        self.solves_each = Target(density).solves_per_gradient if with_gradients else 1  # solves per point

    def points(self, u: FloatArray) -> Points:
        """Evaluate priors, likelihoods and, if needed, gradients at u (n, ndim) in one batch.

        Log-likelihoods that are not finite become −inf.
        """
        theta = u if self.scaled is None else self.scaled.to_theta(u)
        if not self.with_gradients:
            return Points(u, self.density.log_prior(theta), _replace_failures(self.density.log_likelihood(theta)))
        scale = 1.0 if self.scaled is None else self.scaled.scale
        prior, prior_gradient = self.density.log_prior_and_grad(theta)
        value, gradient = self.density.log_prob_and_grad(theta)
        return Points(
            u, prior, _replace_failures(value - prior), prior_gradient * scale, (gradient - prior_gradient) * scale
        )

    def sample_prior(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Return `n` draws from the prior in the samplers' coordinates, clipped to the bounds, shape (n, ndim)."""
        theta = np.asarray(self.density.sample_prior(rng, n), dtype=float)
        u = theta if self.scaled is None else self.scaled.to_scaled(theta)
        return np.clip(u, self.given.lower, self.given.upper)


class TemperedTarget(ExactGradient):
    """Tempered densities of the replicas for one kernel step; stores each replica's last evaluation.

    Parameters
    ----------
    parts : PriorAndLikelihood
    t : ndarray, shape (replicas,)
        Inverse temperatures, above 0.
    start : Points
        The replicas before the step, with leading axis (replicas,).
    """

    def __init__(self, parts: PriorAndLikelihood, t: FloatArray, start: Points) -> None:
        super().__init__(parts.given)
        self.parts, self.t, self.start_points = parts, t, start
        self.last = start.each(np.copy)

    def log_prob(self, position: FloatArray, chain: Index) -> FloatArray:
        """Return the tempered log-densities at `position` (n, ndim), for the replicas with indices `chain`."""
        return self._evaluate(position, chain).log_prob(self.t[chain])

    def log_prob_and_grad(self, position: FloatArray, chain: Index) -> tuple[FloatArray, FloatArray]:
        """Return the tempered log-densities (n,) and gradients (n, ndim) for the replicas with indices `chain`."""
        points, t = self._evaluate(position, chain), self.t[chain]
        gradient = points.gradient(t)
        assert gradient is not None  # the parts were made with gradients
        return points.log_prob(t), gradient

    def at(self, position: FloatArray) -> tuple[Points, IntArray]:
        """Return the replicas at their positions after the step, and the solves per replica, shape (replicas,).

        Usually this takes no solves, because a replica ends where it started or at the point that was evaluated
        last. The exception is coordinate-wise slice sampling: if an interval is given up, the replica stays at the
        position reached along the previous axis.
        """
        n_solves = np.zeros(len(position), dtype=np.int64)
        points = self.last.each(np.copy)
        stayed = np.all(position == self.start_points.position, axis=1)
        points.put(stayed, self.start_points.each(lambda a: a[stayed]))
        unknown = np.any(position != points.position, axis=1)
        if unknown.any():
            points.put(unknown, self.parts.points(position[unknown]))
            n_solves[unknown] = self.parts.solves_each
        return points, n_solves

    def _evaluate(self, position: FloatArray, chain: Index) -> Points:
        points = self.parts.points(position)
        self.last.put(chain, points)
        return points


def _replace_failures(log_likelihood: FloatArray) -> FloatArray:
    """Replace log-likelihoods that are not finite, which mark failures of the model, by −inf."""
    return np.where(np.isfinite(log_likelihood), log_likelihood, -np.inf)
