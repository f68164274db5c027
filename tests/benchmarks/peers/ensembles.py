"""emcee as its users run it: one ensemble of 32 walkers, the default moves, on the unit box."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from fmu.types import FloatArray
from tests.benchmarks.peers.outcome import Cost, Length, Outcome, Stopwatch, per_call
from tests.benchmarks.peers.target import SciPyLogProb, Target

WALKERS = 32


def emcee_default(target: Target, length: Length, ensembles: int = 4) -> Callable[[int], Outcome]:
    """Return what runs emcee's stretch move for a seed, on fmu's log-probability in batches."""
    import emcee

    density = InBox(target)

    def once(seed: int) -> Outcome:
        starts = target.starts(seed, ensembles * WALKERS).reshape(ensembles, WALKERS, -1)
        paths, costs = [], []
        for start, state in zip(starts, np.random.SeedSequence(seed).generate_state(ensembles), strict=True):
            sampler = emcee.EnsembleSampler(WALKERS, target.problem.ndim, density, vectorize=True)
            sampler.random_state = np.random.RandomState(state).get_state()
            density.inside, stopwatch = 0, Stopwatch()
            warm = sampler.run_mcmc(target.to_unit(start), length.warmup)
            warmed = stopwatch.read(density.inside)
            sampler.reset()
            density.inside = 0
            sampler.run_mcmc(warm, length.draws)
            costs.append((warmed, stopwatch.read(density.inside)))
            paths.append(sampler.get_chain(flat=True))
        return _outcome(target, paths, costs)

    return cache(once)


def emcee_dense(run: Callable[[int], Outcome], log_prob: SciPyLogProb) -> Callable[[int], Outcome]:
    """Return emcee on a dense log-probability.

    Its steps are those of `run` on fmu's, the same posterior, and their time is that of the dense one by itself,
    timed at draws of that run: the run would take hours, and what emcee takes besides is left out.
    """

    def once(seed: int) -> Outcome:
        outcome = run(seed)
        draws = outcome.position.reshape(-1, outcome.position.shape[-1])
        points = draws[:: len(draws) // 20]
        return outcome.at(per_call(lambda: [log_prob(x) for x in points]) / len(points))

    return once


class InBox:
    """The log-probability of a batch on the unit box, which counts the points inside: nothing is solved elsewhere.

    Attributes
    ----------
    inside : int
    """

    def __init__(self, target: Target) -> None:
        self.target = target
        self.inside = 0

    def __call__(self, u: FloatArray) -> Any:
        """Return the log-probability at u (ndim,) or (n, ndim)."""
        value = self.target.problem.log_prob(self.target.from_unit(u))
        self.inside += int(np.count_nonzero(value > -np.inf))
        return value


def _outcome(target: Target, paths: list[FloatArray], costs: list[tuple[Cost, Cost]]) -> Outcome:
    warmup, draws = costs[0]
    for warmed, drawn in costs[1:]:
        warmup, draws = warmup + warmed, draws + drawn
    return Outcome(target.from_unit(np.stack(paths)), warmup, draws, walkers=WALKERS)
