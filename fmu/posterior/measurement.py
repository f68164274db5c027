"""Measured modes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ModalData:
    """What a modal test gave.

    Attributes
    ----------
    frequencies_hz : ndarray, shape (n_modes,)
        Natural frequencies.
    numbers : tuple of int
        The number (from 1) of each measured mode in the sorted spectrum of the model, for pairing by number;
        1, 2, … by default.
    sensors : tuple of (node, direction)
        Where the motion was measured and in which direction: a mode that moves no sensor was not measured.
    shapes : ndarray, shape (n_sensors, n_modes), optional
        Measured mode shapes at the sensors, in any scale.
    labels : tuple of str
        Names of the modes, ``"1"``, ``"2"``, … by default.

    Raises
    ------
    ValueError
        If a frequency is not positive and finite, a shape is not finite or zero, or the lengths differ.
    """

    frequencies_hz: ArrayLike
    numbers: tuple[int, ...] = ()
    sensors: tuple[tuple[Any, str], ...] = ()
    labels: tuple[str, ...] = ()
    shapes: ArrayLike | None = None

    def __post_init__(self) -> None:
        frequencies = np.array(self.frequencies_hz, dtype=float)
        if frequencies.ndim != 1 or len(frequencies) == 0:
            raise ValueError(f"frequencies_hz: must be a list of numbers (got shape {frequencies.shape})")
        wrong = ~(np.isfinite(frequencies) & (frequencies > 0))
        if np.any(wrong):
            at = int(np.argmax(wrong))
            raise ValueError(f"frequencies_hz.{at}: must be positive and finite (got {frequencies[at]} Hz)")
        frequencies.flags.writeable = False
        object.__setattr__(self, "frequencies_hz", frequencies)
        n = len(frequencies)
        object.__setattr__(self, "numbers", tuple(self.numbers) or tuple(range(1, n + 1)))
        object.__setattr__(self, "labels", tuple(self.labels) or tuple(str(i + 1) for i in range(n)))
        for name in ("numbers", "labels"):
            if len(getattr(self, name)) != n:
                raise ValueError(f"{name}: must be {n}, one a mode (got {len(getattr(self, name))})")

        if len(set(self.labels)) < n:
            raise ValueError(f"labels: must be distinct (got {self.labels})")
        if self.shapes is not None:
            shapes = np.array(self.shapes, dtype=float)
            if shapes.shape != (len(self.sensors), n):
                raise ValueError(
                    f"shapes: must have shape {(len(self.sensors), n)}, sensors x modes (got {shapes.shape})"
                )
            if not np.all(np.isfinite(shapes)) or not np.all(np.any(shapes != 0.0, axis=0)):
                raise ValueError("shapes: must be finite, and no mode zero at every sensor")
            shapes.flags.writeable = False
            object.__setattr__(self, "shapes", shapes)

    @property
    def n_modes(self) -> int:
        """Number of measured modes."""
        return len(np.asarray(self.frequencies_hz))

    def as_dict(self) -> dict[str, Any]:
        """Return the data in plain Python types."""
        shapes = {} if self.shapes is None else {"shapes": np.asarray(self.shapes).tolist()}
        return {
            "frequencies_hz": np.asarray(self.frequencies_hz).tolist(),
            "numbers": [int(number) for number in self.numbers],
            "sensors": [[_plain(part) for part in sensor] for sensor in self.sensors],
            "labels": list(self.labels),
            **shapes,
        }


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
