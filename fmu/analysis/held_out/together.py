"""Leave-one-out posteriors of several modes from one set of draws.

A solve gives all frequencies, and therefore the log-probability both with all modes and without any one of them.
The same draws from one mixture are weighted for all posteriors, so leaving out ten modes takes about as many
solves as leaving out one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.held_out.candidates import (
    PriorCandidates,
    fitted_to_draws,
    gaussians,
    gaussians_of_groups,
    quadratics_at_maxima,
)
from fmu.analysis.held_out.refit import (
    ACCEPTED,
    ERROR,
    WIDER,
    LeftOut,
    cheaper,
    compare_posteriors,
    log_prob_of_all,
)
from fmu.analysis.maxima.mode_weights import TEMPERATURES
from fmu.posterior.scaled import ScaledDensity
from fmu.progress.phases import by_parts, phase
from fmu.samplers.mixture.importance import Proposal, draw_mixture, effective_size, resample
from fmu.samplers.mixture.quadratic import Quadratic
from fmu.types import FloatArray

if TYPE_CHECKING:
    from fmu.posterior.problem import UpdatingProblem

_PILOT, _FITS = 2048, 2
"""Number of draws to which the Gaussians are fitted, and number of fits."""
_FIRST, _FAIR, _MOST = 3072, 8192, 24_000
"""Draws before the errors are first estimated, draws after which accepted errors suffice, and largest number of
draws."""
_ROUNDS = 3
_EVEN = 0.25
"""Fraction of a posterior's draws below which their ESS is too small, so that chains explore the rest of the
posterior."""
_WALKERS, _STEPS, _FLAT, _JITTER = 48, 100, 0.25, 1e-4
_OF_PRIOR = 0.25
"""Number of draws from the prior divided by the number of draws for each posterior."""


def left_out_together(
    without: Sequence[UpdatingProblem], whole: UpdatingProblem, rng: np.random.Generator
) -> list[LeftOut]:
    """Compare posteriors that each lack one mode with the posterior of all modes, using the same draws.

    Each posterior has a Gaussian at each of its maxima, fitted to the log-probability of draws from all posteriors
    (`fmu.analysis.held_out.candidates`). If these Gaussians do not cover a posterior well, as along a curved
    ridge, short chains explore the rest, and Gaussians fitted to groups of the chains' draws are added. The
    comparisons then use draws from the mixture of all Gaussians, of wider Gaussians and of the prior. If a
    posterior's weights are unreliable, its chains are continued or started, the Gaussians are fitted again, and
    its comparison is repeated, at most twice. If the weights are still unreliable, the result shows this
    (`LeftOut.predicts`, `LeftOut.is_known`).

    Parameters
    ----------
    without : sequence of UpdatingProblem
        The problem updated without each of the modes (`UpdatingProblem.using`).
    whole : UpdatingProblem
        The problem updated with all modes.
    rng : Generator

    Returns
    -------
    list of LeftOut
        One result for each of `without`.
    """
    problems, scaled = [*without, whole], ScaledDensity(whole)
    prior, last = PriorCandidates(whole, scaled), len(without)
    models, walkers, cheap = _first_models(problems, scaled, prior, rng)
    groups: dict[int, list[Quadratic]] = {}
    done: dict[int, LeftOut] = {}
    wanted = list(range(last))
    for _ in range(_ROUNDS):
        walked = _walk([*without, cheap], walkers, scaled, rng)
        groups |= {number: gaussians_of_groups(of, np.zeros(len(of)), rng) for number, of in walked.items()}
        parts = [gaussians([*models[k], *groups.get(k, ())], scaled, WIDER) for k in (*wanted, last)]
        u, values, found = _weigh_candidates(_Mixture(parts, prior), problems, wanted, scaled, rng)
        done |= found
        wanted = [k for k in wanted if not (done[k].predicts and done[k].is_known)]
        if not wanted:
            break
        models = [fitted_to_draws(of, u, log_p) for of, log_p in zip(models, values.T, strict=True)]
        walkers = {
            k: walked[k][-_WALKERS:] if k in walked else _spread(u, done[k].log_weights[0], rng) for k in wanted
        }
    return [done[k] for k in range(last)]


def _first_models(
    problems: Sequence[UpdatingProblem], scaled: ScaledDensity, prior: Proposal, rng: np.random.Generator
) -> tuple[list[list[Quadratic]], dict[int, FloatArray], UpdatingProblem]:
    """Fit quadratics to each posterior, and choose starting points for chains in posteriors they cover poorly.

    The last posterior's maxima are additional starting points in the search for the other posteriors' maxima.

    Returns
    -------
    list of list of Quadratic
        The quadratics of each problem.
    dict of int to ndarray, shape (n, ndim)
        Scaled starting points, keyed by the index of the poorly covered posterior.
    UpdatingProblem
        The last problem, with only part of the reduced basis if this suffices for chains.
    """
    n, whole = len(problems), problems[-1]
    models = [quadratics_at_maxima(whole, scaled, whole.start[None])]
    near = scaled.to_theta(np.array([model.position for model in models[0]]))
    models = [*(quadratics_at_maxima(problem, scaled, near) for problem in problems[:-1]), *models]
    u, values, temperatures = np.empty((0, whole.ndim)), np.empty((0, n)), TEMPERATURES
    for _ in range(_FITS):
        mixture = _Mixture([gaussians(of, scaled, temperatures) for of in models], prior)
        more, log_q, solved = _draws(mixture, problems, scaled, rng, _PILOT)
        u, values = np.concatenate([u, more]), np.concatenate([values, solved[:, :n]])
        models = [fitted_to_draws(of, u, log_p) for of, log_p in zip(models, values.T, strict=True)]
        temperatures = WIDER
    log_w = solved[:, :n].T - log_q
    poor = [number for number in range(n) if effective_size(log_w[number]) < _EVEN * len(more) / n]
    starts = {number: _spread(more, log_w[number], rng) for number in poor}
    return models, starts, cheaper(whole, more, solved[:, n - 1])


def _spread(u: FloatArray, log_w: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Resample `_WALKERS` draws with flattened weights, because a few draws may have all the weight."""
    return resample(rng, u, _FLAT * log_w, _WALKERS)


