"""A profile of the time: python -m tests.benchmarks.profile OUT.md.

One experiment of `fmu paper` is profiled by sampling the stack every few milliseconds (a profiler that hooks into
every call would slow short calls most). One log-probability is divided into layers, which are timed from the
inside out.
"""

from __future__ import annotations

import signal
import sys
import tempfile
import time
import timeit
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import FrameType

import numpy as np
from numpy.typing import NDArray

import fmu
from fmu.paper.plan import Plan
from fmu.paper.run import run_experiment
from fmu.tables import markdown_table
from fmu.types import FloatArray

CASE, PAIRING = "cantilever-young", "shape"
SHORTER = 4

# the file of the innermost frame that is listed here tells what the time was spent on
PLACES = {
    "/fmu/fem/": "structure: assembly, eigenproblems, pairing, training",
    "/fmu/posterior/": "prior, likelihood, search for maxima",
    "/emcee/": "Python code of emcee",
    "/fmu/samplers/": "Python code of fmu's samplers",
    "/matplotlib/": "figures",
    "/arviz": "ArviZ: R-hat, ESS, intervals",
    "/fmu/analysis/": "other analysis",
    "/fmu/report/": "pages and tables",
}
SAMPLERS = {"metropolis.py": "mh", "slice.py": "slice", "trajectory.py": "hmc", "ensemble.py": "emcee"}

TEXT = """## Profile of the time

One experiment of `fmu paper` ({case} by {pairing}, a quarter of its draws) took {cpu:.0f} s of processor time. The
shares are from samples of the call stack.

{paper}
The next table has the time of each sampler, and the part of it that is spent in log-probabilities and gradients.

{samplers}
One log-probability of {case} is divided into layers. The table has the processor time that each layer adds to the
layers inside it, in µs per θ, the shortest of many repetitions, for a single θ and in a batch of 64.

{layers}
"""


class Watch:
    """Samples the call stack every few milliseconds of processor time, and counts the places that it finds."""

    def __init__(self, every: float = 0.004) -> None:
        self.every = every
        self.places: Counter[str] = Counter()
        self.steps: Counter[tuple[str, bool]] = Counter()

    def __enter__(self) -> Watch:
        self._handler = signal.signal(signal.SIGPROF, self._look)
        signal.setitimer(signal.ITIMER_PROF, self.every, self.every)
        return self

    def __exit__(self, *exception: object) -> None:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, self._handler)

    def _look(self, number: int, frame: FrameType | None) -> None:
        files = _files(frame)
        self.places[next((PLACES[p] for file in files for p in PLACES if p in file), "everything else")] += 1
        sampler = next((SAMPLERS[Path(f).name] for f in files if _is_sampler(f)), None)
        if sampler is not None:
            self.steps[sampler, any("/fmu/posterior/" in f or "/fmu/fem/" in f for f in files)] += 1


def main(out: str) -> None:
    """Measure and write."""
    plan = Plan(weighted=())
    shorter = {name: replace(length, draws=length.draws // SHORTER) for name, length in plan.long.items()}
    fmu.cases.load(CASE, PAIRING)  # trained, or read from the cache
    began = time.process_time()
    with tempfile.TemporaryDirectory() as directory, Watch() as watch:
        run_experiment(CASE, PAIRING, replace(plan, long=shorter), Path(directory), None)
    cpu = time.process_time() - began
    samples = watch.places.total()
    names = dict.fromkeys(name for name, _ in watch.steps)
    text = TEXT.format(
        case=CASE,
        pairing=PAIRING,
        cpu=cpu,
        paper=markdown_table(
            ["part", "share"], [[w, f"{n / samples:.1%}"] for w, n in watch.places.most_common()]
        ),
        samplers=markdown_table(
            ["sampler", "share of all time", "part in evaluations"],
            [[name, *_shares(watch.steps, name, samples)] for name in names],
        ),
        layers=layers(),
    )
    Path(out).write_text(text)


def layers() -> str:
    """Return the table of the time that each layer of a log-probability takes."""
    problem = fmu.cases.load(CASE, PAIRING)
    block = problem.model.cheap.blocks[problem.model.pairing.block[0]]
    count = problem.data.n_modes

    def reduced_stiffness(theta: FloatArray) -> FloatArray:
        K = problem.model.structure.K(theta).toarray()[np.ix_(block.dofs, block.dofs)]
        return block.basis.T @ K @ block.basis

    columns = []
    for n in (1, 64):
        theta = problem.sample_prior(np.random.default_rng(1), n)
        A = np.stack([reduced_stiffness(x) for x in theta])
        inside_out: list[tuple[str, Callable[[], object]]] = [
            ("LAPACK through numpy.linalg.eigvalsh", lambda A=A: np.linalg.eigvalsh(A)),
            ("assembly of the reduced matrix", lambda t=theta: block.eigenvalues(t, count)),
            (
                "pairing, bounds of the trained box, BLAS threads, √λ/2π",
                lambda t=theta: problem.model.frequencies(t),
            ),
            ("error model", lambda t=theta: problem.likelihood.terms(t)),
            ("prior, bounds, failures", lambda t=theta: problem.log_prob(t)),
        ]
        took = _best([run for _, run in inside_out]) / n
        columns.append([*np.diff(took, prepend=0.0), took[-1]])
    names = [*(name for name, _ in inside_out), "all layers"]
    rows = [[name, f"{one:.1f}", f"{batch:.1f}"] for name, one, batch in zip(names, *columns, strict=True)]
    return markdown_table(["layer", "single θ", "batch of 64"], rows)


def _best(runs: list[Callable[[], object]], rounds: int = 40) -> NDArray[np.float64]:
    """Return the shortest processor time of each run, in µs; the runs take turns."""
    timers = [timeit.Timer(run, timer=time.process_time) for run in runs]
    numbers = [1 + timer.autorange()[0] // 40 for timer in timers]
    took = [[timer.timeit(n) / n for timer, n in zip(timers, numbers, strict=True)] for _ in range(rounds)]
    return 1e6 * np.min(took, axis=0)


def _files(frame: FrameType | None) -> list[str]:
    files = []
    while frame is not None:
        files.append(frame.f_code.co_filename)
        frame = frame.f_back
    return files


def _is_sampler(file: str) -> bool:
    return "/fmu/samplers/" in file and Path(file).name in SAMPLERS


def _shares(steps: Counter[tuple[str, bool]], name: str, samples: int) -> tuple[str, str]:
    in_all = steps[name, True] + steps[name, False]
    return f"{in_all / samples:.1%}", f"{steps[name, True] / in_all:.0%}"


if __name__ == "__main__":
    main(*sys.argv[1:])
