"""``[plan]``: a planned modal test."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from fmu.arguments import ArgumentError
from fmu.config.mistakes import BrokenError
from fmu.config.parameters import PriorTable
from fmu.config.tables import Built, Name, NumberOrNumbers, ParameterName, Positive, SensorTable, TomlTable
from fmu.config.tests import AddedMass, AddedSpring, build_change
from fmu.formats.modes.measured_modes import MOST_MODES
from fmu.posterior.joint.damage_target import DamageTarget
from fmu.types import Dof

_MOST_CANDIDATES = 100_000
_MODES = 6
ModeNumber = Annotated[int, Field(ge=1, le=MOST_MODES)]


class ChangeTable(TomlTable):
    """A known change made to the structure for a second test."""

    name: ParameterName
    masses: list[AddedMass] = []
    springs: list[AddedSpring] = []


class DamageTargetTable(TomlTable):
    """The decision that the test supports: whether a parameter has dropped by more than a given fraction."""

    of: Annotated[list[Name], Field(min_length=1)]
    """Parameters that vary with ``varies = "damage"`` or by group; with one test, those that may lose stiffness
    after it."""
    beyond: Annotated[float, Field(gt=0, lt=0.5)]
    """The loss that matters, such as 0.1."""
    prior: PriorTable | None = None
    """With one test: prior of each loss, by default normal with mean 0 and sd 0.3, between −0.5 and 0.95."""

    def build(self) -> DamageTarget:
        """Return the damage target described by this table."""
        return DamageTarget(self.of, self.beyond, None if self.prior is None else self.prior.build())


class PlanTable(TomlTable):
    """A planned modal test: sensor positions, modes, errors and the target."""

    sensors: Annotated[int, Field(ge=1)] = 12
    """Number of sensors to choose, in addition to those already mounted."""
    candidates: Annotated[list[SensorTable], Field(max_length=_MOST_CANDIDATES)] | None = None
    """Place and direction of each candidate sensor; if not given, all translations of all nodes in
    ``directions``."""
    directions: Annotated[list[Literal["x", "y", "z"]], Field(min_length=1)] = ["x", "y", "z"]
    """Directions of the candidates, if these are not given."""
    triaxial: bool = False
    """Whether one sensor measures all candidate directions at its place."""
    mounted: list[SensorTable] = []
    """Sensors that are already in place and stay there."""
    exclude: list[int | str] = []
    """Places that cannot be reached."""
    min_distance: Annotated[float, Field(ge=0)] = 0.0
    """Smallest distance between two sensors in m."""
    costs: dict[Name, Positive] = {}
    """Cost of a sensor at each place; 1 at other places."""
    budget: Positive | None = None
    """Largest total cost of the chosen sensors."""
    modes: Annotated[int, Field(ge=1, le=MOST_MODES)] | Annotated[list[ModeNumber], Field(min_length=1)] | None = (
        None
    )
    """Number of modes to be measured (the lowest elastic modes that move a candidate), or a list of their numbers
    from 1."""
    frequency_sd: NumberOrNumbers | None = None
    """Relative standard deviation of the frequencies in one test: one for all modes, or one per mode."""
    shape_sd: Annotated[float, Field(gt=0, le=1)] = 0.02
    """Standard deviation of the components of a shape, relative to its largest component at the candidates."""
    drift: Annotated[float, Field(ge=0)] = 0.0
    """Relative standard deviation of the frequency errors that repeating the test does not reduce."""
    target: list[Name] | dict[Name, float] | None = None
    """Parameters that the test is for, or the weights of a linear combination; all parameters equally if not
    given."""
    damage: DamageTargetTable | None = None
    """The decision about damage that the test is for, instead of a target."""
    like: ParameterName | None = None
    """With several tests, the test whose group and changes the planned test shares; the last test if not given."""
    changes: list[ChangeTable] = []
    """Known changes to the structure, one of which a second test may have."""

    @model_validator(mode="after")
    def _has_one_target(self) -> Self:
        if self.damage is not None and self.target is not None:
            raise ArgumentError("damage", "must not be given with target; delete one of them")
        return self

    def locate(self, error: ArgumentError) -> ArgumentError:
        """Return an error of `fmu.plan` with its key as in the problem file, if the key is one of this table."""
        error = error if self.damage is None else error.replace_key("target", "damage")
        return error.under("plan") if error.key.split(".")[0] in type(self).model_fields else error

    def count_modes(self) -> int:
        """Return the number of the highest mode to be measured: 6 if ``modes`` is not given."""
        return _MODES if self.modes is None else self.modes if isinstance(self.modes, int) else max(self.modes)

    def all_sensors(self, built: Built) -> tuple[Dof, ...]:
        """Return the candidate and mounted sensors, each only once.

        This is used for a model that does not list its degrees of freedom.

        Raises
        ------
        BrokenError
            If no candidates are given.
        """
        if self.candidates is None:
            rule = "must be given for this type of model, in the order of the rows of its shapes"
            raise BrokenError(ArgumentError("plan.candidates", rule))
        every = _sensors(self.candidates, built) + _sensors(self.mounted, built)
        return tuple(dict.fromkeys(every))

    def options(self, built: Built) -> dict[str, Any]:
        """Return the arguments for `fmu.plan` that this table gives."""
        given = None if self.candidates is None else _sensors(self.candidates, built)
        if given is None and built.separable is not None:
            given = [
                dof for dof in built.separable.dofs if dof[1] in self.directions and built.separable.sees(dof)
            ]
            given = given if set(self.directions) < {"x", "y", "z"} else None
        return {
            "sensors": self.sensors,
            "candidates": given,
            "triaxial": self.triaxial,
            "mounted": _sensors(self.mounted, built),
            "exclude": [built.at(place) for place in self.exclude],
            "min_distance": self.min_distance,
            "costs": {built.at(int(place) if place.isdecimal() else place): x for place, x in self.costs.items()},
            "budget": self.budget,
            "modes": self.modes,
            "frequency_sd": self.frequency_sd,
            "shape_sd": self.shape_sd,
            "drift": self.drift,
            "target": self.target if self.damage is None else self.damage.build(),
            "place_names": {place: name for name, place in built.places.items()},
            "like": self.like,
            "changes": {one.name: build_change(one.masses, one.springs, built) for one in self.changes},
        }


def _sensors(given: list[list[int | str]], built: Built) -> list[Dof]:
    return [(built.at(place), str(direction)) for place, direction in given]
