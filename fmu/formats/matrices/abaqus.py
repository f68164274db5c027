"""Reader for the global matrices and element matrices that Abaqus writes as text to ``.mtx`` files.

A separate step in the input deck::

    *STEP
    *MATRIX GENERATE, STIFFNESS, MASS
    *MATRIX OUTPUT, STIFFNESS, MASS, FORMAT=MATRIX INPUT
    *END STEP

writes ``job_STIF1.mtx`` and ``job_MASS1.mtx``, with lines of row node, row degree of freedom, column node, column
degree of freedom, entry. A symmetric matrix needs only one entry of each pair. ``FORMAT=COORDINATE`` writes
lines of row, column, entry, without the names of the degrees of freedom.

The following keyword, in any step, writes a set's element matrices to ``left.mtx``::

    *ELEMENT MATRIX OUTPUT, ELSET=LEFT, STIFFNESS=YES, MASS=YES, OUTPUT FILE=USER DEFINED, FILE NAME=left

fmu reads their sum, which is the stiffness or mass of one property group without supports and constraints. For
each element, comments list its nodes, and ``*USER ELEMENT`` gives the degrees of freedom of its first node.
Further lines give a node's position in the list and the degrees of freedom from that node on. The lower triangle
of each matrix follows, row by row. See Abaqus, *Keywords reference guide*, ``*ELEMENT MATRIX OUTPUT``, ``*USER
ELEMENT``, ``*MATRIX``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import BinaryIO, NamedTuple

import numpy as np
import scipy.sparse as sp

from fmu.formats.matrices.limits import (
    Labelled,
    RefusedError,
    choose_variable,
    entries_within,
    rows_within,
    tables,
    text_lines,
)
from fmu.formats.shown import quote
from fmu.types import DIRECTIONS, FloatArray, IntArray

LARGEST_NUMBER = 10**9
"""Largest node, row or column number."""
HELD = 1e30
"""Diagonal stiffness from which a degree of freedom counts as fixed by a support; Abaqus writes 1e36 there."""


def parse(file: BinaryIO) -> tuple[sp.csr_array, tuple[tuple[int, str], ...] | None]:
    """Read a global matrix and, for ``MATRIX INPUT``, the degrees of freedom of its rows.

    Returns
    -------
    matrix : scipy.sparse.csr_array, shape (n_dof, n_dof)
        For ``MATRIX INPUT``, both triangles, even if the file has only one entry of each pair, and degrees of
        freedom in ascending order. For ``COORDINATE``, as in the file.
    dofs : tuple of (node, direction), or None
        None for ``COORDINATE``.

    Raises
    ------
    ValueError
        If the lines have neither three nor five numbers, there are no lines, a node, row or column is not a whole
        number from 1 to `LARGEST_NUMBER`, or a degree of freedom is not one of 1 to 6.
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


OF_ELEMENTS = b"*USER ELEMENT"
"""Keyword that starts each element in a file of element matrices."""
_KINDS = ("stiffness", "mass")
_AT_A_TIME = 2**20
"""Number of entries collected before they are added to the sum."""
_MOST_NODES = 100
"""Largest number of nodes per element."""


class _Element(NamedTuple):
    """One element matrix: number, kind, degrees of freedom (coded as 8 × node + direction), and lower triangle."""

    number: str
    kind: str
    codes: list[int]
    words: list[str]


