"""``[[tests]]``: several tests of one structure, and the differences between them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from fmu.arguments import ArgumentError
from fmu.config.measurement import MeasurementTable
from fmu.config.mistakes import BrokenError, Mistakes
from fmu.config.parameters import ParameterTable
from fmu.config.tables import Built, Name, ParameterName, TomlTable
from fmu.posterior.joint.modal_test import Test, TestsError
from fmu.posterior.joint.varies import Variation
from fmu.posterior.priors.base import Prior
from fmu.types import Direction

MOST_TESTS = 2000


class AddedMass(TomlTable):
    """A point mass that was added for a test; a negative one was taken away."""

    place: int | str
    """Node or named place."""
    mass: float
    """kg"""


class AddedSpring(TomlTable):
    """A spring to the ground that was added for a test; a negative one was taken away."""

    place: int | str
    """Node or named place."""
    direction: Direction
    stiffness: float
    """N/m or N·m/rad"""


class TestTable(MeasurementTable):
    """One of several tests: its modes, as in ``[measurement]``, and what is known to differ in it."""

    __test__ = False

    name: ParameterName
    """For tables and figures."""
    group: Annotated[str, Field(max_length=100)] = ""
    """State, place or season that several tests share."""
    covariates: dict[Name, float] = {}
    """What may have changed the structure, such as the temperature."""
    masses: list[AddedMass] = []
    springs: list[AddedSpring] = []
    known: dict[Name, float] = {}
    """Parameters whose values are known in this test."""

    def test(self, number: int, folder: Path, built: Built, needs_trust: bool) -> Test:
        """Return the test; BrokenError, with locations in the file, if it cannot be built."""
        where = f"tests.{number}"
        try:
            data = self.build(folder, built, needs_trust)
        except BrokenError as error:
            raise BrokenError(*(mistake.replace_key("measurement", where) for mistake in error.mistakes)) from None
        if self.beta is not None:
            data = type(data)(**{**vars(data), "sd_hz": np.sqrt(0.5 / np.asarray(self.beta))})
        try:
            return Test(
                self.name,
                data,
                self.group,
                dict(self.covariates),
                {built.at(one.place): one.mass for one in self.masses},
                {(built.at(one.place), one.direction): one.stiffness for one in self.springs},
                dict(self.known),
            )
        except ValueError as error:
            raise BrokenError(ArgumentError.of(error).under(where)) from None


def build_tests(
    tables: Sequence[TestTable], folder: Path, built: Built, needs_trust: bool
) -> tuple[list[Test], list[ArgumentError]]:
    """Return the list of tests, and the list of errors in their tables."""
    tests: list[Test] = []
    found: list[ArgumentError] = []
    for number, table in enumerate(tables):
        try:
            tests.append(table.test(number, folder, built, needs_trust))
        except BrokenError as error:
            found += error.mistakes
    return tests, found


def variations(
    tables: Sequence[ParameterTable],
) -> tuple[dict[str, str | Variation], dict[str, dict[str, Prior]]]:
    """Return the dicts `varies` and `slopes` that `fmu.JointProblem` takes as arguments."""
    varies = {table.name: how for table in tables if (how := table.variation()) is not None}
    slopes = {t.name: {name: prior.build() for name, prior in t.slopes.items()} for t in tables if t.slopes}
    return varies, slopes


def in_the_file(error: TestsError, tables: Sequence[ParameterTable]) -> list[ArgumentError]:
    """Return the list of errors of inconsistent tests, with their locations in the file."""
    number = {table.name: i for i, table in enumerate(tables)}
    found = Mistakes()
    for said in error.mistakes:
        where, _, rule = said.partition(": ")
        key, _, name = where.partition(".")
        at = f"parameters.{number[name]}.{key}" if key in ("varies", "slopes") and name in number else where
        found.add(at, rule)
    return found
