"""Embedded model discrepancy: the parameters scatter over the modes, so that each mode has its own values.

No parameter values of a wrong model fit all modes. Let mode i have the parameters θ_k + s_k τ_k z_ik with
independent standard normal z_ik, where s_k is |θ_k| (relative scatter) or a constant (absolute scatter). To first
order, the frequencies then have independent Gaussian errors, in addition to measurement errors, with the variances

v_i = Σ_k (∂f_i/∂θ_k)² s_k² τ_k².

With a correlation ρ > 0, z_ik is replaced by √(1 − ρ_k) z_ik + √ρ_k w_k, where w_k is the same for all modes. Two
frequencies then have the covariance Σ_k ρ_k (∂f_i/∂θ_k) (∂f_j/∂θ_k) s_k² τ_k². A value that is wrong in the same
way for all modes, such as a forgotten mass, has ρ = 1.

The idea is the embedded model error of Sargsyan, Najm & Ghanem 2015, *Int. J. Chem. Kinet.* 47, 246–276.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal, NamedTuple

import numpy as np
from annotated_types import Interval

from fmu.arguments import ArgumentError, check_arguments, first_repeated
from fmu.posterior.errors.noise import NoiseIndex
from fmu.posterior.parameters import Parameter, require_name
from fmu.posterior.priors.one_sided import HalfNormal
from fmu.types import BoolArray, FloatArray, IntArray, Plain, Positive

MOST = 10.0  # upper bound of an inferred τ, in standard deviations of its prior
_START, _MOST_CORRELATED = 0.3, 0.999


class Setting(NamedTuple):
    """A known number or, if `number` is not negative, the inferred error parameter with that index."""

    fixed: float
    number: int = -1

    def at(self, noise: FloatArray) -> FloatArray:
        """Return the setting's values, shape (n,), for the inferred error parameters `noise` (n, n_noise)."""
        return noise[:, self.number] if self.number >= 0 else np.full(len(noise), self.fixed)

    def as_dict(self) -> dict[str, Plain]:
        """Return the setting as a dict of plain Python types."""
        return {"known": self.fixed, "inferred": self.number}


INDEPENDENT = Setting(0.0)
"""The correlation of independent errors."""


