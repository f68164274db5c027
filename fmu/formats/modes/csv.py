"""Readers for modes and points in text tables, as exported from spreadsheets.

A table of frequencies has one row per mode, with the frequency in Hz. Three columns may be omitted: ``number``,
the mode's number in the spectrum of the model; ``sd``, the standard deviation in Hz; and ``use``, true or false
for whether the mode is used in updating::

    mode,number,frequency,sd,use
    first bending,1,31.9,0.1,true
    second bending,3,197.9,0.4,false

A table of shapes has one row per sensor and one column per mode::

    place,direction,first bending,second bending
    tip,z,1.0,1.0
    12,-z,0.34,-0.71

A table of repeated tests has one row per test, in chronological order, and one column per mode, with frequencies
in Hz. The column ``test``, a number or a time, may be omitted. A cell is empty or ``nan`` if the test missed the
mode::

    test,first bending,second bending
    Monday 9:00,31.9,197.9
    Monday 9:30,31.8,

A table of the tests in a campaign has one row per test. Its columns are the test's name, its group (this column
may be omitted), the frequency of each mode in Hz, and covariates, such as the temperature. A frequency is empty
or ``nan`` if the test missed the mode, and a covariate is empty, ``nan`` or ``missing`` if it was not measured::

    name,group,temperature,first bending,second bending
    2024-03-04,before,4.5,31.9,197.9
    2024-07-12,after,,31.8,

A table of measurement points has one row per point, with coordinates in any unit of length::

    point,x,y,z
    tip,2.0,0.0,0.1

The line of column names shows whether commas, semicolons or tabs separate the values of the table. Empty lines
and lines that start with ``#`` are skipped.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fmu.formats.modes.measured_modes import MOST_MODES, MeasuredModes, ModesError, checked_file
from fmu.formats.shown import names_shown, quote
from fmu.types import FloatArray

MOST_ROWS = 10_000
"""Largest number of rows in a table."""
_FREQUENCY_COLUMNS = ("mode", "number", "frequency", "sd", "use")
_YES_OR_NO = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
_TEST, _NAME, _GROUP = "test", "name", "group"
_MISSED = ("", "nan")
_NOT_MEASURED = (*_MISSED, "missing")
_DIRECTION = re.compile(r"-?(r?[xyz])")


class Row(NamedTuple):
    """A table row: its line number in the file, counted from 1, and its values keyed by column name."""

    line: int
    values: dict[str, str]


class Campaign(NamedTuple):
    """Tests listed in a campaign file.

    Attributes
    ----------
    names, groups : tuple of str
        Name and group of each test. The group is empty if the table has no group column.
    covariates : tuple of dict of str to float or None
        Covariate values in each test; None where one was not measured.
    frequencies_hz : ndarray, shape (n_tests, n_modes)
        NaN where a test missed a mode.
    lines : tuple of int
        Line number of each test in the file, counted from 1.
    """

    names: tuple[str, ...]
    groups: tuple[str, ...]
    covariates: tuple[dict[str, float | None], ...]
    frequencies_hz: FloatArray
    lines: tuple[int, ...]


def read_frequencies(path: Path) -> MeasuredModes:
    """Read a table of measured frequencies, without mode shapes.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ModesError
        If the table is invalid; the message lists the errors with their lines and columns.
    """
    header, rows = read_table(path)
    found = [f"column {name}: is missing" for name in ("mode", "frequency") if name not in header]
    found += [
        f"column {name}: must be one of {', '.join(_FREQUENCY_COLUMNS)}"
        for name in header
        if name not in _FREQUENCY_COLUMNS
    ]
    refuse(path, found)
    frequencies = [_number(row, "frequency", found, positive=True) for row in rows]
    sd = [_number(row, "sd", found, positive=True) for row in rows] if "sd" in header else None
    numbers = [_whole(row, "number", found) for row in rows] if "number" in header else []
    use = [_yes(row, "use", found) for row in rows] if "use" in header else []
    labels = [row.values["mode"] for row in rows]
    first = {label: i for i, label in reversed(list(enumerate(labels)))}
    found += [
        f"line {row.line}, column mode: must be a name that no other mode has (got {quote(label)})"
        for i, (row, label) in enumerate(zip(rows, labels, strict=True))
        if not label or first[label] < i
    ]
    refuse(path, found)
    deviations = None if sd is None else np.array(sd)
    return MeasuredModes(np.array(frequencies), tuple(labels), deviations, numbers=tuple(numbers), use=tuple(use))


def read_shapes(path: Path, labels: tuple[str, ...]) -> MeasuredModes:
    """Read a table of mode shapes, with the modes in the order of `labels` and NaN as frequencies.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ModesError
        If the table is invalid; the message lists the errors with their lines and columns.
    """
    header, rows = read_table(path)
    found = [f"column {name}: is missing" for name in ("place", "direction", *labels) if name not in header]
    known = ("place", "direction", *labels)
    found += [f"column {name}: is not a measured mode" for name in header if name not in known]
    refuse(path, found)
    for row in rows:
        if not row.values["place"]:
            found.append(f"line {row.line}, column place: must not be empty")
        if not _DIRECTION.fullmatch(row.values["direction"]):
            found.append(
                f"line {row.line}, column direction: must be x, y, z, rx, ry or rz, with or without a leading "
                f"minus (got {quote(row.values['direction'])})"
            )
    shapes = [[_number(row, label, found) for label in labels] for row in rows]
    refuse(path, found)
    places = [row.values["place"] for row in rows]
    sensors = [
        (int(place) if re.fullmatch(r"-?\d{1,18}", place) else place, row.values["direction"])
        for place, row in zip(places, rows, strict=True)
    ]
    return MeasuredModes(np.full(len(labels), np.nan), labels, None, tuple(sensors), np.array(shapes))


def read_points(path: Path) -> dict[str, FloatArray]:
    """Read a table of points, and return each point's coordinates, shape (3,), keyed by name.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ModesError
        If the table is invalid; the message lists the errors with their lines and columns.
    """
    header, rows = read_table(path)
    wanted = ("point", "x", "y", "z")
    refuse(path, [f"column {name}: is missing" for name in wanted if name not in header])
    refuse(path, [f"column {name}: must be one of {', '.join(wanted)}" for name in header if name not in wanted])
    found: list[str] = []
    points: dict[str, FloatArray] = {}
    for row in rows:
        name = row.values["point"]
        if not name or name in points:
            rule = f"must be a name that no other point has (got {quote(name)})"
            found.append(f"line {row.line}, column point: {rule}")
        points[name] = np.array([_number(row, axis, found) for axis in "xyz"])
    refuse(path, found)
    return points


def read_tests(path: Path) -> tuple[FloatArray, tuple[str, ...]]:
    """Read the frequencies from repeated tests in Hz, shape (n_tests, n_modes), and the mode labels.

    A frequency is NaN if its test missed the mode.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ModesError
        If the table is invalid; the message lists the errors with their lines and columns.
    """
    header, rows = read_table(path)
    found: list[str] = []
    labels = tuple(name for name in header if name != _TEST)
    if not labels:
        found.append("must have a column per mode, with its name")
    if "" in labels:
        found.append("every column must have a name, that of its mode")
    refuse(path, found)
    values = _frequencies(rows, labels, found)
    refuse(path, found)
    return values, labels


def read_campaign(path: Path, labels: Sequence[str], covariates: Collection[str] | None = None) -> Campaign:
    """Read a table of tests from a campaign.

    If the table has no column ``name``, the names are read from a column ``test``.

    Parameters
    ----------
    path : Path
    labels : sequence of str
        Names of the frequency columns, in mode order.
    covariates : collection of str, optional
        Covariate columns that the table may have. By default every other column is a covariate.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ModesError
        If the table is invalid; the message lists the errors with their lines and columns.
    """
    header, rows = read_table(path)
    name = _TEST if _TEST in header and _NAME not in header else _NAME
    known = (name, _GROUP, *labels)
    others = [column for column in header if column not in known]
    found = [
        f"column {column}: must be in the table, which has {names_shown(header)}"
        for column in (name, *labels)
        if column not in header
    ]
    if "" in header:
        found.append("every column must have a name, in the first line")
    elif covariates is not None:
        rule = f"must be one of {names_shown([*known, *covariates])}; correct its name or delete it"
        found += [f"column {column}: {rule}" for column in others if column not in covariates]
    refuse(path, found)
    values = _frequencies(rows, labels, found)
    advice = "; leave the cell empty if it was not measured, or delete the column"
    of_rows = [
        {
            column: None
            if row.values[column].lower() in _NOT_MEASURED
            else _number(row, column, found, advice=advice)
            for column in others
        }
        for row in rows
    ]
    names = [row.values[name] for row in rows]
    first = {one: row.line for one, row in reversed(list(zip(names, rows, strict=True)))}
    for row, one in zip(rows, names, strict=True):
        if not one:
            found.append(f"line {row.line}, column {name}: must not be empty; give the test a name")
        elif first[one] < row.line:
            rule = f"must not be the name in line {first[one]} (got {quote(one)}); rename one of the two tests"
            found.append(f"line {row.line}, column {name}: {rule}")
        if all(row.values[label].lower() in _MISSED for label in labels):
            rule = f"must have a frequency in a column of {names_shown(labels)} (got none); delete the line"
            found.append(f"line {row.line}: {rule}")
    refuse(path, found)
    groups = tuple(row.values.get(_GROUP, "") for row in rows)
    return Campaign(tuple(names), groups, tuple(of_rows), values, tuple(row.line for row in rows))


def _frequencies(rows: Sequence[Row], labels: Sequence[str], found: list[str]) -> FloatArray:
    """Return the frequencies in the columns `labels`, shape (n_rows, n_labels), with NaN for missed modes.

    For each invalid cell, an error is appended to `found`, and the frequency is NaN.
    """
    values = [
        [
            np.nan if row.values[label].lower() in _MISSED else _number(row, label, found, positive=True)
            for label in labels
        ]
        for row in rows
    ]
    return np.array(values)


def read_table(path: Path, most_rows: int = MOST_ROWS) -> tuple[list[str], list[Row]]:
    """Read the column names and rows of a text table.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ModesError
        If the file is too large, is not a table of UTF-8 text, or has more than `most_rows` rows. The message
        lists the errors with their lines.
    """
    try:
        text = checked_file(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ModesError(path.name, ["must be text in UTF-8"]) from None
    numbered = enumerate(io.StringIO(text, newline=None), 1)
    lines = ((i, line) for i, line in numbered if line.strip() and line.strip()[0] != "#")
    found: list[str] = []
    header: list[str] = []
    rows: list[Row] = []
    separator = ","
    for number, line in lines:
        if not header:
            separator = max(",;\t", key=line.count)
        try:
            cells = _cells(line, separator)
        except ValueError as error:
            found.append(f"line {number}: {error}")
            continue
        if not header:
            header = cells
            if len(set(header)) < len(header):
                raise ModesError(
                    path.name, [f"line {number}: column names must be distinct (got {quote(header)})"]
                )
        elif len(cells) != len(header):
            found.append(f"line {number}: must have {len(header)} values, one per column (got {len(cells)})")
        elif len(rows) == most_rows:
            found.append(f"line {number}: must not be there: a table has at most {most_rows} rows")
            break
        else:
            rows.append(Row(number, dict(zip(header, cells, strict=True))))
    if not found and not rows:
        found = ["must have a line of column names and a line of values at least"]
    refuse(path, found)
    return header, rows


def refuse(path: Path, found: list[str]) -> None:
    """Raise ModesError if there are any error messages in `found`."""
    if found:
        raise ModesError(path.name, found)


def _cells(line: str, separator: str) -> list[str]:
    """Split a line into values. Raise ValueError if the line is malformed."""
    if line.count(separator) > MOST_MODES + 1:
        raise ValueError(f"must have at most {MOST_MODES + 2} columns (got {line.count(separator) + 1})")
    try:
        cells = [cell.strip() for cell in next(csv.reader([line], delimiter=separator, strict=True))]
    except csv.Error as error:
        raise ValueError(
            f"must have closed quotes, and values of at most {csv.field_size_limit()} characters ({error})"
        ) from None
    if "\0" in line:
        raise ValueError("must have no NUL character")
    return cells


def _number(row: Row, column: str, found: list[str], *, positive: bool = False, advice: str = "") -> float:
    """Return the number in a row's column. If it is invalid, append an error to `found` and return NaN."""
    text = row.values[column]
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value) or (positive and value <= 0):
        rule = "a positive number" if positive else "a number"
        found.append(f"line {row.line}, column {column}: must be {rule} (got {quote(text)}){advice}")
        return np.nan
    return value


def _yes(row: Row, column: str, found: list[str]) -> bool:
    text = row.values[column]
    if text.lower() not in _YES_OR_NO:
        found.append(f"line {row.line}, column {column}: must be true or false (got {quote(text)})")
    return _YES_OR_NO.get(text.lower(), True)


def _whole(row: Row, column: str, found: list[str]) -> int:
    text = row.values[column]
    if not re.fullmatch(r"[1-9]\d{0,8}", text):
        found.append(f"line {row.line}, column {column}: must be a whole number from 1 (got {quote(text)})")
        return 0
    return int(text)
