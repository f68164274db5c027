"""How much of a posterior's mass belongs to each of its local maxima."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from fmu.analysis.maxima.truncated_normal import SequentialNormal
from fmu.progress.phases import by_parts
from fmu.types import FloatArray

DRAWS = 512
_TEMPERATURES = (1.0, 4.0)
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
        """H, made positive definite where nothing determines a direction of these coordinates of order one."""
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
        How many independent draws the estimate is worth; 0 for the Laplace approximation, without evaluations.
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

    First the Laplace approximation within the box, ∫ exp(m) du, which is the last word on maxima of less than e⁻⁴⁰
    of the greatest mass. For the others importance sampling of P itself: `draws` from each of their Gaussians and
    as many from another of twice its width, all weighted by the mixture of them (Owen & Zhou 2000, JASA 95,
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


def _importance(
    log_prob: Callable[[FloatArray], FloatArray],
    maxima: Sequence[LocalQuadratic],
    lower: FloatArray,
    upper: FloatArray,
    rng: np.random.Generator,
    draws: int,
) -> list[ModeWeight | None]:
    """Return mass and moments of P around each maximum; None where no draw has a probability."""
    proposals = [m.proposal(lower, upper, t) for m in maxima for t in _TEMPERATURES]
    u = np.concatenate([proposal.draw(rng, draws) for proposal in proposals])
    log_q = logsumexp([proposal.log_density(u) for proposal in proposals], axis=0) - np.log(len(proposals))
    log_w = np.concatenate(by_parts("importance sampling", log_prob, u)) - log_q
    model = np.stack([m.log_prob - m.drop(u) for m in maxima])
    belongs = model - logsumexp(model, axis=0)
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
