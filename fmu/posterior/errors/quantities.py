"""Weighed masses and static displacements: data beside the modes, that separate stiffness from mass.

Frequencies alone fix ratios of stiffness to mass. A mass on a scale, a centre of gravity or a static deflection is
one more datum with a Gaussian error, whose computed value is an exact function of theta (`fmu.fem.modes.static`).
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
    """Measured quantities of a structure, and how they are computed.

    Attributes
    ----------
    labels, units : tuple of str
    measured, sd : ndarray, shape (q,)
    computed : callable
        Returns the values (n, q) at the model's parameters (n, n_structural), and if asked for their derivatives.
    test : int
        The test in which they were measured.
    """

    labels: tuple[str, ...]
    units: tuple[str, ...]
    measured: FloatArray
    sd: FloatArray
    computed: Any
    test: int = 0

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the log-densities, shape (n, q)."""
        z = (self.measured - self.computed(theta)[0]) / self.sd
        return np.asarray(-0.5 * z**2 - np.log(self.sd) - 0.5 * LOG_2PI)

    def residuals_and_slopes(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (computed − measured)/sd, (n, q), and the derivatives, (n, q, n_structural)."""
        values, slopes = self.computed(theta, True)
        return (values - self.measured) / self.sd, slopes / self.sd[:, None]

    def as_dict(self) -> dict[str, Plain]:
        """Return labels, units, values and deviations, in plain Python types."""
        return {
            "error": "quantity",
            "labels": list(self.labels),
            "units": list(self.units),
            "measured": self.measured.tolist(),
            "sd": self.sd.tolist(),
        }


class QuantityErrors:
    """Settings of the errors of quantities that are not of modes."""

    sd: ClassVar[Any] = None
    test: str | None

    def bind(self, data: ModalData, index: NoiseIndex) -> ErrorTerm:
        """Raise ValueError: these errors are of the structure, see `bind_structure`."""
        raise ArgumentError("error", f"{type(self).__name__} must be given to a problem of a SeparableModel")

    def n_errors(self, data: ModalData) -> int:
        """Return 0: no errors of modes."""
        return 0

    def data_give_sd(self, data: ModalData) -> bool:
        """Say no: `data` are of modes."""
        return False

    def at_places(self, places: Mapping[str, Any]) -> Self:
        """Return the same with nodes of the model in place of the names that a file has for them."""
        return self

    def bind_structure(self, model: SeparableModel, parameters: Sequence[Parameter]) -> QuantityTerm:
        """Return the quantities of a structure with its parameters.

        Raises
        ------
        ValueError
            If the model cannot give them.
        """
        raise NotImplementedError


@check_arguments
@dataclass(frozen=True)
class MassErrors(QuantityErrors):
    """The weighed mass of the structure, and its centre of gravity if that was found, with Gaussian errors.

    Attributes
    ----------
    mass : float, kg
        As weighed.
    sd : float, kg
        Its standard deviation.
    centre : tuple of float, length 3, optional, m
        The centre of gravity, in the axes of the model, which needs the coordinates of all nodes.
    centre_sd : float, optional, m
        Standard deviation of each of its coordinates.
    at_supports : float, kg
        Mass that the model leaves out because supports hold it still, such as half of the lowest columns. It was
        weighed too. 0 for a free structure. A centre of gravity must be of the rest.
    test : str, optional
        Of several tests, the name of the one in which it was measured, and whose changes and parameters it has.

    Raises
    ------
    ValueError
        If `at_supports` is negative or not below the mass, the centre is not three finite numbers, or only one of
        `centre` and `centre_sd` is given.
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
        """Return mass and centre of a structure, see `QuantityErrors`."""
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
    """The displacement under a static load, with a Gaussian error.

    Attributes
    ----------
    force : tuple of (place, direction)
        Where the load acts, as a sensor is named.
    load : float, N (N·m along rx, ry, rz)
        The load, positive along the direction.
    displacement : float, m (rad along rx, ry, rz)
        As measured.
    sd : float, m (rad)
        Its standard deviation.
    at : tuple of (place, direction), optional
        Where it was measured; where the load acts if not given.
    test : str, optional
        Of several tests, the name of the one in which it was measured, and whose changes and parameters it has.

    Raises
    ------
    ValueError
        If the load or the displacement is not finite, or the load is zero.
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
        """Return the same with nodes of the model in place of the names that a file has for them."""

        def replace_name(place: tuple[int | str, str]) -> tuple[Any, str]:
            return places.get(str(place[0]), place[0]), place[1]

        return replace(self, force=replace_name(self.force), at=None if self.at is None else replace_name(self.at))

    def bind_structure(self, model: SeparableModel, parameters: Sequence[Parameter]) -> QuantityTerm:
        """Return the displacement of a structure, see `QuantityErrors`."""
        at = self.force if self.at is None else self.at
        for key, sensor in (("force", self.force), ("at", at)):
            if not model.sees(sensor):
                raise ArgumentError(key, "must be a place and a direction that are free to move", list(sensor))
        prior, rng = JointPrior(parameters), np.random.default_rng(0)
        lower, upper = (np.array([getattr(p, end) for p in parameters]) for end in ("lower", "upper"))

        def points(n: int) -> FloatArray:
            """Draw from the prior, every other point moved to a corner of the bounds where these are finite."""
            drawn = prior.draw(rng, n)
            ends = np.where(rng.random(drawn.shape) < 0.5, lower, upper)
            corner = (np.arange(n) % 2 == 1)[:, None] & np.isfinite(ends)
            return np.where(corner, ends, drawn)

        displacement = StaticDisplacement(model, self.force, self.load, at, points)
        label = f"displacement of {at[0]} {at[1]}"
        unit = "rad" if at[1].lstrip("-").startswith("r") else "m"
        return QuantityTerm((label,), (unit,), np.array([self.displacement]), np.array([self.sd]), displacement)
