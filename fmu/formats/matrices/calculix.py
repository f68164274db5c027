"""Reader for the CalculiX matrices ``job.sti`` and ``job.mas``, with row names from ``job.dof``.

The step of the input deck must be::

    *FREQUENCY, SOLVER=MATRIXSTORAGE
    10

Each line of a matrix has row, column and entry; only one entry of each symmetric pair is present. Line i of
``job.dof`` is the name ``node.direction`` of row i. CalculiX expands shells and beams into solids, so several rows
can have the same name. The nodes of these rows (copies) are given new ids above the ids in the file, and the
displacement of the original node is a weighted mean of the copies' displacements. ``job.12d`` lists the expanded
nodes. Without that file, every name that occurs more than once is assumed to belong to an expanded node.

A mass that fmu adds moves with this weighted mean, but CalculiX attaches a mass to the mean of a shell's two
faces. The frequencies with masses added at the corners of thick quadratic shells therefore differ.

An expanded node that carries a mass or a spring, or is in an equation or a solid, also has rows of its own, and
CalculiX eliminates the rows of one of its copies. The own rows of all nodes precede the rows of the copies.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import scipy.sparse as sp

from fmu.formats.files import too_large, why_no_file
from fmu.formats.matrices.limits import (
    LARGEST_FILE,
    DofName,
    Labelled,
    MatrixFormat,
    RefusedError,
    entries_within,
    mirror_triangle,
    rows_within,
    tables,
    text_blocks,
    text_lines,
)
from fmu.formats.shown import quote
from fmu.types import DIRECTIONS

LARGEST_NODE = 10**9
_MOST_NODES = 100
"""Largest number of nodes per element."""


def parse(file: BinaryIO, n_dof: int) -> sp.csr_array:
    """Read a ``.sti`` or ``.mas`` matrix, with both triangles, shape (n_dof, n_dof).

    Raises
    ------
    ValueError
        If there are no lines, or a line is not row, column and entry, with row and column whole numbers from 1.
    RefusedError
        If there are too many entries, both entries of a symmetric pair, or not `n_dof` rows.
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
            raise RefusedError(f"must have the {n_dof} rows of the .dof file (got row {int(places.max())})")
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
    return mirror_triangle(matrix)


def names(path: Path) -> list[DofName]:
    """Read the row names (node, direction) from a ``.dof`` file, one per line. A name may occur several times.

    Raises
    ------
    ValueError
        If a line is not ``node.direction``.
    RefusedError
        If there are too many rows.
    """
    found: list[DofName] = []
    with open(path, "rb") as file:
        for text in text_blocks(file):
            for word in text.split():
                node, dot, direction = word.partition(".")
                is_name = node.isdecimal() and dot and direction in ("1", "2", "3", "4", "5", "6")
                if not is_name or not 1 <= int(node[:12]) <= LARGEST_NODE:
                    raise ValueError(f"line {len(found) + 1} must be node.direction (got {quote(word)})")
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
        matrix = parse(file, len(read))
    dofs, motions, if_loaded = _apart(read, _expansion(path.with_suffix(".12d")))
    return Labelled(matrix, dofs, motions, if_loaded=if_loaded)


class _Expansion(NamedTuple):
    """How CalculiX expanded shell and beam nodes into solid nodes.

    Attributes
    ----------
    copies : dict of int to int
        Number of solid nodes per original node: on both faces and possibly in the middle of a shell, or around a
        beam.
    rigid : set of int
        Original nodes whose copies move with them as a rigid body ("knots"); only the original node has rows.
    """

    copies: dict[int, int]
    rigid: set[int]


def _expansion(path: Path) -> _Expansion:
    """Read the expanded nodes from ``job.12d``. The result is empty if that file is missing or too large."""
    found = _Expansion({}, set())
    if why_no_file(path) or too_large(path, LARGEST_FILE):
        return found
    label, nodes = "", list[int]()
    with open(path, "rb") as file:
        for line in text_lines(file):
            words = line.split()
            if "with label" in line:
                label, nodes = line.partition('"')[2].strip(), []
            elif "is expanded" in line:
                for k, node in enumerate(nodes):
                    if label[:1] in "SBTM":
                        found.copies[node] = _copies(label[0] in "SM", k, len(nodes))
                label = ""
            elif "KNOT was generated" in line and words[-1].isdecimal():
                found.rigid.add(int(words[-1][:12]))
            elif label and all(word.isdecimal() for word in words) and len(nodes) < _MOST_NODES:
                nodes += [int(word[:12]) for word in words]
    return found


