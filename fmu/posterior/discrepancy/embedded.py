"""Scatter of the parameters over the modes: each mode sees parameters of its own.

A wrong model has no parameters that fit all modes. Let mode i see the parameters θ_k + s_k τ_k z_ik with
independent standard normal z_ik, where s_k is |θ_k| (relative scatter) or a constant (absolute). To first order
the frequencies then have, beside the errors of their measurement, independent Gaussian errors with the variances

v_i = Σ_k (∂f_i/∂θ_k)² s_k² τ_k².

The idea is the embedded model error of Sargsyan, Najm & Ghanem 2015, *Int. J. Chem. Kinet.* 47, 246–276.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fmu.arguments import ArgumentError, check_arguments
from fmu.posterior.errors.noise import NoiseIndex
from fmu.posterior.parameters import Parameter, require_name
from fmu.posterior.priors.one_sided import HalfNormal
from fmu.types import FloatArray, Plain, Positive

_MOST = 10.0  # upper bound of an inferred τ, in standard deviations of its prior


@check_arguments
@dataclass(frozen=True)
class Discrepancy:
    """Error of the model itself: its parameters scatter from mode to mode (`fmu.posterior.discrepancy.embedded`).

    The frequencies predicted by a wrong model then have errors that grow with their sensitivity to the parameters,
    and all predictive intervals include these errors.

    Attributes
    ----------
    kind : {"embedded"}
        Scatter of the parameters over the modes.
    tau : float, optional
        The scatter τ: relative for parameters that are never 0 between their bounds, else in units of the absolute
        value of the start, or of the prior's scale if the parameter starts at 0. It is inferred if not given.
    prior_sd : float
        Standard deviation of the half-normal prior of an inferred τ.
    by : {"common", "group"}
        Whether all parameters have the same τ, or each group has its own. A parameter without a group is a group
        of its own.
    groups : tuple of str
        Names of the groups, or of parameters, that scatter; all if empty.
    name : str
        Name of the inferred τ. With `by` = "group" the name of the group follows.

    Raises
    ------
    ValueError
        If `tau` or `prior_sd` is not positive and finite, or the name is not allowed.

    Notes
    -----
    The variances are exact to first order in τ: at τ = 0.3 and more they are rough. If the data do not outnumber
    the parameters, τ keeps its prior.
    """

    kind: Literal["embedded"] = "embedded"
    tau: Positive | None = None
    prior_sd: Positive = 0.1
    by: Literal["common", "group"] = "common"
    groups: tuple[str, ...] = ()
    name: str = "tau"

    def __post_init__(self) -> None:
        require_name(self.name)

    def bind(self, parameters: Sequence[Parameter], index: NoiseIndex) -> EmbeddedScatter:
        """Return the scatter bound to the parameters of a structure.

        Parameters
        ----------
        parameters : sequence of Parameter
        index : callable
            Takes the Parameter of an inferred τ and returns its index among the inferred standard deviations.

        Raises
        ------
        ValueError
            If there is no parameter or group of a given name.
        """
        own = [p.group or p.name for p in parameters]
        known = dict.fromkeys([*own, *(p.name for p in parameters)])
        for name in self.groups:
            if name not in known:
                raise ArgumentError("discrepancy.groups", f"must be of {', '.join(known)}", repr(name))
        chosen = [
            not self.groups or own[k] in self.groups or p.name in self.groups for k, p in enumerate(parameters)
        ]
        relative = np.array([p.lowest > 0.0 or p.highest < 0.0 for p in parameters])
        fixed, number = np.zeros(len(parameters)), np.full(len(parameters), -1)
        for k in np.flatnonzero(chosen):
            if self.tau is not None:
                fixed[k] = self.tau
                continue
            name = self.name if self.by == "common" else f"{self.name} {own[k]}"
            prior = HalfNormal(self.prior_sd)
            number[k] = index(Parameter(name, 0.5 * self.prior_sd, 0.0, _MOST * self.prior_sd, prior))
        size = np.array([_size(p) for p in parameters])
        return EmbeddedScatter(tuple(p.name for p in parameters), relative, size, fixed, number)


def _size(parameter: Parameter) -> float:
    """Return the unit of the absolute scatter of a parameter."""
    if parameter.start != 0.0:
        return abs(parameter.start)
    return float(parameter.prior.scale(parameter.lower, parameter.upper)[1])


@dataclass(frozen=True, eq=False)
class EmbeddedScatter:
    """The scatter of p parameters over the modes.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters.
    relative : ndarray of bool, shape (p,)
        Whether the scatter is relative to the value of the parameter.
    size : ndarray, shape (p,)
        Unit of an absolute scatter.
    fixed : ndarray, shape (p,)
        The known τ_k; 0 if a parameter does not scatter or its τ is inferred.
    number : ndarray of int, shape (p,)
        Index of the inferred τ_k among the inferred standard deviations; −1 if it is not inferred.
    """

    names: tuple[str, ...]
    relative: FloatArray
    size: FloatArray
    fixed: FloatArray
    number: FloatArray

    def scale(self, values: FloatArray) -> FloatArray:
        """Return the unit s_k of the scatter of each parameter at values (…, p), of the same shape."""
        return np.where(self.relative, np.abs(values), self.size)

    def variances(self, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return τ², (n, p), and its derivatives by the inferred standard deviations `noise`, (n, n_noise, p)."""
        n, inferred = len(noise), np.flatnonzero(self.number >= 0)
        tau = np.broadcast_to(self.fixed, (n, len(self.fixed)))
        slopes = np.zeros((n, noise.shape[1], len(self.fixed)))
        if len(inferred):
            tau = tau.copy()
            tau[:, inferred] = noise[:, self.number[inferred]]
            slopes[:, self.number[inferred], inferred] = 2.0 * tau[:, inferred]
        return tau**2, slopes

    def as_dict(self) -> dict[str, Plain]:
        """Return a dict of the settings in plain Python types."""
        return {
            "kind": "embedded",
            "names": list(self.names),
            "relative": self.relative.tolist(),
            "size": self.size.tolist(),
            "tau": self.fixed.tolist(),
            "inferred": self.number.tolist(),
        }
