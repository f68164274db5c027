"""Leave-one-out posteriors by importance sampling, and the predictive density of the left-out measurement.

A mode's elpd is the log-density of its measurement given the other modes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import logsumexp

from fmu.analysis.convergence.pareto import GOOD_K, pareto_k
from fmu.analysis.held_out.candidates import (
    PriorCandidates,
    fitted_to_draws,
    gaussians,
    gaussians_of_groups,
    quadratics_at_maxima,
)
from fmu.analysis.maxima.mode_weights import TEMPERATURES
from fmu.posterior.scaled import ScaledDensity
from fmu.progress.phases import by_parts
from fmu.samplers.hmc import HamiltonianMonteCarlo
from fmu.samplers.loop.run import Run
from fmu.samplers.metropolis import MetropolisHastings
from fmu.samplers.mixture.importance import Proposal, draw_mixture, effective_size, resample
from fmu.samplers.mixture.quadratic import Quadratic
from fmu.types import FloatArray

if TYPE_CHECKING:
    from fmu.posterior.problem import UpdatingProblem

ERROR, ACCEPTED = 0.02, 0.05
"""Target standard error of a log-density, and its largest accepted value."""
SOLVES, MOST_SOLVES = 12_000, 120_000
"""Usual minimum and maximum number of solves to leave out a mode."""
_PILOT = 512
_FITS = 2
WIDER = (1.0, 2.0)
_FIRST, _FIRST_IN_ALL = 128, 2560
"""Draws from each proposal, and smallest total number of draws, before the error is first estimated."""
_FAIR, _TELLING = 10_000, 3000
"""Number of draws after which an acceptable error is not reduced further, and number after which one can predict
whether more draws would suffice."""
_LEAST = 6000
"""Smallest number of remaining solves for another round."""
_ROUNDS = (12_000, 12_000, 20_000, 20_000, 60_000)
_EVEN, _WALKERS, _STEPS = 0.5, 32, 40
_EFFECTIVE = 400.0
_SHARE, _COMPARED, _SLIGHT = 0.75, 128, 0.5
"""Fraction of the reduced basis for proposal chains; number of points at which log P is compared; largest change
allowed, nats."""


@dataclass(frozen=True, eq=False)
class Approximation:
    """Gaussians that approximate a posterior, as importance-sampling proposals in scaled coordinates.

    Attributes
    ----------
    quadratics : list of Quadratic
        Quadratic models of the log-probability at each maximum that may matter.
    groups : list of Quadratic
        Gaussians fitted to groups of neighbouring draws.
    """

    quadratics: list[Quadratic]
    groups: list[Quadratic]


@dataclass(frozen=True, eq=False)
class LeftOut:
    """A leave-one-out posterior, and the predictive density of the left-out mode's measurement.

    Attributes
    ----------
    theta : ndarray, shape (n, ndim)
        Draws, SI units.
    hz : ndarray, shape (n, n_modes)
        Computed frequencies at the draws, Hz.
    log_weights : ndarray, shape (2, n)
        Logarithms of weights that sum to 1: for the posterior without the mode in the first row, with it in the
        second.
    elpd, error : float
        log p(y_k | y_-k) in nats, and its standard error.
    pareto_k : ndarray, shape (2,)
        Pareto shape parameters of the weights without and with the mode.
    """

    theta: FloatArray
    hz: FloatArray
    log_weights: FloatArray
    elpd: float
    error: float
    pareto_k: FloatArray

    @property
    def effective(self) -> float:
        """Kish's effective sample size of the draws when they are weighted for the leave-one-out posterior."""
        return effective_size(self.log_weights[0])

    @property
    def predicts(self) -> bool:
        """Whether the weights for the leave-one-out posterior have a low Pareto k and an ESS of at least 400."""
        return bool(self.pareto_k[0] <= GOOD_K and self.effective >= _EFFECTIVE)

    @property
    def is_known(self) -> bool:
        """Whether both Pareto k are low and the standard error of the elpd is small enough (`ACCEPTED`)."""
        return bool(np.all(self.pareto_k <= GOOD_K) and self.error <= ACCEPTED)


