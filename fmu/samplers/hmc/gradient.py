"""Gradients of a log-density: exact, or by the central differences of eq. (15) of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from fmu.samplers.evaluation import evaluate, of_chains
from fmu.types import BoolArray, FloatArray, IntArray, LogDensity


class Slope(NamedTuple):
    """A log-density and its gradient at n points, with their cost.

    Attributes
    ----------
    log_prob : ndarray, shape (n,)
        NaN where it was neither asked for nor came for free.
    gradient : ndarray, shape (n, ndim)
    finite : ndarray of bool, shape (n,)
        Whether everything that was evaluated is finite.
    n_solves : ndarray of int, shape (n,)
    """

    log_prob: FloatArray
    gradient: FloatArray
    finite: BoolArray
    n_solves: IntArray


class Gradient(Protocol):
    """Anything that returns the slope of the log-density at points inside the box."""

    def __call__(self, position: FloatArray, *, with_log_prob: bool, chain: IntArray | None = None) -> Slope:
        """Evaluate at `position`, shape (n, ndim); `chain`, shape (n,), says whose points they are."""
        ...


@dataclass(frozen=True)
class ExactGradient:
    """The density's own gradient, its value included: one solve a point, or its `solves_per_gradient`."""

    density: LogDensity

    def __call__(self, position: FloatArray, *, with_log_prob: bool, chain: IntArray | None = None) -> Slope:
        """Evaluate in one batch."""
        density = of_chains(self.density, slice(None) if chain is None else chain)
        log_prob, gradient = density.log_prob_and_grad(position)
        finite = np.isfinite(log_prob) & np.all(np.isfinite(gradient), axis=1)
        n_solves = np.full(len(position), getattr(self.density, "solves_per_gradient", 1), dtype=np.int64)
        return Slope(log_prob, gradient, finite, n_solves)


@dataclass(frozen=True)
class CentralDifference:
    """∂ log P/∂E_i ≈ (log P(E + h Δ_i e_i) − log P(E − h Δ_i e_i)) / (2 h Δ_i), eq. (15) with V = −log P.

    Where a perturbed point would leave the box it is put on the wall, and the quotient divided by the distance
    that remains: 2 ndim solves a gradient everywhere, one-sided at a wall. The log-density itself is one more.

    Parameters
    ----------
    density : LogDensity
    delta : ndarray, shape (ndim,)
        The perturbation vector Δ, in scaled units.
    h : float
        The scalar that multiplies it.
    """

    density: LogDensity
    delta: FloatArray
    h: float

    def __call__(self, position: FloatArray, *, with_log_prob: bool, chain: IntArray | None = None) -> Slope:
        """Evaluate all perturbed points in one batch; the density is the same for all chains."""
        n, ndim = position.shape
        shift = np.diag(self.h * self.delta)
        centre = position[:, None, :]
        above = np.minimum(centre + shift, self.density.upper)
        below = np.maximum(centre - shift, self.density.lower)
        points = [above.reshape(-1, ndim), below.reshape(-1, ndim)]
        if with_log_prob:
            points.append(position)
        found = evaluate(self.density, np.concatenate(points))
        values = found.log_prob[: 2 * n * ndim].reshape(2, n, ndim)
        distance = np.diagonal(above - below, axis1=1, axis2=2)
        with np.errstate(invalid="ignore"):  # −inf on both sides, where the density has failed: not finite
            gradient = (values[0] - values[1]) / distance
        finite = np.all(np.isfinite(gradient), axis=1)
        log_prob = np.full(n, np.nan)
        if with_log_prob:
            log_prob = found.log_prob[2 * n * ndim :]
            finite &= np.isfinite(log_prob)
        return Slope(log_prob, gradient, finite, np.full(n, 2 * ndim + int(with_log_prob), dtype=np.int64))