@check_arguments
@dataclass(frozen=True)
class Discrepancy:
    """Model discrepancy: an error of the model that remains at any parameter values.

    With `kind` = "embedded" the parameters scatter from mode to mode (`fmu.posterior.discrepancy.embedded`), and
    the error grows with the sensitivity to the parameters. With `kind` = "modes" the predicted frequencies and
    shapes have their own errors, which do not depend on the parameters (`fmu.posterior.discrepancy.modes`). All
    predictive intervals include the discrepancy. It is the same in all tests of a structure. Frequency response
    functions from one test accept only the kind "modes", with given `sd` and `correlation` and without `length`
    (`fmu.posterior.frf.scattered`).

    Attributes
    ----------
    kind : {"embedded", "modes"}
    tau : float, optional
        For "embedded". The scatter τ; inferred if not given. It is relative to the value of the parameter if this
        value cannot be 0 within the bounds. Otherwise it is relative to the absolute starting value or, if the
        parameter starts at 0, to the scale of its prior.
    prior_sd : float
        Scale of the half-normal priors of inferred τ, `sd` and `shape_sd`: the standard deviation of the whole
        Gaussian.
    by : {"common", "group"}
        For "embedded". Whether all parameters have the same τ, or each group has its own. A parameter without a
        group counts as its own group.
    groups : tuple of str
        For "embedded". Names of the groups or parameters that scatter; all scatter if empty.
    sd : float, optional
        For "modes". Standard deviation of the relative frequency errors; inferred if not given.
    correlation : float or "inferred", optional
        Correlation between modes. For "modes", the correlation between the errors of two frequencies, at least 0
        and less than 1; inferred if not given. For "embedded", the correlation between each parameter's values in
        two modes, from 0 to 1; 0 if not given. An inferred correlation has a uniform prior.
    shape_sd : float, optional
        For "modes". Standard deviation of the errors in mode shape components, where the largest component is 1.
        For frequency response functions, standard deviation of a mode's residue errors, relative to the root mean
        square of its residues over the functions. Inferred if not given.
    length : float, optional
        For "modes". Distance in m over which the magnitude of the error correlation between two sensors that
        measure along the same axis falls to 1/e. The correlation is negative between ``"y"`` and ``"-y"``. Errors
        are independent if `length` is not given or the model has no sensor coordinates.
    name : str, optional
        Name of the inferred τ or σ, "tau" or "model error" by default. With `by` = "group" the group name follows;
        the word "correlation" or "shapes" follows if one of these is inferred.

    Raises
    ------
    ValueError
        If a number is out of its range, the name is not allowed, or a setting belongs to the other kind.

    Notes
    -----
    The variances are exact to first order in τ; at τ = 0.3 and more they are rough. If the parameters outnumber
    the data, the data hardly determine τ, and its posterior stays close to its prior.
    """

    kind: Literal["embedded", "modes"] = "embedded"
    tau: Positive | None = None
    prior_sd: Positive = 0.1
    by: Literal["common", "group"] = "common"
    groups: tuple[str, ...] = ()
    sd: Positive | None = None
    correlation: Annotated[float, Interval(ge=0, le=1)] | Literal["inferred"] | None = None
    shape_sd: Positive | None = None
    length: Positive | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        require_name(self.label)
        object.__setattr__(self, "groups", tuple(self.groups))
        of_other = {
            "embedded": {k: vars(self)[k] for k in ("sd", "shape_sd", "length")},
            "modes": {
                "tau": self.tau,
                "by": self.by if self.by != "common" else None,
                "groups": self.groups or None,
            },
        }[self.kind]
        for key, value in of_other.items():
            if value is not None:
                raise ArgumentError(
                    f"discrepancy.{key}", f'must not be given with kind = "{self.kind}"', repr(value)
                )
        if self.kind == "modes" and self.correlation == 1.0:
            raise ArgumentError("discrepancy.correlation", 'must be less than 1 with kind = "modes"', "1.0")

    @property
    def label(self) -> str:
        """Name of the inferred τ or σ."""
        return self.name or ("tau" if self.kind == "embedded" else "model error")

    def infers(self, of_frequencies: bool, of_shapes: bool) -> bool:
        """Return True if a number is inferred, given whether frequencies and shapes have measurement errors."""
        if self.kind == "embedded":
            return self.tau is None or self.correlation == "inferred"
        of_modes = self.sd is None or self.correlation in (None, "inferred")
        return (of_frequencies and of_modes) or (of_shapes and self.shape_sd is None)

    def bind(self, parameters: Sequence[Parameter], index: NoiseIndex) -> EmbeddedScatter:
        """Return the scatter bound to the parameters of a structure.

        Parameters
        ----------
        parameters : sequence of Parameter
        index : callable
            Takes an inferred τ or correlation as a Parameter and returns its index among the inferred error
            parameters.

        Raises
        ------
        ValueError
            If there is no parameter or group of a given name, or an inferred number has the name of another
            parameter.
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
            name = self.label if self.by == "common" else f"{self.label} {own[k]}"
            prior = HalfNormal(self.prior_sd)
            number[k] = index(Parameter(name, 0.5 * self.prior_sd, 0.0, MOST * self.prior_sd, prior))
        size, correlation = np.array([_size(p) for p in parameters]), self.correlation_over_modes(index)
        return EmbeddedScatter(tuple(p.name for p in parameters), relative, size, fixed, number, correlation)

    def correlation_over_modes(self, index: NoiseIndex) -> Setting:
        """Return the correlation between modes as a `Setting`; `index` is as in `bind`."""
        known = 0.0 if self.correlation is None and self.kind == "embedded" else self.correlation
        if isinstance(known, float | int):
            return Setting(float(known))
        return Setting(0.0, index(Parameter(f"{self.label} correlation", _START, 0.0, _MOST_CORRELATED)))


def require_distinct_names(discrepancies: Sequence[Discrepancy], of_frequencies: bool, of_shapes: bool) -> None:
    """Raise ValueError if two discrepancies with an inferred number have the same name.

    The last two arguments state whether there are measurement errors of frequencies and of shapes.
    """
    names = [one.label for one in discrepancies if one.infers(of_frequencies, of_shapes)]
    twice = first_repeated(names)
    if twice is not None:
        raise ArgumentError("discrepancy.name", "must be different for each discrepancy", names[twice])


def _size(parameter: Parameter) -> float:
    """Return the unit in which a parameter's absolute scatter is measured."""
    if parameter.start != 0.0:
        return abs(parameter.start)
    return float(parameter.prior.scale(parameter.lower, parameter.upper)[1])


