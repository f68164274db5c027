"""A run on the paper's first beam that is kept on disk and tells every step, to be killed.

python -m tests.validation.kills_run SAMPLER DIRECTORY RESULT.npz
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import fmu
from fmu.runs import Checkpoint
from fmu.runs.identity import Identity
from fmu.runs.store import Store
from fmu.samplers import Run, make_sampler

LOSS_STEPS, LOSS_S = 100, 0.5
"""What a group of chains may lose."""


@dataclass(frozen=True)
class Size:
    """Of a run: of one to three seconds."""

    warmup: int
    draws: int
    chains: int
    groups: int


SIZES = {
    "mh": Size(500, 2000, 4, 2),
    "slice": Size(400, 1200, 4, 1),
    "hmc": Size(250, 750, 4, 2),
    "emcee": Size(150, 400, 2, 2),
    "tempering": Size(150, 300, 4, 1),
}
Tell = Callable[[str, int, int, Mapping[str, Any]], None]


def load() -> fmu.UpdatingProblem:
    """Return the problem."""
    return fmu.cases.load("cantilever-young", pairing="shape")


def drawn(
    problem: fmu.UpdatingProblem, name: str, directory: Path | None = None, tell: Tell | None = None
) -> dict[str, NDArray[Any]]:
    """Return all draws and statistics of the run of a sampler, warm-up included, by name.

    It is kept in a directory, and what is there already is not drawn again.
    """
    size = SIZES[name]
    with ExitStack() as stack:
        store = None
        if directory is not None:
            where = Checkpoint(directory, draws=LOSS_STEPS, seconds=LOSS_S)
            identity = Identity.of({"problem": problem.configuration(), "sampler": name})
            store = stack.enter_context(Store(where, identity, problem.names, problem.units))
        settings = {"warmup": size.warmup, "chains": size.chains, "groups": size.groups, "seed": 1}
        begun = Run(problem, make_sampler(name), **settings, init="prior", progress=tell, checkpointer=store)  # type: ignore[arg-type]
        result = begun.extend(size.draws)
    found = {}
    for phase in ("warmup", "posterior"):
        draws = getattr(result, phase)
        found[f"{phase}/position"] = draws.position
        found |= {f"{phase}/{key}": value for key, value in draws.stats.items()}
    return found


def same(one: Mapping[str, NDArray[Any]], other: Mapping[str, NDArray[Any]]) -> bool:
    """Say whether two runs are the same to the last bit."""
    return one.keys() == other.keys() and all(
        (one[key].dtype, one[key].shape, one[key].tobytes())
        == (other[key].dtype, other[key].shape, other[key].tobytes())
        for key in one
    )


def teller(pipe: int) -> Tell:
    """Return what writes a line a step into a pipe: group, phase, number, time."""

    def tell(phase: str, done: int, total: int, info: Mapping[str, Any]) -> None:
        group = str(info.get("group", "1")).partition("/")[0]
        os.write(pipe, f"{group} {phase} {done} {time.monotonic()}\n".encode())

    return tell


def main(name: str, directory: str, result: str) -> None:
    """Run to the end."""
    with threadpool_limits(1):
        np.savez(result, **drawn(load(), name, Path(directory), teller(sys.stdout.fileno())))  # type: ignore[arg-type]


if __name__ == "__main__":
    main(*sys.argv[1:])
