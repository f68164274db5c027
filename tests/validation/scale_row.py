"""One row of the study of scale, measured in a process of its own.

python -m tests.validation.scale_row ROW_AS_JSON OUT_FILE
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import fmu
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.reduced.basis import ReducedBlock
from fmu.posterior import train_reduced as focus
from tests.validation.scale_model import Size, scale_problem

REPEATS, AT_MOST_S = 5, 20.0
CHECKED = 16
"""Draws of the prior at which the reduced model is held against the full one."""


@dataclass(frozen=True)
class Row:
    """What is to be measured.

    Attributes
    ----------
    storeys, x_axes, y_axes : int
    parameters : int
    reduction : float or False
        False: the full model alone, of which a single solve is measured.
    chains : int
        Theta in a batch.
    steps : int
        Of a run after warm-up of as many; 0: no run.
    cached : bool
        Whether the basis was trained by another process: what a run takes that has nothing to train.
    """

    storeys: int
    x_axes: int
    y_axes: int
    parameters: int
    reduction: float | bool
    chains: int = 64
    steps: int = 0
    cached: bool = False

    @property
    def size(self) -> Size:
        """The frame's."""
        return Size(self.storeys, self.x_axes, self.y_axes)

    @property
    def name(self) -> str:
        """Name of its file."""
        promised = f"{self.reduction:g}" if self.reduction else "full"
        rest = (f"-run{self.steps}" if self.steps else "") + ("-cached" if self.cached else "")
        return f"{self.size.n_dof}-{self.parameters}-{promised}-{self.chains}{rest}"


def peak_gib() -> float:
    """Return the largest resident set of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def seconds(call: Callable[[], Any]) -> float:
    """Return the processor seconds of a call, the least of a few."""
    taken, began = [], time.perf_counter()
    while len(taken) < REPEATS and (not taken or time.perf_counter() - began < AT_MOST_S):
        busy = time.process_time()
        call()
        taken.append(time.process_time() - busy)
    return min(taken)


class Stopwatch:
    """Counts what training spends on full solves, and how many of them."""

    def __init__(self) -> None:
        self.solves, self.solving = 0, 0.0

    def __call__(self, owner: Any, name: str, count: Callable[..., int]) -> None:
        """Replace a function of `owner` by one that is counted."""
        whole = getattr(owner, name)

        def counted(*arguments: Any) -> Any:
            busy = time.process_time()
            found = whole(*arguments)
            self.solving += time.process_time() - busy
            self.solves += count(*arguments)
            return found

        setattr(owner, name, counted)


def measured(row: Row) -> dict[str, Any]:
    """Return the row with what was measured."""
    watch = Stopwatch()
    watch(FullBlock, "modes", lambda block, theta, count: len(theta))
    found: dict[str, Any] = {"peak_before_gib": peak_gib()}
    began, busy = time.perf_counter(), time.process_time()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", focus.ReductionWarning)
        problem = scale_problem(row.size, row.parameters, row.reduction)
    found |= {"offline_wall_s": time.perf_counter() - began, "offline_s": time.process_time() - busy}
    found |= {"offline_solves": watch.solves, "offline_solving_s": watch.solving, "offline_gib": peak_gib()}
    found["said"] = [str(warning.message) for warning in said]
    structure: Any = problem.model
    theta = problem.sample_prior(np.random.default_rng(3), row.chains)
    found["full_s"] = seconds(lambda: structure.full_modes(theta[:1]))
    if row.reduction:
        found["basis"] = sum(b.size for b in structure.reduced.blocks if isinstance(b, ReducedBlock))
        found["pairing"] = type(structure.pairing).__name__
        found["value_s"] = seconds(lambda: problem.log_prob(theta)) / row.chains
        found["gradient_s"] = seconds(lambda: problem.log_prob_and_grad(theta)) / row.chains
        found["online_gib"] = peak_gib()
        some = problem.sample_prior(np.random.default_rng(4), CHECKED)
        exact, reduced = structure.full_modes(some), structure.modes(some)
        found["frequency_error"] = float(np.max(np.abs(np.sqrt(reduced.eigenvalues / exact.eigenvalues) - 1.0)))
    if row.steps:
        found |= run(problem, row)
    return asdict(row) | found | {"peak_gib": peak_gib(), "finished": time.strftime("%Y-%m-%d %H:%M")}


def run(problem: fmu.UpdatingProblem, row: Row) -> dict[str, Any]:
    """Return what a run costs, and what its certificate says."""
    began, busy = time.perf_counter(), time.process_time()
    trace = fmu.sample(
        problem,
        fmu.HamiltonianMonteCarlo(n_steps=4),
        draws=row.steps,
        warmup=row.steps,
        chains=row.chains,
        seed=1,
        init="prior",
        progress=False,
    )
    wall, cpu = time.perf_counter() - began, time.process_time() - busy
    summary, attrs = fmu.summary(trace), trace.attrs
    kept = {name: value for name, value in attrs.items() if name.startswith("certificate_")}
    return {
        "run_wall_s": wall,
        "run_s": cpu,
        "sampling_s": float(attrs["wall_s"]),
        "gradients": int(attrs["n_gradients"] + attrs["warmup_n_gradients"]),
        "rhat": float(summary["rhat"].max()),
        "ess": float(summary["ess_bulk"].min()),
        "verdict": bool(fmu.diagnose(trace).converged),
        "certificate": {name.removeprefix("certificate_"): value for name, value in kept.items()},
    }


if __name__ == "__main__":
    os.environ.setdefault("FMU_CACHE_DIR", "")
    Path(sys.argv[2]).write_text(json.dumps(measured(Row(**json.loads(sys.argv[1]))), indent=1), encoding="utf-8")
