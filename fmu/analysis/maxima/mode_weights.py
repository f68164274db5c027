"""How much of a posterior's mass belongs to each of its local maxima."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.special import log_ndtr, logsumexp, ndtri_exp

from fmu.progress.phases import by_parts
from fmu.types import FloatArray

DRAWS = 512
TEMPERATURES = (1.0, 4.0)
_FLATTEST = 1e-2
_HOPELESS = 40.0


@dataclass(frozen=True, eq=False)
class LocalQuadratic:
    """log P around a local maximum u*, to second order: m(u) = log_prob + g·d − dᵀHd/2 with d = u − u*.

    Where bounds are active, g does not vanish: the density falls off exponentially from the wall.

    Attributes
    ----------
    position, gradient : ndarray, shape (ndim,)
        u*, and g = ∇ log P there.
    log_prob : float
    hessian : ndarray, shape (ndim, ndim)
        H = −∇² log P or an approximation, positive semidefinite.
    """

    position: FloatArray
    log_prob: float
    gradient: FloatArray
    hessian: FloatArray

    @classmethod
    def fitted(cls, u: FloatArray, log_p: FloatArray, weight: FloatArray) -> LocalQuadratic:
        """Return the quadratic that fits log P best, by weighted least squares over points u (n, ndim).

        It is expanded at the weighted mean of the points.
        """
        centre = weight @ u / weight.sum()
        d = u - centre
        n = d.shape[1]
        i, j = np.triu_indices(n)
        columns = np.column_stack([np.ones(len(d)), d, d[:, i] * d[:, j]])
        root = np.sqrt(weight)
        found = np.linalg.lstsq(columns * root[:, None], log_p * root, rcond=None)[0]
        hessian = np.zeros((n, n))
        hessian[i, j] = -found[n + 1 :]
        return cls(centre, float(found[0]), found[1 : n + 1], hessian + hessian.T)

    def drop(self, u: FloatArray) -> FloatArray:
        """Return by how much m falls from u* to the points u (n, ndim), shape (n,)."""
        d = u - self.position
        return 0.5 * np.einsum("ni,ij,nj->n", d, self.hessian, d) - d @ self.gradient

    def proposal(self, lower: FloatArray, upper: FloatArray, temperature: float) -> SequentialNormal:
        """Return the Gaussian ∝ exp(m/temperature), cut off by the box."""
        precision = self.precision
        centre = self.position + np.linalg.solve(precision, self.gradient)
        return SequentialNormal(centre, precision / temperature, lower, upper, self.position)

    @property
    def precision(self) -> FloatArray:
        """H, made positive definite: its eigenvalues are at least 0.01 in these coordinates of order one."""
        values, vectors = np.linalg.eigh(self.hessian)
        return (vectors * np.maximum(values, _FLATTEST)) @ vectors.T


@dataclass(frozen=True)
class ModeWeight:
    """The share of a maximum in the posterior.

    Attributes
    ----------
    log_mass : float
        Logarithm of ∫ P du over what belongs to the maximum.
    mean, covariance : ndarray, shape (ndim,) and (ndim, ndim)
        Moments of the posterior there.
    effective : float
        Effective sample size of the estimate; 0 for the Laplace approximation, which evaluates nothing.
    """

    log_mass: float
    mean: FloatArray
    covariance: FloatArray
    effective: float


def mode_weights(
    log_prob: Callable[[FloatArray], FloatArray],
    maxima: Sequence[LocalQuadratic],
    lower: FloatArray,
    upper: FloatArray,
    rng: np.random.Generator,
    draws: int = DRAWS,
) -> tuple[ModeWeight, ...]:
    """Estimate the mass of every maximum.

    First the Laplace approximation within the box, ∫ exp(m) du. It is final for maxima with less than e⁻⁴⁰ of
    the largest mass. The others are found by importance sampling of P itself: `draws` from the Gaussian of each
    maximum and as many from one of twice its width, all weighted by their mixture (Owen & Zhou 2000, JASA 95,
    135-143), and divided among the maxima in proportion to exp(m).

    Parameters
    ----------
    log_prob : callable
        Maps (n, ndim) to (n,), in the coordinates of the maxima, which must be of order one.
    maxima : sequence of LocalQuadratic
    lower, upper : ndarray, shape (ndim,)
    rng : Generator
    draws : int

    Returns
    -------
    tuple of ModeWeight
    """
    found = [_laplace(m, lower, upper, rng, draws) for m in maxima]
    best = max(mass.log_mass for mass in found)
    chosen = [i for i, mass in enumerate(found) if mass.log_mass > best - _HOPELESS]
    weighed = _importance(log_prob, [maxima[i] for i in chosen], lower, upper, rng, draws)
    for i, mass in zip(chosen, weighed, strict=True):
        if mass is not None:
            found[i] = mass
    return tuple(found)


def _laplace(
    maximum: LocalQuadratic, lower: FloatArray, upper: FloatArray, rng: np.random.Generator, draws: int
) -> ModeWeight:
    """Return mass and moments of exp(m) in the box."""
    proposal = maximum.proposal(lower, upper, 1.0)
    u = proposal.draw(rng, draws)
    return _weighted(u, maximum.log_prob - maximum.drop(u) - proposal.log_density(u), 0.0)


class Proposal(Protocol):
    """A density that can be drawn from."""

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Return `n` draws, shape (n, ndim)."""
        ...

    def log_density(self, u: FloatArray) -> FloatArray:
        """Return its logarithm at points u (n, ndim), shape (n,)."""
        ...


