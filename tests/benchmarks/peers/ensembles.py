"""emcee as its users run it: ensembles of walkers on the unit box, with fmu's log-probability in batches."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import fmu
from fmu.engines.blas import single_thread
from fmu.types import FloatArray
from tests.benchmarks.peers.posteriors import Target
from tests.benchmarks.peers.run import NOTHING, Meter, Run

ENSEMBLES = 4
"""Independent runs, as users of emcee make them to see whether they agree."""
LEAST_WALKERS = 32
Moves = Callable[[Target], Any]


def walkers_for(ndim: int) -> int:
    """Return how many walkers an ensemble has."""
    return max(LEAST_WALKERS, 2 * ndim + 2)


def stretch(target: Target) -> None:
    """Return emcee's default."""


def differential(target: Target) -> list[tuple[Any, float]]:
    """Return the moves that emcee's documentation recommends for narrow or separate maxima."""
    import emcee

    return [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]


def as_fmu(target: Target) -> list[tuple[Any, float]]:
    """Return the moves of fmu's sampler "emcee"."""
    ndim = target.problem.ndim
    return fmu.Ensemble(walkers_for(ndim)).weighted_moves(ndim)


def mixture(target: Target) -> list[tuple[Any, float]]:
    """Return fmu's `MixtureMove` beside differential evolution, as its docstring has it."""
    import emcee

    zero, one = np.zeros(target.problem.ndim), target.to_unit(target.problem.upper)
    return [(fmu.MixtureMove(lower=zero, upper=one), 0.8), (emcee.moves.DEMove(), 0.2)]


def wrapping(target: Target, share: float) -> float:
    """Return the processor time of a step of fmu's sampler "emcee" relative to emcee with the same moves.

    Both begin at the same walkers, from a warm-up of emcee, and take turns of 1500 steps of 32 walkers. The result
    is the median of three turns. If `share` is below 1, because steps take long, the number of steps is multiplied
    by its square.
    """
    walkers = walkers_for(target.problem.ndim)
    of_walkers = share * LEAST_WALKERS / walkers
    warmup, draws = int(500 * of_walkers), int(1500 * share * of_walkers)
    plain = _sampler(target, as_fmu, 1)
    unit = target.to_unit(target.starts(1, walkers))
    warm = plain.run_mcmc(unit, warmup).coords
    maxima = fmu.find_map(target.problem)  # which fmu.sample would search for otherwise

    def by_emcee(turn: int) -> None:
        plain.reset()
        plain.run_mcmc(warm, draws)

    def by_fmu(turn: int) -> None:
        fmu.sample(
            WithoutModel(target.problem), fmu.Ensemble(walkers), init=target.from_unit(warm)[None], seed=turn,
            warmup=0, draws=draws, chains=1, maxima=maxima,
        )  # fmt: skip

    def seconds(run: Callable[[int], None], turn: int) -> float:
        began = time.process_time()
        run(turn)
        return time.process_time() - began

    by_fmu(0)  # imports
    with single_thread():
        return float(np.median([seconds(by_fmu, turn) / seconds(by_emcee, turn) for turn in range(1, 4)]))


class WithoutModel:
    """A problem as a log-density only, so that `fmu.sample` computes no predictions and checks after its draws."""

    def __init__(self, problem: Any) -> None:
        for name in ("ndim", "names", "units", "lower", "upper", "offset", "scale", "solves_per_gradient"):
            setattr(self, name, getattr(problem, name))
        self.log_prob, self.log_prob_and_grad = problem.log_prob, problem.log_prob_and_grad
        self.sample_prior = problem.sample_prior


def emcee_run(target: Target, moves: Moves, warmup: int, draws: int, seed: int) -> Run:
    """Run ensembles; the warm-up is with ``tune=True``."""
    walkers = walkers_for(target.problem.ndim)
    starts = target.to_unit(target.starts(seed, ENSEMBLES * walkers)).reshape(ENSEMBLES, walkers, -1)
    paths, costs = [], [NOTHING, NOTHING]
    meter = Meter(target)
    with meter.counting():
        for start, state in zip(starts, np.random.SeedSequence(seed).generate_state(ENSEMBLES), strict=True):
            sampler = _sampler(target, moves, state)
            warm = sampler.run_mcmc(start, warmup, tune=True)
            costs[0] += meter.read()
            sampler.reset()
            sampler.run_mcmc(warm, draws)
            costs[1] += meter.read()
            paths.append(sampler.get_chain(flat=True))
    return Run.of_chains(target.from_unit(np.stack(paths)), walkers, warmup=costs[0], draws=costs[1])


def _sampler(target: Target, moves: Moves, state: int) -> Any:
    """Return emcee's sampler on the unit box, seeded by `state`."""
    import emcee

    def density(u: FloatArray) -> FloatArray:
        return np.asarray(target.problem.log_prob(target.from_unit(u)))

    sampler = emcee.EnsembleSampler(
        walkers_for(target.problem.ndim), target.problem.ndim, density, moves=moves(target), vectorize=True
    )
    sampler.random_state = np.random.RandomState(state).get_state()
    return sampler
