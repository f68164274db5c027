"""What more workers give: groups of chains in processes, and single evaluations of a Python function.

    python -m tests.validation.workers OUT [--kept DIRECTORY] [--minutes M]

One and two workers take turns, three times each, on the same run; the draws are compared in every bit, those of
eight workers too. Times are by the clock: measure on a machine that has nothing else to do.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import fmu
from fmu.engines import default_workers, engine
from fmu.engines.base import Engine
from fmu.tables import markdown_table
from tests.validation.kept import Units, study_parser
from tests.validation.scale_model import Size, scale_problem

PAIRS = 3
MANY = 8
CHAINS, GROUPS, STEPS = 64, 8, 30
CALL_S = 0.02
_GROUPS = ("posterior", "warmup_posterior", "sample_stats")


def slow(theta: np.ndarray) -> np.ndarray:
    """Answer like a finite-element program that takes its time: it keeps a core busy for 20 ms."""
    until = time.perf_counter() + CALL_S
    while time.perf_counter() < until:
        pass
    return np.sqrt(np.array([theta[0] + theta[1], theta[1]]))


def frame_run(at_work: Engine) -> Callable[[], Any]:
    """Return a run of groups of chains on a frame of 1008 degrees of freedom with 20 parameters."""
    problem = scale_problem(Size(28, 3, 2), 20, 1e-3)
    return lambda: fmu.sample(
        problem,
        "hmc",
        draws=STEPS,
        warmup=STEPS,
        chains=CHAINS,
        groups=GROUPS,
        seed=1,
        init="prior",
        workers=at_work,
    )


def function_run(at_work: Engine) -> Callable[[], Any]:
    """Return a run of an ensemble on a Python function, its evaluations spread.

    Each run has a model of its own, because a model remembers its answers.
    """
    parameters = [fmu.Parameter(n, start=1.0, lower=0.5, upper=1.5) for n in ("k1", "k2")]

    def run() -> Any:
        model = fmu.BlackBoxModel(slow, 2)
        problem = fmu.UpdatingProblem.reduced(model, fmu.ModalData([1.4, 1.0], sd_hz=[0.02, 0.02]), parameters)
        with model.spread_over(at_work):
            return fmu.sample(problem, "emcee", draws=5, warmup=5, chains=1, seed=1, init="prior")

    return run


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Return what a call takes by the clock, and what it returns."""
    began = time.perf_counter()
    found = call()
    return time.perf_counter() - began, found


def same(one: Any, other: Any) -> bool:
    """Say whether two traces hold the same draws, bit for bit."""
    return all(one[group].identical(other[group]) for group in _GROUPS)


def compared(make: Callable[[Engine], Callable[[], Any]]) -> dict[str, Any]:
    """Measure a run with one and with two workers, and compare its draws with those of eight."""
    seconds: dict[int, list[float]] = {1: [], 2: []}
    with engine(1) as alone, engine(2) as both:
        runs = {1: make(alone), 2: make(both)}
        first = [run() for run in runs.values()]  # starts the workers
        for _ in range(PAIRS):
            for n, run in runs.items():
                taken, trace = timed(run)
                seconds[n].append(taken)
                first.append(trace)
    with engine(MANY) as crowd:
        first.append(make(crowd)())
    t1, t2 = (float(np.median(seconds[n])) for n in (1, 2))
    ratios = np.array(seconds[1]) / np.array(seconds[2])
    shared = min(2.0 * (t1 - t2), t1)  # T(n) = rest + shared/n
    return {
        "t1": t1,
        "t2": t2,
        "ratio": t1 / t2,
        "spread": f"{ratios.min():.2f} to {ratios.max():.2f}",
        "projected": t1 / (t1 - shared + shared / MANY),
        "same": sum(same(first[0], trace) for trace in first),
        "of": len(first),
    }


def page(found: dict[str, dict[str, Any]]) -> str:
    """Return what was measured as Markdown."""
    rows = [
        (
            name, f"{row['t1']:.1f}", f"{row['t2']:.1f}", f"{row['ratio']:.2f}", row["spread"],
            f"{row['projected']:.1f}", f"{row['same']} of {row['of']}",
        )
        for name, row in found.items()
    ]  # fmt: skip
    header = ("run", "1 worker, s", "2 workers, s", "faster", "in pairs", f"{MANY}, projected", "equal draws")
    return f"""# More workers

Written by `python -m tests.validation.workers results` on {default_workers()} cores, by the clock: medians of
{PAIRS} runs, one and two workers in turn, the workers already started (which takes some two seconds, once). Equal
draws: runs whose draws and statistics are those of the first in every bit, one of them with {MANY} workers.

{markdown_table(header, rows, words=(0, 4, 6))}

- frame: 1008 degrees of freedom, 20 parameters, `reduction=1e-3`; HMC, {CHAINS} chains in {GROUPS} groups,
  {STEPS} + {STEPS} steps.
- function: a Python function that takes {1000 * CALL_S:.0f} ms a call; the search for maxima, and emcee with 32
  walkers, 5 + 5 steps. Single evaluations are spread.

The projection to {MANY} workers is Amdahl's law through the two measured times, T(n) = rest + shared/n. It was
not measured: there were no more cores. No run is faster than its number of groups allows, and all wait for the
slowest group at the end of warm-up; an ensemble of emcee moves one half of its walkers at a time, so that more
workers than half the walkers have nothing to do.
"""


def main() -> int:
    """Measure and write the page; 1 if any draws differ."""
    asked = study_parser(__doc__).parse_args()
    runs = {"frame": frame_run, "function": function_run}
    with tempfile.TemporaryDirectory() as cache:
        os.environ["FMU_CACHE_DIR"] = cache
        rows = Units(asked.kept, asked.minutes).completed("runs", runs.items(), compared)
    found = dict(zip(runs, rows, strict=False))
    (asked.out / "workers.md").write_text(page(found), encoding="utf-8")
    return int(any(row["same"] != row["of"] for row in found.values()))


if __name__ == "__main__":
    sys.exit(main())
