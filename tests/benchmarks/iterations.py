"""A solve by factors in double and single precision, and by algebraic multigrid: a solid, a shell and a frame.

    python -m tests.benchmarks.iterations [solid] [shell] [frame] [fine]

It needs the extra ``fast`` and pyamg. Times are processor seconds. Multigrid is smoothed aggregation with the six
rigid-body motions as near null space. Conjugate gradients end at a relative residual of 1e-8, or after 400 steps.
The frequencies of eight modes by factors in single precision are compared with those in double precision.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as ssl

from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.factors import pardiso
from fmu.fem.modes.solver import PARDISO, factorise, unit_diagonal
from fmu.numbers import significant, whole
from fmu.tables import markdown_table
from fmu.types import FloatArray
from tests.validation import wing_box
from tests.validation.large_files import SIDES, STEEL, plate
from tests.validation.scale_model import CONCRETE, Size, frame, frame_model

MOST, RESIDUAL = 400, 1e-8
N_MODES = 8

type Model = tuple[Any, Any, FloatArray, int]
"""Stiffness, mass, the positions of the free nodes, and the unknowns of each."""
type Solve = Callable[[FloatArray], FloatArray]


def solid(fine: bool) -> Model:
    """Return a plate of hexahedra."""
    import skfem

    cells = (80, 36, 10) if fine else (60, 30, 5)
    stiffness, mass = plate(cells)
    mesh = skfem.MeshHex.init_tensor(*(np.linspace(0.0, a, n + 1) for a, n in zip(SIDES, cells, strict=True)))
    return STEEL * sum(stiffness), mass, mesh.p.T[mesh.p[0] > 0.0], 3


def shell(fine: bool) -> Model:
    """Return a wing box."""
    nodes, groups = wing_box.wing_box((192, 30, 6) if fine else (96, 18, 4))
    stiffness, mass, _ = wing_box.matrices(nodes, groups)
    return wing_box.E * sum(stiffness.values()), mass, nodes[nodes[:, 0] > 0.0], 6


def building(fine: bool) -> Model:
    """Return the frame of a building."""
    size = Size(26, 26, 26) if fine else Size(17, 17, 17)
    nodes, model = np.asarray(frame(size, 5).nodes), frame_model(size, 5)
    moduli = np.full(5, CONCRETE.E)
    return model.K(moduli), model.M(moduli), nodes[nodes[:, 2] > 0.0], 6


def rigid(nodes: FloatArray, unknowns: int) -> FloatArray:
    """Return the rigid-body motions of nodes (n, 3) with 3 or 6 unknowns each, shape (n unknowns, 6)."""
    x, y, z = (nodes - nodes.mean(axis=0)).T
    motions = np.zeros((len(nodes), unknowns, 6))
    for i in range(3):
        motions[:, i, i] = 1.0
    motions[:, 1, 3], motions[:, 2, 3], motions[:, 0, 4], motions[:, 2, 4] = -z, y, z, -x
    motions[:, 0, 5], motions[:, 1, 5] = -y, x
    for i in range(3, unknowns):
        motions[:, i, i] = 1.0
    return motions.reshape(-1, 6)


def by_factors(S: sp.csr_array, is_single: bool) -> tuple[Solve, float]:
    """Return the solve by factors in one of the precisions, and their GiB."""
    with patch.object(pardiso, "_SHARE", 0.0 if is_single else np.inf):
        factor = factorise(S, PARDISO)
    return factor.solve, factor.n_bytes / 2**30


def by_multigrid(
    S: sp.csr_array, near: FloatArray, block: int
) -> tuple[Callable[[FloatArray], FloatArray], float]:
    """Return one V-cycle, and the GiB of its matrices."""
    import pyamg

    A = sp.csr_matrix((S.data, S.indices.astype(np.int32), S.indptr.astype(np.int32)), S.shape).tobsr(
        (block, block)
    )
    sweep = ("block_gauss_seidel", {"sweep": "symmetric"})
    levels = pyamg.smoothed_aggregation_solver(
        A, B=near, strength=("symmetric", {"theta": 0.0}), presmoother=sweep, postsmoother=sweep,
        improve_candidates=None, max_coarse=500, coarse_solver="splu",
    )  # fmt: skip
    return levels.aspreconditioner().matvec, sum(12 * level.A.nnz for level in levels.levels) / 2**30


def frequencies(K: Any, M: Any, is_single: bool) -> FloatArray:
    """Return the lowest frequencies by factors in one of the precisions."""
    with patch.object(pardiso, "_SHARE", 0.0 if is_single else np.inf):
        return np.sqrt(eigen(sp.csr_array(K), sp.csr_array(M), N_MODES, K.shape[0])[0])


def rows_of(name: str, model: Model) -> list[tuple[str, ...]]:
    """Return a row for each way."""
    K, M, nodes, block = model
    S, scale = unit_diagonal(sp.csr_array(K))
    S, n, rows = sp.csr_array(S), S.shape[0], []
    load = np.random.default_rng(0).standard_normal(n)
    for way in ("double precision", "single precision", "multigrid"):
        began, steps, off = time.process_time(), [], ""
        if way == "multigrid":
            cycle, size = by_multigrid(S, rigid(nodes, block) / scale[:, None], block)
            made = time.process_time()
            operator = ssl.LinearOperator((n, n), matvec=cycle, dtype=float)
            failed = ssl.cg(S, load, rtol=RESIDUAL, maxiter=MOST, M=operator, callback=steps.append)[1]
            took = f"{whole(len(steps))}{', not converged' if failed else ''}"
        else:
            solve, size = by_factors(S, way.startswith("single"))
            made = time.process_time()
            solve(load)
            took = ""
        spent = time.process_time() - made
        if way.startswith("single"):
            found, exact = (frequencies(K, M, is_single) for is_single in (True, False))
            off = significant(float(np.max(np.abs(found / exact - 1.0))), 2)
        seconds = (significant(value, 2) for value in (made - began, spent))
        rows.append((name, whole(n), way, *seconds, took, significant(size, 2), off))
    return rows


def main(asked: list[str]) -> int:
    """Print the table."""
    os.environ["MKL_NUM_THREADS"] = "1"
    models = {"solid": solid, "shell": shell, "frame": building}
    names = [name for name in models if name in asked] or list(models)
    rows = [row for name in names for row in rows_of(name, models[name]("fine" in asked))]
    header = ("structure", "DOF", "way", "set-up, s", "solve, s", "steps", "GiB", "error of a frequency")
    print(markdown_table(header, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
