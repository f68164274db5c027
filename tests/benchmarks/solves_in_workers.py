"""Training and certificate of a plate of hexahedra with one worker and with two: clock and processor seconds.

python -m tests.benchmarks.solves_in_workers [NX NY NZ]
"""

from __future__ import annotations

import resource
import sys
import time
from typing import Any

import numpy as np
import scipy.sparse as sp

import fmu
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.solver import sparse_solver
from fmu.fem.modes.terms import Term
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.reduced.points import box_points
from fmu.fem.reduced.reduced_structure import train
from fmu.tables import markdown_table
from tests.validation.large_files import CELLS, N_MODES, STEEL, plate

TOLERANCE, SOLVED, PAIRS = 1e-3, 8, 2


def processor_seconds() -> float:
    """Return the processor seconds of this process and of the workers that have ended."""
    used = [resource.getrusage(of) for of in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(of.ru_utime + of.ru_stime for of in used)


def measured(model: SeparableModel, workers: int) -> tuple[list[float], list[np.ndarray]]:
    """Return seconds of training, of the certificate's solves and of the processors, and what was computed."""
    n = model.n_parameters
    lower, upper = np.full(n, 0.85 * STEEL), np.full(n, 1.2 * STEEL)
    structure = PairedStructure.of(
        model, pairing="index", numbers=tuple(range(1, N_MODES + 1)), sensors=(), reference=np.sqrt(lower * upper)
    )
    structure.modes(np.sqrt(lower * upper)[None])  # a run has solved at its start before training
    used, began = processor_seconds(), time.perf_counter()
    with fmu.engine(workers=workers) as engine, structure.spread_over(engine):
        reduced, state = train(structure, lower, upper, TOLERANCE)
        trained = time.perf_counter()
        modes = reduced.confirmed_modes(box_points(lower, upper, SOLVED, seed=1)[:SOLVED])
        ended = time.perf_counter()
    return [trained - began, ended - trained, processor_seconds() - used], [*state.values(), modes.eigenvalues]


def main(arguments: list[str]) -> int:
    """Print the table; 1 if the results are not the same in every bit."""
    stiffness, mass = plate(tuple(map(int, arguments)) or CELLS)  # type: ignore[arg-type]
    powers = np.eye(len(stiffness), dtype=int)
    terms = [Term(sp.csr_array(K), tuple(of.tolist())) for K, of in zip(stiffness, powers, strict=True)]
    model = SeparableModel(terms, [Term(sp.csr_array(mass), (0,) * len(terms))])
    rows: list[tuple[Any, ...]] = []
    first: list[np.ndarray] = []
    equal = True
    for workers in (1, 2) * PAIRS:
        seconds, found = measured(model, workers)
        first = first or found
        equal &= all(np.array_equal(one, other) for one, other in zip(first, found, strict=True))
        rows.append((str(workers), *(f"{of:.1f}" for of in seconds)))
        print(rows[-1], flush=True)
    print(f"{model.n_dof} degrees of freedom, {sparse_solver()}, the same in every bit: {equal}")
    header = ("workers", "training, s", f"{SOLVED} solves of the certificate, s", "processor, s")
    print(markdown_table(header, rows))
    return int(not equal)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
