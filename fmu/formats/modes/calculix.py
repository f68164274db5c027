"""Modes that CalculiX printed at the sensors; `fmu.formats.calculix_dat` says what the deck needs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fmu.formats.calculix_dat import DIRECTIONS, read_displacements, read_frequencies
from fmu.types import FloatArray


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
    frequencies = read_frequencies(path)
    if not sensors:
        return frequencies, None
    nodes = read_displacements(path, len(frequencies), [node for node, _ in sensors])
    shapes = []
    for node, direction in sensors:
        sign, axis = (-1.0, direction[1:]) if direction.startswith("-") else (1.0, direction)
        shapes.append(sign * nodes[node][:, DIRECTIONS.index(axis)])
    return frequencies, np.array(shapes)
