"""Draw from a leave-one-out posterior for which Gaussians are poor proposals, by fitted candidates or by a run."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence.effective import ess_bulk, ess_tail, rhat
from fmu.analysis.convergence.pareto import GOOD_K, pareto_k
from fmu.analysis.convergence.remedies import RHAT_LIMIT, required_ess
from fmu.analysis.held_out.together import walk
from fmu.analysis.maxima.results import NEGLIGIBLE
from fmu.analysis.maxima.search import find_map, is_searchable
from fmu.analysis.maxima.starts import are_in_funnel, choose_starts, components
from fmu.fem.modes.eigensolver import DENSE_LIMIT
from fmu.fem.pairing.paired_structure import structure_of
from fmu.posterior.scaled import LogarithmicDensity, ScaledDensity
from fmu.samplers.kernel import Target
from fmu.samplers.loop.run import Run
from fmu.samplers.mixture.curved import fit_curved
from fmu.samplers.mixture.importance import effective_size, resample
from fmu.samplers.mixture.mixture import MixtureSampler
from fmu.samplers.mixture.warmup.rounds import PER_ROUND, Rounds
from fmu.types import FloatArray

if TYPE_CHECKING:
    from fmu.analysis.maxima.results import Maxima
    from fmu.posterior.problem import UpdatingProblem

_CHAINS, _WARMUP, _FIRST, _MOST = 4, 1000, 1000, 128_000
"""Number of chains, warm-up steps, steps before convergence is first judged, and largest number of steps."""
_WALKERS, _CANDIDATES, _EFFECTIVE = 128, 16_000, 400.0
"""Number of walkers, largest number of candidates, and ESS that is enough."""
_TIMED = 64
"""Number of points at which a user's function is timed."""
_STARTS, _OUTSIDE = 32, 1e-4
"""Number of starting points in the search for maxima that candidates miss, and probability of a Gaussian outside
the ellipsoid that contains nearly all draws."""


def draws_without(without: UpdatingProblem, near: FloatArray, seed: int) -> FloatArray | None:
    """Return draws from a leave-one-out posterior, (chains, n, ndim), SI units, or None if they do not converge.

    Candidates are resampled, as a single chain, if their weights are reliable (`_by_rounds`) and they miss no
    maximum. Otherwise chains are run, with twice as many draws each time, up to `_MOST` per chain, until R-hat and
    ESS of all parameters meet the limits of `fmu.diagnose`.

    Parameters
    ----------
    without : UpdatingProblem
        The problem updated without the mode (`UpdatingProblem.using`).
    near : ndarray, shape (n, ndim)
        Draws from the posterior with the mode, SI units.
    seed : int
    """
    maxima = find_map(without, _STARTS)
    found = _by_rounds(without, near, np.random.default_rng(seed))
    if found is not None and not _lacks_a_maximum(maxima, ScaledDensity(without), found):
        return found[None]
    sampler = MixtureSampler().starting_from(*components(without, maxima))
    starts = choose_starts(without, "maxima", maxima, _CHAINS, sampler.walkers, seed)
    run = Run(without, sampler, warmup=_WARMUP, chains=_CHAINS, seed=seed, init=starts.position)
    more = _FIRST
    while True:
        position = run.extend(more).posterior.position
        draws = position.reshape(_CHAINS, -1, without.ndim)
        if all(_is_converged(x) for x in np.moveaxis(draws, 2, 0)):
            return draws
        more = draws.shape[1]
        if 2 * more > _MOST:
            return None


def _by_rounds(without: UpdatingProblem, near: FloatArray, rng: np.random.Generator) -> FloatArray | None:
    """Return independent draws from a posterior, (n, ndim), SI units, or None if their weights are not reliable.

    Walkers start at some of the rows of `near`, which are draws from the posterior with the mode, and spread over
    the posterior without it. Candidates come from a mixture that is fitted first to the walkers and then, in
    rounds, to the candidates. Parameters with log-normal priors are replaced by their logarithms, whose posterior
    is less skewed. Once the Pareto k of the weights is low and their ESS is at least 400, draws are resampled from
    the candidates; the number of draws equals the ESS.
    """
    density = LogarithmicDensity(without)
    rounds, u = Rounds(Target(density)), density.to_scaled(near[rng.choice(len(near), _WALKERS)])
    walked = walk(density.log_prob, u, (density.lower, density.upper), rng, _WALKERS)
    u = np.concatenate(walked[len(walked) // 2 :])
    with suppress(np.linalg.LinAlgError):  # the draws do not span the space
        mixture = fit_curved(u, np.ones(len(u)), density.lower, density.upper)
        while sum(rounds.counts) < _CANDIDATES:
            rounds.draw(mixture, rng, PER_ROUND)
            log_w = rounds.log_ratio
            if len(log_w) and effective_size(log_w) >= _EFFECTIVE and pareto_k(log_w) <= GOOD_K:
                return density.to_theta(resample(rng, rounds.position, log_w, int(effective_size(log_w))))
            mixture = rounds.fit_mixture()
    return None


def _lacks_a_maximum(maxima: Maxima, scaled: ScaledDensity, theta: FloatArray) -> bool:
    """Return True if an important maximum is outside the ellipsoid that holds nearly all draws theta (n, ndim)."""
    from scipy.special import chdtri

    draws = scaled.to_scaled(theta)
    high = scaled.to_scaled(np.array([m.theta for m in maxima if m.share > NEGLIGIBLE]))
    z = np.linalg.solve(np.linalg.cholesky(np.cov(draws.T)), (high - draws.mean(axis=0)).T)
    return bool(np.any(np.sum(z**2, axis=0) > chdtri(scaled.ndim, _OUTSIDE)))


def is_in_funnel(problem: UpdatingProblem) -> bool:
    """Return True if the posterior is a funnel, so that Gaussians at its maxima are useless as proposals.

    See `fmu.analysis.maxima.starts.are_in_funnel`. Without a discrepancy, or if the problem is hierarchical,
    return False.
    """
    has_discrepancy = problem.likelihood.has_discrepancy and is_searchable(problem)
    return has_discrepancy and are_in_funnel(problem, find_map(problem))


def _is_converged(x: FloatArray) -> bool:
    return bool(rhat(x) < RHAT_LIMIT and min(ess_bulk(x), ess_tail(x)) >= required_ess(len(x)))


def seconds_of_a_solve(problem: UpdatingProblem, theta: FloatArray) -> float:
    """Return the approximate time of a solve in seconds.

    The time of a structure is estimated from the matrix sizes, so that a repeated or resumed run gives the same
    `leave_one_out` table, whatever the load of the machine. The time of a user's function is measured at the first
    rows of `theta` (n, ndim).
    """
    structure = structure_of(problem.model)
    if structure is not None:
        reduced = problem.model.sizes  # solved many at a time
        if reduced:
            return float(sum(max(1e-5, 6e-8 * n**2) for n in reduced))
        sizes = [block.size for block in structure.blocks]
        return float(sum(1.7e-4 + 1.2e-7 * n**2 if n <= DENSE_LIMIT else 3e-5 * n for n in sizes))
    began = time.perf_counter()
    problem.log_prob(theta[:_TIMED])
    return (time.perf_counter() - began) / min(_TIMED, len(theta))
