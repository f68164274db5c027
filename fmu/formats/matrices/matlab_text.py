"""Reader for matrices in MATLAB and Octave code, ``.m``, which is never executed.

Three statements are recognised: ``K = [2 -1; -1 2];``, ``K = sparse([1 2], [1 2], [5.0 6.0], 2, 2);``, in which
the last two arguments are optional, and ``K = spconvert([1 1 5.0; 2 2 6.0]);``. The table of rows, columns and
entries may be assigned to a variable first, as in Sierra's output: ``a = [1 1 5.0; 2 2 6.0];`` is followed by
``K = sparse(a(:,1), a(:,2), a(:,3), n, n);`` or ``K = spconvert(a);``. Such a statement may end with one factor or
divisor, ``*1e6``. Other statements are skipped; numbers must be literals. A matrix is refused if its statement
goes on with other arithmetic, or if a later statement changes it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
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
_FURTHER = re.compile(r"\s*(?=[,)])")
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_END = re.compile(rf"[ \t]*(?:\.?(?P<operator>[*/])[ \t]*(?P<factor>{_NUMBER})[ \t]*)?(?:[;,\n]|\Z)")
_CHANGED = (
    r"(?<![\w.'\"]){name}\s*(?:\([^=\n]{{0,1000}}\))?\s*[-+*/^.|&]{{0,2}}=(?!=)"
    r"(?!\s*(?:sparse|full)\s*\(\s*{name}\s*\)\s*(?:[;,\n]|\Z))"
    r"|\[[^][=\n]{{0,1000}}(?<![\w.]){name}\b[^][=\n]{{0,1000}}\]\s*=(?!=)"
)
"""Statements that assign to a matrix or its entries, alone or among several results, but for `K = sparse(K)`."""


class _Place(NamedTuple):
    """Where a matrix is defined in the text.

    `function` is ``"sparse"``, ``"spconvert"``, or empty for a full matrix. The numbers of the matrix begin at
    `at`. For a matrix built from a table, its statement extends from `start` to `until`, except for a factor, and
    `size` contains the words for the row and column counts, or is None if they are not given. For other matrices,
    all three have their defaults.
    """

    function: str
    at: int
    table: str = ""
    start: int = 0
    until: int = 0
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
            until = at if text[at - 1] == ")" else _after_parenthesis(text, at)
            places[name] = _Place("spconvert", places[table].at, table, found.start(), until, size)
            tables.add(table)
        if len(places) > MOST_NAMES:
            raise RefusedError(f"must hold at most {MOST_NAMES} matrices")
    return places, tables


def _read(path: Path, variable: str | None) -> Labelled:
    if too_large(path, LARGEST_CONTENT // 2):
        raise RefusedError(too_large(path, LARGEST_CONTENT // 2))
    with open(path, "rb") as file:
        lines = _without_comments(text_lines(file))
        text = "".join(line[:-3] + " " if line.endswith("...") else line + "\n" for line in lines)
    places, tables = _places(text)
    name = choose_variable([one for one in places if variable is not None or one not in tables], variable)
    return _matrix(text, name, places[name])


def _without_comments(lines: Iterable[str]) -> Iterator[str]:
    """Yield the lines without comments, which begin with % or #, or are blocks between lines ``%{`` and ``%}``."""
    depth = 0
    for line in lines:
        if line.strip() in ("%{", "#{"):
            depth += 1
        elif depth:
            depth -= line.strip() in ("%}", "#}")
        else:
            yield re.split("[%#]", line, maxsplit=1)[0].rstrip()


def _matrix(text: str, name: str, place: _Place) -> Labelled:
    """Return a matrix. Raise ValueError if its statements do more than give its numbers and a factor."""
    table, at = _table(text, name, place.at)
    if not place.function:
        entries_within(table.size)
        factor = _factor(text, name, at)
        if factor != 1.0 and table.shape[0] != table.shape[1]:
            raise ValueError(
                f"{name} must be square, as it has a factor (got {table.shape[0]} by {table.shape[1]})"
            )
        return Labelled(table * factor)
    if place.function == "spconvert":
        if table.shape[1] != 3:
            raise ValueError(f"{name} must have rows of row, column and entry (got {table.shape[1]} numbers)")
        if place.table:
            if _factor(text, place.table, at, place.start) != 1.0:
                raise ValueError(f"{place.table} must have no factor: it has rows and columns too")
            at = place.until
        else:
            at = _close(text, name, at)
        return _multiply(from_triplets(table, name, _size(text, place.size)), _factor(text, name, at))
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
    return _multiply(
        from_triplets(np.stack(parts, axis=1), name, size), _factor(text, name, _close(text, name, at))
    )


def _multiply(one: Labelled, factor: float) -> Labelled:
    return one._replace(matrix=one.matrix * factor)


def _close(text: str, name: str, at: int) -> int:
    """Return the position after the parenthesis around a bracket that closes at `at`.

    Raise ValueError if there is arithmetic between them.
    """
    found = _FURTHER.match(text, at)
    if found is None:
        raise ValueError(f"{name} must have no arithmetic inside its parentheses (got {_rest(text, at)})")
    return _after_parenthesis(text, found.end())


def _after_parenthesis(text: str, at: int) -> int:
    """Return the position after the parenthesis that encloses `at`, or `at` if it does not close on its line."""
    depth = 1
    for found in re.compile(r"[()\n]").finditer(text, at):
        depth += {"(": 1, ")": -1}.get(found[0], 0)
        if depth == 0 or found[0] == "\n":
            return found.end() if depth == 0 else at
    return at


def _factor(text: str, name: str, at: int, until: int | None = None) -> float:
    """Return the number that multiplies a matrix whose brackets close at `at`; 1 if there is none.

    Raise ValueError if the statement goes on in another way, or if a statement from there to `until`, by default
    the end of the text, changes the matrix.
    """
    end = _END.match(text, at)
    if end is None:
        raise ValueError(
            f"{name} must have no arithmetic but one factor or divisor, a number, after it (got {_rest(text, at)})"
        )
    changed = re.compile(_CHANGED.format(name=name)).search(text, end.end(), len(text) if until is None else until)
    if changed is not None:
        raise ValueError(f"{name} must not be changed by a later statement (got {_rest(text, changed.start())})")
    if not end["operator"]:
        return 1.0
    factor = float(end["factor"])
    if end["operator"] == "/" and factor == 0.0:
        raise ValueError(f"{name} must not be divided by zero")
    return factor if end["operator"] == "*" else 1.0 / factor


def _rest(text: str, at: int) -> str:
    """Return the rest of the line at a position, quoted."""
    return quote(text[at : at + 100].strip().partition("\n")[0])


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
