"""emcee as its users run it: ensembles of walkers on the unit box, on fmu's log-probability in batches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import fmu
from fmu.types import FloatArray
from tests.benchmarks.peers.posteriors import Target
from tests.benchmarks.peers.run import NOTHING, Meter, Run

ENSEMBLES = 4
"""Runs from starts of their own, as emcee's users do it to see whether they agree."""
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


def emcee_run(target: Target, moves: Moves, warmup: int, draws: int, seed: int) -> Run:
    """Run ensembles; the warm-up is with ``tune=True``."""
    import emcee

    walkers = walkers_for(target.problem.ndim)
    starts = target.to_unit(target.starts(seed, ENSEMBLES * walkers)).reshape(ENSEMBLES, walkers, -1)
    paths, costs = [], [NOTHING, NOTHING]
    meter = Meter(target)

    def density(u: FloatArray) -> FloatArray:
        return np.asarray(target.problem.log_prob(target.from_unit(u)))

    with meter.counting():
        for start, state in zip(starts, np.random.SeedSequence(seed).generate_state(ENSEMBLES), strict=True):
            sampler = emcee.EnsembleSampler(
                walkers, target.problem.ndim, density, moves=moves(target), vectorize=True
            )
            sampler.random_state = np.random.RandomState(state).get_state()
            warm = sampler.run_mcmc(start, warmup, tune=True)
            costs[0] += meter.read()
            sampler.reset()
            sampler.run_mcmc(warm, draws)
            costs[1] += meter.read()
            paths.append(sampler.get_chain(flat=True))
    return Run.of_chains(target.from_unit(np.stack(paths)), walkers, warmup=costs[0], draws=costs[1])
