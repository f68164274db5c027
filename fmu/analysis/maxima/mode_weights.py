"""Compute the posterior mass around each local maximum."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from fmu.analysis.maxima.kinds import are_negligible
from fmu.progress.phases import by_parts
from fmu.samplers.mixture.importance import draw_mixture
from fmu.samplers.mixture.quadratic import Quadratic
from fmu.types import FloatArray

DRAWS = 512
TEMPERATURES = (1.0, 4.0)
IMPROBABLE = 25.0
"""Nats below the largest mass at which a Laplace approximation suffices."""


@dataclass(frozen=True)
class ModeWeight:
    """The posterior mass around a maximum, with its mean and covariance.

    Attributes
    ----------
    log_mass : float
        Logarithm of ∫ P du over the part of the posterior that belongs to the maximum.
    mean, covariance : ndarray, shape (ndim,) and (ndim, ndim)
        Moments of this part.
    effective : float
        ESS of the estimate; 0 for the Laplace approximation, which evaluates no densities.
    evidence_covariance : float
        Covariance of the errors of `log_mass` and of the logarithm of the total mass; see `_covariance`. The sum
        over all maxima, weighted by their shares of the mass, is the variance of the latter. It is 0 for the
        Laplace approximation.
    log_reach : float
        Logarithm of the mass that the maximum's quadratic model covers. It equals `log_mass` unless other models
        divide the draws (argument `basins` of `mode_weights`).
    """

    log_mass: float
    mean: FloatArray
    covariance: FloatArray
    effective: float
    evidence_covariance: float
    log_reach: float


def mode_weights(
    log_prob: Callable[[FloatArray], FloatArray],
    maxima: Sequence[Quadratic],
    lower: FloatArray,
    upper: FloatArray,
    rng: np.random.Generator,
    draws: int = DRAWS,
    basins: Sequence[Quadratic] | None = None,
) -> tuple[ModeWeight, ...]:
    """Estimate the posterior mass around each maximum.

    The first estimate is the Laplace approximation within the bounds, ∫ exp(m) du, where m is the quadratic model.
    It is final for maxima with less than e⁻²⁵ of the largest mass, except the highest one, and for maxima without
    a draw of finite weight. A maximum so low that no width can compensate for it has no mass (`log_mass` is −inf).
    The other masses come from importance sampling of P, with `draws` draws from each maximum's Gaussian and as
    many from a Gaussian of twice its width. All draws are weighted by the density of their mixture, and divided
    among the maxima in proportion to exp(m).

    Parameters
    ----------
    log_prob : callable
        Maps (n, ndim) to (n,), in the coordinates of the maxima, which must be of order one.
    maxima : sequence of Quadratic
    lower, upper : ndarray, shape (ndim,)
    rng : Generator
    draws : int
    basins : sequence of Quadratic, optional
        Models that divide the draws among the maxima; the models of `maxima` are then only proposals
        (`fmu.analysis.maxima.kinds.basin`).

    Returns
    -------
    tuple of ModeWeight
    """
    found = [_laplace(m, lower, upper, rng, draws) for m in maxima]
    # where an ascent ended on a slope far from all mass, the quadratic model may be infinite
    is_low = are_negligible(np.array([m.log_prob for m in maxima]), len(lower))
    found = [
        replace(mass, log_mass=-np.inf, log_reach=-np.inf) if low else mass
        for mass, low in zip(found, is_low, strict=True)
    ]
    best, highest = max(mass.log_mass for mass in found), int(np.argmax([m.log_prob for m in maxima]))
    chosen = [i for i, mass in enumerate(found) if mass.log_mass > best - IMPROBABLE or i == highest]
    u, log_w = _importance(log_prob, [maxima[i] for i in chosen], lower, upper, rng, draws)
    reached = _divide_draws(u, log_w, [maxima[i] for i in chosen], draws)
    masses = reached if basins is None else _divide_draws(u, log_w, [basins[i] for i in chosen], draws)
    for i, mass, reach in zip(chosen, masses, reached, strict=True):
        if mass is not None:
            found[i] = replace(mass, log_reach=mass.log_mass if reach is None else reach.log_mass)
    return tuple(found)


def _laplace(
    maximum: Quadratic, lower: FloatArray, upper: FloatArray, rng: np.random.Generator, draws: int
) -> ModeWeight:
    """Return the mass and moments of exp(m) within the bounds, where m is the quadratic model."""
    proposal = maximum.proposal(lower, upper, 1.0)
    u = proposal.draw(rng, draws)
    mass = _weigh_draws(u, maximum(u) - proposal.log_density(u))
    return replace(mass, effective=0.0)


def log_shares(maxima: Sequence[Quadratic], u: FloatArray) -> FloatArray:
    """Return log(exp(m_k)/Σ exp(m)) at points u (n, ndim), shape (maxima, n), where m_k is quadratic model k."""
    model = np.stack([m(u) for m in maxima])
    return np.asarray(model - logsumexp(model, axis=0))


def _importance(
    log_prob: Callable[[FloatArray], FloatArray],
    maxima: Sequence[Quadratic],
    lower: FloatArray,
    upper: FloatArray,
    rng: np.random.Generator,
    draws: int,
) -> tuple[FloatArray, FloatArray]:
    """Return draws around the maxima, (n, ndim), and their log importance weights for P, (n,)."""
    proposals = [m.proposal(lower, upper, t) for m in maxima for t in TEMPERATURES]
    u, log_q = draw_mixture(proposals, [draws] * len(proposals), rng)
    return u, np.concatenate(by_parts("importance sampling", log_prob, u)) - log_q


def _divide_draws(
    u: FloatArray, log_w: FloatArray, maxima: Sequence[Quadratic], draws: int
) -> list[ModeWeight | None]:
    """Return the mass and moments of P around each maximum, or None for one without a draw of finite weight."""
    belonging = log_w + log_shares(maxima, u)
    return [
        replace(_weigh_draws(u, own), evidence_covariance=_covariance(own, log_w, draws))
        if np.any(np.isfinite(own))
        else None
        for own in belonging
    ]


def _covariance(log_v: FloatArray, log_w: FloatArray, draws: int) -> float:
    """Return the covariance of the errors of log Σ v and log Σ w for importance weights v and w of the same draws.

    The draws are independent, and each proposal made a fixed number of `draws` in succession (stratified
    sampling). With weights scaled to the sum 1, the covariance is Σ v (w − w̄), where w̄ is the mean over the draws
    of the same proposal.
    """
    v, w = (np.exp(x - logsumexp(x)).reshape(-1, draws) for x in (log_v, log_w))
    return float(np.sum(v * (w - w.mean(axis=1, keepdims=True))))


def _weigh_draws(u: FloatArray, log_w: FloatArray) -> ModeWeight:
    """Return the mean importance weight as the mass, with the weighted mean and covariance of u (n, ndim)."""
    log_sum = float(logsumexp(log_w))
    w = np.exp(log_w - log_sum)
    mean = w @ u
    d = u - mean
    log_mass = log_sum - float(np.log(len(u)))
    return ModeWeight(
        log_mass=log_mass,
        mean=mean,
        covariance=(w * d.T) @ d,
        effective=float(1.0 / np.sum(w**2)),
        evidence_covariance=0.0,
        log_reach=log_mass,
    )
