"""Approximate draws from a Gaussian truncated at bounds, with their exact density."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import log_ndtr, ndtri_exp

from fmu.types import FloatArray

_LOG_ROOT_2PI = 0.5 * np.log(2.0 * np.pi)
_WITHOUT_EFFECT = 12.0  # standard deviations beyond which a limit cuts off less than 1e-32 of the mass
_FAR_OUT = 1e7  # standard deviations beyond which the log of a normal's mass is mostly rounding error


class SequentialNormal:
    """A distribution close to a truncated Gaussian, even if the Gaussian is centred far outside the bounds.

    With the covariance C = LLᵀ, u = mean + Lz. Each z_i in turn is drawn from a normal distribution with mean μ_i
    and variance 1, truncated where u_i would leave its bounds, given the previous z_j (Geweke, Hajivassiliou and
    Keane). The means μ are Botev's minimax tilting (2017, JRSS B 79, 125-148, section 2.2), which bounds the ratio
    of the Gaussian to the density q of the draws. They are 0 if there are no bounds, or if the tilting cannot be
    computed. For any μ, q(u) is known exactly.

    The most restricted coordinate comes first. Each following coordinate is the most restricted of the remaining
    ones, given the expected values of the previous coordinates (Gibson, Glasbey & Elston 1994; Genz & Bretz 2009,
    section 4.1.3). On the posterior of cantilever-young paired by shape, this order raises the effective sample
    size per draw from 0.29 to 0.97.

    Parameters
    ----------
    mean : ndarray, shape (ndim,)
    precision : ndarray, shape (ndim, ndim)
        Symmetric and positive definite.
    lower, upper : ndarray, shape (ndim,)
        Bounds; infinite where there is none.
    """

    def __init__(self, mean: FloatArray, precision: FloatArray, lower: FloatArray, upper: FloatArray) -> None:
        covariance = np.linalg.inv(precision)
        covariance = 0.5 * (covariance + covariance.T)
        is_free = bool(np.isinf(lower).all() and np.isinf(upper).all())
        if is_free:  # the order does not matter, and no tilting is needed
            self.order, expected = np.arange(len(mean)), np.zeros(len(mean))
        else:
            self.order, expected = _order_coordinates(mean, covariance, lower, upper)
        self.L = np.linalg.cholesky(covariance[np.ix_(self.order, self.order)])
        self.mean, self.lower, self.upper = mean[self.order], lower[self.order], upper[self.order]
        self._sd, self._before = np.diag(self.L), np.tril(self.L, -1)
        self._cut = (self.lower > -np.inf) | (self.upper < np.inf)
        self.tilt = expected if is_free else self._minimax(expected)

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Return `n` draws within the bounds, shape (n, ndim)."""
        z = np.zeros((n, len(self.mean)))
        for i, tilt in enumerate(self.tilt):
            a, b = self._limits(i, z)
            z[:, i] = tilt + _cut_normal(a - tilt, b - tilt, rng.uniform(size=n))
        u = np.empty_like(z)
        u[:, self.order] = np.clip(self.mean + z @ self.L.T, self.lower, self.upper)
        return u

    def log_density(self, u: FloatArray) -> FloatArray:
        """Return the log of the density q at points u (n, ndim) within the bounds, shape (n,)."""
        z = np.linalg.solve(self.L, (u[:, self.order] - self.mean).T).T
        log_q = -0.5 * np.sum((z - self.tilt) ** 2, axis=1)
        log_q -= np.sum(np.log(np.diag(self.L))) + len(self.mean) * _LOG_ROOT_2PI
        cut = self._cut
        if cut.any():
            # einsum adds in the same order for every batch size
            centre = self.mean[cut] + np.einsum("nj,ij->ni", z, self._before[cut])
            a, b = (((limit[cut] - centre) / self._sd[cut]) - self.tilt[cut] for limit in (self.lower, self.upper))
            matters = (a > -_WITHOUT_EFFECT) | (b < _WITHOUT_EFFECT)
            lost = np.zeros(a.shape)
            lost[matters] = log_mass(a[matters], b[matters])
            log_q -= np.sum(lost, axis=1)
        return np.asarray(log_q)

    def _limits(self, i: int, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper limits of z_i given the previous z_j, each of shape (n,); (1,) for i = 0."""
        if i == 0:  # the same in every row
            z = z[:1]
        # einsum adds in the same order for every batch size
        centre = self.mean[i] + np.einsum("nj,j->n", z[:, :i], self.L[i, :i])
        return (self.lower[i] - centre) / self.L[i, i], (self.upper[i] - centre) / self.L[i, i]

    def _minimax(self, start: FloatArray) -> FloatArray:
        """Return the minimax tilting μ, shape (ndim,), found as a saddle point, or zeros if the search fails."""
        from scipy.optimize import root

        n = len(start)
        unit = self.L / np.diag(self.L)[:, None]
        lower, upper = ((limit - self.mean) / np.diag(self.L) for limit in (self.lower, self.upper))

        def tilt_coordinates(z: FloatArray) -> tuple[FloatArray, FloatArray]:
            """Return the μ that makes the objective stationary in z, and the truncated normals' means minus μ.

            Both have shape (ndim,).
            """
            before = unit @ z - z
            a, b = lower - before, upper - before
            tilt, excess = np.zeros(n), np.zeros(n)
            for i in range(n - 1, -1, -1):
                tilt[i] = excess[i + 1 :] @ unit[i + 1 :, i]
                excess[i] = _mean_of_cut_normal(a[i] - tilt[i], b[i] - tilt[i])
            return tilt, excess

        found = root(lambda z: z - np.sum(tilt_coordinates(z), axis=0), start, method="hybr")
        return tilt_coordinates(found.x)[0] if found.success else np.zeros(n)


def _order_coordinates(
    mean: FloatArray, covariance: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[np.ndarray, FloatArray]:
    """Return the order of the coordinates, and each one's expected z given the previous ones, both (ndim,)."""
    left, order, z = list(range(len(mean))), [], np.zeros(len(mean))
    # m and C are conditional on the coordinates taken so far, at expected values: a pivoted Cholesky factorisation
    m, C = mean.copy(), covariance.copy()
    for k in range(len(mean)):
        sd = np.sqrt(np.maximum(np.diag(C)[left], np.finfo(float).tiny))
        a, b = (lower[left] - m[left]) / sd, (upper[left] - m[left]) / sd
        at = int(np.argmin(log_mass(a, b)))
        z[k] = _mean_of_cut_normal(a[at], b[at])
        i = left.pop(at)
        order.append(i)
        column = C[:, i] / sd[at]
        m = m + column * z[k]
        C = C - np.outer(column, column)
    return np.array(order), z


def _mean_of_cut_normal(a: float, b: float) -> float:
    """Return the mean of a standard normal truncated to [a, b], or NaN if it has no mass there.

    The mean is (φ(a) − φ(b))/(Φ(b) − Φ(a)). Far out in a tail, the limit with the higher density approximates it.
    """
    low, high = (-b, -a) if a > 0 else (a, b)
    if -math.inf < high < -_FAR_OUT:
        return a if a > 0 else b
    upper = log_ndtr(high)
    below = math.exp(log_ndtr(low) - upper)
    if not below < 1.0:
        return math.nan
    mass = upper + math.log1p(-below) + _LOG_ROOT_2PI
    return math.exp(-0.5 * a * a - mass) - math.exp(-0.5 * b * b - mass)


def log_mass(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return log(Φ(b) − Φ(a)), the log of a standard normal's mass in [a, b], elementwise.

    The result is accurate even in the tails, where the difference would cancel. It is -inf or NaN where the mass
    vanishes in floating-point arithmetic.
    """
    flip = np.asarray(a) > 0
    a, b = np.where(flip, -np.asarray(b), a), np.where(flip, -np.asarray(a), b)
    # the limits may be so close together, or so far out, that there is no mass between them
    with np.errstate(divide="ignore", invalid="ignore"):
        upper = log_ndtr(b)
        return upper + np.log1p(-np.exp(log_ndtr(a) - upper))


def _cut_normal(a: FloatArray, b: FloatArray, p: FloatArray) -> FloatArray:
    """Return quantiles of the standard normal truncated to [a, b], at probabilities `p`, elementwise."""
    flip = a > 0
    low, high = np.where(flip, -b, a), np.where(flip, -a, b)
    with np.errstate(divide="ignore"):
        z = ndtri_exp(np.logaddexp(log_ndtr(low) + np.log1p(-p), log_ndtr(high) + np.log(p)))
    return np.clip(np.where(flip, -z, z), a, b)
