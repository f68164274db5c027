"""Coordinates that straighten a curved density: transformed margins near the bounds, then a triangular map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import betainc, betaincinv, betaln, digamma, log_ndtr, ndtri_exp, polygamma

from fmu.types import BoolArray, FloatArray, IntArray

HALF_LOG_2PI = 0.5 * np.log(2.0 * np.pi)
BETTER = 0.05
"""Smallest gain in log-likelihood per point for which a bend is used."""
_USELESS = 0.01
"""Gain in log-likelihood per point below which a coordinate is left out of the m_k and s_k of a `Curve`."""
_FAR = 6.0
"""Number of standard deviations beyond which polynomials are held constant."""
_SWEEPS, _NEWTON_STEPS = 8, 30
_POINTS = 5
"""Effective number of points needed per coefficient of m_k or s_k."""
_LEAST, _MOST_SHAPE = 1e-2, 1e3
_INFINITE, _ENOUGH, _NEAREST = 0.8, 100, 0.1
"""Shape parameter of a beta distribution below which a density counts as infinite at a bound; effective number of
points needed for this decision; fraction of the points used, nearest to the bound."""
_PRODUCTS, _FEWEST = 8e6, 500
"""Largest product of the number of points and the squared number of coefficients in a fit, which takes 0.1 s, and
number of points that are kept however many coefficients there are."""
_TINY, _EPS = 1e-300, 2.0**-53


@dataclass(frozen=True, eq=False)
class Curve:
    """Map from points u to coordinates x in which a curved density is close to Gaussian.

    Each margin y_i(u_i) is standardised to z_i, and x_k = (z_k − m_k(z)) exp(−s_k(z)). The shift m_k is quadratic,
    and the log-scale s_k is linear, in the coordinates that precede k in `order`. The map is therefore triangular,
    and its Jacobian determinant is a product. The shift straightens a banana; the log-scale straightens a funnel.

    If the density is infinite at one or both bounds of u_i, the margin is Φ⁻¹(I_t(a, b)) with
    t = (u_i − lower)/(upper − lower). Here Φ is the cumulative distribution function (CDF) of a standard normal,
    and I_t(a, b) is the CDF of a beta distribution at t. Otherwise the margin is u_i itself.

    Attributes
    ----------
    lower, upper : ndarray, shape (ndim,)
        Bounds of u.
    a, b : ndarray, shape (ndim,)
        Shape parameters of the beta distributions; NaN where the margin is u_i itself.
    centre, spread : ndarray, shape (ndim,)
        Centre and spread of the margins in z = (y − centre)/spread.
    order : ndarray of int, shape (ndim,)
        Coordinate indices; each coordinate comes after those on which its m_k and s_k depend.
    location, scale : ndarray, shape (ndim, n)
        Coefficients of m_k and s_k with respect to the n `features`.

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
        """Return the coordinates x, (n, ndim), of points u within the bounds, (n, ndim), and log |dx/du|, (n,)."""
        y, log_slope = self.margins(u)
        z = (y - self.centre) / self.spread
        phi = features(z)
        s = phi @ self.scale.T
        return (z - phi @ self.location.T) * np.exp(-s), log_slope - np.sum(np.log(self.spread) + s, axis=1)

    def to_u(self, x: FloatArray) -> FloatArray:
        """Return the points u with coordinates x; both have shape (n, ndim).

        Components of u without a beta margin may lie outside their bounds.
        """
        z = np.zeros_like(x)
        for k in self.order:
            phi = features(z)
            z[:, k] = x[:, k] * np.exp(phi @ self.scale[k]) + phi @ self.location[k]
        return self.from_margins(self.centre + self.spread * z)

    def margins(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the margins y of points u, both of shape (n, ndim), and log |dy/du|, shape (n,)."""
        y, log_slope = u.copy(), np.zeros(len(u))
        for i in np.flatnonzero(np.isfinite(self.a)):
            width = self.upper[i] - self.lower[i]
            y[:, i], of_t = _normal_of_beta((u[:, i] - self.lower[i]) / width, self.a[i], self.b[i])
            log_slope += of_t - np.log(width)
        return y, log_slope

    def from_margins(self, y: FloatArray) -> FloatArray:
        """Return the points u whose margins are y; both have shape (n, ndim)."""
        u = y.copy()
        for i in np.flatnonzero(np.isfinite(self.a)):
            # measured from the nearer bound, where floating-point numbers are denser
            low = betaincinv(self.a[i], self.b[i], np.exp(log_ndtr(np.minimum(y[:, i], 0.0))))
            high = betaincinv(self.b[i], self.a[i], np.exp(log_ndtr(-np.maximum(y[:, i], 0.0))))
            t = np.clip(np.where(y[:, i] < 0.0, low, 1.0 - high), _TINY, 1.0 - _EPS)
            u[:, i] = self.lower[i] + (self.upper[i] - self.lower[i]) * t
        return u


def features(z: FloatArray) -> FloatArray:
    """Return the polynomial features 1, z_i and z_i z_j (i ≤ j) of points z (n, ndim) clipped to ±`_FAR`."""
    z = np.clip(z, -_FAR, _FAR)
    i, j = np.triu_indices(z.shape[1])
    return np.concatenate([np.ones((len(z), 1)), z, z[:, i] * z[:, j]], axis=1)


def select_features(used: BoolArray, *, linear: bool = False) -> BoolArray:
    """Return a mask of the `features` that involve only coordinates marked in `used`.

    Parameters
    ----------
    used : ndarray of bool, shape (ndim,)
    linear : bool
        If True, the products z_i z_j are left out as well.

    Returns
    -------
    ndarray of bool, shape (n_features,)
    """
    i, j = np.triu_indices(len(used))
    return np.concatenate([[True], used, np.zeros(len(i), dtype=bool) if linear else used[i] & used[j]])


def least_squares(phi: FloatArray, y: FloatArray, weight: FloatArray) -> FloatArray:
    """Fit features phi (n, k) to values y (n,) by weighted least squares; return the coefficients, shape (k,)."""
    weighted = phi.T * (weight / weight.sum())
    normal = weighted @ phi
    return np.asarray(np.linalg.solve(normal + 1e-9 * np.diag(np.diag(normal) + 1e-12), weighted @ y))


def thin_points(u: FloatArray, weight: FloatArray, most: int) -> tuple[FloatArray, FloatArray]:
    """Thin weighted points to at most `most` by systematic resampling; return the points and their new weights.

    The points u have shape (n, ndim). A point drawn several times is returned once, with a proportionally larger
    weight. All points are returned if there are no more than `most`. The new weights sum to 1.
    """
    weight = weight / weight.sum()
    if len(u) <= most:
        return u, weight
    at = np.searchsorted(np.cumsum(weight), (np.arange(most) + 0.5) / most)
    at, times = np.unique(np.minimum(at, len(u) - 1), return_counts=True)
    return u[at], times / most


def fit_curve(u: FloatArray, weight: FloatArray, lower: FloatArray, upper: FloatArray) -> Curve:
    """Return the `Curve` that makes points u (n, ndim) with weights (n,) most nearly Gaussian.

    The last coordinate in the curve's order is the one whose log-likelihood gains most if it depends on all the
    others. The second-to-last is chosen in the same way from the remaining coordinates, and so on until the gain
    becomes too small. If a coordinate's shift and log-scale hardly depend on another coordinate, they are fitted
    without that other coordinate.
    """
    ndim, n = u.shape[1], len(select_features(np.ones(u.shape[1], dtype=bool)))
    u, weight = thin_points(u, weight, max(int(_PRODUCTS / n**2), _FEWEST))
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
        for i in np.flatnonzero(others):  # a useless coordinate would extrapolate badly
            without = others & (np.arange(ndim) != i)
            less, *bend = _bend(z, k, without, weight)
            if less > gain - _USELESS:
                others, gain, (m, s) = without, max(gain, less), bend
        location[k], scale[k] = m, s
        first.remove(k)
        last.insert(0, k)
    return Curve(lower, upper, a, b, centre, spread, np.array([*first, *last]), location, scale)


def _bend(z: FloatArray, k: int, others: BoolArray, weight: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Fit m_k and s_k as functions of the coordinates `others`; return the gain per point, and their coefficients.

    The coefficients of each have shape (n_features,). The gain is the rise in log-likelihood over a linear m_k and
    a constant s_k, minus the number of coefficients of m_k divided by the effective number of points (Akaike's
    penalty). It is -inf if there are too few points. The fit alternates between weighted least squares for m_k and
    Fisher scoring for s_k (Harvey 1976, Econometrica 44, 461-465).
    """
    in_m, in_s = select_features(others), select_features(others, linear=True)
    location, scale = np.zeros(len(in_m)), np.zeros(len(in_m))
    size = 1.0 / float(np.sum(weight**2))
    if size < _POINTS * (in_m.sum() + in_s.sum()):
        return -np.inf, location, scale
    phi, y = features(z), z[:, k]
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
    """Return beta shape parameters a and b, each (ndim,), of the coordinates whose density is infinite at a bound.

    Both are NaN for all other coordinates, for coordinates without two finite bounds, and everywhere if there are
    at most `_ENOUGH` effective points. A shape parameter below 1 means that the density is infinite at that bound;
    uniform and exponential margins have 1. Here a density counts as infinite only if the parameter and the
    exponent from `_shape_at_zero` are both below 0.8.
    """
    shapes = np.full((2, u.shape[1]), np.nan)
    if weight.sum() ** 2 > _ENOUGH * np.sum(weight**2):
        for i in np.flatnonzero(np.isfinite(lower) & np.isfinite(upper)):
            t = (u[:, i] - lower[i]) / (upper[i] - lower[i])
            a, b = _fit_beta(t, weight / weight.sum())
            walls = ((a, t), (b, 1.0 - t))
            if any(shape < _INFINITE and _shape_at_zero(x, weight) < _INFINITE for shape, x in walls):
                shapes[:, i] = a, b
    return shapes[0], shapes[1]


def _shape_at_zero(t: FloatArray, weight: FloatArray) -> float:
    """Return the exponent a of a distribution whose CDF grows as t^a near t = 0; inf if the points used coincide.

    Only the points nearest to 0 are used, with a tenth of the weight. A beta distribution fitted to all points
    would also have a shape parameter below 1 if the density is finite but falls steeply away from the bound. The
    estimate is the maximum-likelihood exponent of a power law up to the farthest of these points (Hill 1975,
    *Annals of Statistics* 3, 1163–1174).
    """
    order = np.argsort(t)
    below = order[: np.searchsorted(np.cumsum(weight[order]), _NEAREST * weight.sum()) + 1]
    logs = np.log(np.maximum(t[below], _TINY))
    spread = float(weight[below] @ (logs[-1] - logs)) / float(weight[below].sum())
    return 1.0 / spread if spread > 0.0 else np.inf


def _fit_beta(t: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Fit a beta distribution to points t by maximum likelihood; return a and b, or NaN if they are extreme."""
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
    """Return y = Φ⁻¹(I_t(a, b)) and log dy/dt; both have the shape of t."""
    t = np.clip(t, _TINY, 1.0 - _EPS)
    below, above = betainc(a, b, t), betainc(b, a, 1.0 - t)
    log_tail = np.log(np.clip(np.minimum(below, above), _TINY, 0.5))
    y = np.where(below < above, 1.0, -1.0) * ndtri_exp(log_tail)
    log_p = (a - 1.0) * np.log(t) + (b - 1.0) * np.log1p(-t) - betaln(a, b)
    return y, log_p + 0.5 * y**2 + HALF_LOG_2PI
