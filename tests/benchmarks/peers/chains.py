"""Chains of PINTS, on fmu's log-probability and the unit box."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pints

from fmu.types import FloatArray
from tests.benchmarks.peers.posteriors import Target
from tests.benchmarks.peers.run import Meter, Run

CHAINS = 4


def pints_adaptive(target: Target, warmup: int, draws: int, seed: int) -> Run:
    """Run PINTS's default, the adaptive Metropolis of Haario and Bardenet.

    By ask and tell, chain by chain, as its controller does. It goes on adapting after the warm-up, its default.
    """
    np.random.seed(seed)  # noqa: NPY002  (PINTS draws from NumPy's global state)
    samplers = [pints.HaarioBardenetACMC(u) for u in target.to_unit(target.starts(seed, CHAINS))]
    meter = Meter(target)

    def density(u: FloatArray) -> float:
        return float(target.problem.log_prob(target.from_unit(u)))

    with meter.counting():
        for sampler in samplers:
            sampler.set_initial_phase(False)  # in which it would not adapt
            _path(sampler, density, warmup)
        warmed = meter.read()
        u = np.stack([_path(sampler, density, draws) for sampler in samplers])
        drawn = meter.read()
    return Run.of_chains(target.from_unit(u), warmup=warmed, draws=drawn)


def _path(sampler: pints.SingleChainMCMC, density: Callable[[FloatArray], float], steps: int) -> FloatArray:
    return np.array([sampler.tell(density(sampler.ask()))[0] for _ in range(steps)])
