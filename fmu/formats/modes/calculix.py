"""Modes that CalculiX prints into ``job.dat``.

The step of the input deck, with the nodes of the sensors in a set::

    *FREQUENCY
    10
    *NODE PRINT, NSET=SENSORS
    U

Shells and beams are expanded into solids, but this file has the motion of their own nodes. Frequencies have seven
figures.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fmu.formats.files import too_large, why_no_file
from fmu.formats.shown import shown
from fmu.types import FloatArray

DIRECTIONS = ("x", "y", "z")
"""Of the displacements that ``*NODE PRINT`` gives."""
LARGEST_FILE = 2**29
_TABLE = "E I G E N V A L U E   O U T P U T"
_MODE = re.compile(r"^\s*E I G E N V A L U E    N U M B E R\s+(\d+)\s*$", re.MULTILINE)
_SHAPE = "displacements (vx,vy,vz)"
_NO_LETTER = re.compile(r"(?<=\d)([+-]\d{3})$")
_COLUMNS, _FREQUENCY = 5, 3


def read_calculix(path: Path, sensors: Sequence[tuple[int, str]] = ()) -> tuple[FloatArray, FloatArray | None]:
    """Return the frequencies in Hz (n,), and the shapes at sensors (n_sensors, n).

    Parameters
    ----------
    path : Path
        ``job.dat``. Of several steps, the last one counts.
    sensors : sequence of (node id, direction)
        Directions are x, y and z, or -x, -y and -z. Without sensors there are no shapes.

    Raises
    ------
    ValueError
        If the file does not exist, has no eigenvalues, lacks a sensor in a mode, or a word is not a number.
    """
    wrong = why_no_file(path) or too_large(path, LARGEST_FILE)
    if wrong:
        raise ValueError(wrong)
    text = path.read_bytes().decode("latin-1")
    _, title, last = text.rpartition(_TABLE)
    if not title:
        raise ValueError(f"{path.name} has no table of eigenvalues: the deck needs *FREQUENCY")
    begins = [match.start() for match in _MODE.finditer(last)]
    frequencies = _frequencies(last[: begins[0] if begins else None], path.name)
    if not sensors:
        return frequencies, None
    ends = [*begins[1:], len(last)]
    blocks = [last[begin:end] for begin, end in zip(begins, ends, strict=False)]
    if len(blocks) != len(frequencies):
        rule = f"has shapes of {len(blocks)} modes and frequencies of {len(frequencies)}"
        raise ValueError(f"{path.name} {rule}: the deck needs *NODE PRINT with U for the nodes of the sensors")
    return frequencies, np.stack([_shape(block, sensors, path.name) for block in blocks], axis=1)


def _frequencies(text: str, name: str) -> FloatArray:
    """Return column 4 of the first table: number, eigenvalue, ω, f, imaginary part of ω."""
    found: list[float] = []
    for line in text.splitlines():
        words = line.split()
        if words and words[0].isdecimal():
            if len(words) != _COLUMNS or int(words[0]) != len(found) + 1:
                raise ValueError(f"{name}: its table of eigenvalues is cut off (got {shown(line.strip())})")
            found.append(_number(words[_FREQUENCY], name))
        elif found:
            break
    if not found:
        raise ValueError(f"{name} has no eigenvalues in its table")
    return np.array(found)


def _shape(block: str, sensors: Sequence[tuple[int, str]], name: str) -> FloatArray:
    """Return the motion at the sensors, from all tables of displacements of one mode."""
    rows: dict[int, list[str]] = {}
    reading = False
    for line in block.splitlines():
        words = line.split()
        if not words:
            continue
        if not words[0].isdecimal():
            reading = line.strip().startswith(_SHAPE)
        elif reading:
            rows[int(words[0][:10])] = words[1:]
    found = []
    for node, direction in sensors:
        if len(rows.get(node, ())) != len(DIRECTIONS):
            raise ValueError(f"{name} has no displacement of node {node}: it must be in a *NODE PRINT with U")
        sign, axis = (-1.0, direction[1:]) if direction.startswith("-") else (1.0, direction)
        found.append(sign * _number(rows[node][DIRECTIONS.index(axis)], name))
    return np.array(found)


def _number(word: str, name: str) -> float:
    """Return a number as Fortran writes it, without the letter before an exponent of three digits."""
    try:
        return float(_NO_LETTER.sub(r"E\1", word))
    except ValueError:
        raise ValueError(f"{name}: must have numbers (got {shown(word)})") from None
