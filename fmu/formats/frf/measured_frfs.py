"""Frequency response functions (FRFs) that a reader has found in a file, and the interface of a format."""

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
"""Largest number of values, FRFs × lines, of a file: 256 MiB of complex numbers."""
Points = Sequence[tuple[Any, str]]
"""Place and direction of the drive, or of the response, of each FRF."""
_NUMBER = re.compile(r"-?\d{1,18}")


class Wanted(NamedTuple):
    """The user's specifications for a file.

    Attributes
    ----------
    drives, responses : sequence of (place, direction), optional
        Points of the FRFs in the order of the file.
    nodes : mapping of node number to place, optional
        Place in the model of each node of the file; FRFs at other nodes are skipped.
    variables : mapping of str to str
        Names of the variables in the file, by the names of the attributes of `fmu.FRFData`.
    frfs : sequence of int, optional
        Numbers of the FRFs in the file, counted from 1.
    """

    drives: Points | None = None
    responses: Points | None = None
    nodes: Mapping[int, Place] | None = None
    variables: Mapping[str, str] = {}
    frfs: Sequence[int] | None = None


@dataclass(frozen=True, eq=False)
class MeasuredFRFs:
    """FRFs in SI units: arguments of `fmu.FRFData`.

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
        Sentences on the assumptions made.
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
        """Return the FRFs with the given numbers, from 1; all if `frfs` is None. `name` is the file's name."""
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
    """A file format for FRFs.

    Attributes
    ----------
    suffixes : tuple of str
        Suffixes of the file names, in lower case.
    read : callable
        ``read(path, wanted)`` returns `MeasuredFRFs`.
    takes : tuple of str
        Which of ``nodes`` and ``variables`` the format can use.
    """

    suffixes: tuple[str, ...]
    read: Callable[[Path, Wanted], MeasuredFRFs]
    takes: tuple[str, ...] = ()


def rows_of(name: str, frfs: Sequence[int], n: int) -> list[int]:
    """Return the rows (from 0) of the FRFs with the given numbers.

    Raises ModesError unless they are from 1 to `n`.
    """
    wrong = [number for number in frfs if not 1 <= number <= n]
    if wrong or len(frfs) == 0:
        raise ModesError(name, [f"frfs: must be numbers from 1 to {n} (got {wrong[0] if wrong else 'none'})"])
    return [int(number) - 1 for number in frfs]


def point_of(text: str) -> Dof:
    """Return the place and direction of a point that a file gives as text, such as ``"tip -z"`` or ``"12 x"``."""
    place, _, direction = text.strip().rpartition(" ")
    place = place.strip()
    return (int(place) if _NUMBER.fullmatch(place) else place, direction)


def points_in_order(
    name: str, key: str, found: Sequence[Dof] | None, given: Points | None, n: int
) -> tuple[Dof, ...]:
    """Return the given points, or else those found in the file. Raise ModesError if there are not `n` of them."""
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
