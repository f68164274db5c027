"""One row of the study of scale, measured in a process of its own.

python -m tests.validation.scale_row ROW_AS_JSON OUT_FILE
"""

from __future__ import annotations

import json
import os
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fmu.fem.modes import full_block, solver
from fmu.fem.modes.factors.banded import BandedFactor
from fmu.fem.modes.factors.pardiso import Pardiso
from fmu.fem.modes.factors.superlu import SuperLU
from fmu.fem.reduced.reduced_structure import reduced_in
from fmu.posterior.reduction import train_reduced as focus
from tests.validation.peak_memory import peak_gib
from tests.validation.scale_model import Size, scale_problem

REPEATS, AT_MOST_S = 5, 20.0
CHECKED, CHECKED_LARGE, LARGE = 16, 4, 50_000
"""Draws of the prior at which the reduced model is held against the full one; of large frames, in DOF, fewer."""


@dataclass(frozen=True)
class Row:
    """What is to be measured.

    Attributes
    ----------
    storeys, x_axes, y_axes : int
    parameters : int
    reduction : float
    chains : int
        Theta in a batch.
    cached : bool
        Whether the basis was trained by another process: what a run takes that has nothing to train.
    solver : {"SuperLU", "PARDISO"}
    """

    storeys: int
    x_axes: int
    y_axes: int
    parameters: int
    reduction: float
    chains: int = 64
    cached: bool = False
    solver: str = solver.SUPERLU

    @property
    def size(self) -> Size:
        """The frame's."""
        return Size(self.storeys, self.x_axes, self.y_axes)

    @property
    def name(self) -> str:
        """Name of its file."""
        rest = ("-cached" if self.cached else "") + (f"-{self.solver}" if self.solver != solver.SUPERLU else "")
        return f"{self.size.n_dof}-{self.parameters}-{self.reduction:g}-{self.chains}{rest}"


def seconds(call: Callable[[], Any]) -> float:
    """Return the processor seconds of a call, the least of a few."""
    taken, began = [], time.perf_counter()
    while len(taken) < REPEATS and (not taken or time.perf_counter() - began < AT_MOST_S):
        busy = time.process_time()
        call()
        taken.append(time.process_time() - busy)
    return min(taken)


class Stopwatch:
    """Counts calls of a function, or what they are given, and their processor seconds."""

    def __init__(self, owner: Any, name: str, count: Callable[..., int] = lambda *_: 1) -> None:
        self.n, self.s = 0, 0.0
        whole = getattr(owner, name)

        def counted(*arguments: Any) -> Any:
            busy = time.process_time()
            found = whole(*arguments)
            self.s += time.process_time() - busy
            self.n += count(*arguments)
            return found

        setattr(owner, name, counted)


def measured(row: Row) -> dict[str, Any]:
    """Return the row with what was measured."""
    if solver.sparse_solver() != row.solver:
        raise RuntimeError(f"row {row.name} is of {row.solver} (here: {solver.sparse_solver()})")
    full = Stopwatch(full_block, "eigen")
    kinds = (BandedFactor, SuperLU, Pardiso)
    factors = [Stopwatch(kind, "__init__") for kind in kinds]
    loads = [Stopwatch(kind, "solve", lambda _, b: 1 if b.ndim == 1 else b.shape[1]) for kind in kinds]
    began, busy = time.perf_counter(), time.process_time()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", focus.ReductionWarning)
        problem = scale_problem(row.size, row.parameters, row.reduction)
    found: dict[str, Any] = {
        "offline_wall_s": time.perf_counter() - began,
        "offline_s": time.process_time() - busy,
        "offline_gib": peak_gib(),
        "full_solves": full.n,
        "factorisations": sum(watch.n for watch in factors),
        "factorising_s": sum(watch.s for watch in factors),
        "right_hand_sides": sum(watch.n for watch in loads),
        "solving_s": sum(watch.s for watch in loads),
        "said": [str(warning.message) for warning in said],
    }
    structure: Any = problem.model
    theta = problem.sample_prior(np.random.default_rng(3), row.chains)
    found["basis"] = sum(structure.sizes)  # 0 where the full model answers, as a basis would save little
    found["value_s"] = seconds(lambda: problem.log_prob(theta)) / row.chains
    found["gradient_s"] = seconds(lambda: problem.log_prob_and_grad(theta)) / row.chains
    found["online_gib"] = peak_gib()
    some = problem.sample_prior(np.random.default_rng(4), CHECKED_LARGE if row.size.n_dof > LARGE else CHECKED)
    exact, reduced, busy = structure.truth.modes(some), structure.modes(some), time.process_time()
    bound = np.zeros(len(some)) if reduced_in(structure) is None else structure.frequency_bound(some)
    found["bound_s"] = (time.process_time() - busy) / len(some)
    same = (exact.rank == reduced.rank).all(axis=1)
    found["checked"] = int(np.sum(same))
    found["frequency_error"] = float(np.max(np.abs(np.sqrt(reduced.eigenvalues / exact.eigenvalues) - 1.0)[same]))
    found["frequency_bound"] = float(np.max(bound[same]))
    # a theta of its own: the last one is remembered
    points = iter(problem.sample_prior(np.random.default_rng(5), REPEATS))
    found["full_s"] = seconds(lambda: structure.truth.modes(next(points)[None]))
    return asdict(row) | found | {"peak_gib": peak_gib(), "finished": time.strftime("%Y-%m-%d %H:%M")}


if __name__ == "__main__":
    os.environ.setdefault("FMU_CACHE_DIR", "")
    Path(sys.argv[2]).write_text(json.dumps(measured(Row(**json.loads(sys.argv[1]))), indent=1), encoding="utf-8")
