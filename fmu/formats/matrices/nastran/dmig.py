"""Reader for Nastran DMIG matrices in bulk data or punch files (``PARAM,EXTOUT,DMIGPCH``)."""

from __future__ import annotations

from array import array
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from fmu.formats.matrices.limits import (
    MOST_NAMES,
    Labelled,
    MatrixFormat,
    RefusedError,
    choose_variable,
    entries_within,
    mirror_triangle,
    rows_within,
)
from fmu.formats.matrices.nastran.cards import cards, components, identity, number, whole
from fmu.formats.matrices.nastran.includes import deck_lines
from fmu.types import DIRECTIONS

SYMMETRIC = 6
"""Code for a symmetric matrix, of which only one entry of each symmetric pair is given."""


def _read(path: Path, variable: str | None) -> Labelled:
    """Read a matrix. Its rows are the nodes and components named by its entries, in ascending order.

    Raise ValueError if an entry is malformed. Raise RefusedError if there is no such matrix, if there are several
    and `variable` is None, if the matrix is complex, empty or too large, or if a symmetric matrix has both entries
    of a pair.
    """
    forms: dict[str, int] = {}
    found: dict[str, tuple[array[int], array[int], array[float]]] = {}
    n = 0
    for entry, fields in cards(deck_lines(path)):
        if entry != "DMIG":
            continue
        name = fields[0]
        if fields[1] == "0":
            forms[name] = whole(fields[2], f"DMIG {name}: the form")
            if whole(fields[3], f"DMIG {name}: the type") not in (1, 2) and variable in (None, name):
                raise RefusedError(f"must hold a real matrix ({name} is complex)")
            if len(forms) > MOST_NAMES:
                raise RefusedError(f"must hold at most {MOST_NAMES} matrices")
            continue
        if variable is not None and name != variable:
            found.setdefault(name, (array("q"), array("q"), array("d")))
            continue
        rows, columns, entries = found.setdefault(name, (array("q"), array("q"), array("d")))
        column = _place(fields[1], fields[2], name)
        for at in range(4, len(fields) - 2, 4):
            if fields[at]:
                rows.append(_place(fields[at], fields[at + 1], name))
                columns.append(column)
                entries.append(number(fields[at + 2], f"DMIG {name}: an entry"))
        n += (len(fields) - 4) // 4
        entries_within(n)
    name = choose_variable([name for name in forms if name in found], variable)
    if not found[name][2]:
        raise RefusedError(f"must have entries of {name} (it has none)")
    *named, values = (np.asarray(part) for part in found[name])
    places = np.union1d(*(np.unique(part) for part in named))
    rows_within(len(places))
    index = tuple(np.searchsorted(places, part).astype(np.int32) for part in named)
    matrix = sp.csr_array((values, index), shape=(len(places),) * 2)
    if forms[name] == SYMMETRIC:
        matrix = mirror_triangle(matrix)
    return Labelled(matrix, tuple((int(at) // 8, DIRECTIONS[int(at) % 8]) for at in places))


def _place(node: str, component: str, name: str) -> int:
    """Return 8 × node + direction (from 0), the key by which rows are sorted.

    Raise ValueError unless there is one component.
    """
    directions = components(component, f"DMIG {name}: a component")
    if len(directions) != 1:
        raise ValueError(f"DMIG {name}: a component must be one of 0 to 6 (got {component})")
    return 8 * identity(node, f"DMIG {name}: a node") + directions[0] - 1


FORMAT = MatrixFormat((".pch", ".dmig", ".bdf", ".dat", ".nas"), _read, has_names=True)
