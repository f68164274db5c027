"""Errors of measurement channels: gain errors (integrated out or inferred), and delays (inferred)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmu.posterior.data.frf_data import FRFData
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.types import ComplexArray, FloatArray, IntArray

_WIDTHS = 8.0
"""Bounds of a channel error, in prior standard deviations."""
_LEAST_GAIN = 0.05
"""Smallest channel gain 1 + γ."""


@dataclass(frozen=True, eq=False)
class Channels:
    """A test's response channels and their errors.

    Indices in theta refer to the parameters of the test's `FRFTerm`.

    Attributes
    ----------
    names : tuple of (place, direction)
    of_frf : ndarray of int, shape (n_frfs,)
        Index of each FRF's channel.
    gain_sd : ndarray, shape (n_channels,)
        Standard deviation of each gain error that is integrated out; 0 for all other channels.
    gain, delay : ndarray of int, shape (n_channels,)
        Index in theta of each inferred gain error and delay; −1 if it is not inferred.
    parameters : list of Parameter
        The inferred gain errors and delays, in theta order.
    """

    names: tuple[Any, ...]
    of_frf: IntArray
    gain_sd: FloatArray
    gain: IntArray
    delay: IntArray
    parameters: list[Parameter]

    @classmethod
    def of(
        cls,
        data: FRFData,
        gains: Mapping[Any, float],
        delays: Mapping[Any, float],
        first: int,
        integrates: bool,
        of_test: str = "",
    ) -> Channels:
        """Return the response channels that occur in the FRFs.

        Parameters
        ----------
        data : FRFData
        gains, delays : mapping of (place, direction) to float
            Standard deviations of a gain's relative error, and of a delay in s.
        first : int
            Index in theta of the first channel parameter.
        integrates : bool
            Whether gain errors are integrated out, which requires Gaussian errors.
        of_test : str
            Prefix of the channel names in parameter names.
        """
        names = tuple(dict.fromkeys(data.responses))
        parameters: list[Parameter] = []
        gain, delay = np.full(len(names), -1), np.full(len(names), -1)
        for j, name in enumerate(names):
            label = f"{of_test}{name[0]} {name[1]}"
            if name in gains and not integrates:
                gain[j] = first + len(parameters)
                sd = gains[name]
                lower = max(-_WIDTHS * sd, _LEAST_GAIN - 1.0)
                prior = Normal(mean=0.0, sd=sd)
                parameters.append(Parameter(f"gain error of {label}", 0.0, lower, _WIDTHS * sd, prior))
            if name in delays:
                delay[j] = first + len(parameters)
                limit, sd = _WIDTHS * delays[name], delays[name]
                parameters.append(Parameter(f"delay of {label}", 0.0, -limit, limit, Normal(mean=0.0, sd=sd), "s"))
        integrated = np.array([gains.get(name, 0.0) if integrates else 0.0 for name in names])
        of_frf = np.array([names.index(one) for one in data.responses])
        return cls(names, of_frf, integrated, gain, delay, parameters)

    def factors(self, theta: FloatArray, omega: FloatArray) -> ComplexArray:
        """Return the inferred channel factors (1 + γ) exp(−iωτ), shape (n, n_frfs, n_lines).

        The shape is (1, 1, 1) if no channel error is inferred.
        """
        if np.all(self.gain < 0) and np.all(self.delay < 0):
            return np.ones((1, 1, 1), dtype=complex)
        found = np.ones((len(theta), len(self.names), len(omega)), dtype=complex)
        for j in np.flatnonzero(self.gain >= 0):
            found[:, j] *= 1.0 + theta[:, self.gain[j], None]
        for j in np.flatnonzero(self.delay >= 0):
            found[:, j] *= np.exp(-1j * theta[:, self.delay[j], None] * omega)
        return found[:, self.of_frf]

    def multiply(self, of_lines: ComplexArray, theta: FloatArray, omega: FloatArray) -> ComplexArray:
        """Return values (n, n_frfs, n_lines) times `factors`."""
        return of_lines * self.factors(theta, omega) if self.parameters else of_lines

    def add_slopes(self, slope: FloatArray, theta: FloatArray, products: ComplexArray, omega: FloatArray) -> None:
        """Add derivatives for inferred gain errors and delays to `slope`; `products` = `Misfit.weights` × H."""
        for j in range(len(self.names)):
            own = products[:, self.of_frf == j]
            if self.gain[j] >= 0:
                total = np.sum(np.sum(own.real, axis=2), axis=1)
                slope[:, self.gain[j]] += total / (1.0 + theta[:, self.gain[j]])
            if self.delay[j] >= 0:
                slope[:, self.delay[j]] += np.sum(np.sum(own.imag * omega, axis=2), axis=1)

    def set_columns(self, dH: ComplexArray, theta: FloatArray, H: ComplexArray, omega: FloatArray) -> None:
        """Set the derivatives dH (n_frfs, n_lines, ndim) of H (n_frfs, n_lines) by gain errors and delays."""
        for f, j in enumerate(self.of_frf):
            if self.gain[j] >= 0:
                dH[f, :, self.gain[j]] = H[f] / (1.0 + theta[self.gain[j]])
            if self.delay[j] >= 0:
                dH[f, :, self.delay[j]] = -1j * omega * H[f]
