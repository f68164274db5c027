"""Speed-up by two workers, for groups of chains and for single evaluations of a Python function.

    python -m tests.validation.workers OUT [--kept DIRECTORY] [--minutes M]

One and two workers do the same run in turn, three times each. Their draws, and those of eight workers, must be
equal bit by bit. Times are wall times: measure on an idle machine.
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
from fmu.numbers import names_in_words
from fmu.tables import markdown_table
from tests.validation.kept import Units, study_parser
from tests.validation.scale_model import Size, scale_problem

PAIRS = 3
MANY = 8
CHAINS, GROUPS, STEPS = 64, 8, 30
CALL_S = 0.02
_GROUPS = ("posterior", "warmup_posterior", "sample_stats")


def slow(theta: np.ndarray) -> np.ndarray:
    """Return two frequencies like a slow finite-element program that keeps a core busy for 20 ms."""
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
    """Return an emcee run on a Python function whose evaluations are spread over the workers.

    Each run has a new model, because a model remembers its answers.
    """
    parameters = [fmu.Parameter(n, start=1.0, lower=0.5, upper=1.5) for n in ("k1", "k2")]

    def run() -> Any:
        model = fmu.BlackBoxModel(slow, 2)
        problem = fmu.UpdatingProblem.reduced(model, fmu.ModalData([1.4, 1.0], sd_hz=[0.02, 0.02]), parameters)
        with model.spread_over(at_work):
            return fmu.sample(problem, "emcee", draws=5, warmup=5, chains=1, seed=1, init="prior")

    return run


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Return the wall time of a call, and its result."""
    began = time.perf_counter()
    found = call()
    return time.perf_counter() - began, found


def same(one: Any, other: Any) -> bool:
    """Say whether two traces hold the same draws, bit for bit."""
    return all(one[group].identical(other[group]) for group in _GROUPS)


def compared(make: Callable[[Engine], Callable[[], Any]]) -> dict[str, Any]:
    """Measure a run with one and with two workers, and compare its draws with those of eight workers."""
    seconds: dict[int, list[float]] = {1: [], 2: []}
    with engine(1) as alone, engine(2) as both:
        runs = {1: make(alone), 2: make(both)}
        first, *others = [run() for run in runs.values()]  # starts the workers
        for _ in range(PAIRS):
            for n, run in runs.items():
                taken, trace = timed(run)
                seconds[n].append(taken)
                others.append(trace)
    with engine(MANY) as crowd:
        others.append(make(crowd)())
    t1, t2 = (float(np.median(seconds[n])) for n in (1, 2))
    ratios = np.array(seconds[1]) / np.array(seconds[2])
    shared = min(2.0 * (t1 - t2), t1)  # T(n) = serial + shared/n
    return {
        "t1": t1,
        "t2": t2,
        "ratio": t1 / t2,
        "spread": f"{ratios.min():.2f} to {ratios.max():.2f}",
        "projected": t1 / (t1 - shared + shared / MANY),
        "same": sum(same(first, trace) for trace in others),
        "of": len(others),
    }


def page(found: dict[str, dict[str, Any]]) -> str:
    """Return the page in Markdown."""
    rows = [
        (
            name, f"{row['t1']:.1f}", f"{row['t2']:.1f}", f"{row['ratio']:.2f}", row["spread"],
            f"{row['projected']:.1f}", f"{row['same']} of {row['of']}",
        )
        for name, row in found.items()
    ]  # fmt: skip
    many = f"{MANY} workers, projected"
    header = ("run", "1 worker, s", "2 workers, s", "speed-up", "of the pairs", many, "equal runs")
    different = sum(row["of"] - row["same"] for row in found.values())
    of = sum(row["of"] for row in found.values())
    ratios = names_in_words([f"{row['ratio']:.2f} ({name})" for name, row in found.items()])
    equal = (
        f"{different} of {of} further runs have other draws than the first"
        if different
        else f"All {of} further runs repeat the draws of the first"
    )
    return f"""# Speed-up by more workers

How much faster are two workers than one, and do they give the same draws? **The speed-up is {ratios}. {equal}.**
Times are wall times on {default_workers()} cores, medians of {PAIRS} runs. One and two workers run in turn; they
are already started, which takes about two seconds once. *Of the pairs* is the range of the {PAIRS} single
speed-ups. *Equal runs* are the other runs that repeat all draws and statistics of the first one, bit by bit; one
of them has {MANY} workers.

{markdown_table(header, rows, words=(0, 4, 6))}
- frame: 1008 degrees of freedom, 20 parameters, `reduction=1e-3`; HMC with {CHAINS} chains in {GROUPS} groups,
  {STEPS} warm-up steps and {STEPS} draws.
- function: a Python function that takes {1000 * CALL_S:.0f} ms per call; search for maxima, and emcee with 32
  walkers, 5 warm-up steps and 5 draws. Single evaluations are spread over the workers.

The projection to {MANY} workers is an extrapolation by Amdahl's law, T(n) = serial + shared/n, from the two
measured times; the machine has too few cores to measure it. The speed-up cannot exceed the number of groups, and
all groups wait for the slowest one at the end of warm-up. An ensemble of emcee moves one half of its walkers at
a time: more workers than half the walkers are idle.
"""


def main() -> int:
    """Measure and write the page; return 1 if draws differ."""
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
