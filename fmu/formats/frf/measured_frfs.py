"""Frequency response functions (FRFs) read from a file, and the interface that each file format implements."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmu.formats.modes.measured_modes import ModesError, Place
from fmu.types import AnyArray, Dof, FloatArray

MOST_VALUES = 2**24
"""Largest number of values (FRFs × lines) in a file: 256 MiB of complex numbers."""
Points = Sequence[tuple[Any, str]]
"""Place and direction of each FRF's drive or response."""
_NUMBER = re.compile(r"-?\d{1,18}")


class Wanted(NamedTuple):
    """User settings that say which FRFs to read from a file, and at which points they were measured.

    Attributes
    ----------
    drives, responses : sequence of (place, direction), optional
        Drive and response point of each FRF in the file, including those that are not read.
    nodes : mapping of node number to place, optional
        Model location of each node in the file; FRFs at other nodes are skipped.
    variables : mapping of str to str
        Variable names in the file, by `fmu.FRFData` attribute.
    frfs : sequence of int, optional
        Numbers of the FRFs to read, counted from 1 in file order; all by default.
    """

    drives: Points | None = None
    responses: Points | None = None
    nodes: Mapping[int, Place] | None = None
    variables: Mapping[str, str] = {}
    frfs: Sequence[int] | None = None


@dataclass(frozen=True, eq=False)
class MeasuredFRFs:
    """Measured FRFs, in SI units if the file states its units. The attributes are arguments of `fmu.FRFData`.

    Attributes
    ----------
    frequencies_hz : ndarray, shape (n_lines,)
    values : ndarray of complex, shape (n_frfs, n_lines)
        NaN where the file has no value.
    drives, responses : tuple of (place, direction)
    kind : str, optional
        As in `fmu.FRFData`, if the file specifies it.
    sd, coherence : ndarray, shape (n_frfs, n_lines), optional
    averages : float, optional
    notes : tuple of str
        Sentences that state the assumptions made.
    """

    frequencies_hz: FloatArray
    values: NDArray[np.complex128]
    drives: tuple[Dof, ...]
    responses: tuple[Dof, ...]
    kind: str | None = None
    sd: FloatArray | None = None
    coherence: FloatArray | None = None
    averages: float | None = None
    notes: tuple[str, ...] = ()

    def only(self, name: str, frfs: Sequence[int] | None) -> MeasuredFRFs:
        """Return the FRFs whose numbers (from 1) are in `frfs`, in that order, or all FRFs if `frfs` is None.

        Raise ModesError if `frfs` is empty, or contains a number that no FRF has. `name` is the file name for the
        message.
        """
        if frfs is None:
            return self
        rows = rows_of(name, frfs, len(self.values))

        def of(array: FloatArray | None) -> FloatArray | None:
            return None if array is None else array[rows]

        return replace(
            self,
            values=self.values[rows],
            drives=tuple(self.drives[i] for i in rows),
            responses=tuple(self.responses[i] for i in rows),
            sd=of(self.sd),
            coherence=of(self.coherence),
        )


@dataclass(frozen=True)
class FRFFormat:
    """Reader for one FRF file format.

    Attributes
    ----------
    suffixes : tuple of str
        File name suffixes, in lower case.
    read : callable
        ``read(path, wanted)`` returns `MeasuredFRFs`.
    takes : tuple of str
        Which of the fields ``nodes`` and ``variables`` of `Wanted` the format supports.
    """

    suffixes: tuple[str, ...]
    read: Callable[[Path, Wanted], MeasuredFRFs]
    takes: tuple[str, ...] = ()


def rows_of(name: str, frfs: Sequence[int], n: int) -> list[int]:
    """Convert FRF numbers, counted from 1, to row indices.

    Raise ModesError if there are no numbers, or one is not between 1 and `n`.
    """
    wrong = [number for number in frfs if not 1 <= number <= n]
    if wrong or len(frfs) == 0:
        raise ModesError(name, [f"frfs: must be numbers from 1 to {n} (got {wrong[0] if wrong else 'none'})"])
    return [int(number) - 1 for number in frfs]


def rows_of_all(rows: Sequence[FloatArray | None], name: str, notes: list[str]) -> FloatArray | None:
    """Return a quantity such as the coherence of all FRFs, shape (n_frfs, n_lines), or None if one FRF lacks it.

    A note is appended to `notes` if only some FRFs have it, because it is then dropped.
    """
    there = [row for row in rows if row is not None]
    if len(there) == len(rows):
        return np.array(there)
    if there:
        notes.append(f"The {name} is not used, as only {len(there)} of {len(rows)} FRFs have it.")
    return None


def point_of(text: str) -> Dof:
    """Parse a point such as ``"tip -z"`` or ``"12 x"`` into its place (an int if it is a number) and direction."""
    place, _, direction = text.strip().rpartition(" ")
    place = place.strip()
    return (int(place) if _NUMBER.fullmatch(place) else place, direction)


def points_in_order(
    name: str, key: str, found: Sequence[Dof] | None, given: Points | None, n: int
) -> tuple[Dof, ...]:
    """Return the `given` points or, if none are given, the points `found` in the file.

    Raise ModesError if there are no points at all, or not `n` of them.
    """
    points = found if given is None else given
    if points is None:
        raise ModesError(name, [f"{key}: must be given, the place and the direction of each of the {n} FRFs"])
    if len(points) != n:
        raise ModesError(name, [f"{key}: must be {n}, one per FRF of the file (got {len(points)})"])
    return tuple((place, str(direction)) for place, direction in points)


def check_size(name: str, values: AnyArray) -> None:
    """Raise ModesError if there are more than `MOST_VALUES` values."""
    if values.size > MOST_VALUES:
        raise ModesError(name, [f"must have at most {MOST_VALUES} values, FRFs x lines (got {values.size})"])