def parse_elements(file: BinaryIO, variable: str | None) -> Labelled:
    """Read the element matrices in a file, and return their sum with row names.

    Parameters
    ----------
    file : binary file
    variable : str, optional
        ``"stiffness"`` or ``"mass"``; required if the file contains both.

    Raises
    ------
    ValueError
        If an element has a wrong number of nodes or entries, or directions other than 1 to 6, or if there is a
        word where a number is expected.
    RefusedError
        If there is no matrix with this name; if the file contains both and `variable` is None; if an element
        occurs twice, or has a matrix that is unsymmetric or neither stiffness nor mass; or if there are too many
        entries or rows, or too many nodes in an element.
    """
    places, entries, n, held = list[IntArray](), list[FloatArray](), 0, 0
    kinds, seen, index = dict[str, None](), set[tuple[str, str]](), dict[int, int]()
    total = sp.csr_array((0, 0))
    for one in _elements(text_lines(file)):
        kinds[one.kind] = None
        if one.number and (one.kind, one.number) in seen:
            raise RefusedError(
                f"must have each element once (element {one.number} is there twice: write it in one increment, "
                "FREQUENCY=0 in other steps)"
            )
        seen.add((one.kind, one.number))
        if one.kind != (variable or next(iter(kinds))):
            continue
        size = len(one.codes)
        n += size**2
        entries_within(n)
        own = np.array([index.setdefault(code, len(index)) for code in one.codes], dtype=np.int32)
        row, column = np.tril_indices(size)
        if len(one.words) != len(row):
            got = f"got {len(one.words)}"
            raise ValueError(f"an element of {size} degrees of freedom must have {len(row)} entries ({got})")
        entry = np.array(one.words, dtype=float)
        off = row != column
        places.append(np.array([own[np.append(row, column[off])], own[np.append(column, row[off])]]))
        entries.append(np.append(entry, entry[off]))
        held += len(entries[-1])
        if held > _AT_A_TIME:
            total = _add_entries(total, places, entries, len(index))
            places, entries, held = [], [], 0
    name = choose_variable([kind for kind in _KINDS if kind in kinds], variable)
    if not index:
        raise RefusedError(f"must hold the {name} of elements (it has none)")
    rows_within(len(index))
    total = _add_entries(total, places, entries, len(index))
    codes = np.array(list(index))
    order = np.argsort(codes)
    names = tuple((int(code) // 8, DIRECTIONS[int(code) % 8 - 1]) for code in codes[order])
    return Labelled(total[order][:, order], names, is_whole=True)


def _add_entries(
    total: sp.csr_array, places: list[IntArray], entries: list[FloatArray], size: int
) -> sp.csr_array:
    """Resize `total` in place to `size` rows and columns. Return it with `entries` added at their `places`."""
    total.resize((size, size))
    if not entries:
        return total
    row, column = np.concatenate(places, axis=1)
    return sp.csr_array(total + sp.csr_array((np.concatenate(entries), (row, column)), shape=(size, size)))


def _elements(lines: Iterable[str]) -> Iterator[_Element]:
    nodes: list[int] = []
    of_node: dict[int, list[int]] = {}
    n_nodes, reading, kind, number, owner = 0, "", "", "", ""
    words: list[str] = []
    for line in chain(lines, ["*END"]):  # this line ends the last matrix
        text = line.strip().upper()
        if text.startswith("**"):
            if "ELEMENT NUMBER" in text:
                number = (text.partition("ELEMENT NUMBER")[2].split() or [""])[0]
            if "ELEMENT NODES" in text:
                reading, nodes = "nodes", []
            elif reading == "nodes":
                nodes += [_whole(word) for word in text[2:].replace(",", " ").split()]
            continue
        if text.startswith("*"):
            if kind:
                yield _Element(owner, kind, _codes(nodes, of_node, n_nodes), words)
            keyword = text.replace(" ", "").split(",")
            kind, words = "", []
            if keyword[0] == "*USERELEMENT":
                if "UNSYMM" in keyword:
                    raise RefusedError("must have symmetric matrices of elements (it has UNSYMM)")
                counts = [option[6:] for option in keyword if option.startswith("NODES=")]
                n_nodes, of_node, nodes = _whole(counts[0] if counts else ""), {}, []
                reading = "element"
            elif keyword[0] == "*MATRIX":
                kind = next((own for own in _KINDS if f"TYPE={own.upper()}" in keyword), "")
                if not kind:
                    raise RefusedError(f"must have matrices of the types STIFFNESS and MASS (got {quote(text)})")
                reading, owner = "matrix", number
            continue
        values = text.replace(",", " ").split()
        if reading == "matrix":
            words += values
            if len(words) > (6 * _MOST_NODES + 1) ** 2:
                raise RefusedError(f"must have elements of at most {_MOST_NODES} nodes")
        elif values:  # degrees of freedom: the first line of all nodes, further lines from one node on
            numbers = [_whole(word) for word in values]
            at, own = (numbers[0], numbers[1:]) if of_node else (1, numbers)
            of_node[at] = own


def _codes(nodes: list[int], of_node: dict[int, list[int]], n_nodes: int) -> list[int]:
    """Return an element's degrees of freedom, node by node, coded as 8 × node + direction.

    Raise ValueError if nodes are missing, or a direction is not one of 1 to 6.
    """
    if not 1 <= n_nodes <= _MOST_NODES or len(nodes) != n_nodes:
        raise ValueError(f"an element must have the nodes that it names (got {len(nodes)} of {n_nodes})")
    codes: list[int] = []
    own: list[int] = []
    for at, node in enumerate(nodes, 1):
        own = of_node.get(at, own)
        if not own or not set(own) <= {1, 2, 3, 4, 5, 6}:
            raise ValueError(f"degrees of freedom must be 1 to 6, displacements and rotations (got {quote(own)})")
        codes += [8 * node + k for k in own]
    return codes


def _whole(word: str) -> int:
    if not (word.isdecimal() and len(word) <= 10 and 1 <= int(word) <= LARGEST_NUMBER):
        raise ValueError(
            f"nodes and degrees of freedom must be whole numbers from 1 to {LARGEST_NUMBER} (got {quote(word)})"
        )
    return int(word)


def _without_keywords(text: str) -> str:
    """Return a text without its keyword lines, and with commas replaced by blanks."""
    if "*" in text:
        text = "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("*"))
    return text.replace(",", " ")


def _places(names: FloatArray) -> IntArray:
    """Return the row and column of each entry, shape (n, 2).

    For ``MATRIX INPUT``, they are coded as 8 × node + degree of freedom. Raise ValueError if a number is not whole
    or out of range.
    """
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