def approximation(problem: UpdatingProblem, near: FloatArray, rng: np.random.Generator) -> Approximation:
    """Approximate the posterior of a problem by Gaussians.

    Each quadratic model first has the curvature at its maximum. It is then fitted twice by least squares to the
    log-probability of draws, which is much more accurate if the posterior is skewed. If the draws' weights are
    still uneven, a curved ridge may lead to regions where no quadratic has any probability; importance weights do
    not reveal regions without draws. Short chains from some of the draws then follow the ridge, and their draws
    form the groups.

    Parameters
    ----------
    problem : UpdatingProblem
    near : ndarray, shape (n, ndim)
        Additional starting points for the search for maxima, such as draws from a posterior with other modes, SI
        units.
    rng : Generator
    """
    scaled = ScaledDensity(problem)
    models, temperatures = quadratics_at_maxima(problem, scaled, near), TEMPERATURES
    u, log_p, log_q = np.empty((0, problem.ndim)), np.empty(0), np.empty(0)
    for _ in range(_FITS):
        proposals = gaussians(models, scaled, temperatures)
        more, log_q = draw_mixture(proposals, [_PILOT] * len(proposals), rng)
        u = np.concatenate([u, more])
        log_p = np.concatenate([log_p, *by_parts("importance sampling", scaled.log_prob, more)])
        models, temperatures = fitted_to_draws(models, u, log_p), WIDER
    last = slice(len(u) - len(log_q), None)
    log_w = log_p[last] - log_q
    log_w = np.where(np.isfinite(log_w), log_w, -np.inf)
    if effective_size(log_w) >= _EVEN * len(log_w):
        return Approximation(models, [])
    walked = _walk_chains(cheaper(problem, u[last], log_p[last]), u[last], log_w, rng)
    return Approximation(models, gaussians_of_groups(walked, np.zeros(len(walked)), rng))


def cheaper(problem: UpdatingProblem, u: FloatArray, log_p: FloatArray) -> UpdatingProblem:
    """Return the problem with only `_SHARE` of its reduced basis, unless this alters log P noticeably.

    The median change at the highest of the scaled draws u (n, ndim), whose log-probabilities are `log_p` (n,), may
    be at most 0.5 nats. If it is larger, or if the problem has no reduced basis, `problem` itself is returned.
    Chains of the cheaper problem only supply proposals, which need not be exact.
    """
    if problem.model.coarser(_SHARE) is problem.model:
        return problem
    coarse, highest = problem.coarser(_SHARE), np.argsort(log_p)[-_COMPARED:]
    changes = np.abs(ScaledDensity(coarse).log_prob(u[highest]) - log_p[highest])
    return coarse if np.median(changes) <= _SLIGHT else problem


