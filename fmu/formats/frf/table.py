"""Reader for frequency response functions in text tables, as exported from spreadsheets.

In the first form there is one row per frequency line. The columns of an FRF are ``re`` and ``im``, or
``amplitude`` and ``phase_deg``, preceded by its response and its drive; ``coherence`` and ``sd`` are optional::

    frequency_hz,tip z / root y re,tip z / root y im,tip z / root y coherence
    10.0,0.0012,-0.0004,0.98
    10.5,0.0013,-0.0005,0.99

In the second form there is one row per value::

    frequency_hz,response,drive,amplitude,phase_deg
    10.0,tip z,root y,0.0013,-18.4
    10.5,tip z,root y,0.0014,-21.0

A point is written as a node's number or name, a blank, and a direction: x, y, z, rx, ry or rz, optionally with a
minus sign. A missing value is an empty cell or ``nan``. Values are in SI units; separators and comments are as in
`fmu.formats.modes.csv`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fmu.formats.frf.measured_frfs import (
    FRFFormat,
    MeasuredFRFs,
    Points,
    Wanted,
    check_size,
    point_of,
    points_in_order,
    rows_of,
    rows_of_all,
)
from fmu.formats.modes.csv import Row, read_table, refuse
from fmu.formats.shown import names_shown, quote
from fmu.types import Dof, FloatArray

MOST_ROWS = 300_000
"""Largest number of rows in a table: 30 FRFs of 10 000 lines, one row per value."""
_FREQUENCY, _POINTS = "frequency_hz", ("response", "drive")
_PAIRS = (("re", "im"), ("amplitude", "phase_deg"))
_OPTIONAL = ("coherence", "sd")
_COLUMN = re.compile(r"(.+?) */ *(.+) (re|im|amplitude|phase_deg|coherence|sd)")
_COMMA = re.compile(r"[+-]?[\d.]*,\d+(e[+-]?\d+)?", re.IGNORECASE)
_POINT = re.compile(r".+ -?r?[xyz]")
_Columns = dict[str, FloatArray]
"""Columns of one FRF, by name."""


def read_frf_table(path: Path, wanted: Wanted) -> MeasuredFRFs:
    """Read the FRFs in a text table. Coherences and sds are dropped, with a note, unless all FRFs read have them.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ModesError
        If the table is invalid (the message lists the errors with their lines and columns), if it lacks FRFs that
        are wanted, or if the number of given points differs from the number of FRFs in the table.
    """
    header, rows = read_table(path, MOST_ROWS)
    if _FREQUENCY not in header:
        refuse(path, [f"column {_FREQUENCY}: is missing (the columns are {names_shown(header)})"])
    found: list[str] = []
    _refuse_commas(path, rows)
    read = _read_long if _POINTS[0] in header else _read_wide
    lines, frfs = read(path, header, rows, found)
    refuse(path, found)
    n = len(frfs)
    chosen = list(range(n)) if wanted.frfs is None else rows_of(path.name, wanted.frfs, n)
    columns_of = [list(frfs.values())[i] for i in chosen]
    values = np.array([_complex(columns) for columns in columns_of])
    check_size(path.name, values)
    notes: list[str] = []

    def of_all(name: str) -> FloatArray | None:
        return rows_of_all([columns.get(name) for columns in columns_of], name, notes)

    def points(key: str, end: int, given: Points | None) -> tuple[Dof, ...]:
        of_file = points_in_order(path.name, key, [point_of(pair[end]) for pair in frfs], given, n)
        return tuple(of_file[i] for i in chosen)

    return MeasuredFRFs(
        lines,
        values,
        points("drives", 1, wanted.drives),
        points("responses", 0, wanted.responses),
        sd=of_all("sd"),
        coherence=of_all("coherence"),
        notes=tuple(notes),
    )


def _refuse_commas(path: Path, rows: Sequence[Row]) -> None:
    """Raise a ModesError that names the first number with a decimal comma, if there is one."""
    for row in rows:
        for name, text in row.values.items():
            if "," in text and _COMMA.fullmatch(text):
                rule = f"must have a decimal point, not a comma (got {quote(text)}); replace all decimal commas"
                refuse(path, [f"line {row.line}, column {name}: {rule} by points"])


def _read_wide(
    path: Path, header: Sequence[str], rows: Sequence[Row], found: list[str]
) -> tuple[FloatArray, dict[tuple[str, str], _Columns]]:
    """Read a table with one row per frequency line.

    Return the frequencies in Hz, shape (n_lines,), and the columns of each FRF, keyed by (response, drive). Errors
    are appended to `found`.
    """
    frfs: dict[tuple[str, str], _Columns] = {}
    for name in header:
        match = _COLUMN.fullmatch(name)
        if match and all(_POINT.fullmatch(match[k]) for k in (1, 2)):
            frfs.setdefault((match[1], match[2]), {})[match[3]] = _column(rows, name, found)
        elif name != _FREQUENCY:
            found.append(f"column {name}: must be named as 'tip z / root y re', or im, amplitude, phase_deg, …")
    for (response, drive), columns in frfs.items():
        _check_pair(list(columns), f" of {response} / {drive}", found)
    if not frfs and not found:
        found.append("must have a column per part of an FRF, such as 'tip z / root y re'")
    return _frequencies(rows, found), frfs


def _read_long(
    path: Path, header: Sequence[str], rows: Sequence[Row], found: list[str]
) -> tuple[FloatArray, dict[tuple[str, str], _Columns]]:
    """Read a table with one row per FRF value.

    Return the distinct frequencies in Hz, shape (n_lines,), and the columns of each FRF, keyed by (response,
    drive), with NaN for missing rows. Errors are appended to `found`, or raised as a ModesError.
    """
    parts = [name for name in header if name not in (_FREQUENCY, *_POINTS)]
    allowed = [*(name for pair in _PAIRS for name in pair), *_OPTIONAL]
    found += [f"column {name}: must be one of {names_shown(allowed)}" for name in parts if name not in allowed]
    found += [f"column {name}: is missing" for name in _POINTS if name not in header]
    _check_pair(parts, "", found)
    refuse(path, found)
    for name in _POINTS:
        wrong = next((row for row in rows if not _POINT.fullmatch(row.values[name])), None)
        if wrong is not None:
            rule = f"must be a node and a direction, such as 'tip -z' (got {quote(wrong.values[name])})"
            found.append(f"line {wrong.line}, column {name}: {rule}")
    frequencies = _frequencies(rows, found)
    values = {name: _column(rows, name, found) for name in parts}
    refuse(path, found)
    lines, at = np.unique(frequencies, return_inverse=True)
    pairs = [(row.values[_POINTS[0]], row.values[_POINTS[1]]) for row in rows]
    row_of = {pair: i for i, pair in enumerate(dict.fromkeys(pairs))}
    places = np.array([row_of[pair] for pair in pairs]) * len(lines) + at
    first = np.unique(places, return_index=True)[1]
    for i in np.setdiff1d(np.arange(len(rows)), first).tolist():
        found.append(f"line {rows[i].line}: must not repeat a frequency of {pairs[i][0]} / {pairs[i][1]}")
    filled = {name: np.full(len(row_of) * len(lines), np.nan) for name in parts}
    for name, column in values.items():
        filled[name][places] = column
    tables = {name: array.reshape(len(row_of), -1) for name, array in filled.items()}
    return lines, {pair: {name: table[i] for name, table in tables.items()} for pair, i in row_of.items()}


def _check_pair(parts: Sequence[str], of: str, found: list[str]) -> None:
    """Append an error to `found` unless an FRF has the columns re and im, or amplitude and phase_deg.

    `parts` lists its columns, which may also include coherence and sd. `of` names the FRF in the message.
    """
    if sorted(name for name in parts if name not in _OPTIONAL) not in [sorted(pair) for pair in _PAIRS]:
        found.append(f"must have columns re and im, or amplitude and phase_deg{of} (got {names_shown(parts)})")


def _complex(columns: _Columns) -> FloatArray:
    if "re" in columns:
        return np.asarray(columns["re"] + 1j * columns["im"])
    return np.asarray(columns["amplitude"] * np.exp(1j * np.radians(columns["phase_deg"])))


def _frequencies(rows: Sequence[Row], found: list[str]) -> FloatArray:
    column = _column(rows, _FREQUENCY, found)
    for i in np.flatnonzero(np.isnan(column)).tolist():
        found.append(f"line {rows[i].line}, column {_FREQUENCY}: must be a number")
    return column


def _column(rows: Sequence[Row], name: str, found: list[str]) -> FloatArray:
    """Return a column as numbers (n_rows,), with NaN for empty and invalid cells.

    An error is appended to `found` for each invalid cell.
    """
    column = np.empty(len(rows))
    for i, row in enumerate(rows):
        text = row.values[name]
        try:
            column[i] = float(text or "nan")
        except ValueError:
            column[i] = np.nan
            found.append(f"line {row.line}, column {name}: must be a number (got {quote(text)})")
    return column


FORMAT = FRFFormat((".csv", ".tsv", ".txt"), read_frf_table)
