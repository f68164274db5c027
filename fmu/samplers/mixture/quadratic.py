"""Quadratic approximations of a log-density, expanded about a maximum or fitted to evaluations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fmu.samplers.mixture.truncated_normal import SequentialNormal
from fmu.types import FloatArray

FLATTEST, STEEPEST = 1e-2, 1e12
"""Smallest and largest eigenvalue of a precision matrix, in coordinates of order one."""
_CONDITION = 1e13
_FLAT = 20.0
_MOST_WIDENED = 2.5
_PULL = 1e-3
_CLIMBS, _LONGEST = 8, 3.0
"""Largest number of steps in a climb, and largest step along an axis, in lengths of the axis."""
_LEVEL, _CLIFF = 0.1, 50.0
"""Smallest curvature assumed in a step, which is also the gain below which the climb ends; and the largest drop to
a neighbouring point that a step takes into account."""


@dataclass(frozen=True, eq=False)
class Quadratic:
    """Second-order expansion of log P about a point u₀: m(u) = log_prob + g·d − dᵀHd/2 with d = u − u₀.

    At a maximum on a bound, g does not vanish: the density decreases exponentially away from the bound.

    Attributes
    ----------
    position, gradient : ndarray, shape (ndim,)
        The point u₀, and the gradient g.
    log_prob : float
    hessian : ndarray, shape (ndim, ndim)
        The negative Hessian H. Proposals clip eigenvalues that are negative, very small or very large.
    covariance : ndarray, shape (ndim, ndim), optional
        Covariance of the points to which the quadratic was fitted; u₀ is then their weighted mean.
    """

    position: FloatArray
    log_prob: float
    gradient: FloatArray
    hessian: FloatArray
    covariance: FloatArray | None = None

    def __call__(self, u: FloatArray) -> FloatArray:
        """Return the value of m at points u (n, ndim), shape (n,)."""
        d = u - self.position
        return self.log_prob + d @ self.gradient - 0.5 * np.einsum("ni,ij,nj->n", d, self.hessian, d)

    def proposal(self, lower: FloatArray, upper: FloatArray, temperature: float = 1.0) -> SequentialNormal:
        """Return a distribution close to the Gaussian ∝ exp(m/temperature), truncated at the bounds."""
        precision = definite(self.hessian)
        centre = self.position + np.linalg.solve(precision, self.gradient)
        return SequentialNormal(centre, precision / temperature, lower, upper)

    def proposals(self, lower: FloatArray, upper: FloatArray) -> list[SequentialNormal]:
        """Return the Gaussian ∝ exp(m) truncated at the bounds, followed by one or two wider copies.

        The first copy is wider along all principal axes. Without bounds, its density at the centre is at least
        e^(-5/2) times the Gaussian's. The second copy is far wider, but only along axes on which the density is
        almost as wide as the bounds or the prior. It is omitted if there are no such axes. If the quadratic was
        fitted to points, the second copy is centred at their mean, and has their covariance along the other axes.
        """
        found = [self.proposal(lower, upper, t) for t in (1.0, _temperature(len(lower)))]
        centre, precision = self.position, definite(self.hessian)
        if self.covariance is None:
            centre = centre + np.linalg.solve(precision, self.gradient)
        else:
            precision = definite(np.linalg.inv(self.covariance))
        values, axes = np.linalg.eigh(precision)
        flat = values < _FLAT
        if flat.any():
            values = np.where(flat, values / _temperature(int(flat.sum())), values)
            found.append(SequentialNormal(centre, (axes * values) @ axes.T, lower, upper))
        return found


def definite(hessian: FloatArray) -> FloatArray:
    """Return a symmetric matrix with its eigenvalues clipped, so that it and its inverse are positive definite."""
    values, vectors = np.linalg.eigh(hessian)
    values = np.minimum(values, STEEPEST)
    values = np.maximum(values, max(FLATTEST, values[-1] / _CONDITION))
    return np.asarray((vectors * values) @ vectors.T)


def inverse(hessian: FloatArray) -> FloatArray:
    """Return the inverse of a matrix whose eigenvalues are clipped by `definite`; it is exactly symmetric."""
    inverted = np.linalg.inv(definite(hessian))
    return np.asarray(0.5 * (inverted + inverted.T))


def _temperature(ndim: int) -> float:
    return float(np.exp(min(5.0 / ndim, _MOST_WIDENED)))


def measure_kurtosis(x: FloatArray, weight: FloatArray) -> float:
    """Return Mardia's (1970) kurtosis of weighted points x (n, ndim), divided by the value for a Gaussian."""
    n, z = x.shape[1], standardise(x, weight)[0]
    return float(weight @ np.sum(z**2, axis=1) ** 2 / weight.sum() / (n * (n + 2)))


def n_coefficients(ndim: int) -> int:
    """Return the number of coefficients in a quadratic polynomial of `ndim` coordinates."""
    return (ndim + 1) * (ndim + 2) // 2


