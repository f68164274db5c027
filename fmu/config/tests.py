"""``[[tests]]``: several tests on one structure, and the differences between them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from fmu.arguments import ArgumentError
from fmu.config.errors import with_trust
from fmu.config.frf.errors import FRFTable, FRFWindow
from fmu.config.measurement import MeasurementTable, ModesGiven
from fmu.config.mistakes import BrokenError, Mistakes
from fmu.config.parameters import NoiseTable, ParameterTable, PriorTable
from fmu.config.tables import Built, FileName, Name, ParameterName, TomlTable, build_value, kind_of, reading
from fmu.fem.modes.changes import Change
from fmu.formats.modes.csv import Campaign, read_campaign
from fmu.formats.modes.measured_modes import MeasuredModes, ModesError, Place, Sensors
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.frf.errors import FRFErrors
from fmu.posterior.joint.modal_test import Test, TestsError
from fmu.posterior.joint.varies import Variation
from fmu.posterior.joint.varies.laws import Law
from fmu.posterior.priors.base import Prior
from fmu.types import Direction

MOST_TESTS = 2000
_OF_TEST = re.compile(r"\btests\.(\d+)\b")


class AddedMass(TomlTable):
    """A point mass that was added for a test, or removed if the mass is negative."""

    place: int | str
    """Node or named place."""
    mass: float
    """kg"""


class AddedSpring(TomlTable):
    """A spring to the ground that was added for a test, or removed if the stiffness is negative."""

    place: int | str
    """Node or named place."""
    direction: Direction
    stiffness: float
    """N/m or N·m/rad"""


def build_change(masses: Sequence[AddedMass], springs: Sequence[AddedSpring], built: Built) -> Change:
    """Return the change made to the structure. Several masses or springs at one place and direction add up."""
    of_masses: dict[Place, float] = {}
    of_springs: dict[tuple[Place, str], float] = {}
    for mass in masses:
        place = built.at(mass.place)
        of_masses[place] = of_masses.get(place, 0.0) + mass.mass
    for spring in springs:
        end = built.at(spring.place), spring.direction
        of_springs[end] = of_springs.get(end, 0.0) + spring.stiffness
    return Change(of_masses, of_springs)


CovariateValue = Annotated[
    Annotated[float, Tag("<number>")]
    | Annotated[Literal["missing"], Tag("<text>")]
    | Annotated[PriorTable, Tag("<table>")],
    Discriminator(kind_of),
]


def _known_or_inferred(given: CovariateValue | None) -> float | Prior | None:
    """Return a covariate in the form that `fmu.Test` accepts: a number, a prior, or None if it is missing."""
    found: float | Prior | None = None if given in (None, "missing") else build_value(given)
    return found


class TestTable(MeasurementTable):
    """One of several tests: its modes, as in ``[measurement]``, and its known differences from the other tests.

    With ``data``, the test has frequency response functions, and its modes are picked from them. With
    ``campaign``, the table describes all tests in a file; its other keys apply to each of them.
    """

    __test__ = False

    sources: ClassVar[tuple[str, ...]] = (*MeasurementTable.sources, "campaign", "data")
    name: ParameterName = ""
    """Name of the test in tables and figures."""
    campaign: FileName | None = None
    """CSV table of several tests, relative to this file: one row per test. Its columns are the name, the group
    (optional), the frequency of each mode in Hz with its label as header, empty or nan if the test missed the
    mode, and covariates such as the temperature, empty, nan or missing if not measured. ``labels`` lists the
    columns with modes."""
    data: FileName | None = None
    """File with this test's frequency response functions, relative to this file; the [[error]] table with of =
    "frf" says how to read it."""
    modes: list[Annotated[int, Field(ge=1)]] = []
    """With data: the mode number of each picked resonance, if it differs from the number in the [[error]]
    table."""
    window: FRFWindow = None
    """With data: the window and the length of its segments in s, if they differ from those in the [[error]] table.
    If other tests are of hammer hits, which have no window, give windows only in the tables of the tests that have
    one."""
    group: Annotated[str, Field(max_length=100)] = ""
    """State, place or season that several tests share."""
    covariates: dict[Name, CovariateValue] = {}
    """Conditions that may have changed the structure, such as the temperature: a number; if it is uncertain, a
    distribution such as { distribution = "normal", mean = 12.5, sd = 0.5 }; or "missing"."""
    masses: list[AddedMass] = []
    springs: list[AddedSpring] = []
    known: dict[Name, float] = {}
    """Parameters whose values in this test are known."""

    @model_validator(mode="after")
    def _is_test_or_campaign(self) -> Self:
        if self.campaign is None and not self.name:
            raise ArgumentError("name", "is missing")
        if self.campaign is not None and self.name:
            raise ArgumentError("name", "must not be given with campaign, whose table has the names", self.name)
        if self.campaign is not None and not self.labels:
            rule = "must be given with campaign, the headers of its columns with frequencies in the order of modes"
            raise ArgumentError("labels", rule, "none")
        if self.data is None and self.modes:
            raise ArgumentError("modes", "must be given with data, in which the modes are picked", self.modes)
        if self.data is None and self.window:
            raise ArgumentError("window", "must be given with data, which it smoothed", list(self.window))
        for key in sorted(self.model_fields_set & set(MeasurementTable.model_fields) if self.data else ()):
            raise ArgumentError(key, "must not be given with data, in which the modes are picked")
        return self

    def _count_modes(self) -> int | None:
        return len(self.labels) or None if self.campaign is not None else super()._count_modes()

    def _read_frequencies(self, folder: Path, options: Mapping[str, Sensors]) -> ModesGiven:
        if self.campaign is None:
            return super()._read_frequencies(folder, options)
        mean = np.nanmean(self._read_campaign(folder).frequencies_hz, axis=0)
        return ModesGiven(MeasuredModes(mean, tuple(self.labels)))

    def _read_campaign(self, folder: Path) -> Campaign:
        """Read the tests in the campaign file. Raise BrokenError if it has errors."""
        wrong: list[str] = []
        with reading("measurement.campaign"):
            try:
                found = read_campaign(folder / str(self.campaign), self.labels)
            except ModesError as error:
                wrong += error.mistakes
            else:
                wrong += self._find_mistakes(found)
        if wrong:
            raise BrokenError(*(ArgumentError("measurement.campaign", f"{self.campaign}, {one}") for one in wrong))
        return found

    def _find_mistakes(self, found: Campaign) -> list[str]:
        """Return error messages if a campaign file is implausible or contradicts this table."""
        missed = np.isnan(found.frequencies_hz).all(axis=0)
        rule = "must have a frequency in one line at least (got none); delete it here and in labels"
        wrong = [f"column {label}: {rule}" for label, none in zip(self.labels, missed, strict=True) if none]
        twice = [name for name in found.covariates[0] if name in self.covariates]
        twice += ["group"] if self.group and any(found.groups) else []
        wrong += [f"column {name}: must not be a key of [[tests]] too; delete one of them" for name in twice]
        rows = zip(found.frequencies_hz.tolist(), found.covariates, found.groups, strict=True)
        if len(found.lines) > 1 and len({str(row) for row in rows}) == 1:
            rule = "must differ (got the same numbers in all lines); give what was measured in each test"
            wrong.append(f"lines {found.lines[0]} to {found.lines[-1]}: {rule}")
        return wrong

    def build_all(
        self, number: int, folder: Path, built: Built, needs_trust: bool, of_frfs: OfFRFs | None
    ) -> list[PlacedTest]:
        """Build all tests described by this table. Raise BrokenError if they cannot be built.

        Parameters
        ----------
        number : int
            Index of this table in the file, from 0.
        folder, built
            See `MeasurementTable.build`.
        needs_trust : bool
            True if no error model applies to modes. Measured modes must then have an uncertainty. Modes picked
            from FRFs are marked as used in updating only if this is True.
        of_frfs : OfFRFs or None
            The FRF table and error models; None if there are no FRFs.
        """
        where = f"tests.{number}"
        try:
            data = (
                self.build(folder, built, needs_trust)
                if self.data is None
                else self._pick(built, needs_trust, of_frfs)
            )
            if self.beta is not None:
                data = with_trust(data, self.beta)
            if self.campaign is not None:
                return self._build_campaign(where, self._read_campaign(folder), data, built)
            return [PlacedTest(self._test(self.name, data, self.group, self.covariates, built), where)]
        except BrokenError as error:
            raise BrokenError(*(mistake.replace_key("measurement", where) for mistake in error.mistakes)) from None
        except ValueError as error:
            raise BrokenError(ArgumentError.of(error).under(where)) from None

    def _pick(self, built: Built, are_data: bool, of_frfs: OfFRFs | None) -> ModalData:
        """Pick the modes at the FRF resonances. They are used in updating only if `are_data` is True.

        Raise BrokenError if the resonances do not fit the model.
        """
        assert of_frfs is not None  # otherwise there is an error in the file
        try:
            modes = of_frfs.table.pick(of_frfs.errors[self.name], built, self.modes)
        except BrokenError as error:
            raise BrokenError(*(mistake.under("measurement") for mistake in error.mistakes)) from None
        numbers = modes.numbers or tuple(range(1, modes.n_modes + 1))
        use = modes.use if are_data else (False,) * modes.n_modes
        return replace(modes, numbers=numbers, counterparts=numbers, labels=tuple(map(str, numbers)), use=use)

    def _build_campaign(self, where: str, campaign: Campaign, data: ModalData, built: Built) -> list[PlacedTest]:
        """Build one test for each line of a campaign.

        The frequencies in `data`, which has all modes, are replaced by those in the line.
        Raise BrokenError if a line gives no valid test.
        """
        tests, wrong = [], Mistakes()
        for name, group, covariates, frequencies, number in zip(*campaign, strict=True):
            line = f"{self.campaign}, line {number}"
            try:
                own = data.with_frequencies(frequencies)
                one = self._test(name, own, group or self.group, {**self.covariates, **covariates}, built)
            except ValueError as error:
                wrong.add(f"{where}.campaign", f"{line}, {error}")
            else:
                tests.append(PlacedTest(one, f"{where}.campaign", line))
        if wrong:
            raise BrokenError(*wrong)
        return tests

    def _test(
        self, name: str, data: ModalData, group: str, covariates: Mapping[str, CovariateValue | None], built: Built
    ) -> Test:
        change = build_change(self.masses, self.springs, built)
        known = {name: _known_or_inferred(x) for name, x in covariates.items()}
        return Test(name, data, group, known, change.masses, change.springs, dict(self.known))


class OfFRFs(NamedTuple):
    """The FRF table, and the FRF error model of each test, keyed by test name."""

    table: FRFTable
    errors: Mapping[str, FRFErrors]


class PlacedTest(NamedTuple):
    """A test, and the problem file's key that gives it. A campaign's test also has its file and line."""

    test: Test
    where: str
    line: str = ""


def build_tests(
    tables: Sequence[TestTable], folder: Path, built: Built, needs_trust: bool, of_frfs: OfFRFs | None = None
) -> tuple[list[PlacedTest], list[ArgumentError]]:
    """Build all tests, and return them with the errors found in their tables. Too many tests are an error too."""
    tests: list[PlacedTest] = []
    found: list[ArgumentError] = []
    for number, table in enumerate(tables):
        try:
            tests += table.build_all(number, folder, built, needs_trust, of_frfs)
        except BrokenError as error:
            found += error.mistakes
    if len(tests) > MOST_TESTS:
        found.append(ArgumentError("tests", f"must be at most {MOST_TESTS}", len(tests)))
    return tests, found


def variations(
    tables: Sequence[ParameterTable],
) -> tuple[dict[str, str | Variation], dict[str, dict[str, Prior | Law | str]]]:
    """Return the arguments `varies` and `slopes` for `fmu.JointProblem`."""
    varies = {table.name: how for table in tables if (how := table.variation()) is not None}
    slopes = {table.name: table.laws() for table in tables if table.slopes}
    return varies, slopes


def in_the_file(
    error: TestsError, tables: Sequence[ParameterTable], noise: Sequence[NoiseTable], tests: Sequence[PlacedTest]
) -> list[ArgumentError]:
    """Return inconsistencies between tests as errors, each with its location in the file.

    If the same error message applies to several lines of a campaign, only the first line is reported.
    """
    of = {table.name: f"parameters.{i}" for i, table in enumerate(tables)}
    of |= {table.name: f"noise.{i}" for i, table in enumerate(noise)}
    found: dict[tuple[str, str], ArgumentError] = {}
    for said in error.mistakes:
        where, _, rule = said.partition(": ")
        key, _, name = where.partition(".")
        at = f"{of[name]}.{key}" if key in ("varies", "slopes", "lower") and name in of else where
        rule = _OF_TEST.sub(lambda match: _place(tests[int(match[1])]), rule)
        of_test = _OF_TEST.match(where)
        mistake = ArgumentError(at, rule)
        if of_test:
            placed, rest = tests[int(of_test[1])], where[of_test.end() + 1 :]
            mistake = ArgumentError(f"{placed.where}.{rest}".rstrip("."), rule)
            if placed.line:
                mistake = ArgumentError(placed.where, f"{', '.join(filter(None, (placed.line, rest)))}: {rule}")
            at = f"{placed.where}.{rest}"
        found.setdefault((at, rule), mistake)
    return list(found.values())


def _place(placed: PlacedTest) -> str:
    return placed.line or placed.where