@dataclass(frozen=True, eq=False)
class EmbeddedScatter:
    """Scatter of p parameters over the modes.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters.
    relative : ndarray of bool, shape (p,)
        Whether the scatter is relative to the parameter's value.
    size : ndarray, shape (p,)
        Unit of an absolute scatter.
    fixed : ndarray, shape (p,)
        The known τ_k; 0 if a parameter does not scatter or its τ is inferred.
    number : ndarray of int, shape (p,)
        Index of the inferred τ_k among the inferred error sds, or −1 if τ_k is not inferred.
    correlation : Setting
        Correlation ρ between modes.
    """

    names: tuple[str, ...]
    relative: FloatArray
    size: FloatArray
    fixed: FloatArray
    number: FloatArray
    correlation: Setting = INDEPENDENT

    @classmethod
    def none(cls, p: int) -> EmbeddedScatter:
        """Return an `EmbeddedScatter` of p parameters, none of which scatters."""
        return cls(("",) * p, np.zeros(p, dtype=bool), np.ones(p), np.zeros(p), np.full(p, -1))

    def scale(self, values: FloatArray) -> FloatArray:
        """Return the unit s_k of each parameter's scatter, (…, p), at parameter `values` (…, p)."""
        return np.where(self.relative, np.abs(values), self.size)

    @property
    def scatters(self) -> BoolArray:
        """Mask of the parameters that scatter, shape (p,)."""
        return np.asarray((self.fixed > 0.0) | (self.number >= 0))

    def variances(self, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return two scatter variances in units of s², each of shape (n, p), for error sds `noise` (n, n_noise).

        They are (1 − ρ) τ² for the part that differs from mode to mode, and ρ τ² for the common part.
        """
        square = self._tau(noise) ** 2
        if self.correlation == INDEPENDENT:
            return square, np.zeros_like(square)
        rho = self.correlation.at(noise)[:, None]
        return square * (1.0 - rho), square * rho

    def variance_slopes(self, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of `variances` with respect to `noise`, each of shape (n, n_noise, p)."""
        tau, inferred = self._tau(noise), self._inferred
        slopes = np.zeros((*noise.shape, len(self.fixed)))
        slopes[:, self.number[inferred], inferred] = 2.0 * tau[:, inferred]
        if self.correlation == INDEPENDENT:
            return slopes, np.zeros_like(slopes)
        rho = self.correlation.at(noise)[:, None, None]
        own, common = slopes * (1.0 - rho), slopes * rho
        if self.correlation.number >= 0:
            own[:, self.correlation.number] -= tau**2
            common[:, self.correlation.number] += tau**2
        return own, common

    @cached_property
    def _inferred(self) -> IntArray:
        """Indices of the parameters whose τ is inferred."""
        return np.flatnonzero(self.number >= 0)

    def _tau(self, noise: FloatArray) -> FloatArray:
        if len(self._inferred) == len(self.fixed):
            return noise[:, self.number]
        tau = np.repeat(self.fixed[None], len(noise), axis=0)
        tau[:, self._inferred] = noise[:, self.number[self._inferred]]
        return tau

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings as a dict of plain Python types."""
        of_modes = {} if self.correlation == INDEPENDENT else {"correlation": self.correlation.as_dict()}
        return {
            "kind": "embedded",
            "names": list(self.names),
            "relative": self.relative.tolist(),
            "size": self.size.tolist(),
            "tau": self.fixed.tolist(),
            "inferred": self.number.tolist(),
            **of_modes,
        }
