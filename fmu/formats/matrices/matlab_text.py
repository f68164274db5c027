"""Reader for matrices in MATLAB and Octave code, ``.m``, which is never executed.

Three statements are recognised: ``K = [2 -1; -1 2];``, ``K = sparse([1 2], [1 2], [5.0 6.0], 2, 2);``, in which
the last two arguments are optional, and ``K = spconvert([1 1 5.0; 2 2 6.0]);``. The table of rows, columns and
entries may be assigned to a variable first, as in Sierra's output: ``a = [1 1 5.0; 2 2 6.0];`` is followed by
``K = sparse(a(:,1), a(:,2), a(:,3), n, n);`` or ``K = spconvert(a);``. Other statements are skipped; numbers must
be literals.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fmu.formats.files import too_large
from fmu.formats.matrices.limits import (
    LARGEST_CONTENT,
    MOST_NAMES,
    Labelled,
    MatrixFormat,
    RefusedError,
    choose_variable,
    entries_within,
    from_triplets,
    text_lines,
)
from fmu.formats.shown import quote
from fmu.types import FloatArray

_COLUMN = r"\s*(?P={table})\s*\(\s*:\s*,\s*{k}\s*\)\s*"
_STATEMENT = re.compile(
    r"(?<![\w.])(?P<name>[A-Za-z]\w{0,62})\s*=\s*(?:"
    r"(?:(?P<function>sparse|spconvert)\s*\(\s*)?\["
    r"|sparse\s*\(\s*(?P<table>[A-Za-z]\w{0,62})\s*\(\s*:\s*,\s*1\s*\)\s*,"
    + ",".join(_COLUMN.format(table="table", k=k) for k in (2, 3))
    + r"(?:,\s*(?P<rows>\w{1,63})\s*,\s*(?P<columns>\w{1,63})\s*)?[,)]"
    r"|spconvert\s*\(\s*(?P<converted>[A-Za-z]\w{0,62})\s*\))"
)
_NEXT = re.compile(r"\s*,\s*\[")
_SIZE = re.compile(r"\s*(?:,\s*(\d{1,9})\s*,\s*(\d{1,9})\s*)?\)")


class _Place(NamedTuple):
    """Where a matrix is defined in the text.

    `function` is ``"sparse"``, ``"spconvert"``, or empty for a full matrix. The numbers of the matrix begin at
    `at`. For a matrix built from a table, `size` contains the words for the row and column counts, or is None if
    they are not given; for other matrices, it is None.
    """

    function: str
    at: int
    size: tuple[str, str] | None = None


def _places(text: str) -> tuple[dict[str, _Place], set[str]]:
    """Return the `_Place` of each matrix, keyed by name, and the names of tables used to build sparse matrices.

    Raise ValueError if a matrix is cut short, and RefusedError if there are too many.
    """
    places: dict[str, _Place] = {}
    tables: set[str] = set()
    at = 0
    while (found := _STATEMENT.search(text, at)) is not None:
        name, table = found["name"], found["table"] or found["converted"]
        at = found.end()
        if table is None:
            places[name] = _Place(found["function"] or "", at)
            at = text.find("]", at) + 1
            if not at:
                raise ValueError(f"{name} is cut short")
        elif table in places and not places[table].function:
            size = (found["rows"], found["columns"]) if found["rows"] else None
            places[name] = _Place("spconvert", places[table].at, size)
            tables.add(table)
        if len(places) > MOST_NAMES:
            raise RefusedError(f"must hold at most {MOST_NAMES} matrices")
    return places, tables


def _read(path: Path, variable: str | None) -> Labelled:
    if too_large(path, LARGEST_CONTENT // 2):
        raise RefusedError(too_large(path, LARGEST_CONTENT // 2))
    with open(path, "rb") as file:
        lines = (line.partition("%")[0].rstrip() for line in text_lines(file))
        text = "".join(line[:-3] + " " if line.endswith("...") else line + "\n" for line in lines)
    places, tables = _places(text)
    name = choose_variable([one for one in places if variable is not None or one not in tables], variable)
    return _matrix(text, name, places[name])


def _matrix(text: str, name: str, place: _Place) -> Labelled:
    table, at = _table(text, name, place.at)
    if not place.function:
        entries_within(table.size)
        return Labelled(table)
    if place.function == "spconvert":
        if table.shape[1] != 3:
            raise ValueError(f"{name} must have rows of row, column and entry (got {table.shape[1]} numbers)")
        return from_triplets(table, name, _size(text, place.size))
    parts = [table.ravel()]
    for _ in range(2):
        further = _NEXT.match(text, at)
        if further is None:
            raise ValueError(f"{name} must be sparse(rows, columns, entries) with each in brackets")
        table, at = _table(text, name, further.end())
        parts.append(table.ravel())
    if len({len(part) for part in parts}) > 1:
        counts = ", ".join(str(len(part)) for part in parts)
        raise ValueError(f"{name} must have as many rows as columns and entries (got {counts})")
    last = _SIZE.match(text, at)
    size = (int(last[1]), int(last[2])) if last is not None and last[1] else None
    return from_triplets(np.stack(parts, axis=1), name, size)


def _size(text: str, words: tuple[str, str] | None) -> tuple[int, int] | None:
    """Return the numbers of rows and columns if they are literals or variables set to literals.

    Return None if they are anything else, or not given.
    """
    found = []
    for word in words or ():
        number = re.fullmatch(r"\d{1,9}", word) or re.search(rf"(?<![\w.]){word}\s*=\s*(\d{{1,9}})\s*[;,\n]", text)
        if number is None:
            return None
        found.append(int(number[number.re.groups]))
    return (found[0], found[1]) if found else None


def _table(text: str, name: str, at: int) -> tuple[FloatArray, int]:
    """Parse the array (rows, columns) up to the closing bracket; return it and the position after the bracket.

    Raise ValueError if the rows differ in length, a word is not a number, or the bracket is missing.
    """
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
        raise ValueError(f"{name} must have its numbers written out (got {quote(word)})") from None
    return values.reshape(len(rows), columns), end + 1


FORMAT = MatrixFormat((".m",), _read, has_names=True)