def fit_quadratic(
    u: FloatArray, log_prob: FloatArray, weight: FloatArray, slope: FloatArray | None = None
) -> Quadratic:
    """Fit a quadratic to log-densities, and to their gradients if available, by weighted least squares.

    The fit uses coordinates in which the weighted points have unit covariance. The points hardly determine a
    curvature if they are fewer than the coefficients, or along a coordinate between two close bounds. Such
    curvatures are shrunk towards a Gaussian with the points' covariance, and the precision matrix is made positive
    definite.

    Parameters
    ----------
    u : ndarray, shape (n, ndim)
    log_prob, weight : ndarray, shape (n,)
        Finite log-densities; weights that are not all zero.
    slope : ndarray, shape (n, ndim), optional
        Gradients of the log-density. In the coordinates of the fit, each component has the same weight as the
        log-density at its point.
    """
    z, mean, L = standardise(u, weight)
    c = coefficients(z, log_prob, weight, None if slope is None else slope @ L)[0]
    H = _symmetric(c[1 + len(mean) :], len(mean))
    back = np.linalg.inv(L)
    gradient, curvature = back.T @ c[1 : 1 + len(mean)], back.T @ definite(H) @ back
    return Quadratic(mean, float(c[0]), gradient, curvature, L @ L.T)


def climb(log_prob: Callable[[FloatArray], FloatArray], start: FloatArray, like: FloatArray) -> Quadratic:
    """Climb towards a maximum without gradients; return the quadratic about the highest point found.

    The climb takes at most 8 Newton steps with finite differences, along axes scaled by the curvatures found so
    far. Each step costs 2 ndim + 1 evaluations. The quadratic has no mixed second derivatives along these axes.

    Parameters
    ----------
    log_prob : callable
        Returns log-densities (n,), which may be -inf, at points (n, ndim).
    start : ndarray, shape (ndim,)
    like : ndarray, shape (ndim, ndim)
        Precision matrix whose Cholesky factor gives the initial axes.
    """
    x, axes = start, np.linalg.inv(np.linalg.cholesky(definite(like))).T
    top, highest = start, -np.inf
    for _ in range(_CLIMBS):
        points = np.concatenate([x[None], x + axes.T, x - axes.T])
        values = log_prob(points)
        if values[0] < highest:  # the step was too long
            x, axes = top, 0.5 * axes
            continue
        top, highest = points[np.argmax(values)], float(values.max())
        ahead, behind = np.maximum(values[1:], values[0] - _CLIFF).reshape(2, -1)
        slope, curvature = 0.5 * (ahead - behind), np.maximum(2.0 * values[0] - ahead - behind, _LEVEL)
        x = x + axes @ np.clip(slope / curvature, -_LONGEST, _LONGEST)
        axes = axes / np.sqrt(curvature)
        if slope @ (slope / curvature) < _LEVEL:
            break
    back = np.linalg.inv(axes)
    return Quadratic(top, highest, np.zeros_like(top), back.T @ back)


def of_moments(u: FloatArray, weight: FloatArray) -> Quadratic:
    """Return the log-density, up to a constant, of a Gaussian with the mean and covariance of weighted points."""
    _, mean, L = standardise(u, weight)
    return Quadratic(mean, 0.0, np.zeros_like(mean), np.linalg.inv(L @ L.T), L @ L.T)


def standardise(u: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return z (n, ndim), the mean (ndim,) and L (ndim, ndim) such that u = mean + Lz.

    The weighted points z have zero mean and unit covariance.
    """
    w = weight / weight.sum()
    mean = w @ u
    covariance = (w * (u - mean).T) @ (u - mean)
    spread = np.diag(covariance)
    covariance = covariance + 1e-10 * np.diag(np.maximum(spread, 1e-12 * max(spread.max(), 1.0 / STEEPEST)))
    L = np.linalg.cholesky(covariance)
    return np.linalg.solve(L, (u - mean).T).T, mean, L


def coefficients(
    z: FloatArray, log_prob: FloatArray, weight: FloatArray, slope: FloatArray | None = None
) -> tuple[FloatArray, float]:
    """Return the coefficients of a quadratic in standardised z (n, ndim), and its weighted mean squared residual.

    The coefficients are the constant, the gradient and the upper triangle of the negative Hessian. The Hessian is
    pulled slightly towards that of a standard normal. The residual does not include the gradients. Normal
    equations are accurate enough, because z has unit covariance and `_PULL` limits their condition number to
    1/_PULL².
    """
    ndim = z.shape[1]
    i, j = np.triu_indices(ndim)
    columns = np.concatenate([np.ones((len(z), 1)), z, -z[:, i] * z[:, j] * np.where(i == j, 0.5, 1.0)], axis=1)
    w = weight / weight.sum()
    weighted = columns.T * w
    pull = np.concatenate([np.zeros(ndim + 1), np.full(len(i), _PULL**2)])
    A, b = (
        weighted @ columns + np.diag(pull),
        weighted @ log_prob + pull * (np.concatenate([np.zeros(ndim + 1), i == j])),
    )
    if slope is not None:
        place = np.empty((ndim, ndim), dtype=int)
        place[i, j] = place[j, i] = 1 + ndim + np.arange(len(i))
        one_z = np.concatenate([np.ones((len(z), 1)), -z], axis=1)
        of_slopes, right = (one_z.T * w) @ one_z, (one_z.T * w) @ slope
        for k in range(ndim):  # the derivative by z_k has the coefficients of z_k and of its products
            at = np.concatenate([[1 + k], place[k]])
            A[np.ix_(at, at)] += of_slopes
            b[at] += right[:, k]
    c = np.linalg.solve(A, b)
    return c, float(w @ (log_prob - columns @ c) ** 2)


def _symmetric(upper: FloatArray, ndim: int) -> FloatArray:
    i, j = np.triu_indices(ndim)
    H = np.zeros((ndim, ndim))
    H[i, j] = H[j, i] = upper
    return H
