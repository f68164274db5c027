"""Reader for the real eigenvectors that Nastran and MYSTRAN print to ``.f06`` files.

The modes may be those of another model or of a simulated test. OP2 files are not read. The printed components are
along the axes of each node's output coordinate system, which the bulk data define.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fmu.arguments import ArgumentError
from fmu.formats.matrices.limits import text_lines
from fmu.formats.matrices.nastran.includes import BULK_DATA
from fmu.formats.models.read import read_mesh
from fmu.formats.modes.measured_modes import (
    MOST_MODES,
    Computed,
    MeasuredModes,
    ModeNumber,
    ModesError,
    ModesFormat,
    Sensors,
    checked_file,
    modes_chosen,
)
from fmu.formats.shown import quote
from fmu.numbers import given
from fmu.types import DIRECTIONS, FloatArray

MOST_NODES = 2**20
_PRINTED = 1e-4
"""Largest relative difference between two printed frequencies of one mode."""
_REAL = r"[+-]?\d*\.\d*(?:[EeDd]?[+-]\d+)?"
_CYCLES = re.compile(rf"\s*CYCLES\s*=\s*({_REAL})")
_TITLE = re.compile(r"R E A L   E I G E N V E C T O R   N O \.\s+(\d{1,9})\s*$")
_TABLE = "R E A L   E I G E N V A L U E S"
_VALUE = re.compile(rf"\s*(\d{{1,9}})\s+\d{{1,9}}\s+({_REAL})\s+({_REAL})\s+({_REAL})\s+({_REAL})\s+({_REAL})\s*$")
_ROW = re.compile(rf"[01 ]\s*(\d{{1,10}})\s+([GS]|\d{{1,9}})\s+({_REAL}(?:\s+{_REAL}){{0,5}})\s*$")
_MYSTRAN_TITLE = re.compile(r"\s*OUTPUT FOR EIGENVECTOR\s+(\d{1,9})\s*$")
_MYSTRAN_VECTOR = "E I G E N V E C T O R"
"""Heading of a displacement table; tables of other quantities, such as forces, have the same title line."""
_FATAL = re.compile(r"FATAL MESSAGE|\*ERROR")


def read_f06(
    file: Path,
    sensors: Sensors,
    deck: Path | None = None,
    modes: Sequence[ModeNumber] | None = None,
) -> MeasuredModes:
    """Read real eigenvectors at the sensors from an F06 file of Nastran or MYSTRAN.

    Parameters
    ----------
    file : Path
    sensors : sequence of (place, direction)
        Node ids, and directions, which may have a minus sign.
    deck : Path, optional
        The bulk data, needed if nodes have their own output coordinate systems (CD).
    modes : sequence of int, optional
        Numbers of the modes to use; all by default.

    Returns
    -------
    MeasuredModes
        The labels are the mode numbers.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ModesError
        If the file is too large, is not printed output, has no eigenvectors, or lacks a mode or node; if a
        component is not a finite number; if a mode has two frequencies, as in several subcases; if a mode to use
        has no frequency above 0 Hz; or if the deck cannot be read.
    """
    printed = _read_printed(file, sensors, deck)
    return modes_chosen(file.name, printed[:2], sensors, modes, printed[2])


def computed_f06(path: Path, sensors: Sensors, deck: Path) -> Computed:
    """Read all modes in an F06 file; see `fmu.formats.modes.measured_modes.ModesFormat`.

    Node axes are read from the deck if it is bulk data. The errors are the same as for `read_f06`, but modes
    without a frequency above 0 Hz are accepted.
    """
    return _read_printed(path, sensors, deck if deck.suffix.lower() in BULK_DATA else None)[:2]


def _read_printed(
    file: Path, sensors: Sensors, deck: Path | None
) -> tuple[FloatArray, FloatArray | None, list[int]]:
    """Return the frequencies in Hz, the shapes and the mode numbers; see `read_f06`.

    The shapes are None if there are no sensors. A frequency that is not printed is 0. Raise ModesError if the file
    or deck cannot be read, or lacks modes or a sensor's node.
    """
    path = checked_file(file)
    if path.suffix.lower() in (".op2", ".xdb"):
        rule = "must be the printed output, .f06: DISP(PRINT) = ALL in the case control prints the modes"
        raise ModesError(file.name, [f"{rule} (got a {path.suffix} file)"])
    try:
        with open(path, "rb") as content:
            found = _find_tables(text_lines(content))
    except ValueError as error:
        raise ModesError(file.name, [str(error)]) from None
    numbers = list(found.shapes if len(sensors) else found.frequencies)
    if not numbers:
        said = f"; it says: {found.fatal}" if found.fatal else ""
        what = (
            "real eigenvectors (got none; DISP = ALL, or VECTOR = ALL, in the case control prints them"
            if len(sensors)
            else "real eigenvalues (got none"
        )
        raise ModesError(file.name, [f"must have {what}{said})"])
    frequencies = np.array([found.frequencies.get(number, 0.0) for number in numbers])
    if not len(sensors):
        return frequencies, None, numbers
    try:
        axes = {} if deck is None else read_mesh(deck).axes
    except ValueError as error:
        raise ModesError(file.name, [str(ArgumentError.of(error).replace_key("path", "deck"))]) from None
    shapes = [[_at(found.shapes[number], sensor, axes, file.name) for number in numbers] for sensor in sensors]
    if not np.all(np.isfinite(shapes)):
        raise ModesError(file.name, ["shapes: must be finite at the sensors"])
    return frequencies, np.array(shapes), numbers


@dataclass
class _Found:
    """Frequencies in Hz by mode, components (6,) by mode and node, and the first fatal message in a file."""

    frequencies: dict[int, float] = field(default_factory=dict)
    shapes: dict[int, dict[int, FloatArray]] = field(default_factory=dict)
    fatal: str = ""

    def add_frequency(self, number: int, frequency: float) -> None:
        """Store a mode's frequency, in Hz. Raise ValueError if the mode has another one already."""
        known = self.frequencies.setdefault(number, frequency)
        if abs(frequency - known) > _PRINTED * max(abs(frequency), abs(known)):
            raise ValueError(
                "must have the modes of one subcase: print one alone "
                f"(mode {number} has {given(known)} and {given(frequency)} Hz)"
            )


