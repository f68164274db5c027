"""Where the time goes: python -m tests.benchmarks.profile OUT.md.

One experiment of `fmu paper`, watched by looking at the stack every few milliseconds (a profiler that hooks into
every call would slow the short ones most); and one log-probability, taken apart by timing its parts from the
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

# where a frame's file lies, innermost first, says what the time was spent on
PLACES = {
    "/fmu/fem/": "the structure: assembly, eigenproblems, pairing, training",
    "/fmu/posterior/": "prior, likelihood, search for maxima",
    "/emcee/": "emcee's own Python",
    "/fmu/samplers/": "the samplers' own Python",
    "/matplotlib/": "figures",
    "/arviz": "ArviZ: R-hat, ESS, intervals",
    "/fmu/analysis/": "the rest of the analysis",
    "/fmu/report/": "pages and tables",
}
SAMPLERS = {"metropolis.py": "mh", "slice.py": "slice", "trajectory.py": "hmc", "ensemble.py": "emcee"}

TEXT = """## Where the time goes

One experiment of `fmu paper` ({case} by {pairing}, a quarter of its draws) took {cpu:.0f} s of processor time:

{paper}
Sampling alone, and how much of it were log-probabilities and gradients:

{samplers}
One log-probability of {case}, alone and in a batch of 64: what each layer adds around the one inside it, in µs
of processor time a theta, the best of many.

{layers}
"""


class Watch:
    """Looks at the stack after every few milliseconds of processor time, and counts what it was doing."""

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
            ["what", "share"], [[w, f"{n / samples:.1%}"] for w, n in watch.places.most_common()]
        ),
        samplers=markdown_table(
            ["sampler", "of all time", "of which evaluations"],
            [[name, *_shares(watch.steps, name, samples)] for name in names],
        ),
        layers=layers(),
    )
    Path(out).write_text(text)


def layers() -> str:
    """Return what each layer of a log-probability takes."""
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
    names = [*(name for name, _ in inside_out), "in all"]
    rows = [[name, f"{one:.1f}", f"{batch:.1f}"] for name, one, batch in zip(names, *columns, strict=True)]
    return markdown_table(["layer", "alone", "batch of 64"], rows)


def _best(runs: list[Callable[[], object]], rounds: int = 40) -> NDArray[np.float64]:
    """Return the least processor time of each, in µs; they take turns."""
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