def _walk_chains(
    problem: UpdatingProblem, u: FloatArray, log_w: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Run short chains from some of the weighted draws; return the chains' draws in scaled units, (n, ndim)."""
    scaled = ScaledDensity(problem)
    start = resample(rng, u, log_w, _WALKERS)
    seed = int(rng.integers(2**31))
    sampler = HamiltonianMonteCarlo() if problem.solves_per_gradient == 1 else MetropolisHastings()
    run = Run(problem, sampler, warmup=_STEPS, chains=_WALKERS, seed=seed, init=scaled.to_theta(start))
    return scaled.to_scaled(run.extend(_STEPS).posterior.position.reshape(-1, problem.ndim))


def left_out(
    without: UpdatingProblem,
    whole: UpdatingProblem,
    known: Sequence[Approximation],
    rng: np.random.Generator,
    most: int = MOST_SOLVES,
) -> LeftOut:
    """Compare the posteriors without and with a mode by importance sampling.

    The mode's elpd is log p(y_k | y_-k) = log Z - log Z_-k, where Z and Z_-k are the evidences with and without
    mode k. Both evidences come from the same draws. The proposal is a mixture of the Gaussians in both
    approximations, of wider Gaussians and of the prior. It therefore also covers a measurement far out in the tail
    of its prediction, where the posteriors hardly overlap. The number of draws is doubled until the ESS is at
    least 400 and the standard error is at most `ERROR`, or at most `ACCEPTED` if more than `_FAIR` draws would be
    needed.

    The weights may be unreliable, as for a posterior along a curved ridge. The quadratics are then fitted again to
    all draws, and the draws are divided into groups of neighbours. New draws from a mixture that includes the
    groups' Gaussians replace the old draws.

    Parameters
    ----------
    without, whole : UpdatingProblem
        The same problem, updated without and with the mode (`UpdatingProblem.using`).
    known : pair of Approximation
        Approximations of the two posteriors.
    rng : Generator
    most : int
        Largest number of solves.
    """
    scaled = ScaledDensity(whole)
    models = [one.quadratics for one in known]
    groups = [group for one in known for group in one.groups]
    for limit in _ROUNDS:
        found, log_p = _draw_until_enough(without, whole, [*models[0], *models[1], *groups], rng, min(most, limit))
        most -= len(found.theta)
        if (found.predicts and found.is_known) or most < _LEAST:
            break
        u = scaled.to_scaled(found.theta)
        models = [fitted_to_draws(of, u, values) for of, values in zip(models, log_p, strict=True)]
        groups = [one for log_w in found.log_weights for one in gaussians_of_groups(u, log_w, rng)]
    return found


def _draw_until_enough(
    without: UpdatingProblem,
    whole: UpdatingProblem,
    models: Sequence[Quadratic],
    rng: np.random.Generator,
    most: int,
) -> tuple[LeftOut, FloatArray]:
    """Compare both posteriors with as many draws as needed; return the comparison, and log P of both, (2, n).

    At most `most` draws are made. The function stops early if even these would be too few, because a better
    mixture is then needed.
    """
    scaled = ScaledDensity(whole)
    proposals: list[Proposal] = [*gaussians(models, scaled, WIDER), PriorCandidates(whole, scaled)]

    def evaluate(u: FloatArray) -> FloatArray:
        return log_prob_of_all((without, whole), scaled.to_theta(u))

    n = len(proposals)
    u, log_q = draw_mixture(proposals, [max(_FIRST, _FIRST_IN_ALL // n)] * n, rng)
    values = np.concatenate(by_parts("importance sampling", evaluate, u))
    while True:
        found = compare_posteriors(scaled.to_theta(u), values[:, :2].T, values[:, 2:], log_q)
        is_accepted = found.error <= ACCEPTED and found.effective >= _EFFECTIVE
        is_done = is_accepted and (found.error <= ERROR or 2 * len(u) > _FAIR)
        more_times = most / len(u)
        is_hopeless = found.error > ACCEPTED * np.sqrt(more_times) and found.effective * more_times < _EFFECTIVE
        if is_done or (is_hopeless and len(u) >= _TELLING) or 2 * len(u) > most:
            return found, values[:, :2].T
        more, more_q = draw_mixture(proposals, [len(u) // n] * n, rng)
        u, log_q = np.concatenate([u, more]), np.concatenate([log_q, more_q])
        values = np.concatenate([values, *by_parts("importance sampling", evaluate, more)])


def log_prob_of_all(problems: Sequence[UpdatingProblem], theta: FloatArray) -> FloatArray:
    """Return the log-probability of each problem, and the common model's frequencies in Hz, side by side.

    The shape is (n, n_problems + n_modes). A log-probability is −inf where a solve fails. The model is solved once
    at each theta, unless a pairing is soft. The last problem must use all modes of the other problems.
    """
    whole, likelihoods = problems[-1], list[Any](problem.likelihood for problem in problems)
    if whole.model.is_soft:
        log_p = [problem.log_likelihood(theta) for problem in problems]
        hz = whole.frequencies(theta)
    else:
        of_model = whole.layout.of_model(theta)
        seen = likelihoods[-1].observed(of_model)
        log_p = [likelihood.terms_of_observed(seen, of_model).sum(axis=1) for likelihood in likelihoods]
        hz = seen.frequencies
    found = np.stack(log_p, axis=1) + np.asarray(whole.log_prior(theta))[:, None]
    return np.concatenate([np.where(np.isfinite(found), found, -np.inf), hz], axis=1)


def compare_posteriors(theta: FloatArray, log_p: FloatArray, hz: FloatArray, log_q: FloatArray) -> LeftOut:
    """Compare the posteriors without and with a mode, using draws `theta` (n, ndim) from a density q.

    `log_p` (2, n) contains the log-probabilities without the mode, then with it; `hz` (n, n_modes) the computed
    frequencies; and `log_q` (n,) the log-density of the draws.
    """
    log_w = log_p - log_q
    total = logsumexp(log_w, axis=1)
    w = np.exp(log_w - total[:, None])
    return LeftOut(
        theta=theta,
        hz=hz,
        log_weights=log_w - total[:, None],
        elpd=float(total[1] - total[0]),
        error=float(np.sqrt(np.sum((w[1] - w[0]) ** 2))),
        pareto_k=np.array([pareto_k(one) for one in log_w]),
    )
