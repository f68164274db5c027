"""Reader for natural frequencies and modal displacements that CalculiX prints to ``job.dat``.

The input deck needs this step, and a set SENSORS with the sensor nodes::

    *FREQUENCY
    10
    *NODE PRINT, NSET=SENSORS
    U

If *TRANSFORM rotates the axes of a node, CalculiX prints its displacements along the rotated axes, with the mark
L. Such rows are not used: ``*NODE PRINT`` needs ``GLOBAL=YES``.

CalculiX expands shells and beams into solids, but this file contains the displacements of the original nodes.
Frequencies have seven significant digits.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from fmu.formats.files import too_large, why_no_file
from fmu.formats.shown import quote
from fmu.types import FloatArray

DIRECTIONS = ("x", "y", "z")
"""Directions of the displacements printed by ``*NODE PRINT``."""
LARGEST_FILE = 2**29
_TABLE = "E I G E N V A L U E   O U T P U T"
_MODE = re.compile(r"^\s*E I G E N V A L U E    N U M B E R\s+(\d+)\s*$", re.MULTILINE)
_LOCAL = "L"
"""Last word of a line with displacements along the rotated axes of a node."""
_SHAPE = "displacements (vx,vy,vz)"
_NO_LETTER = re.compile(r"(?<=\d)([+-]\d{3})$")
_COLUMNS, _FREQUENCY = 5, 3


def read_frequencies(path: Path) -> FloatArray:
    """Return the natural frequencies of the last step in Hz, shape (n_modes,).

    Raises
    ------
    ValueError
        If the file does not exist, is too large or has no eigenvalues, if its table is cut off, or if it has a
        word where a number is expected.
    """
    text = _last_step(path)
    first = _MODE.search(text)
    return _frequencies(text[: first.start() if first else None], path.name)


def read_displacements(path: Path, n_modes: int, nodes: Collection[int] | None = None) -> dict[int, FloatArray]:
    """Return the modal displacements in the last step along global axes, shape (n_modes, 3), keyed by node id.

    Parameters
    ----------
    path : Path
    n_modes : int
        Number of modes in the step; see `read_frequencies`.
    nodes : collection of int, optional
        Node ids to read. Defaults to all nodes whose displacements are printed along global axes in every mode.

    Raises
    ------
    ValueError
        If the file does not exist, is too large or has no eigenvalues, if its last step does not have `n_modes`
        shapes, if a mode has no displacements of a node along global axes, or if there is a word where a number is
        expected.
    """
    text = _last_step(path)
    begins = [match.start() for match in _MODE.finditer(text)]
    blocks = [text[begin:end] for begin, end in zip(begins, [*begins[1:], len(text)], strict=False)]
    modes, rotated = _displacements(blocks, n_modes, path.name)
    wanted = sorted(set.intersection(*map(set, modes))) if nodes is None else nodes
    missing = next((node for node in wanted for rows in modes if node not in rows), None)
    if missing is not None:
        why = f"has no displacement of node {missing}: it must be in a *NODE PRINT with U"
        if missing in rotated:
            rule = "displacements along the axes of *TRANSFORM: its *NODE PRINT needs GLOBAL=YES"
            why = f"has, for node {missing}, {rule}"
        raise ValueError(f"{path.name} {why}")
    return {
        node: np.array([[_number(word, path.name) for word in rows[node]] for rows in modes]) for node in wanted
    }


def _last_step(path: Path) -> str:
    wrong = why_no_file(path) or too_large(path, LARGEST_FILE)
    if wrong:
        raise ValueError(wrong)
    _, title, last = path.read_bytes().decode("latin-1").rpartition(_TABLE)
    if not title:
        raise ValueError(f"{path.name} has no table of eigenvalues: the deck needs *FREQUENCY")
    return last


def _frequencies(text: str, name: str) -> FloatArray:
    """Return the frequencies in Hz, shape (n_modes,), from column 4 of a step's first table.

    Raise ValueError if the table is empty or cut off, or a frequency is not a number.
    """
    found: list[float] = []
    for line in text.splitlines():
        words = line.split()
        if words and words[0].isdecimal():
            if len(words) != _COLUMNS or int(words[0]) != len(found) + 1:
                raise ValueError(f"{name}: its table of eigenvalues is cut off (got {quote(line.strip())})")
            found.append(_number(words[_FREQUENCY], name))
        elif found:
            break
    if not found:
        raise ValueError(f"{name} has no eigenvalues in its table")
    return np.array(found)


def _displacements(blocks: Sequence[str], n_modes: int, name: str) -> tuple[list[dict[int, list[str]]], set[int]]:
    """Return one dict per mode that maps each node id to its three displacements along global axes, still as text.

    Also return the ids of nodes with displacements along axes of their own. Raise ValueError unless there are
    `n_modes` blocks.
    """
    if len(blocks) != n_modes:
        rule = f"has shapes of {len(blocks)} modes and frequencies of {n_modes}"
        raise ValueError(f"{name} {rule}: the deck needs *NODE PRINT with U for the nodes of the sensors")
    modes, rotated = [], set[int]()
    for block in blocks:
        rows: dict[int, list[str]] = {}
        reading = False
        for line in block.splitlines():
            words = line.split()
            if words and not words[0].isdecimal():
                reading = line.strip().startswith(_SHAPE)
            elif reading and words[-1:] == [_LOCAL]:
                rotated.add(int(words[0][:10]))
            elif reading and len(words) == 1 + len(DIRECTIONS):
                rows[int(words[0][:10])] = words[1:]
        modes.append(rows)
    return modes, rotated


def _number(word: str, name: str) -> float:
    """Convert a Fortran number to float. Raise ValueError if it is not a number.

    Fortran omits the letter E before a three-digit exponent: ``1.0-100``.
    """
    try:
        return float(_NO_LETTER.sub(r"E\1", word))
    except ValueError:
        raise ValueError(f"{name}: must have numbers (got {quote(word)})") from None
