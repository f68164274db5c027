"""Error models: how far computed modes are from measured ones, and how probable that is.

Each is a choice of ε and of the size of its spread; all are log-densities, normalised in what they say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike

from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.noise import NoiseIndex, spread
from fmu.posterior.errors.subspace import groups_of
from fmu.posterior.errors.terms import ErrorTerm, FrequencyTerm, MACTerm, ShapeTerm
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray

Kind = Literal["absolute", "relative", "eigenvalue"]


class ErrorModel(Protocol):
    """Settings of an error model."""

    @property
    def sd(self) -> ArrayLike | Parameter | None:
        """Standard deviation of the errors, known or to be inferred; None for that of the data."""
        ...

    def bind(self, data: ModalData, index: NoiseIndex) -> ErrorTerm:
        """Return the model of the errors of `data`."""
        ...

    def n_errors(self, data: ModalData) -> int:
        """Return how many errors `data` have of this kind."""
        ...

    def data_give_sd(self, data: ModalData) -> bool:
        """Say whether `data` have the standard deviation of these errors, which `sd` would replace."""
        ...


@dataclass(frozen=True)
class FrequencyErrors:
    """Independent Gaussian errors of the frequencies.

    Attributes
    ----------
    kind : {"absolute", "relative", "eigenvalue"}
        ε = f − f^m in Hz, ε = (f − f^m)/f^m, or ε = (f/f^m)² − 1, the relative error of the eigenvalue. The first
        two are normalised as densities of f^m in Hz, the last as a density of ε.
    sd : float, array_like of shape (n_modes,), or Parameter, optional
        Standard deviation of ε: known, or to be inferred with a prior of its own. That of the data if not given.
    weights : array_like, shape (n_modes,), optional
        Trust in each mode: the variance of ε_i is sd²/w_i.
    discrepancy : Parameter, optional
        Standard deviation of what the model leaves out, to be inferred: it adds sd_d² to every variance, in the
        same unit, as an error that is independent from mode to mode.

    Notes
    -----
    What a model leaves out is rarely independent: a mass that was not modelled shifts many modes at once, and the
    parameters follow it by more than their standard deviations say. Where a discrepancy may be nil, a prior that
    reaches zero (half-normal) makes a posterior that is hard to sample; a log-normal keeps away from it. With as
    many parameters as frequencies, errors of no size at all fit best: an sd to be inferred needs more data than
    that, or a prior that says what is possible.
    """

    kind: Kind = "relative"
    sd: ArrayLike | Parameter | None = None
    weights: ArrayLike | None = None
    discrepancy: Parameter | None = None

    def bind(self, data: ModalData, index: NoiseIndex) -> ErrorTerm:
        """Return the model of the errors of `data`.

        Parameters
        ----------
        data : ModalData
        index : callable
            Gives an inferred standard deviation its place.

        Raises
        ------
        ValueError
            If the kind is unknown, or standard deviations or weights do not fit the data.
        """
        if self.kind not in get_args(Kind):
            raise ValueError(f"kind: must be one of {get_args(Kind)} (got {self.kind!r})")
        measured = np.asarray(data.frequencies_hz)
        unit = {"absolute": np.ones(len(measured)), "relative": measured, "eigenvalue": np.ones(len(measured))}
        sd = self.sd
        if sd is None and data.covariance_hz2 is not None:
            raise ValueError(
                "sd: errors with a covariance are absolute, known and without weights: error='frequency'"
            )
        if sd is None and data.sd_hz is not None:
            sd = (
                np.asarray(data.sd_hz)
                / {"absolute": 1.0, "relative": measured, "eigenvalue": 0.5 * measured}[self.kind]
            )
        size = unit[self.kind] / np.sqrt(_weights(self.weights, len(measured)))
        known = spread("frequency errors", sd, self.discrepancy, size, index)
        return FrequencyTerm(self.kind, measured, known)

    def n_errors(self, data: ModalData) -> int:
        """Return the number of modes."""
        return data.n_modes

    def data_give_sd(self, data: ModalData) -> bool:
        """Say whether `data` have standard deviations or a covariance of the frequencies."""
        return data.sd_hz is not None or data.covariance_hz2 is not None


@dataclass(frozen=True)
class ShapeErrors:
    """Gaussian errors of the mode shapes, scaled to unit length at the sensors.

    With the measured shape u of unit length, the computed shape φ and the precisions Λ = diag(1/σ_s²) of the
    sensors, ε = u − aφ with the scale a that fits best, and

    log p = −½ εᵀΛε + ½ log det Λ − ½ log(φᵀΛφ / φᵀφ) − ½ (q − 1) log 2π.

    That is the Gaussian density of the direction of u beside that of φ: the component along φ, a matter of scale,
    is integrated out (cf. Vanik, Beck & Au 2000, *J. Eng. Mech.* 126, 738–745). It has q − 1 dimensions at q
    sensors. With one σ for all sensors εᵀΛε = (1 − MAC)/σ². Signs and scales of shapes play no part.

    Attributes
    ----------
    sd : float, array_like of shape (n_modes,) or (n_sensors, n_modes), or Parameter, optional
        Standard deviation of a component of a shape of unit length; that of the data if not given.
    weights : array_like, shape (n_modes,), optional
        Trust in each mode: its variances are sd²/w_i.
    discrepancy : Parameter, optional
        Standard deviation of what the model leaves out, to be inferred; in the same unit.
    """

    sd: ArrayLike | Parameter | None = None
    weights: ArrayLike | None = None
    discrepancy: Parameter | None = None

    def bind(self, data: ModalData, index: NoiseIndex) -> ErrorTerm:
        """Return the model of the errors of `data`.

        Parameters
        ----------
        data : ModalData
            With shapes, at two sensors or more.
        index : callable
            Gives an inferred standard deviation its place.

        Raises
        ------
        ValueError
            If no shapes were measured, or standard deviations or weights do not fit the data.
        """
        unit = _unit_shapes(data, "shape errors")
        size = np.ones(unit.shape) / np.sqrt(_weights(self.weights, unit.shape[1]))
        sd = data.shapes_sd if self.sd is None else self.sd
        return ShapeTerm(unit, spread("shape errors", sd, self.discrepancy, size, index))

    def n_errors(self, data: ModalData) -> int:
        """Return the number of components of all measured shapes."""
        return 0 if data.shapes is None else np.size(data.shapes)

    def data_give_sd(self, data: ModalData) -> bool:
        """Say whether `data` have standard deviations of the shapes."""
        return data.shapes_sd is not None


@dataclass(frozen=True)
class MACErrors:
    """Half-Gaussian errors ε = 1 − MAC at the sensors.

    Normalised as a density of ε on [0, 1]. A habit of the field rather than a model of how shapes are measured:
    with noise of size σ at the sensors 1 − MAC is of size (q − 1) σ², and that is what `ShapeErrors` says.

    Attributes
    ----------
    sd : float, array_like of shape (n_modes,), or Parameter
        Size of 1 − MAC.
    weights : array_like, shape (n_modes,), optional
        Trust in each mode: the variance of ε_i is sd²/w_i.
    together : sequence of sequence of str
        Groups of modes, by their labels, too close in frequency to have shapes of their own, as the pairs of a
        nearly symmetric structure. Each is compared with all that the computed modes of its group span, for which
        it does not matter how the shapes turn into each other (`fmu.posterior.errors.subspace`).
    """

    sd: ArrayLike | Parameter
    weights: ArrayLike | None = None
    together: Sequence[Sequence[str]] = ()

    def bind(self, data: ModalData, index: NoiseIndex) -> ErrorTerm:
        """Return the model of the errors of `data`.

        Parameters
        ----------
        data : ModalData
            With shapes, at two sensors or more.
        index : callable
            Gives an inferred standard deviation its place.

        Raises
        ------
        ValueError
            If no shapes were measured, or standard deviations, weights or groups do not fit the data.
        """
        unit = _unit_shapes(data, "MAC errors")
        size = 1.0 / np.sqrt(_weights(self.weights, unit.shape[1]))
        groups = groups_of(self.together, data.labels, len(unit))
        return MACTerm(unit, spread("MAC errors", self.sd, None, size, index), groups=groups)

    def n_errors(self, data: ModalData) -> int:
        """Return the number of modes."""
        return data.n_modes

    def data_give_sd(self, data: ModalData) -> bool:
        """Say no: `data` have no errors of MAC values."""
        return False


ERROR_MODELS: dict[str, type[ErrorModel]] = {
    "frequencies": FrequencyErrors,
    "shapes": ShapeErrors,
    "mac": MACErrors,
}
"""By the name that ``of`` has in a problem file; its other keys are the arguments (`fmu.config.errors`)."""


def _weights(weights: ArrayLike | None, n: int) -> FloatArray:
    if weights is None:
        return np.ones(n)
    given = np.asarray(weights, dtype=float)
    if given.shape != (n,) or not np.all(np.isfinite(given) & (given > 0)):
        raise ValueError(f"weights: must be {n} positive numbers, one per mode (got {given.tolist()})")
    return given


def _unit_shapes(data: ModalData, name: str) -> FloatArray:
    if data.shapes is None:
        raise ValueError(f"{name}: need measured shapes at the sensors (got none)")
    shapes = np.asarray(data.shapes)
    if len(shapes) < 2:
        raise ValueError(f"{name}: need shapes at two sensors or more (got {len(shapes)})")
    return np.asarray(shapes / np.linalg.norm(shapes, axis=0))
