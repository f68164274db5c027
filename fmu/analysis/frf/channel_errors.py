"""Find the measurement channel error that would explain why an FRF contradicts the model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.numbers import significant

if TYPE_CHECKING:
    import xarray as xr

_EXPLAINS = 0.25
"""Largest fraction of the squared error that may remain after a channel error explains the misfit."""
_SIMPLER = 1.1
"""Ratio of squared errors up to which reversed polarity, the simplest error, is preferred to the best one."""
_STEPS, _ROUNDS = 201, 4
"""Number of delays that are tried at a time, and number of searches in ever smaller intervals."""


def explain_by_channel(one: xr.Dataset) -> str:
    """Return a clause on the channel error that explains most of an FRF's misfit, or an empty string if none does.

    The candidate errors are a wrong gain, reversed polarity and a delay, each applied to the median of the model's
    FRFs. An error must remove three quarters of the weighted squared error at the lines in use.

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
    # V is the variance of an error
    weight = (distance / np.maximum(np.abs(d - H), np.finfo(float).tiny)) ** 2  # 1/V; less in Student's tails

    def squares_with(factor: Any) -> Any:
        """Return the weighted squared error of the model's FRF after multiplication by `factor`.

        The factor is a number or an array (..., n_lines).
        """
        return np.sum(weight * np.abs(d - factor * H) ** 2, axis=-1)

    gain = float(np.sum(weight * np.real(np.conj(H) * d)) / np.sum(weight * np.abs(H) ** 2))
    centre, width = 0.0, np.pi / float(np.max(omega)) * 4.0
    for _ in range(_ROUNDS):
        delays = centre + np.linspace(-width, width, _STEPS)
        centre = float(delays[np.argmin(squares_with(np.exp(-1j * omega * delays[:, None])))])
        width *= 4.0 / _STEPS
    sign = "reversed polarity and " * (gain < 0.0)
    polarity = "reversed polarity would explain it: correct the sign of the channel"
    found = {
        polarity: squares_with(-1.0),
        f"{sign}a gain of {significant(abs(gain))} would explain it: infer it by gain_sd": squares_with(gain),
        f"a delay of {significant(1e3 * centre)} ms would explain it: infer it by delay_sd": squares_with(
            np.exp(-1j * omega * centre)
        ),
    }
    best = min(found, key=found.__getitem__)
    if found[polarity] < _SIMPLER * found[best]:
        best = polarity
    return best if found[best] < _EXPLAINS * squares_with(1.0) else ""
