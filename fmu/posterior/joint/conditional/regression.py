"""Fit a normal distribution to a log-density by regression on its gradients.

Let N(m, C) be the normal distribution closest to a density p, in the Kullback–Leibler divergence from N to p. It
has E[∇ log p] = 0 and E[−∇² log p] = C⁻¹, with expectations over N itself. A linear regression of gradients on
draws from N gives both expectations (Salimans & Knowles 2013, *Bayesian Anal.* 8, 837–882). By contrast, the
curvature at a single point is misleading if the density is skewed or has its maximum at a bound.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fmu.types import FloatArray

_ROUNDS, _SETTLED = 12, 0.05
_POINTS, _FEWEST = 4, 32
"""Number of points per coordinate in a round, and the smallest number of points."""
_CHANGE = 4.0
"""Largest factor by which a round changes a variance, and the square of its largest step in standard
deviations."""


class FittedNormal(NamedTuple):
    """A normal distribution whose draws are reflected at bounds.

    Attributes
    ----------
    mean : ndarray, shape (d,)
    factor : ndarray, shape (d, d)
        A square root of the covariance matrix C = factor factorᵀ.
    """

    mean: FloatArray
    factor: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """Covariance matrix before reflection, shape (d, d)."""
        return self.factor @ self.factor.T

    def draws(self, n: int, lower: FloatArray, upper: FloatArray) -> FloatArray:
        """Return `n` draws, reflected at the bounds, shape (n, d). Every call uses the same random numbers."""
        noise = np.random.default_rng(1).standard_normal((n, len(self.mean)))
        return reflect(self.mean + noise @ self.factor.T, lower, upper)[0]


def reflect(w: FloatArray, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Reflect points (n, d) into the box between the bounds; return them and their derivatives, which are ±1.

    A point that is still outside after one reflection is clipped to the bounds.
    """
    sign = np.where((w < lower) | (w > upper), -1.0, 1.0)
    w = np.where(w < lower, 2.0 * lower - w, np.where(w > upper, 2.0 * upper - w, w))
    return np.clip(w, lower, upper), sign


def fit_normal(
    gradient: Callable[[FloatArray], FloatArray],
    mean: FloatArray,
    covariance: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
) -> FittedNormal:
    """Return the normal distribution closest to a density within bounds.

    Parameters
    ----------
    gradient : callable
        Returns the log-density gradients at n points, (n, d) → (n, d).
    mean, covariance : ndarray, shapes (d,) and (d, d)
        The normal distribution from which the search starts.
    lower, upper : ndarray, shape (d,)
        Bounds of the points. The density is continued beyond them by reflection.

    Notes
    -----
    Every iteration uses the same standard normal numbers, with zero mean and unit covariance. The reciprocal
    variance of a uniform distribution between the bounds is added to the curvature, because the fitted variances
    would otherwise be infinite where the density is flat. Where the gradient is not finite, the gradient of the
    current normal distribution replaces it. There are at most `_ROUNDS` iterations.
    """
    d, flat = len(mean), 12.0 / (upper - lower) ** 2
    half = max(_POINTS * d, _FEWEST) // 2
    noise = np.random.default_rng(0).standard_normal((half, d))
    noise = np.concatenate([noise, -noise])
    noise = noise @ np.linalg.inv(np.linalg.cholesky(noise.T @ noise / len(noise))).T
    factor = np.linalg.cholesky(covariance)
    for _ in range(_ROUNDS):
        w, sign = reflect(mean + noise @ factor.T, lower, upper)
        slopes = (sign * gradient(w)) @ factor
        slopes = np.where(np.all(np.isfinite(slopes), axis=1)[:, None], slopes, -noise)
        precision = factor.T @ (flat[:, None] * factor) - (noise.T @ slopes) / len(noise)
        values, vectors = np.linalg.eigh(0.5 * (precision + precision.T))
        values = np.clip(values, 1.0 / _CHANGE, _CHANGE)
        step = (vectors / values) @ vectors.T @ slopes.mean(axis=0)
        step *= min(1.0, np.sqrt(_CHANGE / max(float(step @ step), np.finfo(float).tiny)))
        mean, _ = reflect(mean + factor @ step, lower, upper)
        factor = factor @ (vectors / np.sqrt(values))
        if max(float(step @ step), float(np.max(np.abs(np.log(values))))) < _SETTLED:
            break
    return FittedNormal(mean, factor)
