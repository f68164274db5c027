"""``[plan]``: a modal test that is planned."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from fmu.arguments import ArgumentError
from fmu.config.mistakes import BrokenError
from fmu.config.parameters import PriorTable
from fmu.config.tables import Built, Name, NumberOrNumbers, ParameterName, Positive, SensorTable, TomlTable
from fmu.config.tests import AddedMass, AddedSpring
from fmu.fem.modes.changes import Change
from fmu.formats.modes.measured_modes import MOST_MODES
from fmu.posterior.joint.damage_target import DamageTarget
from fmu.types import Dof

_MOST_CANDIDATES = 100_000
_MODES = 6
ModeNumber = Annotated[int, Field(ge=1, le=MOST_MODES)]


class ChangeTable(TomlTable):
    """A known change of the structure for a second test."""

    name: ParameterName
    masses: list[AddedMass] = []
    springs: list[AddedSpring] = []


class DamageTargetTable(TomlTable):
    """A decision about damage that a test is for: whether a parameter has lost more than a share of its value."""

    of: Annotated[list[Name], Field(min_length=1)]
    """Parameters with ``varies = "damage"`` or by group; with one test, those that may lose stiffness after it."""
    beyond: Annotated[float, Field(gt=0, lt=0.5)]
    """The loss that matters, such as 0.1."""
    prior: PriorTable | None = None
    """With one test: prior of each loss, by default normal with mean 0 and sd 0.3, between −0.5 and 0.95."""

    def build(self) -> DamageTarget:
        """Return the target."""
        return DamageTarget(self.of, self.beyond, None if self.prior is None else self.prior.build())


class PlanTable(TomlTable):
    """A modal test that is planned: places of sensors, modes, errors and the target."""

    sensors: Annotated[int, Field(ge=1)] = 12
    """Number of sensors to choose, besides those that are mounted."""
    candidates: Annotated[list[SensorTable], Field(max_length=_MOST_CANDIDATES)] | None = None
    """Place and direction of each candidate; all translations of all nodes in ``directions`` if not given."""
    directions: Annotated[list[Literal["x", "y", "z"]], Field(min_length=1)] = ["x", "y", "z"]
    """Directions of candidates, where these are not given."""
    triaxial: bool = False
    """Whether one sensor reads all candidate directions of its place."""
    mounted: list[SensorTable] = []
    """Sensors that stay where they are."""
    exclude: list[int | str] = []
    """Places out of reach."""
    min_distance: Annotated[float, Field(ge=0)] = 0.0
    """Smallest distance of two sensors, m."""
    costs: dict[Name, Positive] = {}
    """Cost of a sensor by its place; 1 elsewhere."""
    budget: Positive | None = None
    """Largest total cost of the chosen sensors."""
    modes: Annotated[int, Field(ge=1, le=MOST_MODES)] | Annotated[list[ModeNumber], Field(min_length=1)] | None = (
        None
    )
    """Number of modes to be measured, the lowest elastic ones that candidates see; or their numbers, from 1."""
    frequency_sd: NumberOrNumbers | None = None
    """Relative standard deviation of the frequencies in one test: one, or one per mode."""
    shape_sd: Annotated[float, Field(gt=0, le=1)] = 0.02
    """Standard deviation of a component of a shape, relative to its largest component at the candidates."""
    drift: Annotated[float, Field(ge=0)] = 0.0
    """Relative standard deviation of the frequencies that repeated tests do not reduce."""
    target: list[Name] | dict[Name, float] | None = None
    """Parameters that the test is for, or the weights of a combination; all parameters alike if not given."""
    damage: DamageTargetTable | None = None
    """The decision about damage that the test is for, instead of a target."""
    like: ParameterName | None = None
    """With several tests, the one that the planned test resembles in its group and its changes; the last if not
    given."""
    changes: list[ChangeTable] = []
    """Known changes of the structure, one of which a second test may have."""

    @model_validator(mode="after")
    def _has_one_target(self) -> Self:
        if self.damage is not None and self.target is not None:
            raise ArgumentError("damage", "must not be given with target; delete one of them")
        return self

    @property
    def key_of_target(self) -> str:
        """The key of the target in the problem file, for messages."""
        return "plan.target" if self.damage is None else "plan.damage"

    def count_modes(self) -> int:
        """Return the number of the highest mode to be measured."""
        return _MODES if self.modes is None else self.modes if isinstance(self.modes, int) else max(self.modes)

    def all_sensors(self, built: Built) -> tuple[Dof, ...]:
        """Return the candidates and the mounted sensors of a model that has no list of its own.

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
        """Return the arguments of `fmu.plan` other than the problem."""
        given = None if self.candidates is None else _sensors(self.candidates, built)
        if given is None and built.separable is not None:
            given = [dof for dof in built.separable.dofs if dof[1] in self.directions]
            given = given if set(self.directions) < {"x", "y", "z"} else None
        changes = {
            one.name: Change(
                {built.at(mass.place): mass.mass for mass in one.masses},
                {(built.at(spring.place), spring.direction): spring.stiffness for spring in one.springs},
            )
            for one in self.changes
        }
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
            "changes": changes,
        }


def _sensors(given: list[list[int | str]], built: Built) -> list[Dof]:
    return [(built.at(place), str(direction)) for place, direction in given]
