"""Measured modes, the interface for readers of mode files, and the conversion of complex shapes to real shapes."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Ge, Interval
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError, MissingFileError
from fmu.formats.files import too_large, why_no_file
from fmu.formats.shown import list_mistakes, names_shown, quote
from fmu.numbers import apart, given
from fmu.types import DIRECTIONS, ComplexArray, Dof, FloatArray

LARGEST_FILE = 2**26
"""Largest size of a file with modes, bytes; a larger file is rejected before it is read."""
MOST_MODES = 1000
"""Largest number of modes in a file, far more than a test identifies."""
LEAST_MPC = 0.8
"""Default for the smallest modal phase collinearity at which a complex shape is accepted."""


Place = int | str
"""Location of a sensor: a node id or a name."""
Sensors = Sequence[Dof]
"""Place and direction of each sensor; a minus sign before the direction reverses the sensor's sign."""
ModeNumber = Annotated[int, Ge(1)]
Collinearity = Annotated[float, Interval(ge=0.0, le=1.0)]


def is_node(place: Hashable) -> bool:
    """Return True if a place is a node id rather than a name."""
    return isinstance(place, int | np.integer)


class ModesError(ValueError):
    """Raised when modes or frequency response functions cannot be read from a file or result.

    Attributes
    ----------
    mistakes : tuple of str
        All errors found, with their positions in the file where these are known.
    """

    def __init__(self, source: str, mistakes: Sequence[str]) -> None:
        self.mistakes = tuple(mistakes)
        super().__init__(f"{source}: " + "; ".join(list_mistakes(self.mistakes)))


@dataclass(frozen=True, eq=False)
class MeasuredModes:
    """Measured frequencies and, if known, shapes and standard deviations, in the form accepted by `fmu.ModalData`.

    Attributes
    ----------
    frequencies_hz : ndarray, shape (n_modes,)
    labels : tuple of str
        Mode names in the file.
    sd_hz : ndarray, shape (n_modes,), optional
    sensors : tuple of (place, direction)
    shapes : ndarray, shape (n_sensors, n_modes), optional
        Real; see `real_shapes`.
    numbers : tuple of int
        Mode numbers in the spectrum of the model, if given.
    use : tuple of bool
        Whether each mode is used in updating, if given.
    mpc : ndarray, shape (n_modes,), optional
        Modal phase collinearity of shapes that were complex.
    shapes_sd : ndarray, shape (n_sensors, n_modes), optional
        Standard deviations for shapes scaled to unit length at the sensors.
    """

    frequencies_hz: FloatArray
    labels: tuple[str, ...]
    sd_hz: FloatArray | None = None
    sensors: tuple[Dof, ...] = ()
    shapes: FloatArray | None = None
    numbers: tuple[int, ...] = ()
    use: tuple[bool, ...] = ()
    mpc: FloatArray | None = None
    shapes_sd: FloatArray | None = None


Computed = tuple[FloatArray, FloatArray | None]
"""Frequencies (n,) in Hz, including modes at 0 Hz, and shapes (n_sensors, n). The shapes are None if there are no
sensors."""


@dataclass(frozen=True)
class ModesFormat:
    """Reader for one mode file format.

    Attributes
    ----------
    read : callable
        Returns `MeasuredModes`; its arguments are the keys of the format's table in ``[measurement]``.
    result : str
        Name of the file that a program writes, such as ``{job}.f06``, with ``{job}`` for the name of its deck.
    computed : callable
        ``computed(path, sensors, deck)`` returns all modes that a program wrote (see `Computed`); `deck` is the
        program's input file.
    directions : tuple of str
        Sensor directions that the file format can contain.
    has_numbers : bool
        Whether sensor places must be node ids.
    """

    read: Callable[..., MeasuredModes]
    result: str
    computed: Callable[[Path, Sensors, Path], Computed]
    directions: tuple[str, ...] = DIRECTIONS
    has_numbers: bool = True


def modes_chosen(
    name: str, computed: Computed, sensors: Sensors, modes: Sequence[int] | None, numbers: Sequence[int]
) -> MeasuredModes:
    """Return the computed modes whose numbers are in `modes`, in that order; all modes if `modes` is None.

    `numbers` contains the number of each computed mode.

    Raises
    ------
    ModesError
        If no mode is chosen, a number in `modes` is not in `numbers`, or a chosen mode has no frequency above
        0 Hz.
    """
    frequencies, shapes = computed
    chosen = list(numbers) if modes is None else [int(number) for number in modes]
    if not chosen or not set(chosen) <= set(numbers):
        raise ModesError(name, [f"modes: must be some of {names_shown(list(numbers))} (got {quote(chosen)})"])
    at = [numbers.index(number) for number in chosen]
    for k, number in zip(at, chosen, strict=True):
        if not 0.0 < frequencies[k] < np.inf:
            raise ModesError(name, [f"modes: must have frequencies above 0 Hz (mode {number} has none)"])
    places = tuple((place, str(direction)) for place, direction in sensors)
    labels = tuple(map(str, chosen))
    return MeasuredModes(frequencies[at], labels, None, places, None if shapes is None else shapes[:, at])


