"""Error model for 1 − MAC, either of single modes or relative to the subspace spanned by closely spaced modes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import erf

from fmu.arguments import ArgumentError, check_arguments
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.data.covariance import mode_weights
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.base import LOG_2PI, ErrorTerm, Evaluated, Residuals
from fmu.posterior.errors.noise import NoiseIndex, Spread, require_sizes, spread
from fmu.posterior.errors.shape import unit_shapes
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray, Plain

_RIDGE = 1e-14
"""Ridge added to the Gram matrix of shapes, relative to its trace, since shapes may be equal at the sensors."""

Groups = tuple[tuple[int, ...], ...]


@check_arguments
@dataclass(frozen=True)
class MACErrors:
    """Half-Gaussian errors ε = 1 − MAC at the sensors.

    The density is normalised for ε on [0, 1]. It is a convention in the field rather than a model of measurement
    noise. If the components of a unit-length shape at q sensors have noise with the standard deviation σ, 1 − MAC
    is (q − 1) σ² on average, to first order in σ². `ShapeErrors` models such noise.

    Attributes
    ----------
    sd : float, array_like of shape (n_modes,), or Parameter
        Standard deviation of the Gaussian that is truncated to [0, 1].
    weights : array_like, shape (n_modes,), optional
        Weights w_i of the modes: the variance of the Gaussian for ε_i is sd²/w_i.
    together : sequence of sequence of str
        Groups of mode labels. The modes in a group have frequencies too close for their shapes to be distinct,
        such as the mode pairs of a nearly symmetric structure. Each mode is compared with the subspace spanned by
        its group's computed modes, which does not depend on how the shapes are rotated within it (`in_span`).

    Raises
    ------
    ValueError
        If a standard deviation or a weight is not positive and finite.
    """

    sd: ArrayLike | Parameter
    weights: ArrayLike | None = None
    together: Sequence[Sequence[str]] = ()

    def __post_init__(self) -> None:
        require_sizes(self.sd, self.weights)

    def bind(self, data: ModalData, index: NoiseIndex) -> ErrorTerm:
        """Return the error model bound to `data`; see `ErrorModel.bind`.

        Raises
        ------
        ValueError
            If shapes were not measured at two sensors or more, standard deviations, weights or groups do not fit
            the data, or an inferred standard deviation has a negative lower bound or the name of another
            parameter.
        """
        unit = unit_shapes(data, "MAC errors")
        size = 1.0 / np.sqrt(mode_weights(self.weights, unit.shape[1]))
        groups = groups_of(self.together, data.labels, len(unit))
        return MACTerm(unit, spread("MAC errors", self.sd, None, size, index), groups)

    def n_errors(self, data: ModalData) -> int:
        """Return the number of used modes."""
        return sum(data.use)

    def data_give_sd(self, data: ModalData) -> bool:
        """Return False, because `data` never have standard deviations of MAC values."""
        return False


@dataclass(frozen=True, eq=False)
class MACTerm(ErrorTerm):
    """Errors 1 − MAC of the modes.

    Attributes
    ----------
    unit : ndarray, shape (n_sensors, n_modes)
        Measured unit-length shapes.
    spread : Spread
    groups : tuple of tuple of int
        Indices of the modes in each group that is compared as a subspace.
    """

    unit: FloatArray
    spread: Spread
    groups: Groups = ()
    needs_shapes: ClassVar[bool] = True
    is_least_squares: ClassVar[bool] = True
    quantity: ClassVar[str] = "MAC values"  # shape noise does not make 1 − MAC half-normal: see `MACErrors`

    @property
    def couples_modes(self) -> bool:
        """Whether modes are compared in groups."""
        return bool(self.groups)

    def project(self, seen: ModalPrediction) -> ModalPrediction:
        """Return the prediction with the shapes of grouped modes projected; see `in_span`."""
        return in_span(seen, self.unit, self.groups) if self.groups else seen

    def evaluate(self, seen: ModalPrediction, noise: FloatArray, gradient: bool) -> Evaluated:
        """Return the log-density of each mode; see `ErrorTerm.evaluate`."""
        error, slope = self._errors(seen.shapes)
        V = self.spread.variance(noise)
        z = 1.0 / np.sqrt(2.0 * V)
        terms = np.log(2.0) - 0.5 * (error**2 / V + np.log(V) + LOG_2PI) - np.log(erf(z))
        if not gradient:
            return Evaluated(terms)
        by_V = 0.5 * (error**2 / V - 1.0) / V + 2.0 / np.sqrt(np.pi) * np.exp(-(z**2)) * z**3 / erf(z)
        by_noise = {k: by_V * dV for k, dV in self.spread.slopes(noise).items()}
        return Evaluated(terms, None, (-error / V)[:, None] * slope, by_noise)

    def residuals(self, seen: ModalPrediction, noise: FloatArray) -> Residuals:
        """Return the errors divided by their standard deviations; see `ErrorTerm.residuals`."""
        error, slope = self._errors(seen.shapes)
        sd = np.sqrt(self.spread.variance(noise))
        return Residuals((error / sd)[..., None], None, np.swapaxes(slope / sd[:, None], 1, 2)[:, :, None])

    def labels(self, modes: Sequence[str]) -> list[str]:
        """Return the residuals' names, given the mode names; see `ErrorTerm.labels`."""
        return [f"{mode}, MAC" for mode in modes]

    def as_dict(self) -> dict[str, Plain]:
        """Return the error model's name and settings as a dict."""
        together = {"together": [list(group) for group in self.groups]} if self.groups else {}
        return {"error": "MAC", "spread": self.spread.as_dict(), **together}

    def _errors(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return 1 − MAC, (n, n_modes), and its derivatives with respect to shapes, (n, n_sensors, n_modes)."""
        cross, size = np.sum(self.unit * s, axis=1), np.sum(s**2, axis=1)
        a = (cross / size)[:, None]
        return 1.0 - cross**2 / size, -2.0 * a * (self.unit - a * s)


def groups_of(together: Sequence[Sequence[str]], labels: Sequence[str], n_sensors: int) -> Groups:
    """Convert groups of mode labels to groups of mode indices (from 0).

    Raises
    ------
    ValueError
        If a mode is unknown or named twice, or the number of modes in a group is below 2 or not below the number
        of sensors.
    """
    named = [str(name) for group in together for name in group]
    unknown = [name for name in named if name not in labels]
    if unknown:
        raise ArgumentError("together", f"must name measured modes, {', '.join(labels)}", repr(unknown[0]))
    if len(set(named)) < len(named):
        raise ArgumentError("together", "must name no mode twice", named)
    for group in together:
        if not 2 <= len(group) < n_sensors:
            raise ArgumentError(
                "together",
                f"a group must be of 2 modes or more, and fewer than the {n_sensors} sensors",
                list(group),
            )
    return tuple(tuple(list(labels).index(str(name)) for name in group) for group in together)


def in_span(seen: ModalPrediction, unit: FloatArray, groups: Groups) -> ModalPrediction:
    """Return the prediction with each shape in a group replaced by a projection of the measured shape.

    The measured shape u_i is projected onto the span of the group's computed shapes S. With P = S S⁺ and the
    pseudo-inverse S⁺ = (SᵀS)⁻¹ Sᵀ, the shape of mode i becomes P u_i. The MAC of P u_i with u_i is ‖P u_i‖²,
    whatever basis of the span the eigensolver returned (cf. D'Ambrogio & Fregolent 2003, Higher-order MAC for the
    correlation of close and multiple modes, *Mech. Syst. Signal Process.* 17). The derivative of P u is

    ∂P u = (I − P) ∂S S⁺u + S⁺ᵀ ∂Sᵀ (I − P) u.

    Rotations of the shapes within their span cancel, so the derivative remains of order one through a veering.
    Let the coefficients be a = S⁺u. The variances v of a surrogate's shapes become the variances of S a at fixed
    coefficients, Σ_r a_ri² v_sr for sensor s of mode i. Errors of the coefficients move P u_i within the span,
    along which the MAC has no slope.

    Parameters
    ----------
    seen : ModalPrediction
    unit : ndarray, shape (n_sensors, n_modes)
        Measured unit-length shapes.
    groups : tuple of tuple of int
        Mode indices in each group.
    """
    shapes = seen.shapes.copy()
    slopes, v, dv = (
        None if x is None else x.copy()
        for x in (seen.shape_slopes, seen.shape_variance, seen.shape_variance_slopes)
    )
    for group in groups:
        modes = list(group)
        S, u = seen.shapes[:, :, modes], unit[:, modes]
        gram = np.swapaxes(S, 1, 2) @ S
        ridge = _RIDGE * np.trace(gram, axis1=1, axis2=2) + np.finfo(float).tiny
        pseudo = np.linalg.solve(gram + ridge[:, None, None] * np.eye(len(modes)), np.swapaxes(S, 1, 2))
        a = pseudo @ u
        shapes[:, :, modes] = S @ a
        if v is not None:
            own = v[:, :, modes]
            v[:, :, modes] = np.einsum("nqr,nrm->nqm", own, a**2)
        if slopes is None or seen.shape_slopes is None:
            continue
        dS = seen.shape_slopes[:, :, modes]
        across = np.einsum("nqrp,nrm->nqmp", dS, a)  # ∂S S⁺u
        back = np.einsum("nrq,nqmp->nrmp", pseudo, across)
        across -= np.einsum("nqr,nrmp->nqmp", S, back)
        left = u - S @ a
        turned = np.einsum("nrq,nrmp->nqmp", pseudo, np.einsum("nqrp,nqm->nrmp", dS, left))
        slopes[:, :, modes] = across + turned
        if dv is not None:
            da = np.einsum("nrq,nqmp->nrmp", pseudo, turned) - back
            dv[:, :, modes] = np.einsum("nqrp,nrm->nqmp", dv[:, :, modes], a**2)
            dv[:, :, modes] += 2.0 * np.einsum("nqr,nrm,nrmp->nqmp", own, a, da)
    return replace(seen, shapes=shapes, shape_slopes=slopes, shape_variance=v, shape_variance_slopes=dv)