def _walk(
    problems: Sequence[UpdatingProblem],
    walkers: Mapping[int, FloatArray],
    scaled: ScaledDensity,
    rng: np.random.Generator,
) -> dict[int, FloatArray]:
    """Run short chains in some of the posteriors; return scaled draws (n, ndim), keyed by posterior index.

    The chains use differential evolution (ter Braak 2006, *Stat. Comput.* 16, 239-249): a walker moves along the
    difference of two other walkers, so that the walkers spread along a ridge. The walkers of all posteriors move
    in lockstep, and one batch of solves serves all of them. The last draws are the walkers' final positions.
    """
    if not walkers:
        return {}
    rows, t = np.repeat(list(walkers), _WALKERS), np.arange(len(walkers) * _WALKERS)

    def log_prob(x: FloatArray) -> FloatArray:
        return np.asarray(log_prob_of_all(problems, scaled.to_theta(x))[t, rows])

    x = np.concatenate(list(walkers.values()))
    last = walk(log_prob, x, (scaled.lower, scaled.upper), rng, _WALKERS)[_STEPS // 2 :]
    return {number: np.concatenate(last[:, rows == number]) for number in walkers}


def walk(
    log_prob: Callable[[FloatArray], FloatArray],
    x: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    rng: np.random.Generator,
    walkers: int,
) -> FloatArray:
    """Return the positions of walkers after each step of differential evolution, shape (_STEPS, n, ndim).

    Parameters
    ----------
    log_prob : callable
        Returns log-densities (n,) at points (n, ndim).
    x : ndarray, shape (n, ndim)
        Starting points.
    bounds : pair of ndarray, shape (ndim,)
    rng : Generator
    walkers : int
        Size of an ensemble: each `walkers` successive rows of `x` move separately from the others.
    """
    (lower, upper), t = bounds, np.arange(len(x))
    log_p = log_prob(x)
    first, kept = t - t % walkers, []
    with phase("chains along ridges", _STEPS) as under_way:
        for step in range(_STEPS):
            one, other = (first + rng.integers(walkers, size=len(t)) for _ in range(2))
            length = 1.0 if step % 10 == 9 else 2.38 / np.sqrt(2.0 * x.shape[1])
            proposed = x + length * (x[one] - x[other]) + _JITTER * rng.standard_normal(x.shape)
            proposed = np.where(proposed < lower, 2.0 * lower - proposed, proposed)
            proposed = np.where(proposed > upper, 2.0 * upper - proposed, proposed)
            proposed = np.clip(proposed, lower, upper)
            new = log_prob(proposed)
            moves = np.log(rng.random(len(t))) < new - log_p
            x, log_p = np.where(moves[:, None], proposed, x), np.where(moves, new, log_p)
            kept.append(x)
            under_way.advance()
    return np.array(kept)


@dataclass(frozen=True, eq=False)
class _Mixture:
    """A mixture of Gaussians and the prior. All posteriors have the same weight in it; the prior has less."""

    parts: Sequence[Sequence[Proposal]]
    prior: Proposal

    def draws(self, rng: np.random.Generator, n: int) -> tuple[FloatArray, FloatArray]:
        """Return about `n` draws, shape (n, ndim), and the mixture's log-density at the draws."""
        share = n / (len(self.parts) + _OF_PRIOR)
        counted = [(proposal, -int(-share // len(part))) for part in self.parts for proposal in part]
        counted.append((self.prior, -int(-share * _OF_PRIOR // 1)))
        proposals, counts = zip(*counted, strict=True)
        return draw_mixture(proposals, counts, rng)


def _draws(
    mixture: _Mixture,
    problems: Sequence[UpdatingProblem],
    scaled: ScaledDensity,
    rng: np.random.Generator,
    n: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return about `n` draws u (n, ndim) from the mixture, its log-density (n,), and the solutions at the draws.

    The solutions are the log-probabilities of all problems and the frequencies, (n, n_problems + n_modes).
    """
    u, log_q = mixture.draws(rng, n)
    solved = by_parts("importance sampling", lambda v: log_prob_of_all(problems, scaled.to_theta(v)), u)
    return u, log_q, np.concatenate(solved)


def _weigh_candidates(
    mixture: _Mixture,
    problems: Sequence[UpdatingProblem],
    wanted: Sequence[int],
    scaled: ScaledDensity,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray, dict[int, LeftOut]]:
    """Return draws u (n, ndim) from the mixture, all problems' log P there, and the leave-one-out results.

    The log-probabilities have shape (n, n_problems). The results are computed only for the problem indices in
    `wanted`, which are their keys.
    """
    n = len(problems)
    u, log_q, values = _draws(mixture, problems, scaled, rng, _FIRST)
    while True:
        theta, log_p, hz = scaled.to_theta(u), values[:, :n].T, values[:, n:]
        found = {k: compare_posteriors(theta, log_p[[k, -1]], hz, log_q) for k in wanted}
        worst = max(one.error for one in found.values())
        is_covered = all(one.predicts and one.is_known for one in found.values())
        needed = max(int(1.2 * len(u) * (worst / ACCEPTED) ** 2), _FAIR)
        if (is_covered and (worst <= ERROR or len(u) >= _FAIR)) or not len(u) < needed <= _MOST:
            return u, values[:, :n], found
        more = _draws(mixture, problems, scaled, rng, needed - len(u))
        u, log_q, values = (np.concatenate(parts) for parts in zip((u, log_q, values), more, strict=True))
