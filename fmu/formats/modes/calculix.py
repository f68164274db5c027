"""Reader for modes that CalculiX prints at sensors. `fmu.formats.calculix_dat` describes the required deck."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fmu.formats.calculix_dat import DIRECTIONS, read_displacements, read_frequencies
from fmu.formats.modes.measured_modes import (
    Computed,
    MeasuredModes,
    ModeNumber,
    ModesError,
    ModesFormat,
    Sensors,
    checked_file,
    is_node,
    modes_chosen,
)
from fmu.formats.shown import quote


def read_calculix(file: Path, sensors: Sensors, modes: Sequence[ModeNumber] | None = None) -> MeasuredModes:
    """Read the modes that CalculiX printed at sensors, for example the modes of another model or a simulated test.

    Parameters
    ----------
    file : Path
        ``job.dat``; the deck needs ``*NODE PRINT`` with U.
    sensors : sequence of (place, direction)
        Node ids, and directions x, y or z, which may have a minus sign.
    modes : sequence of int, optional
        Numbers of the modes to use; all by default.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ModesError
        If the file is too large or broken, has no eigenvalues, or lacks a mode or a sensor; if a sensor is not a
        node with direction x, y or z; or if a mode to use has no frequency above 0 Hz.
    """
    path = checked_file(file)
    wrong = [at for at in sensors if not is_node(at[0]) or at[1].removeprefix("-") not in DIRECTIONS]
    if wrong:
        got = " ".join(map(str, wrong[0]))
        raise ModesError(path.name, [f"sensors: must be nodes, and x, y or z (got {quote(got)})"])
    try:
        computed = computed_calculix(path, sensors)
    except ValueError as error:
        raise ModesError(path.name, [str(error)]) from None
    return modes_chosen(path.name, computed, sensors, modes, range(1, len(computed[0]) + 1))


def computed_calculix(path: Path, sensors: Sensors = (), _deck: Path | None = None) -> Computed:
    """Read all computed frequencies in Hz, shape (n,), and mode shapes at the sensors, shape (n_sensors, n).

    Parameters
    ----------
    path : Path
        ``job.dat``. If there are several steps, the last one is read.
    sensors : sequence of (node id, direction)
        Directions are x, y and z, or -x, -y and -z. The shapes are None if there are no sensors.

    Raises
    ------
    ValueError
        If the file does not exist, is too large, is cut off or has no eigenvalues; if a mode has no displacements
        of a sensor's node along global axes; or if there is a word where a number is expected.
    """
    frequencies = read_frequencies(path)
    if not sensors:
        return frequencies, None
    nodes = read_displacements(path, len(frequencies), [int(str(node)) for node, _ in sensors])
    shapes = []
    for node, direction in sensors:
        sign, axis = (-1.0, direction[1:]) if direction.startswith("-") else (1.0, direction)
        shapes.append(sign * nodes[int(str(node))][:, DIRECTIONS.index(axis)])
    return frequencies, np.array(shapes)


FORMAT = ModesFormat(read_calculix, "{job}.dat", computed_calculix, DIRECTIONS)
