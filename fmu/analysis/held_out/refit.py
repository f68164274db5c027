"""The posterior without a mode by importance sampling, and how probable the mode's measurement is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import logsumexp

from fmu.analysis.maxima.mode_weights import (
    TEMPERATURES,
    LocalQuadratic,
    SequentialNormal,
    log_shares,
    mixture_draws,
)
from fmu.analysis.maxima.search import hessian_at
from fmu.posterior.maxima import local_maxima
from fmu.posterior.scaled import ScaledDensity
from fmu.progress.phases import by_parts
from fmu.types import FloatArray

if TYPE_CHECKING:
    from fmu.posterior.problem import UpdatingProblem

ERROR = 0.03
"""Wanted standard error of a log-density."""
GOOD_K = 0.7
"""Importance weights with a Pareto k above this have no reliable mean (Vehtari et al. 2024, JMLR 25, 72)."""
SOLVES = 12_000
"""What leaving a mode out takes as a rule, in solves."""
_STARTS = 32
_HOPELESS = 30.0
_MOST_MAXIMA = 8
_PILOT = 512
_FITS = 2
_WIDER = (1.0, 2.0)
_FLATTER = 4.0
_FIRST, _MOST = 512, 16_384
_EFFECTIVE = 400.0


@dataclass(frozen=True, eq=False)
class LeftOut:
    """The posterior without a mode, and how probable its measurement is there.

    Attributes
    ----------
    theta : ndarray, shape (n, ndim)
        Draws, SI units.
    hz : ndarray, shape (n, n_modes)
        The model's frequencies there.
    log_weight : ndarray, shape (n,)
        Logarithms of weights that sum to 1 and make the draws those of the posterior without the mode.
    elpd, error : float
        log p(y_k | y_-k) in nats, and its standard error.
    pareto_k : float
        Shape of the tail of the weights, the larger of those without and with the mode.
    """

    theta: FloatArray
    hz: FloatArray
    log_weight: FloatArray
    elpd: float
    error: float
    pareto_k: float

    @property
    def is_good(self) -> bool:
        """Whether the weights can be relied on."""
        return bool(self.pareto_k <= GOOD_K and self.error <= 2.0 * ERROR)

    @property
    def is_enough(self) -> bool:
        """Whether there are draws enough."""
        effective = np.exp(-logsumexp(2.0 * self.log_weight))  # Kish's number
        return bool(self.error <= ERROR and effective >= _EFFECTIVE)


def quadratics(problem: UpdatingProblem, near: FloatArray, rng: np.random.Generator) -> list[LocalQuadratic]:
    """Return quadratics close to the log-probability around each maximum that may matter.

    Each has the curvature of its maximum first, and is then fitted by least squares to the log-probability of
    draws, twice: where the posterior is skewed, that is far closer.

    Parameters
    ----------
    problem : UpdatingProblem
    near : ndarray, shape (n, ndim)
        Points to climb from besides others, such as draws from a posterior with other modes, SI units.
    rng : Generator
    """
    scaled = ScaledDensity(problem)
    models, temperatures = _around_maxima(problem, scaled, near), TEMPERATURES
    u, log_p = np.empty((0, problem.ndim)), np.empty(0)
    for _ in range(_FITS):
        more, _ = mixture_draws(_proposals(models, scaled, temperatures), rng, _PILOT)
        u = np.concatenate([u, more])
        log_p = np.concatenate([log_p, *by_parts("importance sampling", scaled.log_prob, more)])
        models, temperatures = _fitted(models, u, log_p), _WIDER
    return models


def left_out(
    without: UpdatingProblem,
    whole: UpdatingProblem,
    models: Sequence[LocalQuadratic],
    rng: np.random.Generator,
) -> LeftOut:
    """Compare the posterior without a mode with the one that has it, by importance sampling.

    log p(y_k | y_-k) = log Z - log Z_-k. Both evidences come from the same draws, from the mixture of the
    Gaussians around the maxima of both posteriors and of wider ones. Where the two hardly overlap, the measurement
    lies far out in the tail of its prediction, which draws of the posterior without the mode alone do not reach.
    The number of draws is doubled until the standard error is `ERROR`, up to 16 384 from each Gaussian.

    Parameters
    ----------
    without, whole : UpdatingProblem
        One problem, updated without the mode and with it (`UpdatingProblem.using`).
    models : sequence of LocalQuadratic
        The `quadratics` of both.
    rng : Generator
    """
    scaled = ScaledDensity(whole)
    proposals = _proposals(models, scaled, _WIDER)

    def evaluated(u: FloatArray) -> FloatArray:
        return _both(without, whole, scaled.to_theta(u))

    u, log_q = mixture_draws(proposals, rng, _FIRST)
    values = np.concatenate(by_parts("importance sampling", evaluated, u))
    while True:
        found = _compared(scaled.to_theta(u), values, log_q)
        each = len(u) // len(proposals)
        if found.is_enough or each >= _MOST:
            return found
        more, more_q = mixture_draws(proposals, rng, each)
        u, log_q = np.concatenate([u, more]), np.concatenate([log_q, more_q])
        values = np.concatenate([values, *by_parts("importance sampling", evaluated, more)])


def _both(without: UpdatingProblem, whole: UpdatingProblem, theta: FloatArray) -> FloatArray:
    """Return both log-probabilities and the frequencies, shape (n, 2 + n_modes)."""
    likelihoods: list[Any] = [without.likelihood, whole.likelihood]
    if whole.model.is_soft:
        log_p = [problem.log_likelihood(theta) for problem in (without, whole)]
        hz = whole.frequencies(theta)
    else:
        seen = likelihoods[1].observed(theta)
        log_p = [likelihood.terms_of_observed(seen, theta).sum(axis=1) for likelihood in likelihoods]
        hz = seen.frequencies
    found = np.stack(log_p, axis=1) + np.asarray(whole.log_prior(theta))[:, None]
    return np.concatenate([np.where(np.isfinite(found), found, -np.inf), hz], axis=1)


def _compared(theta: FloatArray, values: FloatArray, log_q: FloatArray) -> LeftOut:
    log_w = values[:, :2].T - log_q
    total = logsumexp(log_w, axis=1)
    w = np.exp(log_w - total[:, None])
    return LeftOut(
        theta=theta,
        hz=values[:, 2:],
        log_weight=log_w[0] - total[0],
        elpd=float(total[1] - total[0]),
        error=float(np.sqrt(np.sum((w[1] - w[0]) ** 2))),
        pareto_k=max(pareto_k(one) for one in log_w),
    )


def _around_maxima(problem: UpdatingProblem, scaled: ScaledDensity, near: FloatArray) -> list[LocalQuadratic]:
    """Return the quadratics at the maxima that may hold some of the probability, by the curvature there."""
    maxima = local_maxima(problem, _STARTS, near=near)
    found = []
    for m in [m for m in maxima if m.log_prob > maxima[0].log_prob - _HOPELESS][:_MOST_MAXIMA]:
        gradient = np.asarray(problem.log_prob_and_grad(m.theta)[1]) * problem.scale
        hessian = hessian_at(problem, m.theta)[0]
        found.append(LocalQuadratic(scaled.to_scaled(m.theta), m.log_prob, gradient, hessian))
    return found


def _proposals(
    models: Sequence[LocalQuadratic], scaled: ScaledDensity, temperatures: Sequence[float]
) -> list[SequentialNormal]:
    return [model.proposal(scaled.lower, scaled.upper, t) for model in models for t in temperatures]


def _fitted(models: Sequence[LocalQuadratic], u: FloatArray, log_p: FloatArray) -> list[LocalQuadratic]:
    """Return each quadratic fitted to the draws around it; as it was where they are too few.

    The weights P^(1/4) count the flanks as well, from which most of the draws are.
    """
    weight = np.exp((log_p - log_p.max()) / _FLATTER)
    fitted = []
    for model, share in zip(models, np.exp(log_shares(models, u)), strict=True):
        own, n = weight * share, u.shape[1]
        is_enough = own.sum() ** 2 > (n + 1) * (n + 2) * np.sum(own**2)  # twice the number of coefficients
        fitted.append(LocalQuadratic.fitted(u, log_p, own) if is_enough else model)
    return fitted


def pareto_k(log_w: FloatArray) -> float:
    """Return the shape of the tail of importance weights, from their logarithms (n,)."""
    from arviz_stats.base.array import array_stats

    return float(array_stats.psislw(-log_w)[1])
