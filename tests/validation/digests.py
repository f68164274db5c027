"""Digests of what all samplers draw on all built-in cases, to see that a change of the code alters no draw.

    python -m tests.validation.digests FILE
    python -m tests.validation.digests --against FILE

The first writes them, the second compares, lists the runs that differ, and has the exit code 1 if there are some.
Users' functions, alone and in several tests, are sampled too, and one run is interrupted and resumed. Digests
differ between machines and versions of packages.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import fmu
from fmu.analysis.maxima.search import is_searchable
from fmu.analysis.maxima.starts import choose_starts, components
from fmu.samplers.loop.run import Run
from fmu.samplers.registry import COMPARED, make_sampler

WARMUP, DRAWS, CHAINS, SEED = 200, 200, 4, 1
RESUMED = ("shear-2dof", "hmc")
SOFT = 130.0
"""N/m: a lower storey that is softer makes the function fail."""


def frequencies(theta: Any) -> Any:
    """Return the two frequencies of a shear building of unit masses, Hz; fail where the lower storey is soft."""
    if theta[0] < SOFT:
        raise RuntimeError("mesh is inverted")
    k, m = theta
    return np.sqrt(np.linalg.eigvalsh(np.array([[k + m, -m], [-m, m]]))) / (2.0 * np.pi)


def function() -> fmu.UpdatingProblem:
    """Return a problem of a user's function."""
    parameters = [fmu.Parameter(name, 300.0, 100.0, 600.0) for name in ("k1", "k2")]
    return fmu.UpdatingProblem(fmu.BlackBoxModel(frequencies, 2), fmu.ModalData([1.7, 4.5], sd_hz=0.2), parameters)


def tests_of_a_function() -> fmu.UpdatingProblem:
    """Return a problem of three tests of a user's function."""
    parameters = [fmu.Parameter(name, 300.0, 100.0, 600.0) for name in ("k1", "k2")]
    tests = [
        fmu.Test(f"test {i}", fmu.ModalData([1.7, 4.5 + 0.1 * i], sd_hz=0.2, labels=("one", "two")))
        for i in range(3)
    ]
    return fmu.JointProblem(fmu.BlackBoxModel(frequencies, 2), tests, parameters, varies={"k1": "test"})


def problems() -> dict[str, fmu.UpdatingProblem]:
    """Return the problems by name."""
    built_in = {name: fmu.cases.load(name) for name in fmu.cases.names()}
    return built_in | {"function": function(), "function, three tests": tests_of_a_function()}


def digest(*arrays: Any) -> str:
    """Return a hash of arrays."""
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array, dtype=float).tobytes())
    return found.hexdigest()


def digests() -> Iterator[tuple[str, str]]:
    """Yield the name of each run, and the digest of its warm-up, its draws and their log-probabilities."""
    for name, problem in problems().items():
        maxima = fmu.find_map(problem) if is_searchable(problem) else None
        if maxima is not None:
            yield f"{name}: maxima", digest(*(value for one in maxima for value in (one.theta, one.log_prob)))
        for sampler in COMPARED:
            settings = make_sampler(sampler).starting_from(*components(problem, maxima))
            if settings.walkers > 1:
                settings = replace(settings, walkers=max(settings.walkers, 2 * problem.ndim))
            start = choose_starts(problem, "maxima", maxima, CHAINS, settings.walkers, SEED).position
            run = Run(problem, settings, warmup=WARMUP, chains=CHAINS, seed=SEED, init=start)
            found = run.extend(DRAWS)
            parts = (found.warmup, found.posterior)
            yield f"{name}: {sampler}", digest(*(one for p in parts for one in (p.position, p.stats["lp"])))
    yield f"{', '.join(RESUMED)}: resumed", resumed()


def resumed() -> str:
    """Return the digest of the draws of a run that was interrupted in the middle of its draws."""
    problem = fmu.cases.load(RESUMED[0])

    def interrupt(phase: str, done: int, total: int, info: object) -> None:
        if phase == "draws" and done == DRAWS // 2:
            raise KeyboardInterrupt

    with tempfile.TemporaryDirectory() as folder:
        options = {"draws": DRAWS, "warmup": WARMUP, "seed": SEED, "checkpoint": Path(folder) / "run"}
        try:
            fmu.sample(problem, RESUMED[1], progress=interrupt, **options)  # type: ignore[arg-type]
        except KeyboardInterrupt:
            trace = fmu.sample(problem, RESUMED[1], **options)  # type: ignore[arg-type]
        else:
            raise RuntimeError("the run was not interrupted")
    return digest(*(trace.posterior[name] for name in problem.names), trace.sample_stats["lp"])


def main() -> int:
    """Write the digests, or compare them with those of a file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, nargs="?", help="where the digests are written")
    parser.add_argument("--against", type=Path, help="digests to compare with")
    given = parser.parse_args()
    if (given.file is None) == (given.against is None):
        parser.error("give FILE or --against FILE")
    found = {}
    with threadpool_limits(1, "blas"):
        for name, value in digests():
            print(f"{value[:12]}  {name}", flush=True)
            found[name] = value
    if given.against is None:
        given.file.write_text(json.dumps(found, indent=1) + "\n")
        return 0
    before = json.loads(given.against.read_text())
    different = [name for name in before | found if before.get(name) != found.get(name)]
    print("\n".join(["These differ:", *different]) if different else f"All {len(found)} are equal.")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
