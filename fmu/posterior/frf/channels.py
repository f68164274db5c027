"""Errors of channels: gains of responses (integrated out or inferred), gains of forces and delays (inferred)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmu.posterior.data.frf_data import FRFData
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.types import BoolArray, ComplexArray, FloatArray, IntArray

_WIDTHS = 8.0
"""Bounds of a channel error, in prior standard deviations."""
_LEAST_GAIN = 0.05
"""Smallest channel gain 1 + γ."""


@dataclass(frozen=True, eq=False)
class Channels:
    """A test's response channels and their errors, and the gain errors of its forces.

    Indices in theta refer to the parameters of the test's `FRFTerm`.

    Attributes
    ----------
    names : tuple of (place, direction)
        Response channels.
    of_frf : ndarray of int, shape (n_frfs,)
        Index of each FRF's response channel.
    gain_sd : ndarray, shape (n_channels,)
        Standard deviation of each gain error that is integrated out; 0 for all other channels.
    gains, delays : list of (int, ndarray of bool)
        Index in theta of each inferred gain error of a response or force, or delay, and a mask (n_frfs,) of the
        FRFs with this error.
    parameters : list of Parameter
        The inferred gain errors and delays, in theta order.
    """

    names: tuple[Any, ...]
    of_frf: IntArray
    gain_sd: FloatArray
    gains: list[tuple[int, BoolArray]]
    delays: list[tuple[int, BoolArray]]
    parameters: list[Parameter]

    @classmethod
    def of(
        cls,
        data: FRFData,
        errors: Mapping[str, Mapping[Any, float]],
        first: int,
        integrates: bool,
        of_test: str = "",
    ) -> Channels:
        """Return the response channels of the FRFs, and the inferred errors of channels and forces.

        Parameters
        ----------
        data : FRFData
        errors : mapping of str to mapping of (place, direction) to float
            Standard deviations: ``gain_sd`` and ``force_gain_sd`` of the relative errors of the gains of responses
            and forces, ``delay_sd`` of the delays of responses, s.
        first : int
            Index in theta of the first channel parameter.
        integrates : bool
            Whether gain errors of responses are integrated out, which requires Gaussian errors.
        of_test : str
            Prefix of the channel names in parameter names.
        """
        gains, forces, delays = (errors.get(key, {}) for key in ("gain_sd", "force_gain_sd", "delay_sd"))
        names = tuple(dict.fromkeys(data.responses))
        of_frf = np.array([names.index(one) for one in data.responses])
        parameters: list[Parameter] = []
        inferred: tuple[list[tuple[int, BoolArray]], list[tuple[int, BoolArray]]] = ([], [])
        for j, name in enumerate(names):
            label, own = f"{of_test}{name[0]} {name[1]}", of_frf == j
            if name in gains and not integrates:
                inferred[0].append((first + len(parameters), own))
                parameters.append(_gain_error(label, gains[name]))
            if name in delays:
                inferred[1].append((first + len(parameters), own))
                limit, sd = _WIDTHS * delays[name], delays[name]
                parameters.append(Parameter(f"delay of {label}", 0.0, -limit, limit, Normal(mean=0.0, sd=sd), "s"))
        for name, sd in forces.items():
            inferred[0].append((first + len(parameters), np.array([drive == name for drive in data.drives])))
            parameters.append(_gain_error(f"{of_test}force {name[0]} {name[1]}", sd))
        integrated = np.array([gains.get(name, 0.0) if integrates else 0.0 for name in names])
        return cls(names, of_frf, integrated, *inferred, parameters)

    def factors(self, theta: FloatArray, omega: FloatArray) -> ComplexArray:
        """Return the inferred channel factors Π (1 + γ) exp(−iωτ), shape (n, n_frfs, n_lines).

        The shape is (1, 1, 1) if no channel error is inferred.
        """
        if not self.parameters:
            return np.ones((1, 1, 1), dtype=complex)
        found = np.ones((len(theta), len(self.of_frf), len(omega)), dtype=complex)
        for column, own in self.gains:
            found[:, own] *= 1.0 + theta[:, column, None, None]
        for column, own in self.delays:
            found[:, own] *= np.exp(-1j * theta[:, column, None] * omega)[:, None]
        return found

    def multiply(self, of_lines: ComplexArray, theta: FloatArray, omega: FloatArray) -> ComplexArray:
        """Return values (n, n_frfs, n_lines) times `factors`."""
        return of_lines * self.factors(theta, omega) if self.parameters else of_lines

    def add_slopes(self, slope: FloatArray, theta: FloatArray, products: ComplexArray, omega: FloatArray) -> None:
        """Add derivatives for inferred gain errors and delays to `slope`; `products` = `Misfit.weights` × H."""
        for column, own in self.gains:
            total = np.sum(np.sum(products[:, own].real, axis=2), axis=1)
            slope[:, column] += total / (1.0 + theta[:, column])
        for column, own in self.delays:
            slope[:, column] += np.sum(np.sum(products[:, own].imag * omega, axis=2), axis=1)

    def set_columns(self, dH: ComplexArray, theta: FloatArray, H: ComplexArray, omega: FloatArray) -> None:
        """Set the derivatives dH (n_frfs, n_lines, ndim) of H (n_frfs, n_lines) by gain errors and delays."""
        for column, own in self.gains:
            dH[own, :, column] = H[own] / (1.0 + theta[column])
        for column, own in self.delays:
            dH[own, :, column] = -1j * omega * H[own]


def _gain_error(of: str, sd: float) -> Parameter:
    """Return the relative gain error, with the standard deviation `sd`, of the channel `of` as a parameter."""
    lower = max(-_WIDTHS * sd, _LEAST_GAIN - 1.0)
    return Parameter(f"gain error of {of}", 0.0, lower, _WIDTHS * sd, Normal(mean=0.0, sd=sd))
