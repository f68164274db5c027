"""``[[parameters]]`` and ``[[noise]]``: uncertain quantities and their priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from fmu.arguments import ArgumentError
from fmu.config.mistakes import Mistakes
from fmu.config.tables import (
    Declared,
    Name,
    NotNegative,
    OneOf,
    ParameterName,
    Positive,
    TomlTable,
    build_value,
    kind_of,
)
from fmu.fem.frame.updates import PROPERTIES
from fmu.formats.shown import quote
from fmu.posterior.joint.outliers import Outliers
from fmu.posterior.joint.varies import Variation
from fmu.posterior.joint.varies.damage import Damage
from fmu.posterior.joint.varies.laws import Law, PiecewiseLinear, Polynomial
from fmu.posterior.joint.varies.population import Population
from fmu.posterior.joint.varies.undated import UndatedDamage
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors import PRIORS
from fmu.posterior.priors.base import Prior
from fmu.types import Direction

LEAST_LOG_MASS = -200.0
"""Smallest log-probability that a prior may have between the bounds; bounds 20 standard deviations away are
typos."""
KEYS = dict.fromkeys(PROPERTIES, "groups") | {"mass": "masses", "inertia": "masses", "stiffness": "springs"}
"""For each property, the key of a parameter's table that lists its groups, masses or springs."""


class Target(TomlTable):
    """The frame quantities that a parameter sets or multiplies.

    Each quantity is the ``property`` of the members in one of the ``groups`` (``"all"`` means all groups), of one
    of the ``masses`` or of one of the ``springs``. For masses and springs, ``directions`` can limit the inertia or
    stiffness to some directions.
    """

    property: Literal["E", "rho", "A", "Iy", "Iz", "J", "mass", "inertia", "stiffness"] | None = None
    groups: list[Name] | Literal["all"] = []
    masses: list[Name] = []
    springs: list[Name] = []
    directions: list[Direction] = []
    scaling: Literal["absolute", "factor"] = "absolute"

    def names_at(self, key: str, groups: Sequence[str] = ()) -> list[str]:
        """Return the names listed under `key` ("groups", "masses" or "springs"), or all `groups` for ``"all"``."""
        names = {"groups": self.groups, "masses": self.masses, "springs": self.springs}[key]
        return list(groups) if names == "all" else list(names)


class Uncertain(TomlTable):
    """An uncertain quantity with bounds and a prior."""

    name: ParameterName
    """Name in tables and figures."""
    start: float
    """Value before updating."""
    lower: float | None = None
    """Lower bound. Bounds truncate the prior; a uniform prior needs both."""
    upper: float | None = None
    """Upper bound. Bounds truncate the prior; a uniform prior needs both."""
    unit: str = ""
    """SI unit, for labels."""
    prior: Annotated[Declared, OneOf("distribution", PRIORS)] = Field(
        {"distribution": "uniform"}, validate_default=True
    )
    """Prior distribution: knowledge before the measurement."""

    def build(self) -> Parameter:
        """Return the parameter described by this table.

        Raises
        ------
        ValueError
            If bounds, start and prior are inconsistent.
        """
        if self.prior.called == "truncated-normal" and self.lower is None and self.upper is None:
            raise ArgumentError("prior", "a truncated normal needs lower or upper")
        lower = -np.inf if self.lower is None else self.lower
        upper = np.inf if self.upper is None else self.upper
        parameter = Parameter(self.name, self.start, lower, upper, self.prior.build(), self.unit)
        log_mass = parameter.prior.log_mass(lower, upper)
        if log_mass < LEAST_LOG_MASS:
            power = f"1e{log_mass / np.log(10.0):.0f}"
            raise ArgumentError("prior", "must have probability between the bounds", power)
        return parameter


PriorTable = Annotated[Declared, OneOf("distribution", PRIORS)]


def _kind_of_time(value: object) -> str:
    return {"<table>": "<table>", "<text>": "<word>"}.get(kind_of(value) or "", "<number>")


class PopulationTable(TomlTable):
    """The distribution of a parameter over several tests. Its mean and standard deviation are inferred."""

    distribution: Literal["normal", "log-normal"] = "normal"
    """Distribution of the values in the tests, truncated at the bounds."""
    sd: PriorTable | None = None
    """Prior of the standard deviation of the values, or of their logarithms; half-normal if not given."""
    between: PriorTable | None = None
    """Prior of the relative standard deviation between groups of tests, in addition to the one within groups."""
    sd_by_group: bool = False
    """Whether each group of tests has its own standard deviation."""
    correlation_time: (
        Annotated[
            Annotated[Literal["inferred"], Tag("<word>")]
            | Annotated[Positive, Tag("<number>")]
            | Annotated[Declared, OneOf("distribution", PRIORS), Tag("<table>")],
            Discriminator(_kind_of_time),
        ]
        | None
    ) = None
    """Time over which the values are correlated: a number, "inferred", or the prior of an inferred time."""
    by: Name | None = None
    """The covariate that serves as time, different in each test; the order of the tests if not given."""

    def build(self) -> Population:
        """Return the population described by this table."""
        sd, between = (None if prior is None else prior.build() for prior in (self.sd, self.between))
        how = build_value(self.correlation_time)
        return Population(self.distribution, sd, between, self.sd_by_group, how, self.by or "")