def _copies(is_shell: bool, k: int, n: int) -> int:
    """Return how many solid nodes CalculiX creates for node k (from 0) of an n-node shell or beam element."""
    if is_shell:
        return 3 if n >= 6 and k < n // 2 else 2
    return 8 if n == 3 and k != 1 else 4


def _weights(n: int) -> tuple[float, ...]:
    """Return the weights with which CalculiX prints the displacement of a node that became n solid nodes.

    Three nodes, from one face of a shell to the other, have the weights of Simpson's rule. Two nodes on the faces
    have equal weights. Of the nodes around a beam, the four at the corners of its section come first and have
    equal weights; the others have the weight 0.
    """
    if n == 3:
        return 1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0
    corners = min(n, 4)
    return (1.0 / corners,) * corners + (0.0,) * (n - corners)


def _weights_of_own(n: int, known: int) -> tuple[float, ...]:
    """Return the weights of a node's n rows: its own row, then the copies that CalculiX did not eliminate.

    `known` is the number of copies. If there are three, the own row is the mean displacement of a shell's two
    faces, and CalculiX eliminates the copy on the first face. Simpson's rule then gives the weights 1/3, 2/3
    and 0. In all other cases the own row has the weight 1.
    """
    return (1.0 / 3.0, 2.0 / 3.0, 0.0) if n == known == 3 else (1.0,) + (0.0,) * (n - 1)


def _own_rows(read: Sequence[DofName]) -> tuple[set[DofName], int]:
    """Return the names of expanded nodes' own rows, and the first node for which they are uncertain (0 if none).

    The own rows of all nodes precede the rows of copies. If the rows of a node form several runs, its own rows are
    therefore the first run. Only at the first node with copies can own rows and copies be in one run, so that they
    cannot be told apart.
    """
    names: dict[DofName, None] = {}
    runs: dict[int, int] = {}
    first = before = 0
    for name in read:
        node = name[0]
        runs[node] = runs.get(node, 0) + (node != before)
        first = first or (node if runs[node] == 1 and name in names else 0)
        before = node
        if runs[node] == 1:
            names[name] = None
    return {name for name in names if runs[name[0]] > 1}, first


def _apart(
    read: Sequence[DofName], expansion: _Expansion
) -> tuple[tuple[DofName, ...], dict[DofName, dict[DofName, float]], dict[DofName, dict[DofName, float]]]:
    """Return distinct row names, displacements of expanded nodes as weighted sums of rows, and an alternative.

    The displacement of a node is the sum of its copies with `_weights` or, if it has rows of its own, the sum of
    its own row and the copies with `_weights_of_own`; rows with the weight 0 are included. If a support fixes some
    of the copies of a node without own rows, the displacement is omitted, because the sum over the others would be
    wrong. The third item has the displacements of the uncertain node of `_own_rows` in case it has rows of its
    own.
    """
    counts = Counter(read)
    own, first = _own_rows(read)
    ahead = max((node for node, _ in read), default=0) + 1
    places: dict[tuple[int, int], int] = {}
    seen: dict[DofName, int] = {}
    dofs: list[DofName] = []
    motions: dict[DofName, dict[DofName, float]] = {}
    if_loaded: dict[DofName, dict[DofName, float]] = {}
    for name in read:
        node, direction = name
        known = 1 if node in expansion.rigid else expansion.copies.get(node, counts[name])
        if counts[name] == known == 1:
            dofs.append(name)
            continue
        copy = seen[name] = seen.get(name, 0) + 1
        row = (places.setdefault((node, copy), ahead + len(places)), direction)
        dofs.append(row)
        if name in own:
            motions.setdefault(name, {})[row] = _weights_of_own(counts[name], known)[copy - 1]
        elif counts[name] == known:
            motions.setdefault(name, {})[row] = _weights(known)[copy - 1]
            if node == first:
                if_loaded.setdefault(name, {})[row] = _weights_of_own(known, known)[copy - 1]
    return tuple(dofs), motions, if_loaded


FORMAT = MatrixFormat((".sti", ".mas"), _read)
