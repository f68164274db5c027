"""Matrices as MATLAB and Octave code, ``.m``, which is read and never executed.

Known are ``K = [2 -1; -1 2];``, ``K = sparse([1 2], [1 2], [5.0 6.0], 2, 2);`` with or without the last two, and
``K = spconvert([1 1 5.0; 2 2 6.0]);``. Other statements are skipped; numbers must be written out.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from fmu.formats.files import too_large
from fmu.formats.matrices.limits import (
    LARGEST_CONTENT,
    MOST_NAMES,
    Labelled,
    MatrixFormat,
    RefusedError,
    chosen,
    entries_within,
    rows_within,
    text_lines,
)
from fmu.formats.shown import shown

_BEGIN = re.compile(r"(?<![\w.])([A-Za-z]\w{0,62})\s*=\s*(?:(sparse|spconvert)\s*\(\s*)?\[")
_NEXT = re.compile(r"\s*,\s*\[")
_SIZE = re.compile(r"\s*(?:,\s*(\d{1,9})\s*,\s*(\d{1,9})\s*)?\)")


def _statements(text: str) -> Iterator[tuple[str, str, int]]:
    """Yield name, function and the position after the bracket of each matrix."""
    at = 0
    while (found := _BEGIN.search(text, at)) is not None:
        yield found[1], found[2] or "", found.end()
        at = text.find("]", found.end()) + 1
        if not at:
            raise ValueError(f"{found[1]} is cut short")


def _read(path: Path, variable: str | None) -> Labelled:
    if too_large(path, LARGEST_CONTENT // 2):
        raise RefusedError(too_large(path, LARGEST_CONTENT // 2))
    with open(path, "rb") as file:
        lines = (line.partition("%")[0].rstrip() for line in text_lines(file))
        text = "".join(line[:-3] + " " if line.endswith("...") else line + "\n" for line in lines)
    places: dict[str, tuple[str, int]] = {}
    for name, function, at in _statements(text):
        places[name] = function, at
        if len(places) > MOST_NAMES:
            raise RefusedError(f"must hold at most {MOST_NAMES} matrices")
    name = chosen(list(places), variable)
    return Labelled(_matrix(text, name, *places[name]))


def _matrix(text: str, name: str, function: str, at: int) -> Any:
    """Return the matrix whose numbers begin at a position."""
    table, at = _table(text, name, at)
    if not function:
        entries_within(table.size)
        return table
    if function == "spconvert":
        if table.shape[1] != 3:
            raise ValueError(f"{name} must have rows of row, column and entry (got {table.shape[1]} numbers)")
        row, column, entry = table.T
        size = None
    else:
        parts = [table.ravel()]
        for _ in range(2):
            further = _NEXT.match(text, at)
            if further is None:
                raise ValueError(f"{name} must be sparse(rows, columns, entries) with each in brackets")
            table, at = _table(text, name, further.end())
            parts.append(table.ravel())
        row, column, entry = parts
        if not len(row) == len(column) == len(entry):
            counts = f"{len(row)}, {len(column)}, {len(entry)}"
            raise ValueError(f"{name} must have as many rows as columns and entries (got {counts})")
        last = _SIZE.match(text, at)
        size = (int(last[1]), int(last[2])) if last is not None and last[1] else None
    entries_within(len(entry))
    places = np.stack([row, column])
    if np.any(places != np.floor(places)) or np.any(places < 1) or np.any(places > 2**31):
        raise ValueError(f"{name} must have rows and columns that are whole numbers from 1")
    row, column = places.astype(np.int64) - 1
    shape = size or (int(row.max(initial=0)) + 1, int(column.max(initial=0)) + 1)
    rows_within(max(shape))
    return sp.csr_array((entry, (row, column)), shape=shape)


def _table(text: str, name: str, at: int) -> tuple[Any, int]:
    """Return the numbers up to the closing bracket, two-dimensional, and the position after it."""
    end = text.find("]", at)
    if end < 0:
        raise ValueError(f"{name} is cut short")
    rows = [row.replace(",", " ").split() for row in text[at:end].replace(";", "\n").split("\n")]
    rows = [row for row in rows if row]
    columns = len(rows[0]) if rows else 0
    if any(len(row) != columns for row in rows):
        raise ValueError(f"{name} must have {columns} numbers in each row, as in the first")
    try:
        values = np.array([float(word) for row in rows for word in row])
    except ValueError as error:
        word = str(error).partition(": ")[2].strip("'")
        raise ValueError(f"{name} must have its numbers written out (got {shown(word)})") from None
    return values.reshape(len(rows), columns), end + 1


FORMAT = MatrixFormat((".m",), _read, has_names=True)
