"""The text in which Abaqus writes global matrices, into files that it calls ``.mtx``.

In a step of its own::

    *STEP
    *MATRIX GENERATE, STIFFNESS, MASS
    *MATRIX OUTPUT, STIFFNESS, MASS, FORMAT=MATRIX INPUT
    *END STEP

gives ``job_STIF1.mtx`` and ``job_MASS1.mtx``, with lines of row node, row degree of freedom, column node, column
degree of freedom, entry; of a symmetric matrix each pair of entries may be there once. ``FORMAT=COORDINATE`` gives
lines of row, column, entry, without the names of the degrees of freedom.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import scipy.sparse as sp

from fmu.formats.matrix_files import MOST_DOFS

DIRECTIONS = {1: "x", 2: "y", 3: "z", 4: "rx", 5: "ry", 6: "rz"}
HELD = 1e30
"""Abaqus keeps the degrees of freedom that a support holds, with 1e36 on the diagonal of the stiffness."""


def parse(text: str) -> tuple[Any, tuple[tuple[int, str], ...] | None]:
    """Return the matrix in the text of a file and, of ``MATRIX INPUT``, its degrees of freedom (node, direction).

    Returns
    -------
    matrix : scipy.sparse.csr_array, shape (n_dof, n_dof)
        Mirrored where ``MATRIX INPUT`` has each pair of entries once; degrees of freedom in ascending order.
    dofs : tuple or None

    Raises
    ------
    ValueError
        If the lines have neither three nor five numbers, or a degree of freedom is not one of 1 to 6.
    """
    lines = "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("*"))
    table = np.loadtxt(io.StringIO(lines.replace(",", " ")), ndmin=2, comments=None)
    if table.shape[1] not in (3, 5) or not len(table):
        raise ValueError(f"each line must have 3 or 5 numbers (got {table.shape[1]})")
    names, entries = table[:, :-1].astype(np.int64), table[:, -1]
    if np.any(names != table[:, :-1]) or np.any(names < 1):
        raise ValueError("nodes, degrees of freedom, rows and columns must be whole numbers from 1")
    if table.shape[1] == 3:
        size = int(names.max())
        if size > MOST_DOFS:
            raise ValueError(f"must have at most {MOST_DOFS} degrees of freedom (got {size})")
        return sp.csr_array((entries, (names[:, 0] - 1, names[:, 1] - 1)), shape=(size, size)), None
    dofs, index = np.unique(names.reshape(-1, 2), axis=0, return_inverse=True)
    if dofs[:, 1].max() > 6:
        raise ValueError(
            f"degrees of freedom must be 1 to 6, displacements and rotations (got {dofs[:, 1].max()})"
        )
    row, column = index.reshape(-1, 2).T
    matrix = sp.csr_array((entries, (row, column)), shape=(len(dofs),) * 2)
    half = sp.csr_array(matrix - sp.diags_array(matrix.diagonal()))
    half.eliminate_zeros()
    if not half.multiply(half.T).nnz:
        matrix = matrix + half.T
    return sp.csr_array(matrix), tuple((int(node), DIRECTIONS[int(dof)]) for node, dof in dofs)
