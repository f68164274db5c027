"""Mixtures of curved Gaussians, fitted by expectation–maximisation (EM)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from fmu.samplers.mixture.curve import BETTER, HALF_LOG_2PI, features, least_squares, select_features
from fmu.types import FloatArray

MOST = 32
"""Largest number of Gaussians in a mixture."""
_SWEEPS, _LITTLE = 12, 2e-3
"""Largest number of sweeps in a fit, and smallest gain in log-likelihood per point that is worth another sweep."""
_POINTS, _PER_GAUSSIAN = 4, 20
"""Effective number of points needed per coefficient of a bend b_i, and per coordinate of a Gaussian."""
PENALTY = 3.0
"""Gain in log-likelihood required per coefficient. Weighted points carry less information than the same number of
independent points: Akaike's criterion, 1, leaves too many Gaussians, which collapse onto single points."""
_WORTH, _FAILURES = 0.01, 2
_NEAR = 1e-3


@dataclass(frozen=True, eq=False)
class BentGaussians:
    """Mixture of curved ("bent") Gaussians: x = mean + A t with t_i = b_i(t) + sd_i z_i and z standard normal.

    Each b_i is a quadratic polynomial in the t_j with j > i. The columns of A are the principal axes, shortest
    first. A short axis therefore curves along the longer ones, and a Gaussian can follow a thin curved sheet or
    thread. The map from z to t is triangular, so its Jacobian determinant is the product of the sd_i.

    Attributes
    ----------
    weights : ndarray, shape (k,)
    means : ndarray, shape (k, ndim)
    axes : ndarray, shape (k, ndim, ndim)
        The matrices A.
    bends : ndarray, shape (k, ndim, n)
        Coefficients of b_i with respect to the n `features` of t.
    sds : ndarray, shape (k, ndim)
        Standard deviations of t_i about b_i.
    """

    weights: FloatArray
    means: FloatArray
    axes: FloatArray
    bends: FloatArray
    sds: FloatArray

    def to_z(self, x: FloatArray, k: int) -> FloatArray:
        """Transform points x to the standard normal coordinates z of Gaussian k; both have shape (n, ndim)."""
        t = np.linalg.solve(self.axes[k], (x - self.means[k]).T).T
        return np.asarray((t - features(t) @ self.bends[k].T if self.bends[k].any() else t) / self.sds[k])

    def to_x(self, z: FloatArray, k: int) -> FloatArray:
        """Transform standard normal coordinates z of Gaussian k to points x; both have shape (n, ndim)."""
        t = z * self.sds[k]
        if self.bends[k].any():
            for i in range(t.shape[1] - 2, -1, -1):
                t[:, i] += features(t) @ self.bends[k, i]
        return np.asarray(self.means[k] + t @ self.axes[k].T)

    def log_densities(self, x: FloatArray, wider: FloatArray) -> FloatArray:
        """Return the log of each Gaussian's weighted density at points x (n, ndim), shape (n_factors, k, n).

        The first axis is for the factors in `wider`, by which the widths of all Gaussians are multiplied.
        """
        ndim, found = x.shape[1], np.empty((len(wider), len(self.weights), len(x)))
        for k, weight in enumerate(self.weights):
            square = np.sum(self.to_z(x, k) ** 2, axis=1)
            log_volume = np.linalg.slogdet(self.axes[k])[1] + np.sum(np.log(self.sds[k])) + ndim * HALF_LOG_2PI
            found[:, k] = np.log(weight) - log_volume - ndim * np.log(wider)[:, None]
            found[:, k] -= 0.5 * square / wider[:, None] ** 2
        return found

    def responsibilities(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return each Gaussian's probability of having produced each point, (k, n).

        The second result is the mixture's log-density at the points, (n,).
        """
        each = self.log_densities(x, np.ones(1))[0]
        total = np.asarray(logsumexp(each, axis=0))
        return np.exp(each - total), total

    @property
    def n_coefficients(self) -> int:
        """Number of free parameters in the mixture, which determines the penalty in a fit."""
        ndim = self.means.shape[1]
        return int(np.count_nonzero(self.bends)) + len(self.weights) * (ndim + 1) * (ndim + 2) // 2


def fit_gaussians(x: FloatArray, weight: FloatArray) -> tuple[BentGaussians, float]:
    """Return the best mixture for weighted points, and its penalised mean log-likelihood.

    The points x have shape (n, ndim) and their weights shape (n,). The fit begins with one Gaussian and repeatedly
    splits every Gaussian across its longest axis. It ends when two splits in a row bring no gain, or when the next
    mixture would have more than `MOST` Gaussians or too few points for each. Raise LinAlgError if there are too
    few points for one Gaussian.
    """
    ndim, weight = x.shape[1], weight / weight.sum()
    size = 1.0 / float(np.sum(weight**2))
    best: BentGaussians | None = None
    best_score, failures = -np.inf, 0
    parts = _fit_parts(x, weight[None], size)
    while parts is not None and failures < _FAILURES:
        parts, value = _run_sweeps(x, weight, size, parts)
        score = value - PENALTY * parts.n_coefficients / size
        if best is None or score > best_score + _WORTH:
            best, best_score, failures = parts, score, 0
        else:
            failures += 1
        k = 2 * len(parts.weights)
        if k > MOST or size < _PER_GAUSSIAN * ndim * k:
            break
        side = np.stack([parts.to_z(x, i)[:, -1] for i in range(len(parts.weights))])
        side = 1.0 / (1.0 + np.exp(-4.0 * np.clip(side, -50.0, 50.0)))
        r = parts.responsibilities(x)[0] * weight
        parts = _fit_parts(x, np.concatenate([r * side, r * (1.0 - side)]), size)
    if best is None:
        raise np.linalg.LinAlgError("too few points for a Gaussian")
    return best, best_score


def _run_sweeps(
    x: FloatArray, weight: FloatArray, size: float, parts: BentGaussians
) -> tuple[BentGaussians, float]:
    """Run up to `_SWEEPS` EM sweeps; return the best mixture and its weighted mean log-likelihood per point.

    `size` is the effective number of points.
    """
    best, highest = parts, -np.inf
    for sweep in range(_SWEEPS + 1):
        r, total = parts.responsibilities(x)
        value, before = float(weight @ total), highest
        if value > highest:
            best, highest = parts, value
        following = None if sweep == _SWEEPS or value < before + _LITTLE else _fit_parts(x, r * weight, size)
        if following is None:
            break
        parts = following
    return best, highest


def _fit_parts(x: FloatArray, r: FloatArray, size: float) -> BentGaussians | None:
    """Fit k Gaussians to weighted points; return None if all of them have too few points.

    `r` (k, n) contains the responsibilities times the weights of the points, which sum to 1. `size` is the
    effective number of all points. A Gaussian with too few points is dropped. Each Gaussian is widened to allow
    for its own uncertainty: with the mean and covariance of m points, a new point's expected squared distance is
    larger than a fitted point's by the factor 1 + (ndim + 2)/m.
    """
    ndim = x.shape[1]
    r = r[r.sum(axis=1) * size > ndim + 2]
    if not len(r):
        return None
    k, n = len(r), len(select_features(np.ones(ndim, dtype=bool)))
    means, axes = np.empty((k, ndim)), np.empty((k, ndim, ndim))
    bends, sds = np.zeros((k, ndim, n)), np.empty((k, ndim))
    for one in range(k):
        w = r[one] / r[one].sum()
        points = 1.0 / float(np.sum(w**2))
        means[one] = w @ x
        d = x - means[one]
        values, vectors = np.linalg.eigh((w * d.T) @ d)
        length = np.sqrt(np.maximum(values, 1e-14 * values[-1] + 1e-300))
        axes[one], sds[one] = vectors * length, np.sqrt(1.0 + (ndim + 2.0) / points)
        near = w > _NEAR * w.max()
        t, w = d[near] @ vectors / length, w[near] / w[near].sum()
        phi = features(t)
        for i in range(ndim - 1):
            used = select_features(np.arange(ndim) > i)
            if points < _POINTS * used.sum():
                continue
            c = least_squares(phi[:, used], t[:, i], w)
            left = max(float(w @ (t[:, i] - phi[:, used] @ c) ** 2), 1e-14)
            if -0.5 * np.log(left) > BETTER + used.sum() / points:
                bends[one, i, used], sds[one, i] = c, np.sqrt(left * (1.0 + (used.sum() + 2.0) / points))
    return BentGaussians(r.sum(axis=1) / r.sum(), means, axes, bends, sds)