def _find_tables(lines: Iterator[str]) -> _Found:
    found = _Found()
    cycles, is_table, reading, next_mode = 0.0, False, 0, 0
    for line in lines:
        if match := _CYCLES.match(line):
            cycles = _number(match[1])
        if match := _TITLE.search(line):
            reading, is_table = int(match[1]), False
            if cycles:
                found.add_frequency(reading, cycles)
                found.frequencies[reading] = cycles
        elif match := _MYSTRAN_TITLE.match(line):
            next_mode, reading = int(match[1]), 0
        elif next_mode and line.strip() == _MYSTRAN_VECTOR:
            reading, next_mode, is_table = next_mode, 0, False
        elif _TABLE in line:
            reading, is_table = 0, True
        elif is_table and "BEFORE AUGMENTATION" in line:  # another table follows, with residual vectors
            is_table = False
        elif is_table and (match := _VALUE.match(line)):
            found.add_frequency(int(match[1]), _number(match[4]))
        elif reading and (match := _ROW.match(line)):
            values = [_number(word) for word in match[3].split()]
            found.shapes.setdefault(reading, {})[int(match[1])] = np.array(values + [0.0] * (6 - len(values)))
        elif line.startswith("1") or "PAGE" in line:
            reading, cycles = 0, 0.0
        elif not found.fatal and _FATAL.search(line):
            found.fatal = quote(" ".join(line.split()))
        if len(found.shapes) > MOST_MODES or len(found.shapes.get(reading, ())) > MOST_NODES:
            raise ValueError(f"must have at most {MOST_MODES} modes of {MOST_NODES} nodes")
    return found


def _number(word: str) -> float:
    exponent = (
        re.sub(r"(?<=[\d.])([+-])", r"E\1", word.upper().replace("D", "E")) if "E" not in word.upper() else word
    )
    try:
        return float(exponent.upper().replace("D", "E"))
    except ValueError:
        raise ValueError(f"it has a component that is no number ({quote(word)})") from None


def _at(
    shape: dict[int, FloatArray], sensor: tuple[object, str], axes: Mapping[int, FloatArray], name: str
) -> float:
    """Return a mode shape's component at a sensor. Raise ModesError if the file lacks the sensor's node."""
    place, direction = sensor
    sign, along = (-1.0, direction[1:]) if direction.startswith("-") else (1.0, direction)
    node = int(str(place)) if str(place).isdecimal() else -1
    if node not in shape:
        raise ModesError(name, [f"sensors: must be at nodes of the file (got {quote(place)})"])
    k, values = DIRECTIONS.index(along), shape[node]
    if node in axes:
        values = np.concatenate([values[:3] @ axes[node], values[3:] @ axes[node]])
    return float(sign * values[k])


FORMAT = ModesFormat(read_f06, "{job}.f06", computed_f06)
