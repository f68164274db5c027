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
    labels : tuple of str
        Names of the modes, ``"1"``, ``"2"``, … by default.

    Raises
    ------
    ValueError
        If a frequency is not positive and finite, or the lengths differ.
    """

    frequencies_hz: ArrayLike
    numbers: tuple[int, ...] = ()
    sensors: tuple[tuple[Any, str], ...] = ()
    labels: tuple[str, ...] = ()

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

    @property
    def n_modes(self) -> int:
        """Number of measured modes."""
        return len(np.asarray(self.frequencies_hz))

    def as_dict(self) -> dict[str, Any]:
        """Return the data in plain Python types."""
        return {
            "frequencies_hz": np.asarray(self.frequencies_hz).tolist(),
            "numbers": [int(number) for number in self.numbers],
            "sensors": [[_plain(part) for part in sensor] for sensor in self.sensors],
            "labels": list(self.labels),
        }


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