class OutliersTable(TomlTable):
    """Tests whose parameters may be outliers of their populations."""

    share: Annotated[
        Annotated[float, Tag("<number>")]
        | Annotated[Declared, OneOf("distribution", {"beta": PRIORS["beta"]}), Tag("<table>")],
        Discriminator(lambda value: "<table>" if kind_of(value) == "<table>" else "<number>"),
    ] = 0.05
    """Probability that a test is an outlier, or the prior of an inferred probability, distribution = "beta" on [0,
    1]."""
    scale: float = 5.0
    """Standard deviation of the values of outliers, relative to the standard deviation of the other values."""

    def build(self) -> Outliers:
        """Return the outlier model described by this table."""
        return Outliers(build_value(self.share), self.scale)

    @model_validator(mode="after")
    def _can_be_built(self) -> Self:
        self.build()
        return self


class PolynomialTable(TomlTable):
    """A polynomial in a covariate that is centred on its mean over the tests."""

    law: Literal["polynomial"]
    priors: list[PriorTable]
    """Priors of the coefficients of x, x², …, in units of 1/x, 1/x², …"""

    def build(self) -> Polynomial:
        """Return the polynomial described by this table."""
        return Polynomial([prior.build() for prior in self.priors])

    @model_validator(mode="after")
    def _can_be_built(self) -> Self:
        self.build()
        return self


class PiecewiseLinearTable(TomlTable):
    """A continuous, piecewise linear function of a covariate."""

    law: Literal["piecewise-linear"]
    prior: PriorTable
    """Prior of the relative slope of each segment."""
    kinks: Annotated[
        Annotated[list[float], Tag("<list>")] | Annotated[PriorTable, Tag("<table>")],
        Discriminator(lambda value: "<list>" if isinstance(value, list) else "<table>"),
    ]
    """Values of the covariate at the kinks, in ascending order; or the prior of the position of a single inferred
    kink."""

    def build(self) -> PiecewiseLinear:
        """Return the function described by this table."""
        return PiecewiseLinear(self.prior.build(), build_value(self.kinks))

    @model_validator(mode="after")
    def _can_be_built(self) -> Self:
        self.build()
        return self


LawTable = Annotated[PolynomialTable | PiecewiseLinearTable, Field(discriminator="law")]


def _kind_of_slope(value: object) -> str:
    if kind_of(value) == "<text>":
        return "<text>"
    return "<law>" if isinstance(value, dict) and "law" in value else "<prior>"


SlopeTable = Annotated[
    Annotated[PriorTable, Tag("<prior>")] | Annotated[LawTable, Tag("<law>")] | Annotated[Name, Tag("<text>")],
    Discriminator(_kind_of_slope),
]
"""A prior of a relative slope, a law, or the name of another parameter with the same law."""


class OnsetTable(TomlTable):
    """The unknown date at which damage began, and whether the damage has grown since then."""

    by: Annotated[str, Field(max_length=100)] = ""
    """The covariate that serves as time, such as "day"; the order of the tests if not given."""
    grows: bool = False
    """Whether the loss grows linearly with time after the date."""
    date: PriorTable | None = None
    """Prior of the date, in the unit of the time. If not given, uniform between the first and the last test, or
    the last but one if the loss grows."""
    event: Name = "damage"
    """Parameters with the same event have the same date, and must have the same by, grows and date."""


SETTINGS = {
    "population": ("population", "damage", "undated-damage"),
    "loss": ("damage", "undated-damage"),
    "onset": ("undated-damage",),
}
"""For each key that sets how a parameter varies, the values of ``varies`` with which it is allowed."""