def check_sensors(name: str, sensors: Sequence[Dof], there: Sequence[Dof]) -> None:
    """Raise ModesError if a sensor is not among the places and directions with values in a file (`there`).

    A minus sign before a sensor's direction is ignored.
    """
    directions: dict[Hashable, dict[str, None]] = {}
    for place, direction in there:
        directions.setdefault(place, {})[direction] = None
    for place, direction in sensors:
        if place not in directions:
            places = names_shown(list(directions))
            raise ModesError(name, [f"sensors: must be at places in the file, {places} (got {quote(place)})"])
        if direction.removeprefix("-") not in directions[place]:
            along = ", ".join(directions[place])
            raise ModesError(name, [f"sensors: must be along {along} at {quote(place)} (got {quote(direction)})"])


def phase_collinearity(shapes: ArrayLike) -> FloatArray:
    """Return the modal phase collinearity |φᵀφ|²/(φᴴφ)² of complex shapes (n_sensors, n_modes), shape (n_modes,).

    The value is 1 if all components are in phase or in opposite phase, 0 if they are evenly distributed over all
    phases, and NaN for a zero shape (Pappa, Elliott & Schenk 1993, Journal of Guidance, Control, and Dynamics 16,
    275, who define it by an eigenvalue ratio).
    """
    phi = np.asarray(shapes, dtype=complex)
    length = np.sum(np.abs(phi) ** 2, axis=0)
    return np.asarray(np.abs(np.sum(phi**2, axis=0)) ** 2 / length**2)


def real_shapes(shapes: ArrayLike, least_mpc: float = LEAST_MPC) -> tuple[FloatArray, FloatArray]:
    """Convert complex mode shapes to real ones, rotating each so that its real part is largest.

    Parameters
    ----------
    shapes : array_like of complex, shape (n_sensors, n_modes)
    least_mpc : float
        Smallest phase collinearity that is accepted. An undamped model has only real shapes. A lower value
        suggests that a measured shape mixes two close modes, or is affected by local damping or noise. 0 accepts
        all shapes.

    Returns
    -------
    real : ndarray, shape (n_sensors, n_modes)
        Re(φ e^{−iα/2}) with α the phase of φᵀφ, for which the discarded imaginary part is smallest.
    mpc : ndarray, shape (n_modes,)
        Modal phase collinearity.

    Raises
    ------
    ValueError
        If a shape is zero or not finite, or its phase collinearity is too low.
    """
    phi = np.asarray(shapes, dtype=complex)
    require_shapes(phi, range(1, phi.shape[1] + 1))
    mpc = phase_collinearity(phi)
    if not np.all(mpc >= least_mpc):
        at = int(np.argmin(mpc))
        raise ArgumentError(
            "shapes",
            f"mode {at + 1} must have a phase collinearity (MPC) of at least {given(least_mpc)} "
            "to be taken for a real one",
            apart(mpc[at], least_mpc, sd=0.1)[0],
            "; least_mpc=0 takes it anyway",
        )
    return np.asarray((phi * np.exp(-0.5j * np.angle(np.sum(phi**2, axis=0)))).real), mpc


def require_shapes(shapes: FloatArray | ComplexArray, labels: Sequence[Hashable]) -> None:
    """Raise ArgumentError if a mode shape (n_sensors, n_modes) is not finite, or zero at every sensor."""
    unknown = np.argwhere(~np.isfinite(shapes))
    if len(unknown):
        sensor, mode = unknown[0]
        got = f"{shapes[sensor, mode]} at sensor {sensor + 1} of mode {labels[mode]}"
        raise ArgumentError("shapes", "must be finite: leave out the sensor or the mode", got)
    still = np.flatnonzero(~np.any(shapes != 0, axis=0))
    if len(still):
        rule = "must not be zero at every sensor: choose sensors that the mode moves, or leave the mode out"
        raise ArgumentError("shapes", rule, f"zeros for mode {labels[still[0]]}")


def checked_file(path: Path, most: int | None = None) -> Path:
    """Return a path after checking that it is a readable file with at most `most` bytes.

    `most` defaults to `LARGEST_FILE`.

    Raises
    ------
    FileNotFoundError
        If there is no such file, or it is a directory or not readable.
    ModesError
        If the file is larger.
    """
    why = why_no_file(path)
    if why:
        raise MissingFileError("path", f"must be a file ({why})")
    large = too_large(path, most or LARGEST_FILE)
    if large:
        raise ModesError(path.name, [large])
    return path
