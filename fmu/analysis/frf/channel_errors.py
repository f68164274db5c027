"""Errors of a measurement channel that would explain why a frequency response function contradicts the model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fmu.numbers import significant
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr

_EXPLAINS = 0.25
"""Largest share of the squared errors that an explanation may leave."""
_SIMPLER = 1.1
"""Ratio of the squared errors up to which reversed polarity is preferred to a gain near minus one."""
_STEPS, _ROUNDS = 201, 4
"""Numbers of delays that are tried at once, and of searches in ever smaller intervals."""


def explain_by_channel(one: xr.Dataset) -> str:
    """Return the error of the channel that explains most of the misfit of one FRF; empty if none does.

    Tried are another gain, reversed polarity, and a delay, each at the median of the model's FRFs.

    Parameters
    ----------
    one : xarray.Dataset
        The variables of one FRF in the group ``frfs`` of a trace.
    """
    used = one["used"].to_numpy().astype(bool)
    amplitude, phase = (
        one[name].sel(kind="model", quantile=0.5).to_numpy()[used] for name in ("amplitude", "phase")
    )
    H, parts = amplitude * np.exp(1j * np.radians(phase)), one["measured"].to_numpy()[used]
    d, omega = parts[:, 0] + 1j * parts[:, 1], 2.0 * np.pi * one["line"].to_numpy()[used]
    distance = np.maximum(one["distance"].to_numpy()[used], np.finfo(float).tiny)
    weight = (distance / np.maximum(np.abs(d - H), np.finfo(float).tiny)) ** 2  # 1/V

    def left(factor: FloatArray) -> FloatArray:
        """Return the squared errors with the FRF times a factor of shape (n, 1) or (n, n_lines)."""
        return np.asarray(np.sum(weight * np.abs(d - factor * H) ** 2, axis=-1))

    gain = float(np.sum(weight * np.real(np.conj(H) * d)) / np.sum(weight * np.abs(H) ** 2))
    centre, width = 0.0, np.pi / float(np.max(omega)) * 4.0
    for _ in range(_ROUNDS):
        delays = centre + np.linspace(-width, width, _STEPS)
        centre = float(delays[np.argmin(left(np.exp(-1j * omega * delays[:, None])))])
        width *= 4.0 / _STEPS
    sign = "reversed polarity and " * (gain < 0.0)
    by_delay = np.exp(-1j * omega * centre)[None]
    found = [
        (left(np.array([[-1.0]])), "reversed polarity would explain it: correct the sign of the channel"),
        (
            left(np.array([[gain]])),
            f"{sign}a gain of {significant(abs(gain))} would explain it: infer it by gain_sd",
        ),
        (left(by_delay), f"a delay of {significant(1e3 * centre)} ms would explain it: infer it by delay_sd"),
    ]
    (rest, said), base = min(found, key=lambda pair: float(pair[0][0])), float(left(np.ones((1, 1)))[0])
    if float(found[0][0][0]) < _SIMPLER * float(rest[0]):
        rest, said = found[0]
    return said if float(rest[0]) < _EXPLAINS * base else ""