class ParameterTable(Uncertain, Target):
    """A parameter and, for a frame, the quantities that it updates."""

    updated: bool = True
    """false fixes the parameter at its starting value. It may still scatter over the modes with [[discrepancy]];
    its bounds and prior only determine where a reduced model must be accurate."""
    varies: Literal["shared", "test", "group", "population", "damage", "undated-damage"] | None = None
    """With [[tests]]: one value for all tests, one per test or group, values from a population, losses in later
    groups, or a loss from an unknown date."""
    population: PopulationTable | None = None
    """With varies = "population"; or with damage, if the undamaged value scatters from test to test."""
    slopes: dict[Name, SlopeTable] = {}
    """With [[tests]]: priors of the relative slopes with respect to covariates, such as { temperature = … } in
    1/°C; or a law with kinks or powers; or the name of a parameter that has the same slopes."""
    loss: PriorTable | None = None
    """With varies = "damage" or "undated-damage": prior of each loss; normal with mean 0 and sd 0.3 if not given.
    If few parameters are expected to be damaged, use distribution = "spike-and-slab"."""
    onset: OnsetTable | None = None
    """With varies = "undated-damage": the covariate that serves as time, the prior of the date, and whether the
    loss grows."""

    @model_validator(mode="after")
    def _what_varies(self) -> Self:
        for key, kinds in SETTINGS.items():
            if key in self.model_fields_set and self.varies not in kinds:
                ways = " or ".join(f'"{kind}"' for kind in kinds)
                raise ArgumentError(key, f"must be given with varies = {ways}", self.varies)
        return self

    def variation(self) -> str | Variation | None:
        """Return the variation of the parameter between tests, or None if the file does not specify it.

        The variation is a `Variation` object, or one of the words ``"shared"``, ``"test"`` and ``"group"``.
        """
        if self.varies == "population":
            return (self.population or PopulationTable()).build()
        loss = None if self.loss is None else self.loss.build()
        scatter = None if self.population is None else self.population.build()
        if self.varies == "damage":
            return Damage(loss, scatter)
        if self.varies == "undated-damage":
            onset = self.onset or OnsetTable()
            date = None if onset.date is None else onset.date.build()
            return UndatedDamage(loss, onset.by, onset.grows, date, onset.event, scatter)
        return self.varies

    def laws(self) -> dict[str, Prior | Law | str]:
        """Return the parameter's dependence on each covariate, keyed by covariate name.

        The dependence is the prior of a relative slope, a law, or the name of another parameter with the same
        slopes.
        """
        return {name: how if isinstance(how, str) else how.build() for name, how in self.slopes.items()}

    def build(self) -> Parameter:
        """Return the parameter described by this table; see `Uncertain.build`."""
        return replace(super().build(), updated=self.updated)

    def is_positive(self) -> bool:
        """Return True if the bounds or the prior ensure that the parameter is positive.

        Only the lower bound counts if the table is invalid.
        """
        try:
            return self.build().lowest > 0.0
        except ValueError:  # this error is reported separately
            return self.lower is not None and self.lower > 0.0


class NoiseTable(Uncertain):
    """A standard deviation to be inferred; error models refer to it by name."""

    start: Positive
    lower: NotNegative = 0.0
    upper: Positive | None = None


def build_parameters(
    key: str, tables: Sequence[Uncertain], taken: Sequence[str] = ()
) -> tuple[dict[str, Parameter], list[ArgumentError]]:
    """Return the parameters, keyed by name in file order, and the errors found in their tables.

    A table that cannot be built gives no parameter.

    Parameters
    ----------
    key : str
        Key of the tables in the file.
    tables : sequence of Uncertain
    taken : sequence of str
        Names of other parameters, which must not be used again.
    """
    parameters: dict[str, Parameter] = {}
    found, names = Mistakes(), list(taken)
    for i, table in enumerate(tables):
        if table.name in names:
            found.add(f"{key}.{i}.name", "must not be the name of another parameter", quote(table.name))
        names.append(table.name)
        try:
            parameters[table.name] = table.build()
        except ValueError as error:
            found.append(ArgumentError.of(error).replace_key(table.name, "").under(f"{key}.{i}"))
    return parameters, found


def of_several_tests(tables: Sequence[ParameterTable]) -> list[ArgumentError]:
    """Return an error for each key that is allowed only if there are several tests."""
    return [
        ArgumentError(f"parameters.{i}.{key}", "is allowed with several [[tests]] only")
        for i, table in enumerate(tables)
        for key in ParameterTable.__annotations__  # without the keys of the base classes, allowed for one test too
        if key in table.model_fields_set and key != "updated"
    ]


class ModelTable(TomlTable):
    """Base class for the model tables. Most of them reject the parameter keys that apply only to frames."""

    @property
    def decks(self) -> list[str]:
        """Names of the input decks that are filled with parameter values; empty for models without decks."""
        return []

    def mistakes(self, parameters: Sequence[ParameterTable]) -> list[ArgumentError]:
        """Return an error for each parameter key that is allowed only for frames."""
        return [
            ArgumentError(f"parameters.{i}.{key}", "is allowed for frames only")
            for i, table in enumerate(parameters)
            for key in Target.model_fields
            if key in table.model_fields_set
        ]
