"""Real eigenvectors in the printed output of Nastran, ``.f06``: modes of another model, or of a simulated test.

OP2 files are not read. Components that Nastran prints are along the axes of each node's output coordinate system,
which the bulk data give.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from fmu.formats.matrices.limits import text_lines
from fmu.formats.models.read import read_mesh
from fmu.formats.modes.measured_modes import (
    MOST_MODES,
    MeasuredModes,
    ModeNumber,
    ModesError,
    Sensors,
    checked_file,
)
from fmu.formats.shown import names_shown, shown
from fmu.types import DIRECTIONS, FloatArray

MOST_NODES = 2**20
_REAL = r"[+-]?\d*\.\d*(?:[EeDd]?[+-]\d+)?"
_CYCLES = re.compile(rf"\s*CYCLES\s*=\s*({_REAL})")
_TITLE = re.compile(r"R E A L   E I G E N V E C T O R   N O \.\s+(\d{1,9})\s*$")
_TABLE = "R E A L   E I G E N V A L U E S"
_VALUE = re.compile(rf"\s*(\d{{1,9}})\s+\d{{1,9}}\s+({_REAL})\s+({_REAL})\s+({_REAL})\s+({_REAL})\s+({_REAL})\s*$")
_ROW = re.compile(rf"[01 ]\s*(\d{{1,10}})\s+([GS])\s+({_REAL}(?:\s+{_REAL}){{0,5}})\s*$")


def read_f06(
    file: Path,
    sensors: Sensors,
    deck: Path | None = None,
    modes: Sequence[ModeNumber] | None = None,
) -> MeasuredModes:
    """Return the real eigenvectors of an F06 file of Nastran at sensors.

    Parameters
    ----------
    file : Path
    sensors : sequence of (place, direction)
        Nodes and directions, which may have a minus sign.
    deck : Path, optional
        The bulk data, needed if nodes have output coordinate systems of their own (CD).
    modes : sequence of int, optional
        Numbers of the modes to take; by default all.

    Returns
    -------
    MeasuredModes
        Labels are the numbers of the modes.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ModesError
        If it has no eigenvectors, no such modes or nodes, or the deck cannot be read.
    """
    path = checked_file(file)
    try:
        with open(path, "rb") as content:
            frequencies, shapes = _found(text_lines(content))
    except ValueError as error:
        raise ModesError(file.name, [str(error)]) from None
    if not shapes:
        raise ModesError(
            file.name, ["must have real eigenvectors (got none; the case control's DISP = ALL prints them)"]
        )
    chosen = list(shapes) if modes is None else [int(number) for number in modes]
    missing = [number for number in chosen if number not in shapes]
    if missing or not chosen:
        raise ModesError(file.name, [f"modes: must be some of {names_shown(list(shapes))} (got {shown(chosen)})"])
    wrong = [number for number in chosen if not 0.0 < frequencies.get(number, 0.0) < np.inf]
    if wrong:
        raise ModesError(file.name, [f"modes: must have frequencies above 0 Hz (mode {wrong[0]} has none)"])
    try:
        axes = {} if deck is None else read_mesh(deck).axes
    except ValueError as error:
        raise ModesError(file.name, [f"deck: {error}"]) from None
    table = np.array([[_at(shapes[number], sensor, axes, file.name) for number in chosen] for sensor in sensors])
    if not np.all(np.isfinite(table)):
        raise ModesError(file.name, ["shapes: must be finite at the sensors"])
    return MeasuredModes(
        np.array([frequencies[number] for number in chosen]),
        tuple(map(str, chosen)),
        sensors=tuple((place, str(direction)) for place, direction in sensors),
        shapes=table,
    )


def _found(lines: Iterator[str]) -> tuple[dict[int, float], dict[int, dict[int, FloatArray]]]:
    """Return the frequency of each mode, Hz, and the components (6,) of each node by mode."""
    frequencies: dict[int, float] = {}
    shapes: dict[int, dict[int, FloatArray]] = {}
    cycles, is_table, reading = 0.0, False, 0
    for line in lines:
        if found := _CYCLES.match(line):
            cycles = _number(found[1])
        if found := _TITLE.search(line):
            reading, is_table = int(found[1]), False
            shapes.setdefault(reading, {})
            if cycles:
                frequencies[reading] = cycles
            if len(shapes) > MOST_MODES:
                raise ValueError(f"must have at most {MOST_MODES} modes")
        elif _TABLE in line:
            reading, is_table = 0, True
        elif is_table and (found := _VALUE.match(line)):
            frequencies.setdefault(int(found[1]), _number(found[4]))
        elif reading and (found := _ROW.match(line)):
            values = [_number(word) for word in found[3].split()]
            shapes[reading][int(found[1])] = np.array(values + [0.0] * (6 - len(values)))
            if len(shapes[reading]) > MOST_NODES:
                raise ValueError(f"must have at most {MOST_NODES} nodes")
        elif line.startswith("1") or "PAGE" in line:
            reading, cycles = 0, 0.0
    return frequencies, shapes


def _number(word: str) -> float:
    exponent = (
        re.sub(r"(?<=[\d.])([+-])", r"E\1", word.upper().replace("D", "E")) if "E" not in word.upper() else word
    )
    try:
        return float(exponent.upper().replace("D", "E"))
    except ValueError:
        raise ValueError(f"it has a component that is no number ({shown(word)})") from None


def _at(
    shape: dict[int, FloatArray], sensor: tuple[object, str], axes: Mapping[int, FloatArray], name: str
) -> float:
    """Return the component of a shape that a sensor reads."""
    place, direction = sensor
    sign, along = (-1.0, direction[1:]) if direction.startswith("-") else (1.0, direction)
    node = int(place) if isinstance(place, int | str) and str(place).isdecimal() else -1
    if node not in shape:
        raise ModesError(name, [f"sensors: must be at nodes of the file (got {shown(place)})"])
    k, values = DIRECTIONS.index(along), shape[node]
    if node in axes:
        values = np.concatenate([values[:3] @ axes[node], values[3:] @ axes[node]])
    return float(sign * values[k])
