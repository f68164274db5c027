"""Error models for weighed masses and static displacements. Such data separate stiffness from mass.

Frequencies alone determine only ratios of stiffness to mass. A weighed mass, a centre of gravity or a static
displacement is a further datum with a Gaussian error. The value that the model predicts for it is computed from
the matrices, not from modes (`fmu.fem.modes.static`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from fmu.arguments import ArgumentError, check_arguments
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.static import MassMoments, StaticDisplacement
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.base import LOG_2PI, ErrorTerm
from fmu.posterior.errors.noise import NoiseIndex
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.joint import JointPrior
from fmu.types import FloatArray, Plain, Positive

_AXES = ("x", "y", "z")


class QuantityTerm(NamedTuple):
    """Measured structural quantities other than modes, with the function that computes them.

    Attributes
    ----------
    labels, units : tuple of str
    measured, sd : ndarray, shape (q,)
        Measured values and their standard deviations, in `units`.
    computed : callable
        Returns two results for model parameters (n, n_structural): the computed values (n, q), and their
        derivatives (n, q, n_structural). The derivatives are None unless the second argument is True.
    test : int
        Index of the test in which the quantities were measured.
    """

    labels: tuple[str, ...]
    units: tuple[str, ...]
    measured: FloatArray
    sd: FloatArray
    computed: Any
    test: int = 0

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the log-densities of the q measured quantities, shape (n, q)."""
        z = (self.measured - self.computed(theta)[0]) / self.sd
        return np.asarray(-0.5 * z**2 - np.log(self.sd) - 0.5 * LOG_2PI)

    def residuals_and_slopes(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the residuals (computed − measured)/sd, (n, q), and their derivatives, (n, q, n_structural)."""
        values, slopes = self.computed(theta, True)
        return (values - self.measured) / self.sd, slopes / self.sd[:, None]

    def as_dict(self) -> dict[str, Plain]:
        """Return labels, units, measured values and standard deviations as a dict of plain Python types."""
        return {
            "error": "quantity",
            "labels": list(self.labels),
            "units": list(self.units),
            "measured": self.measured.tolist(),
            "sd": self.sd.tolist(),
        }


class QuantityErrors:
    """Error settings for measured quantities other than modes."""

    sd: ClassVar[Any] = None
    test: str | None

    def bind(self, data: ModalData, index: NoiseIndex) -> ErrorTerm:
        """Raise ValueError, because these errors belong to a structure (see `bind_structure`), not to modes."""
        raise ArgumentError("error", f"{type(self).__name__} must be given to a problem of a SeparableModel")

    def n_errors(self, data: ModalData) -> int:
        """Return 0, because these are not errors in modes."""
        return 0

    def data_give_sd(self, data: ModalData) -> bool:
        """Return False: `data` describe modes, and contain no standard deviations of these quantities."""
        return False

    def at_places(self, places: Mapping[str, Any]) -> Self:
        """Return the settings with place names replaced by nodes of the model; by default, unchanged."""
        return self

    def bind_structure(self, model: SeparableModel, parameters: Sequence[Parameter]) -> QuantityTerm:
        """Bind the measured quantities to a structure's model and parameters.

        Raises
        ------
        ValueError
            If the model cannot compute the quantities.
        """
        raise NotImplementedError


@check_arguments
@dataclass(frozen=True)
class MassErrors(QuantityErrors):
    """The structure's weighed mass and, if it was measured, its centre of gravity. The errors are Gaussian.

    Attributes
    ----------
    mass : float, kg
        The weighed mass.
    sd : float, kg
        Standard deviation of the mass.
    centre : tuple of float, length 3, optional, m
        The centre of gravity in the model's coordinates. All nodes that can move must have coordinates.
    centre_sd : float, optional, m
        Standard deviation of each coordinate of the centre of gravity.
    at_supports : float, kg
        Part of the weighed mass that the model omits because the supports fix it, such as half of the lowest
        columns; 0 for a free structure. `centre` must be the centre of gravity of the remaining mass.
    test : str, optional
        If there are several tests, the name of the test in which the mass was measured. The mass is computed with
        that test's changes and parameters.

    Raises
    ------
    ValueError
        If the mass or a standard deviation is not positive and finite, `at_supports` is negative or not below the
        mass, the centre is not three finite numbers, or only one of `centre` and `centre_sd` is given.
    """

    mass: Positive
    sd: Positive  # type: ignore[misc]  # a setting here
    centre: tuple[float, float, float] | None = None
    centre_sd: Positive | None = None
    at_supports: float = 0.0
    test: str | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.at_supports < self.mass:
            rule = f"must be at least 0 and less than the mass, {self.mass} kg"
            raise ArgumentError("at_supports", rule, self.at_supports)
        if (self.centre is None) != (self.centre_sd is None):
            raise ArgumentError("centre_sd", "must be given together with centre")
        if self.centre is not None and not (len(self.centre) == 3 and np.all(np.isfinite(self.centre))):
            raise ArgumentError("centre", "must be three finite coordinates", list(self.centre))

    def bind_structure(self, model: SeparableModel, parameters: Sequence[Parameter]) -> QuantityTerm:
        """Bind the mass and, if it was measured, the centre of gravity; see `QuantityErrors.bind_structure`."""
        start = np.array([p.start for p in parameters])
        moments = MassMoments(model, start, self.centre is not None)
        labels, units = ["mass"], ["kg"]
        measured, sd = [self.mass - self.at_supports], [float(self.sd)]
        if self.centre is not None and self.centre_sd is not None:
            labels += [f"centre of gravity, {d}" for d in _AXES]
            units += ["m"] * 3
            measured += list(self.centre)
            sd += [self.centre_sd] * 3
        return QuantityTerm(tuple(labels), tuple(units), np.array(measured), np.array(sd), moments)


@check_arguments
@dataclass(frozen=True)
class StaticErrors(QuantityErrors):
    """The displacement under a static load. Its error is Gaussian.

    Attributes
    ----------
    force : tuple of (place, direction)
        Place and direction of the load, written like a sensor.
    load : float, N (N·m about rx, ry, rz)
        The load, positive along the direction.
    displacement : float, m (rad about rx, ry, rz)
        The measured displacement.
    sd : float, m (rad)
        Standard deviation of the displacement.
    at : tuple of (place, direction), optional
        Place and direction of the displacement; by default, the load's place and direction.
    test : str, optional
        If there are several tests, the name of the test in which the displacement was measured. The displacement
        is computed with that test's changes and parameters.

    Raises
    ------
    ValueError
        If the load or the displacement is not finite, the load is zero, or the standard deviation is not positive
        and finite.
    """

    force: tuple[int | str, str]
    load: float
    displacement: float
    sd: Positive  # type: ignore[misc]  # a setting here
    at: tuple[int | str, str] | None = None
    test: str | None = None

    def __post_init__(self) -> None:
        for name in ("load", "displacement"):
            value = getattr(self, name)
            if not np.isfinite(value) or (name == "load" and value == 0.0):
                raise ArgumentError(name, f"must be a finite number{', not 0' * (name == 'load')}", value)

    def at_places(self, places: Mapping[str, Any]) -> StaticErrors:
        """Return the same settings with place names replaced by nodes of the model; other names are kept."""

        def replace_name(place: tuple[int | str, str]) -> tuple[Any, str]:
            return places.get(str(place[0]), place[0]), place[1]

        return replace(self, force=replace_name(self.force), at=None if self.at is None else replace_name(self.at))

    def bind_structure(self, model: SeparableModel, parameters: Sequence[Parameter]) -> QuantityTerm:
        """Bind the static displacement to a structure; see `QuantityErrors.bind_structure`.

        Raise ValueError if the place or direction of the load or of the displacement is not free to move, the
        stiffness is not positive definite, or the displacement from a reduced stiffness does not converge.
        """
        at = self.force if self.at is None else self.at
        for key, sensor in (("force", self.force), ("at", at)):
            if not model.sees(sensor):
                raise ArgumentError(key, "must be a place and a direction that are free to move", list(sensor))
        prior, rng = JointPrior(parameters), np.random.default_rng(0)
        lower, upper = (np.array([getattr(p, end) for p in parameters]) for end in ("lower", "upper"))

        def points(n: int) -> FloatArray:
            """Return n prior draws, (n, p). Every second draw is moved to a corner of the finite bounds."""
            drawn = prior.draw(rng, n)
            ends = np.where(rng.random(drawn.shape) < 0.5, lower, upper)
            corner = (np.arange(n) % 2 == 1)[:, None] & np.isfinite(ends)
            return np.where(corner, ends, drawn)

        displacement = StaticDisplacement(model, self.force, self.load, at, points)
        label = f"displacement of {at[0]} {at[1]}"
        unit = "rad" if at[1].lstrip("-").startswith("r") else "m"
        return QuantityTerm((label,), (unit,), np.array([self.displacement]), np.array([self.sd]), displacement)