def mixture_draws(
    proposals: Sequence[Proposal], rng: np.random.Generator, draws: int
) -> tuple[FloatArray, FloatArray]:
    """Return `draws` of each proposal, (n, ndim), and the log-density of their mixture there, (n,)."""
    u = np.concatenate([proposal.draw(rng, draws) for proposal in proposals])
    log_q = logsumexp([proposal.log_density(u) for proposal in proposals], axis=0) - np.log(len(proposals))
    return u, log_q


def log_shares(maxima: Sequence[LocalQuadratic], u: FloatArray) -> FloatArray:
    """Return the logarithm of the share of each maximum in Σ exp(m) at points u (n, ndim), shape (maxima, n)."""
    model = np.stack([m.log_prob - m.drop(u) for m in maxima])
    return np.asarray(model - logsumexp(model, axis=0))


def _importance(
    log_prob: Callable[[FloatArray], FloatArray],
    maxima: Sequence[LocalQuadratic],
    lower: FloatArray,
    upper: FloatArray,
    rng: np.random.Generator,
    draws: int,
) -> list[ModeWeight | None]:
    """Return mass and moments of P around each maximum; None if no draw has a finite log-probability."""
    proposals = [m.proposal(lower, upper, t) for m in maxima for t in TEMPERATURES]
    u, log_q = mixture_draws(proposals, rng, draws)
    log_w = np.concatenate(by_parts("importance sampling", log_prob, u)) - log_q
    belongs = log_shares(maxima, u)
    return [_weighted(u, log_w + part, None) if np.any(np.isfinite(log_w + part)) else None for part in belongs]


def _weighted(u: FloatArray, log_w: FloatArray, effective: float | None) -> ModeWeight:
    """Return the mean of the weights and the weighted moments of the draws (n, ndim)."""
    log_sum = float(logsumexp(log_w))
    w = np.exp(log_w - log_sum)
    mean = w @ u
    d = u - mean
    return ModeWeight(
        log_mass=log_sum - float(np.log(len(u))),
        mean=mean,
        covariance=(w * d.T) @ d,
        effective=float(1.0 / np.sum(w**2)) if effective is None else effective,
    )


_LOG_ROOT_2PI = 0.5 * np.log(2.0 * np.pi)


class SequentialNormal:
    """A proposal for a Gaussian truncated to a box, close to it even if its centre lies far outside the box.

    With the covariance C = LLᵀ, u = mean + Lz. Each z_i in turn is drawn from a normal of mean μ_i and variance 1,
    truncated where u_i leaves the box given those before (Geweke, Hajivassiliou and Keane). The means μ are the
    minimax tilting of Botev (2017, JRSS B 79, 125-148, section 2.2), which bounds the ratio of the Gaussian to q.
    The density q(u) of the draws is known for any μ.

    Parameters
    ----------
    mean : ndarray, shape (ndim,)
    precision : ndarray, shape (ndim, ndim)
        Symmetric and positive definite.
    lower, upper : ndarray, shape (ndim,)
        The box; infinite where there is no bound.
    densest : ndarray, shape (ndim,)
        The point of the box with the highest density: the search for μ begins there.
    """

    def __init__(
        self, mean: FloatArray, precision: FloatArray, lower: FloatArray, upper: FloatArray, densest: FloatArray
    ) -> None:
        covariance = np.linalg.inv(precision)
        sd = np.sqrt(np.diag(covariance))
        # the coordinate that the bounds restrict most comes first, so that the others are conditional on it
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
        """Return the tilting μ at the saddle point; zero if the search fails."""
        from scipy.optimize import root

        def tilted(z: FloatArray) -> tuple[FloatArray, FloatArray]:
            """Return μ that makes z stationary, and the mean of each truncated normal relative to its μ."""
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
    """Return the mean of the standard normal truncated to [a, b], (φ(a) − φ(b))/(Φ(b) − Φ(a))."""
    mass = log_mass(np.array(a), np.array(b))
    return float(np.exp(-0.5 * a**2 - _LOG_ROOT_2PI - mass) - np.exp(-0.5 * b**2 - _LOG_ROOT_2PI - mass))


def log_mass(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return log(Φ(b) − Φ(a)) without cancellation in either tail."""
    flip = np.asarray(a) > 0
    a, b = np.where(flip, -np.asarray(b), a), np.where(flip, -np.asarray(a), b)
    with np.errstate(
        divide="ignore", invalid="ignore"
    ):  # the limits may be so close, or so far out, that no mass is left between them
        return log_ndtr(b) + np.log1p(-np.exp(log_ndtr(a) - log_ndtr(b)))


def _cut_normal(a: FloatArray, b: FloatArray, p: FloatArray) -> FloatArray:
    """Return the quantiles `p` of the standard normal truncated to [a, b]."""
    flip = a > 0
    low, high = np.where(flip, -b, a), np.where(flip, -a, b)
    with np.errstate(divide="ignore"):
        z = ndtri_exp(np.logaddexp(log_ndtr(low) + np.log1p(-p), log_ndtr(high) + np.log(p)))
    return np.clip(np.where(flip, -z, z), a, b)
