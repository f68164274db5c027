"""Coordinates in which a bent density is straight: margins at walls, then a triangular map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import betainc, betaincinv, betaln, digamma, log_ndtr, ndtri_exp, polygamma

from fmu.types import BoolArray, FloatArray, IntArray

HALF_LOG_2PI = 0.5 * np.log(2.0 * np.pi)
BETTER = 0.05
"""Gain of log-likelihood per point from which on a margin, or a bend, is worth having."""
_USELESS = 0.01
"""Gain of log-likelihood per point below which a bend does without a coordinate."""
_FAR = 6.0
"""Standard deviations beyond which polynomials go on as constants."""
_SWEEPS, _NEWTON_STEPS = 8, 30
_POINTS = 5
"""Effective points per coefficient of a bend."""
_LEAST, _MOST_SHAPE = 1e-2, 1e3
_INFINITE, _ENOUGH = 0.8, 100
"""Shape of a beta distribution below which the density is called infinite at a wall, seen in so many points."""
_PRODUCTS = 8e6
"""Points times squared coefficients of a fit: what a tenth of a second allows."""
_TINY, _EPS = 1e-300, 2.0**-53


@dataclass(frozen=True, eq=False)
class Curve:
    """Coordinates x of u: margins y_i(u_i), scaled to z, and x_k = (z_k − m_k(z)) exp(−s_k(z)).

    m_k is quadratic and s_k linear in the coordinates before k in `order`, so that the map is triangular and its
    determinant a product. The first makes a banana Gaussian, the second a funnel. Between two bounds a margin may
    be Φ⁻¹(I_t(a, b)), t = (u − lower)/(upper − lower), with the distribution function I_t of a beta distribution:
    a density that is infinite at a wall becomes Gaussian. Other margins are u itself.

    Attributes
    ----------
    lower, upper : ndarray, shape (ndim,)
        The box of u.
    a, b : ndarray, shape (ndim,)
        Shapes of the beta distributions; NaN where the margin is u.
    centre, spread : ndarray, shape (ndim,)
        z = (y − centre)/spread.
    order : ndarray of int, shape (ndim,)
        The coordinates, each after those that it depends on.
    location, scale : ndarray, shape (ndim, n)
        Coefficients of m_k and s_k for the n `features`.

    References
    ----------
    Moselhy & Marzouk (2012), J. Comput. Phys. 231, 7815-7850 (triangular maps); Haario, Saksman & Tamminen (1999),
    Comput. Statist. 14, 375-395 (the banana).
    """

    lower: FloatArray
    upper: FloatArray
    a: FloatArray
    b: FloatArray
    centre: FloatArray
    spread: FloatArray
    order: IntArray
    location: FloatArray
    scale: FloatArray

    def to_x(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x of points u (n, ndim) of the box, and log |dx/du|, shape (n,)."""
        y, log_slope = self.margins(u)
        z = (y - self.centre) / self.spread
        phi = features(z)
        s = phi @ self.scale.T
        return (z - phi @ self.location.T) * np.exp(-s), log_slope - np.sum(np.log(self.spread) + s, axis=1)

    def to_u(self, x: FloatArray) -> FloatArray:
        """Return u of points x (n, ndim): it may lie outside the box, but not where a margin is a beta's."""
        z = np.zeros_like(x)
        for k in self.order:
            phi = features(z)
            z[:, k] = x[:, k] * np.exp(phi @ self.scale[k]) + phi @ self.location[k]
        return self.from_margins(self.centre + self.spread * z)

    def margins(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return y of points u (n, ndim), and log |dy/du|, shape (n,)."""
        y, log_slope = u.copy(), np.zeros(len(u))
        for i in np.flatnonzero(np.isfinite(self.a)):
            width = self.upper[i] - self.lower[i]
            y[:, i], of_t = _normal_of_beta((u[:, i] - self.lower[i]) / width, self.a[i], self.b[i])
            log_slope += of_t - np.log(width)
        return y, log_slope

    def from_margins(self, y: FloatArray) -> FloatArray:
        """Return u of y, both (n, ndim)."""
        u = y.copy()
        for i in np.flatnonzero(np.isfinite(self.a)):
            # from the nearer wall, where a double tells more points apart
            low = betaincinv(self.a[i], self.b[i], np.exp(log_ndtr(np.minimum(y[:, i], 0.0))))
            high = betaincinv(self.b[i], self.a[i], np.exp(log_ndtr(-np.maximum(y[:, i], 0.0))))
            t = np.clip(np.where(y[:, i] < 0.0, low, 1.0 - high), _TINY, 1.0 - _EPS)
            u[:, i] = self.lower[i] + (self.upper[i] - self.lower[i]) * t
        return u


def features(z: FloatArray) -> FloatArray:
    """Return 1, z_i, and z_i z_j with i ≤ j at points z (n, ndim), with z cut off at ±`_FAR`."""
    z = np.clip(z, -_FAR, _FAR)
    i, j = np.triu_indices(z.shape[1])
    return np.concatenate([np.ones((len(z), 1)), z, z[:, i] * z[:, j]], axis=1)


def select_features(used: BoolArray, *, linear: bool = False) -> BoolArray:
    """Mark the `features` that consist of the coordinates `used` alone; without products if `linear`.

    Parameters
    ----------
    used : ndarray of bool, shape (ndim,)
    linear : bool

    Returns
    -------
    ndarray of bool, shape (n_features,)
    """
    i, j = np.triu_indices(len(used))
    return np.concatenate([[True], used, np.zeros(len(i), dtype=bool) if linear else used[i] & used[j]])


def least_squares(phi: FloatArray, y: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the coefficients of the features phi (n, k) that fit y (n,) best with weights (n,)."""
    weighted = phi.T * (weight / weight.sum())
    normal = weighted @ phi
    return np.asarray(np.linalg.solve(normal + 1e-9 * np.diag(np.diag(normal) + 1e-12), weighted @ y))


def thin_points(u: FloatArray, weight: FloatArray, most: int) -> tuple[FloatArray, FloatArray]:
    """Return at most `most` of the points u (n, ndim), drawn by their weights at equal steps, and new weights.

    A point that is drawn several times is returned once, with a weight in proportion. All points stay where they
    are no more than `most`.
    """
    weight = weight / weight.sum()
    if len(u) <= most:
        return u, weight
    at = np.searchsorted(np.cumsum(weight), (np.arange(most) + 0.5) / most)
    at, times = np.unique(np.minimum(at, len(u) - 1), return_counts=True)
    return u[at], times / most


def fit_curve(u: FloatArray, weight: FloatArray, lower: FloatArray, upper: FloatArray) -> Curve:
    """Return the curve that makes points u (n, ndim) with weights (n,) most nearly Gaussian, by their likelihood.

    The coordinate that gains most by a bend, given all others, is the last in the order; the next is the one that
    gains most given the rest, and so on, as long as one gains enough.
    """
    ndim, n = u.shape[1], len(select_features(np.ones(u.shape[1], dtype=bool)))
    u, weight = thin_points(u, weight, int(_PRODUCTS / n**2))
    a, b = fit_infinite_margins(u, weight, lower, upper)
    none = np.zeros((ndim, n))
    plain = Curve(lower, upper, a, b, np.zeros(ndim), np.ones(ndim), np.arange(ndim), none, none)
    y, _ = plain.margins(u)
    centre = weight @ y
    spread = np.sqrt(np.maximum(weight @ (y - centre) ** 2, _TINY))
    z = (y - centre) / spread
    location, scale = none.copy(), none.copy()
    first, last = list(range(ndim)), list[int]()
    while len(first) > 1:
        bends = [(_bend(z, k, np.isin(np.arange(ndim), first) & (np.arange(ndim) != k), weight), k) for k in first]
        (gain, m, s), k = max(bends, key=lambda one: one[0][0])
        if gain < BETTER:
            break
        others = np.isin(np.arange(ndim), first) & (np.arange(ndim) != k)
        for i in np.flatnonzero(others):  # what is useless here goes wrong where no points are
            without = others & (np.arange(ndim) != i)
            less, *bend = _bend(z, k, without, weight)
            if less > gain - _USELESS:
                others, gain, (m, s) = without, max(gain, less), bend
        location[k], scale[k] = m, s
        first.remove(k)
        last.insert(0, k)
    return Curve(lower, upper, a, b, centre, spread, np.array([*first, *last]), location, scale)


def _bend(z: FloatArray, k: int, others: BoolArray, weight: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return the gain of log-likelihood per point by m_k and s_k of `others`, and their coefficients.

    The gain is over a linear m_k and a constant s_k, less that expected from as many useless coefficients; -inf
    with too few points. m_k by weighted least squares and s_k by scoring, in turn (Harvey 1976, Econometrica 44,
    461-465).
    """
    phi, y = features(z), z[:, k]
    in_m, in_s = select_features(others), select_features(others, linear=True)
    location, scale = np.zeros(phi.shape[1]), np.zeros(phi.shape[1])
    size = 1.0 / float(np.sum(weight**2))
    if size < _POINTS * (in_m.sum() + in_s.sum()):
        return -np.inf, location, scale
    plain = y - phi[:, in_s] @ least_squares(phi[:, in_s], y, weight)
    log_sd = np.full(len(y), 0.5 * np.log(max(float(weight @ plain**2), _TINY)))
    before = -float(log_sd[0]) - 0.5
    coefficients = np.zeros(in_s.sum())
    best = -np.inf
    for sweep in range(_SWEEPS):
        m = least_squares(phi[:, in_m], y, weight * np.exp(2.0 * (log_sd.min() - log_sd)))
        r = y - phi[:, in_m] @ m
        if sweep == 0:
            coefficients[0] = 0.5 * np.log(max(float(weight @ r**2), _TINY))
            log_sd = phi[:, in_s] @ coefficients
        square = r**2 * np.exp(-2.0 * log_sd)
        value = -float(weight @ (log_sd + 0.5 * square))
        if value < best + 1e-4:
            break
        best = value
        location[in_m], scale[in_s] = m, coefficients
        coefficients = coefficients + 0.5 * least_squares(phi[:, in_s], np.minimum(square, 50.0) - 1.0, weight)
        log_sd = phi[:, in_s] @ coefficients
    return best - before - in_m.sum() / size, location, scale


def fit_infinite_margins(
    u: FloatArray, weight: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the shapes a, b (ndim,) of beta margins where the density is infinite at a wall; others are NaN.

    A density that is finite at a wall has shape 1 there (a uniform or an exponential margin) or more.
    """
    shapes = np.full((2, u.shape[1]), np.nan)
    if weight.sum() ** 2 > _ENOUGH * np.sum(weight**2):
        for i in np.flatnonzero(np.isfinite(lower) & np.isfinite(upper)):
            a, b = _fit_beta((u[:, i] - lower[i]) / (upper[i] - lower[i]), weight / weight.sum())
            if min(a, b) < _INFINITE:
                shapes[:, i] = a, b
    return shapes[0], shapes[1]


def _fit_beta(t: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Return the shapes of the likeliest beta distribution of points t in [0, 1], NaN if they are extreme."""
    t = np.clip(t, _TINY, 1.0 - _EPS)
    mean = float(weight @ t)
    common = mean * (1.0 - mean) / max(float(weight @ (t - mean) ** 2), _TINY) - 1.0
    shape = np.array([mean * common, (1.0 - mean) * common])
    means = np.array([weight @ np.log(t), weight @ np.log1p(-t)])
    for _ in range(_NEWTON_STEPS):
        if not (shape.min() > _LEAST and shape.max() < _MOST_SHAPE):
            return np.nan, np.nan
        slope = means - digamma(shape) + digamma(shape.sum())
        curvature = polygamma(1, shape.sum()) - np.diag(polygamma(1, shape))
        shape = np.clip(shape - np.linalg.solve(curvature, slope), 0.3 * shape, 3.0 * shape)
    return float(shape[0]), float(shape[1])


def _normal_of_beta(t: FloatArray, a: float, b: float) -> tuple[FloatArray, FloatArray]:
    """Return y = Φ⁻¹(I_t(a, b)), and log dy/dt."""
    t = np.clip(t, _TINY, 1.0 - _EPS)
    below, above = betainc(a, b, t), betainc(b, a, 1.0 - t)
    log_tail = np.log(np.clip(np.minimum(below, above), _TINY, 0.5))
    y = np.where(below < above, 1.0, -1.0) * ndtri_exp(log_tail)
    log_p = (a - 1.0) * np.log(t) + (b - 1.0) * np.log1p(-t) - betaln(a, b)
    return y, log_p + 0.5 * y**2 + HALF_LOG_2PI
