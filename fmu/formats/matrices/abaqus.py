"""Reader of the global matrices that Abaqus writes as text to ``.mtx`` files.

A separate step in the input deck::

    *STEP
    *MATRIX GENERATE, STIFFNESS, MASS
    *MATRIX OUTPUT, STIFFNESS, MASS, FORMAT=MATRIX INPUT
    *END STEP

gives ``job_STIF1.mtx`` and ``job_MASS1.mtx``, with lines of row node, row degree of freedom, column node, column
degree of freedom, entry; a symmetric matrix may have only one entry of each pair. ``FORMAT=COORDINATE`` gives
lines of row, column, entry, without the names of the degrees of freedom.
"""

from __future__ import annotations

from typing import BinaryIO

import numpy as np
import scipy.sparse as sp

from fmu.formats.matrices.limits import entries_within, rows_within, tables
from fmu.types import DIRECTIONS, FloatArray, IntArray

LARGEST_NUMBER = 10**9
"""Largest number of a node, a row or a column."""
HELD = 1e30
"""Diagonal stiffness from which a degree of freedom is taken as held by a support; Abaqus writes 1e36 there."""


def parse(file: BinaryIO) -> tuple[sp.csr_array, tuple[tuple[int, str], ...] | None]:
    """Return the matrix in a file and, for ``MATRIX INPUT``, its degrees of freedom (node, direction).

    Returns
    -------
    matrix : scipy.sparse.csr_array, shape (n_dof, n_dof)
        Mirrored where ``MATRIX INPUT`` has one entry of each pair; degrees of freedom in ascending order.
    dofs : tuple or None

    Raises
    ------
    ValueError
        If the lines have neither three nor five numbers, or a degree of freedom is not one of 1 to 6.
    RefusedError
        If there are too many entries or rows.
    """
    places, entries, n = [], [], 0
    for rows in tables(file, None, cleaned=_without_keywords):
        if rows.shape[1] not in (3, 5):
            raise ValueError(f"each line must have 3 or 5 numbers (got {rows.shape[1]})")
        n += len(rows)
        entries_within(n)
        places.append(_places(rows[:, :-1]))
        entries.append(rows[:, -1].copy())
    if not entries:
        raise ValueError("it has no numbers")
    place, entry = np.concatenate(places), np.concatenate(entries)
    known, index = np.unique(place, return_inverse=True)
    if rows.shape[1] == 3:
        size = int(known[-1])
        rows_within(size)
        row, column = (place - 1).T
        return sp.csr_array((entry, (row, column)), shape=(size, size)), None
    rows_within(len(known))
    row, column = index.reshape(place.shape).T
    matrix = sp.csr_array((entry, (row, column)), shape=(len(known),) * 2)
    half = sp.csr_array(matrix - sp.diags_array(matrix.diagonal()))
    half.eliminate_zeros()
    if not half.multiply(half.T).nnz:
        matrix = matrix + half.T
    dofs = tuple((int(dof) // 8, DIRECTIONS[int(dof) % 8 - 1]) for dof in known)
    return sp.csr_array(matrix), dofs


def _without_keywords(text: str) -> str:
    """Return a text without its keyword lines, and with blanks in place of commas."""
    if "*" in text:
        text = "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("*"))
    return text.replace(",", " ")


def _places(names: FloatArray) -> IntArray:
    """Return the row and column of each entry (n, 2): as given, or coded as 8 × node + degree of freedom."""
    if np.any(names != np.floor(names)) or np.any(names < 1) or np.any(names > LARGEST_NUMBER):
        raise ValueError(
            f"nodes, degrees of freedom, rows and columns must be whole numbers from 1 to {LARGEST_NUMBER}"
        )
    whole = names.astype(np.int64)
    if whole.shape[1] == 2:
        return whole
    if whole[:, 1::2].max() > 6:
        raise ValueError(
            f"degrees of freedom must be 1 to 6, displacements and rotations (got {whole[:, 1::2].max()})"
        )
    return 8 * whole[:, ::2] + whole[:, 1::2]
