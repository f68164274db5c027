"""The cost of saving a run to disk."""

import itertools
import time

import numpy as np
import pytest

from fmu.runs import Checkpoint
from fmu.runs.identity import Identity
from fmu.runs.store import Store
from fmu.samplers import HamiltonianMonteCarlo, Run
from tests.benchmarks.ratio import spread

CHAINS, WARMUP, DRAWS, PAIRS = 4, 300, 1500, 9
BUDGET = 1.05
EVERY = {"default": {}, "every 100 steps or every second": {"draws": 100, "seconds": 1.0}}


@pytest.fixture
def drawn(load, tmp_path):
    """Return a function that draws, and saves to a new directory if it is given the settings of a `Checkpoint`."""
    problem, number = load("cantilever-young"), itertools.count()
    identity = Identity.of(problem.configuration())
    settings = {"warmup": WARMUP, "chains": CHAINS, "seed": 1, "init": "prior"}

    def draw(every=None):
        if every is None:
            return Run(problem, HamiltonianMonteCarlo(), **settings).extend(DRAWS)
        where = Checkpoint(tmp_path / f"{next(number)}", **every)
        with Store(where, identity, problem.names, problem.units) as store:
            return Run(problem, HamiltonianMonteCarlo(), checkpointer=store, **settings).extend(DRAWS)

    return draw


@pytest.mark.parametrize("name", EVERY)
def test_hmc(drawn, benchmark, note, name):
    """Compare pairs of runs by processor time and by wall time, which includes waiting for the disk."""
    every = EVERY[name]
    benchmark.pedantic(drawn, args=(every,), rounds=1)
    took = np.array([[timed(drawn, each) for each in (every, None)] for _ in range(PAIRS)])
    busy, wall = (took[:, 0] / took[:, 1]).T
    what = f"HMC, cantilever-young, {CHAINS} chains of {WARMUP} + {DRAWS} steps, saved: {name}"
    met = bool(np.median(busy) <= BUDGET) if name == "default" else None
    note("checkpoints", what, spread(busy, BUDGET), f"≤ {BUDGET:g} ×" if met is not None else "—", met)
    note("checkpoints", f"{what}, wall time", spread(wall))


def timed(draw, every):
    """Return processor and wall time."""
    began, busy = time.perf_counter(), time.process_time()
    draw(every)
    return time.process_time() - busy, time.perf_counter() - began
