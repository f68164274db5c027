"""Modes of a solid by PARDISO with factors in memory and in files: processor seconds, memory, and frequencies.

python -m tests.benchmarks.out_of_core [NX NY NZ]
"""

from __future__ import annotations

import sys
import time
import warnings
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import scipy.sparse as sp

from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.factors import memory, pardiso
from fmu.fem.modes.solver import PARDISO, factorise
from fmu.tables import markdown_table
from tests.validation.large_files import N_MODES, STEEL, plate

CELLS, COLUMNS = (60, 30, 12), 32


def resident_mib() -> float:
    """Return the memory of this process, MiB."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return float(next(line.split()[1] for line in lines if line.startswith("VmRSS"))) / 1024


def measured(K: sp.csr_array, M: Any, free: int | None) -> tuple[list[float], np.ndarray]:
    """Return processor seconds of factors, of solves and of modes, the MiB of the factors, and frequencies, Hz."""
    modules = [patch.object(module, "free_memory", lambda: free) for module in (memory, pardiso)]
    with modules[0], modules[1], warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        before, began = resident_mib(), time.process_time()
        factor = factorise(K, PARDISO)
        made = time.process_time()
        factor.solve(np.ones((len(K.indptr) - 1, COLUMNS)))
        solved, held = time.process_time(), resident_mib() - before
        del factor
        lam, _ = eigen(K, M, N_MODES)
        ended = time.process_time()
    for line in {str(one.message) for one in said}:
        print(line)
    return [made - began, solved - made, ended - solved, held], np.sqrt(lam) / (2.0 * np.pi)


def main(arguments: list[str]) -> int:
    """Print the table; 1 if the frequencies differ by more than 1e-10."""
    stiffness, mass = plate(tuple(map(int, arguments)) or CELLS)  # type: ignore[arg-type]
    K = sp.csr_array(sum(STEEL * matrix for matrix in stiffness))
    factor = factorise(K, PARDISO)
    needed = factor.n_bytes
    del factor
    rows, found = [], []
    for name, free in (("in memory", None), ("in files", int(0.6 * needed))) * 2:
        numbers, frequencies = measured(K, mass, free)
        rows.append((name, *(f"{of:.1f}" for of in numbers)))
        found.append(frequencies)
        print(rows[-1], flush=True)
    apart = max(float(np.max(np.abs(of / found[0] - 1.0))) for of in found)
    print(f"{K.shape[0]} degrees of freedom, largest relative difference of a frequency: {apart:.1e}")
    header = ("factors", "factorise, s", f"{COLUMNS} right-hand sides, s", f"{N_MODES} modes, s", "memory, MiB")
    print(markdown_table(header, rows))
    return int(apart > 1e-10)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
