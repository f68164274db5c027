"""Comparison of paired shapes, warnings about the pairing of computed with measured modes, and notes on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.trace.modal_states import sensor_names
from fmu.fem.modes.modal import assign, mac
from fmu.fem.pairing.correlation import ALIKE, CLOSE, Correlation, close_groups
from fmu.numbers import apart, fixed, share, significant
from fmu.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from fmu.fem.modes.separable import SeparableModel
    from fmu.posterior.data.modal_data import ModalData

_COMMON, _FAR = 1.25, 2.0
"""Largest ratio between the factors by which frequencies err that suggests one cause, and smallest factor that
causes a warning."""
RIVAL = 0.1
"""Smallest amount by which the paired mode's MAC should exceed any other mode's MAC."""


@dataclass(frozen=True)
class ComputedMode:
    """A computed mode.

    Attributes
    ----------
    number : int or None
        Number from 1, in the sorted spectrum or in the order of a user's function; None if the model computes only
        paired frequencies.
    frequency_hz : float
    measured : int or None
        Index of the paired measured mode; None if the mode is not paired.
    seen : bool
        Whether the mode moves a sensor.
    moves : str
        The directions with most of the kinetic energy: ``"z 98 %"``; empty if unknown.
    is_rigid : bool
        Whether the mode is a rigid-body motion at 0 Hz.
    """

    number: int | None
    frequency_hz: float
    measured: int | None
    seen: bool = True
    moves: str = ""
    is_rigid: bool = False


def correlate_shapes(
    data: ModalData, structure: SeparableModel | None, computed: FloatArray, frequencies_hz: FloatArray
) -> Correlation:
    """Compare the measured mode shapes with the paired computed shapes, (n_sensors, n_modes).

    The measured frequencies and the computed ones, `frequencies_hz` (n_modes,), decide which modes are close.
    """
    groups = close_groups(data.frequencies_hz, frequencies_hz)
    sensors = tuple(sensor_names(structure, data.sensors))
    return Correlation(sensors, tuple(map(str, data.labels)), np.asarray(data.shapes), computed, groups)


def unlike(
    labels: tuple[str, ...], paired: list[int], alike: FloatArray | None, found: Correlation | None = None
) -> list[str]:
    """Return warnings about measured modes that differ from their paired mode, or also resemble another one.

    A mode is reported if its MAC with the paired mode is below `ALIKE`. It is also reported if its MAC with
    another computed mode is larger than with the paired mode, or smaller by less than `RIVAL`; if it is larger by
    more than `RIVAL`, the warning says that the mode looks like that other one. Modes in a group of
    close modes are skipped if the subspace MAC of the group, which `found` contains, is at least `ALIKE`.

    Parameters
    ----------
    labels : tuple of str
        Labels of the measured modes.
    paired : list of int
        For each measured mode, the column of its paired mode in `alike`.
    alike : ndarray, shape (n_modes, n_computed), or None
        MAC between measured and computed modes. If it is None, because no shapes were measured, there are no
        warnings.
    found : Correlation, optional
    """
    doubts = []
    for k, column in enumerate(paired if alike is not None else []):
        if found is not None and found.subspace.get(k, 0.0) >= ALIKE:
            continue
        row = alike[k]  # type: ignore[index]  # None only if there are no columns
        others = np.delete(np.arange(len(row)), column)
        if row[column] < ALIKE:
            doubts.append(
                f"Mode {labels[k]}: MAC {apart(row[column], ALIKE, sd=0.1)[0]} with computed mode {column + 1}, "
                f"below {ALIKE}."
            )
        rival = others[np.argmax(row[others])] if len(others) else column
        if rival != column and row[rival] > row[column] + RIVAL:
            doubts.append(
                f"Mode {labels[k]}: it looks like computed mode {rival + 1} (MAC {fixed(row[rival], 2)}), not "
                f"{column + 1} (MAC {fixed(row[column], 2)}): check its shape and the labels."
            )
        elif rival != column and row[rival] > row[column] - RIVAL:
            doubts.append(
                f"Mode {labels[k]}: the sensors can hardly distinguish computed mode {column + 1} (MAC "
                f"{fixed(row[column], 2)}) from {rival + 1} (MAC {fixed(row[rival], 2)})."
            )
    return doubts


def close(
    labels: tuple[str, ...], paired: list[int], frequencies: FloatArray, seen: BoolArray, by_number: bool
) -> list[str]:
    """Return warnings about neighbouring computed modes that are close in frequency, one of which is paired.

    Unless modes are paired by number, a neighbour that moves no sensor is ignored.
    """
    doubts, told = [], set()
    for k, column in enumerate(paired):
        for other in (column - 1, column + 1):
            pair = (min(column, other), max(column, other))
            if not 0 <= other < len(frequencies) or pair in told or not (by_number or seen[other]):
                continue
            distance = abs(frequencies[other] / frequencies[column] - 1.0)
            if distance < CLOSE:
                told.add(pair)
                doubts.append(
                    f"Mode {labels[k]}: computed modes {pair[0] + 1} and {pair[1] + 1} are {share(distance)} "
                    "apart in frequency, too close to tell which of them was measured."
                )
    return doubts


def warn_of_order(labels: tuple[str, ...], paired: list[int], measured: FloatArray) -> list[str]:
    """Return a list with a warning if the paired modes are not in the order of the measured frequencies."""
    if _is_in_order(paired, measured):
        return []
    return [
        "Measured and computed modes are in different orders: "
        + ", ".join(f"{labels[k]} is computed mode {paired[k] + 1}" for k in np.argsort(measured, kind="stable"))
        + "."
    ]


def _is_in_order(paired: Sequence[int], measured: FloatArray) -> bool:
    """Return True if the paired modes are in the order of the measured frequencies, shape (n_modes,)."""
    numbers = [paired[k] for k in np.argsort(measured, kind="stable")]
    return numbers == sorted(numbers)


def find_reversed_sensor(
    found: Correlation, computed: FloatArray, modes: Sequence[ComputedMode], measured: FloatArray
) -> str:
    """Return a warning about the one sensor whose opposite sign would put the pairing right, or "" if none would.

    With a wrong sign, MAC pairs modes that fit the wrong shapes, and the sensor may then hardly stand out. If the
    paired modes are not in the order of the measured frequencies, or a MAC is below `ALIKE`, the shapes are paired
    again with the sign of each sensor reversed. A sign is taken for wrong if the pairing then has neither fault,
    and a larger least MAC. A sensor that stands out (`Correlation.suspects`) has a warning already.

    Parameters
    ----------
    found : Correlation
        The measured shapes with their sensors.
    computed : ndarray, shape (n_sensors, n_computed)
        The shapes of all computed modes at the sensors.
    modes : sequence of ComputedMode
        All computed modes. Rigid-body modes are not paired.
    measured : ndarray, shape (n_modes,)
        Measured frequencies.
    """
    elastic = [k for k, mode in enumerate(modes) if not mode.is_rigid]
    frequencies = np.array([modes[k].frequency_hz for k in elastic])

    def judge(seen: FloatArray) -> tuple[bool, float]:
        """Return whether the modes paired with measured shapes are in order, and the least MAC."""
        alike = mac(computed[:, elastic], seen)
        columns = assign(alike[None], frequencies[None], measured)[0]
        return _is_in_order(columns.tolist(), measured), float(alike[np.arange(len(columns)), columns].min())

    is_ordered, least = judge(found.measured)
    if not found.is_enough or (is_ordered and least >= ALIKE):
        return ""
    right = []
    for j in range(len(found.sensors)):
        turned = found.measured.copy()
        turned[j] *= -1.0
        is_right, alike = judge(turned)
        if is_right and alike >= ALIKE and alike > least:
            right.append((j, alike))
    if len(right) != 1 or right[0][0] in found.suspects:
        return ""
    ((j, alike),) = right
    return (
        f"Sensor {found.sensors[j]}: with the opposite sign, the modes would be paired in the order of their "
        f"frequencies, MAC at least {fixed(alike, 2)}; look at its direction."
    )


def note_unmeasured(found: Sequence[ComputedMode]) -> list[str]:
    """Return notes on rigid-body modes, and on unmeasured modes below the last measured one."""
    last = max(i for i, mode in enumerate(found) if mode.measured is not None)
    rigid = [mode.number for mode in found if mode.is_rigid]
    notes = []
    if rigid:
        subject = (
            "mode 1 is a rigid-body motion" if len(rigid) == 1 else f"modes 1–{len(rigid)} are rigid-body motions"
        )
        notes.append(f"Computed {subject}; the first elastic mode is number {len(rigid) + 1}.")
    for seen, one, many in (
        (False, "moves no sensor", "move no sensor"),
        (True, "moves a sensor, but was not measured", "move a sensor, but were not measured"),
    ):
        numbers = [
            mode.number
            for mode in found[:last]
            if mode.measured is None and mode.seen == seen and not mode.is_rigid
        ]
        if numbers:
            subject, words = ("mode", one) if len(numbers) == 1 else ("modes", many)
            notes.append(f"Computed {subject} {ranges([n for n in numbers if n is not None])} {words}.")
    return notes


def ranges(numbers: Sequence[int]) -> str:
    """Format ascending numbers, with runs of three or more as ranges: ``"1, 2, 5–9"``."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and runs[-1][-1] == number - 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    words = [f"{run[0]}–{run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs]
    return ", ".join(words)


def warn_of_units(ratio: FloatArray, alike: FloatArray) -> list[str]:
    """Return a list with a warning if all frequencies err by nearly one factor though all shapes agree.

    The arguments are the computed frequency of each pair over the measured one, and its MAC, (n_modes,) each.
    """
    far = max(ratio.min(), 1.0 / ratio.max())
    if not (alike.min() >= ALIKE and ratio.max() <= _COMMON * ratio.min() and far >= _FAR):
        return []
    middle = np.exp(np.mean(np.abs(np.log(ratio))))
    low, high, square = (significant(float(x), 2) for x in (far, far * ratio.max() / ratio.min(), middle**2))
    side, change, other = ("high", "divided", "multiplied") if ratio[0] > 1.0 else ("low", "multiplied", "divided")
    return [
        f"All computed frequencies are {low} to {high} times too {side}, and the shapes agree: look at the units "
        f"of stiffness and mass. With the stiffness {change} by about {square}, or the mass {other} by it, the "
        "frequencies would agree too."
    ]
