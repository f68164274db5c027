"""Matrices of CalculiX: ``job.sti``, ``job.mas`` and the names of their rows, ``job.dof``.

In the step of the input deck::

    *FREQUENCY, SOLVER=MATRIXSTORAGE
    10

Each line of a matrix has row, column and entry, each pair of entries once; line i of ``job.dof`` is
``node.direction`` of row i. CalculiX expands shells and beams into solids, so that several rows can have the name
of one node: they are given numbers of their own above those of the file, and the node's motion is their mean.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import scipy.sparse as sp

from fmu.formats.files import too_large, why_no_file
from fmu.formats.matrices.limits import (
    LARGEST_FILE,
    Labelled,
    MatrixFormat,
    RefusedError,
    entries_within,
    rows_within,
    tables,
    text_blocks,
)
from fmu.formats.shown import shown
from fmu.types import DIRECTIONS

LARGEST_NODE = 10**9


def parse(file: BinaryIO, n_dof: int) -> Any:
    """Return the matrix of a ``.sti`` or ``.mas`` file, both triangles filled, shape (n_dof, n_dof).

    Raises
    ------
    ValueError
        If the lines are not whole row, whole column and entry, or rows lie outside.
    RefusedError
        If there are too many entries.
    """
    rows, columns, entries, n = [], [], [], 0
    for table in tables(file, None):
        if table.shape[1] != 3:
            raise ValueError(f"each line must have row, column and entry (got {table.shape[1]} numbers)")
        n += len(table)
        entries_within(n)
        places = table[:, :2]
        if np.any(places != np.floor(places)) or np.any(places < 1):
            raise ValueError("rows and columns must be whole numbers from 1")
        if places.max() > n_dof:
            raise RefusedError(f"must have the {n_dof} rows of the .dof file (got row {places.max():.0f})")
        row, column = (places - 1).astype(np.int32).T
        rows.append(row)
        columns.append(column)
        entries.append(table[:, 2].copy())
    if not n:
        raise ValueError("it has no numbers")
    row, column = np.concatenate(rows), np.concatenate(columns)
    if row.max() + 1 < n_dof and column.max() + 1 < n_dof:
        last = max(row.max(), column.max()) + 1
        raise RefusedError(f"must have the {n_dof} rows of the .dof file (its last is {last})")
    matrix = sp.csr_array((np.concatenate(entries), (row, column)), shape=(n_dof, n_dof))
    upper, lower = sp.triu(matrix, 1, format="csr"), sp.tril(matrix, -1, format="csr")
    if upper.nnz and lower.nnz:
        return matrix
    return sp.csr_array(matrix + upper.T + lower.T)


def names(path: Path) -> list[tuple[int, str]]:
    """Return node and direction of each line of a ``.dof`` file; a name may be there several times.

    Raises
    ------
    ValueError
        If a line is not ``node.direction``.
    """
    found: list[tuple[int, str]] = []
    with open(path, "rb") as file:
        for text in text_blocks(file):
            for word in text.split():
                node, dot, direction = word.partition(".")
                is_name = node.isdecimal() and dot and direction in ("1", "2", "3", "4", "5", "6")
                if not is_name or not 1 <= int(node[:12]) <= LARGEST_NODE:
                    raise ValueError(f"line {len(found) + 1} must be node.direction (got {shown(word)})")
                found.append((int(node), DIRECTIONS[int(direction) - 1]))
            rows_within(len(found))
    return found


def _read(path: Path, variable: str | None) -> Labelled:
    beside = path.with_suffix(".dof")
    why = why_no_file(beside) or too_large(beside, LARGEST_FILE)
    if why:
        raise RefusedError(f"must have the names of its rows in {beside.name} beside it ({why})")
    try:
        read = names(beside)
    except ValueError as error:
        raise RefusedError(f"must have the names of its rows in {beside.name} beside it ({error})") from error
    with open(path, "rb") as file:
        return Labelled(parse(file, len(read)), *_apart(read))


def _apart(read: list[tuple[int, str]]) -> tuple[Any, Any]:
    """Return names of rows, no two the same, and the motions that are means of several rows."""
    counts: dict[tuple[int, str], int] = {}
    for name in read:
        counts[name] = counts.get(name, 0) + 1
    ahead = max((node for node, _ in read), default=0) + 1
    places: dict[tuple[int, int], int] = {}
    seen: dict[tuple[int, str], int] = {}
    dofs: list[tuple[int, str]] = []
    motions: dict[tuple[int, str], dict[tuple[int, str], float]] = {}
    for name in read:
        if counts[name] == 1:
            dofs.append(name)
            continue
        copy = seen[name] = seen.get(name, 0) + 1
        row = (places.setdefault((name[0], copy), ahead + len(places)), name[1])
        dofs.append(row)
        motions.setdefault(name, {})[row] = 1.0 / counts[name]
    return tuple(dofs), motions


FORMAT = MatrixFormat((".sti", ".mas"), _read)
