"""What makes it doubtful which computed mode answers to which measured one, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fmu.numbers import apart, fixed, share
from fmu.types import BoolArray, FloatArray

ALIKE = 0.8
"""MAC below which two shapes are hardly of one mode."""
RIVAL = 0.1
"""How much more MAC the mode chosen must have than any other."""
CLOSE = 0.01
"""Relative distance of two frequencies below which they are hard to tell apart."""
TAKEN_FOR_GRANTED = (
    "No shapes were measured. The measured modes are assumed to be the lowest modes that the sensors see, in "
    "this order."
)
COUNTERPARTS_GIVEN = "No shapes were measured. The counterparts define the pairing before updating."


@dataclass(frozen=True)
class ComputedMode:
    """A mode of the model.

    Attributes
    ----------
    number : int or None
        In the sorted spectrum, from 1; None where a model gives paired frequencies alone.
    frequency_hz : float
    measured : int or None
        The measured mode (from 0) that it answers to.
    seen : bool
        Whether a sensor moves in it.
    moves : str
        The directions that hold most of its kinetic energy: ``"z 98 %"``; empty where they are not known.
    """

    number: int | None
    frequency_hz: float
    measured: int | None
    seen: bool = True
    moves: str = ""


def unlike(labels: tuple[str, ...], paired: list[int], alike: FloatArray | None) -> list[str]:
    """Name measured shapes that no mode has, or that two have: by MAC (n_modes, n_computed) at the sensors."""
    doubts = []
    for k, column in enumerate(paired if alike is not None else []):
        row = alike[k]  # type: ignore[index]  # there is one, or there is no column
        others = np.delete(np.arange(len(row)), column)
        if row[column] < ALIKE:
            doubts.append(
                f"Mode {labels[k]}: MAC {apart(row[column], ALIKE, sd=0.1)[0]} with computed mode {column + 1}, "
                f"below {ALIKE}."
            )
        rival = others[np.argmax(row[others])] if len(others) else column
        if rival != column and row[rival] > row[column] - RIVAL:
            doubts.append(
                f"Mode {labels[k]}: the sensors can hardly distinguish computed mode {column + 1} (MAC "
                f"{fixed(row[column], 2)}) from {rival + 1} (MAC {fixed(row[rival], 2)})."
            )
    return doubts


def close(
    labels: tuple[str, ...], paired: list[int], frequencies: FloatArray, seen: BoolArray, by_number: bool
) -> list[str]:
    """Name computed modes that are hardly apart: any two if pairing is by number, else those that sensors see."""
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


def disordered(labels: tuple[str, ...], paired: list[int], measured: FloatArray) -> list[str]:
    """Say if the modes are paired in another order than that of the measured frequencies."""
    order = np.argsort(measured, kind="stable")
    numbers = [paired[k] for k in order]
    if numbers == sorted(numbers):
        return []
    return [
        "Measured and computed modes are in different orders: "
        + ", ".join(f"{labels[k]} is computed mode {paired[k] + 1}" for k in order)
        + "."
    ]


def unmeasured(found: Sequence[ComputedMode]) -> list[str]:
    """Name the modes between the measured ones: those that move no sensor, and those that might have been seen."""
    last = max(i for i, mode in enumerate(found) if mode.measured is not None)
    notes = []
    for seen, one, many in (
        (False, "moves no sensor", "move no sensor"),
        (True, "moves a sensor, but was not measured", "move a sensor, but were not measured"),
    ):
        numbers = [mode.number for mode in found[:last] if mode.measured is None and mode.seen == seen]
        if numbers:
            subject, words = ("mode", one) if len(numbers) == 1 else ("modes", many)
            notes.append(f"Computed {subject} {ranges([n for n in numbers if n is not None])} {words}.")
    return notes


def ranges(numbers: Sequence[int]) -> str:
    """Return ascending numbers, runs of three and more as ranges: ``"1, 2, 5–9"``."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and runs[-1][-1] == number - 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    words = [f"{run[0]}–{run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs]
    return ", ".join(words)
