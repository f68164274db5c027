"""Chains of PINTS, on fmu's log-probability and the unit box."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pints

from fmu.types import FloatArray
from tests.benchmarks.peers.ensembles import InBox
from tests.benchmarks.peers.outcome import Length, Outcome, Stopwatch
from tests.benchmarks.peers.target import Target

CHAINS = 4


def pints_adaptive(target: Target, length: Length) -> Callable[[int], Outcome]:
    """Return what runs PINTS's default, the adaptive Metropolis of Haario and Bardenet, for a seed.

    By ask and tell, chain by chain, as its controller does. It goes on adapting after the warm-up, its default.
    """

    def once(seed: int) -> Outcome:
        np.random.seed(seed)  # noqa: NPY002  (PINTS draws from NumPy's global state)
        density = InBox(target)
        starts = target.to_unit(target.starts(seed, CHAINS))
        samplers = [pints.HaarioBardenetACMC(start) for start in starts]
        stopwatch = Stopwatch()
        for sampler in samplers:
            sampler.set_initial_phase(False)  # in which it would not adapt
            _path(sampler, density, length.warmup)
        warmup = stopwatch.read(density.inside)
        density.inside = 0
        u = np.stack([_path(sampler, density, length.draws) for sampler in samplers])
        return Outcome(target.from_unit(u), warmup, stopwatch.read(density.inside))

    return once


def _path(sampler: pints.SingleChainMCMC, density: InBox, steps: int) -> FloatArray:
    return np.array([sampler.tell(density(sampler.ask()))[0] for _ in range(steps)])
