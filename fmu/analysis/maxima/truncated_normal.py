"""A Gaussian cut off by a box, drawn coordinate after coordinate, however far out the box lies."""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr, ndtri_exp

from fmu.types import FloatArray

_LOG_ROOT_2PI = 0.5 * np.log(2.0 * np.pi)


class SequentialNormal:
    """A proposal for a Gaussian within a box, close to it even where the Gaussian's centre lies far outside.

    With the covariance C = LLᵀ, u = mean + Lz. Each z_i in turn is drawn from a normal of mean μ_i and variance 1,
    cut off where u_i leaves the box given those before (Geweke, Hajivassiliou and Keane). The means μ are the
    minimax tilting of Botev (2017, JRSS B 79, 125-148, section 2.2), which bounds the ratio of the Gaussian to q.
    The draws' density q(u) is known whatever μ is.

    Parameters
    ----------
    mean : ndarray, shape (ndim,)
    precision : ndarray, shape (ndim, ndim)
        Symmetric and positive definite.
    lower, upper : ndarray, shape (ndim,)
        The box; infinite where there is no wall.
    densest : ndarray, shape (ndim,)
        Where in the box the Gaussian is densest: the search for μ begins there.
    """

    def __init__(
        self, mean: FloatArray, precision: FloatArray, lower: FloatArray, upper: FloatArray, densest: FloatArray
    ) -> None:
        covariance = np.linalg.inv(precision)
        sd = np.sqrt(np.diag(covariance))
        # the coordinate that the walls leave least room comes first, for then the others follow it
        self.order = np.argsort(log_mass((lower - mean) / sd, (upper - mean) / sd))
        self.L = np.linalg.cholesky(covariance[np.ix_(self.order, self.order)])
        self.mean, self.lower, self.upper = mean[self.order], lower[self.order], upper[self.order]
        self.tilt = self._minimax(np.linalg.solve(self.L, densest[self.order] - self.mean))

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Return `n` draws within the box, shape (n, ndim)."""
        z = np.zeros((n, len(self.mean)))
        for i, tilt in enumerate(self.tilt):
            a, b = self._limits(i, z)
            z[:, i] = tilt + _cut_normal(a - tilt, b - tilt, rng.uniform(size=n))
        u = np.empty_like(z)
        u[:, self.order] = np.clip(self.mean + z @ self.L.T, self.lower, self.upper)
        return u

    def log_density(self, u: FloatArray) -> FloatArray:
        """Return log q at points u (n, ndim) of the box, shape (n,)."""
        z = np.linalg.solve(self.L, (u[:, self.order] - self.mean).T).T
        log_q = np.full(len(u), -np.sum(np.log(np.diag(self.L))) - len(self.mean) * _LOG_ROOT_2PI)
        for i, tilt in enumerate(self.tilt):
            a, b = self._limits(i, z)
            log_q -= 0.5 * (z[:, i] - tilt) ** 2 + log_mass(a - tilt, b - tilt)
        return log_q

    def _limits(self, i: int, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return where z_i leaves the box, given the z before it; each of shape (n,)."""
        centre = self.mean[i] + z[:, :i] @ self.L[i, :i]
        return (self.lower[i] - centre) / self.L[i, i], (self.upper[i] - centre) / self.L[i, i]

    def _minimax(self, start: FloatArray) -> FloatArray:
        """Return the tilting μ: the saddle point's, or none if the search fails."""
        from scipy.optimize import root

        def tilted(z: FloatArray) -> tuple[FloatArray, FloatArray]:
            """Return μ that makes z stationary, and the mean of each cut normal relative to its μ."""
            tilt, excess = np.zeros(n), np.zeros(n)
            for i in range(n - 1, -1, -1):
                tilt[i] = np.sum(excess[i + 1 :] * self.L[i + 1 :, i] / np.diag(self.L)[i + 1 :])
                a, b = self._limits(i, z[None])
                excess[i] = _mean_of_cut_normal(a[0] - tilt[i], b[0] - tilt[i])
            return tilt, excess

        n = len(start)
        found = root(lambda z: z - np.sum(tilted(z), axis=0), start, method="hybr")
        return tilted(found.x)[0] if found.success else np.zeros(n)


def _mean_of_cut_normal(a: float, b: float) -> float:
    """Return the mean of the standard normal cut off at a and b, (φ(a) − φ(b))/(Φ(b) − Φ(a))."""
    mass = log_mass(np.array(a), np.array(b))
    return float(np.exp(-0.5 * a**2 - _LOG_ROOT_2PI - mass) - np.exp(-0.5 * b**2 - _LOG_ROOT_2PI - mass))


def log_mass(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return log(Φ(b) − Φ(a)) without cancellation in either tail."""
    flip = np.asarray(a) > 0
    a, b = np.where(flip, -np.asarray(b), a), np.where(flip, -np.asarray(a), b)
    with np.errstate(divide="ignore", invalid="ignore"):  # limits so close or far out that nothing is left between
        return log_ndtr(b) + np.log1p(-np.exp(log_ndtr(a) - log_ndtr(b)))


def _cut_normal(a: FloatArray, b: FloatArray, p: FloatArray) -> FloatArray:
    """Return the quantiles `p` of the standard normal cut off at a and b."""
    flip = a > 0
    low, high = np.where(flip, -b, a), np.where(flip, -a, b)
    with np.errstate(divide="ignore"):
        z = ndtri_exp(np.logaddexp(log_ndtr(low) + np.log1p(-p), log_ndtr(high) + np.log(p)))
    return np.clip(np.where(flip, -z, z), a, b)
