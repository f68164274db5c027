"""The table of a whole problem file, which builds the updating problem, and the JSON schema of problem files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, cast

from numpy.typing import ArrayLike
from pydantic import Field, Tag

from fmu.arguments import ArgumentError
from fmu.config.discrepancy import DiscrepancyTable
from fmu.config.errors import (
    IGNORED,
    OF_FREQUENCIES,
    ErrorTable,
    beside_tests,
    build_error_models,
    is_of_modes,
    vanishing,
    with_own_sd,
    with_places,
    with_trust,
)
from fmu.config.frf.damping import DampingTable, build_damping, structural
from fmu.config.frf.in_file import FRFsInFile, mistakes_of_frfs
from fmu.config.measurement import MeasurementTable
from fmu.config.mistakes import BrokenError, ConfigurationError, Mistakes
from fmu.config.models.command import CommandTable
from fmu.config.models.exports import ExportsTable
from fmu.config.models.frame import FrameTable
from fmu.config.models.matrices import MatricesTable
from fmu.config.models.opensees import OpenSeesTable
from fmu.config.models.python import PythonTable
from fmu.config.parameters import NoiseTable, OutliersTable, ParameterTable, build_parameters, of_several_tests
from fmu.config.planned.plan import PlanTable
from fmu.config.tables import Built, FileName, Name, Positive, TomlTable, by_kind, for_toml
from fmu.config.tests import MOST_TESTS, TestTable, build_tests, in_the_file, variations
from fmu.engines.base import Engine
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.rules import SOFTNESS
from fmu.fem.reduced.cost import memory_in_words
from fmu.formats.decks import EXPORTED, fill_deck, filled_name, read_deck
from fmu.posterior.data.expected import expected_modes
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.base import ErrorModel
from fmu.posterior.frf.damping import DampingModel
from fmu.posterior.frf.errors import FRFErrors
from fmu.posterior.joint.modal_test import TestsError
from fmu.posterior.parameters import Parameter
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.reduction.tolerance import LOOSEST_FREQUENCY
from fmu.progress.phases import phase, tell_fact

NamedError = Annotated[Literal["frequency", "modal-residual"], Tag("<text>")]
ErrorModels = Annotated[list[ErrorTable], Field(min_length=1), Tag("<list>")]
Reduction = Annotated[
    Annotated[bool, Tag("<switch>")] | Annotated[float, Field(gt=0, le=LOOSEST_FREQUENCY), Tag("<number>")],
    by_kind("true, false or a number"),
]
DIALECT = "https://json-schema.org/draft/2020-12/schema"
TITLE = "A Bayesian model-updating problem for fmu"
MOST_PARAMETERS = 200
"""Largest number of parameters, far more than a few modes can determine."""
NAMES_OR_MODELS = by_kind("the name of an error model, or tables [[error]]")


class ExportTable(TomlTable):
    """Files that ``fmu export`` writes in addition to the matrices."""

    templates: Annotated[list[FileName], Field(min_length=1, max_length=100)]
    """Input decks of other programs, relative to this file, with {NAME} for the value of a parameter, {NAME sd}
    for its posterior standard deviation, and {NAME:8} or {NAME:16} in a Nastran field. plate.inp.in becomes
    plate.inp."""

    def mistakes(self, folder: Path, names: Sequence[str]) -> list[ArgumentError]:
        """Return an error for each template that cannot be read or filled, or whose output file name is taken."""
        found, given = Mistakes(), dict.fromkeys([*names, *(f"{name} sd" for name in names)], 1.0)
        made = list(EXPORTED)
        for i, template in enumerate(self.templates):
            try:
                name = filled_name(template)
                if name in made:
                    raise ValueError(f"must give a file of another name (got {name})")
                made.append(name)
                fill_deck(read_deck(folder / template), given)
            except ValueError as error:
                found.add(f"export.templates.{i}", str(error))
        return found


class ProblemFile(TomlTable):
    """A problem: a model, uncertain parameters, and measured modes or FRFs. Values are in SI units by default."""

    name: Name
    """Title in reports."""
    description: str = ""
    """One line of text."""
    pairing: Literal["shape", "index", "soft"] = "shape"
    """How computed modes are paired with measured modes: by the MAC of their shapes ("shape"), by number in the
    spectrum ("index"), or softly ("soft"), with weights exp(MAC/softness), so that the log-probability is
    continuous where modes veer."""
    softness: Positive = SOFTNESS
    """For soft pairing: the smaller the value, the closer the pairing is to one-to-one pairing by MAC."""
    error: NamedError | ErrorModels = Field("frequency", discriminator=NAMES_OR_MODELS)
    """What is compared: frequencies in Hz, the modal residual (K − ω²M) φ, or error models in [[error]] tables."""
    noise: list[NoiseTable] = []
    """Standard deviations to be inferred, which error models refer to by name."""
    damping: Annotated[list[DampingTable], Field(max_length=MOST_PARAMETERS)] = []
    """Damping of the structure, for frequency response functions; several tables are added. The damping parameters
    come after the structural parameters in [[parameters]]."""
    discrepancy: Annotated[list[DiscrepancyTable], Field(max_length=MOST_PARAMETERS)] = []
    """Model discrepancy, if the model is not assumed to be correct."""
    reduction: Reduction = True
    """Whether a certified reduced model, which is much faster, replaces the full model within the bounds. A number
    up to 0.01 is the tolerance on its relative frequency errors. true means 1e-6 or, from 20 000 degrees of
    freedom, an error of the log-probability of 0.01 where the posterior has its mass. If the bounds are too wide
    for this to pay off, the tolerance holds where the posterior has its mass, and 1e-3 elsewhere. Failing that,
    the model is reduced by its modes at draws from the prior and the posterior, where errors of the
    log-probability stay below 0.1. A warning says which tolerance holds."""
    model: Annotated[
        FrameTable | MatricesTable | ExportsTable | CommandTable | OpenSeesTable | PythonTable,
        Field(discriminator="type"),
    ]
    """The structure: type "frame", "matrices", "exports", "command", "opensees" or "python"."""
    measurement: MeasurementTable | None = None
    """The modes of a test. With frequency response functions alone, they are used only to begin the search for
    maxima; the resonances replace them if they are not given."""
    tests: Annotated[list[TestTable], Field(min_length=1, max_length=MOST_TESTS)] | None = None
    """Several tests of the structure, instead of one measurement."""
    plan: PlanTable | None = None
    """A planned test, for ``fmu plan``; it may replace a measurement that has not been made yet."""
    reference: str | None = None
    """The group of tests relative to which losses are defined; the group of the first test if not given."""
    correlation: float | None = None
    """Shape η of the LKJ(η) prior of the correlations between parameters with a population. η = 1 is uniform over
    correlation matrices; a larger η favours smaller correlations. Independent if not given."""
    outliers: OutliersTable | None = None
    """With a population: tests that may be outliers."""
    parameters: Annotated[list[ParameterTable], Field(min_length=1, max_length=MOST_PARAMETERS)]
    """The uncertain parameters, in the order of theta."""
    export: ExportTable | None = None
    """Files of other programs that ``fmu export`` fills with the updated values."""

    def build(
        self,
        source: str,
        folder: Path,
        pairing: str | None = None,
        beta: ArrayLike | None = None,
        engine: Engine | None = None,
        planning: bool = False,
    ) -> UpdatingProblem:
        """Build the updating problem described by this file.

        Parameters
        ----------
        source : str
            Name of the file in error messages.
        folder : Path
            Folder to which file names in the problem file are relative.
        pairing, beta : optional
            Values that replace those in the file; see `fmu.load`.
        engine : Engine, optional
            Trains the reduced model.
        planning : bool
            Whether a test is being planned. If so, modes predicted by the model replace a missing measurement. No
            reduced model is then trained, except for several tests.

        Raises
        ------
        ConfigurationError
            If the problem cannot be built; it lists the errors found.
        """
        parameters, found = build_parameters("parameters", self.parameters)
        of_frfs, given = self._frfs, self._errors
        found += self.model.mistakes(self.structural)
        found += mistakes_of_frfs(of_frfs, given, self.damping, self.parameters, self.tests)
        noise, wrong = build_parameters("noise", self.noise, [table.name for table in self.parameters])
        damping: list[DampingModel] = []
        if not found:
            try:
                damping = build_damping(self.damping, parameters, folder)
            except BrokenError as error:
                found += error.mistakes
        read = None if of_frfs is None else of_frfs.reader(folder, damping)
        errors, unnamed = build_error_models(given, noise, [table.name for table in self.noise], read)
        parameters = {table.name: parameters[table.name] for table in self.structural if table.name in parameters}
        needs_trust = not (unnamed or any(map(is_of_modes, errors)))  # a wrong table may be of modes
        found += wrong + unnamed + ([] if self._is_unmeasured(planning) else self._of_measurements(needs_trust))
        found += [] if beta is None else [ArgumentError("beta", IGNORED.format(key)) for key in with_own_sd(given)]
        if self.export is not None:
            found += self.export.mistakes(folder, [table.name for table in (*self.parameters, *self.noise)])
        if found:
            raise ConfigurationError(source, found)
        try:
            with phase("reading the model"):
                structure = self.model.build(folder, self.structural)
            if structure.separable is not None:
                tell_fact(f"{structure.separable.n_dof} degrees of freedom, {len(self.parameters)} parameters")
                if memory := memory_in_words(structure.separable):
                    tell_fact(memory)
            if self.tests is not None:
                return self._joint(folder, structure, parameters, errors, pairing, beta, engine)
            if self._is_unmeasured(planning):
                return self._build_unmeasured(structure, parameters, errors)
            trust = self.measurement.beta if beta is None and self.measurement is not None else beta
            data = self._data(folder, structure, trust, errors)
            errors = with_places(errors, structure)
            wrong = beside_tests(given, errors, {"tests": data}) or vanishing(noise, errors, data, parameters)
            if wrong:
                raise BrokenError(*wrong)
            return UpdatingProblem.reduced(
                structure.model,
                data,
                list(parameters.values()),
                pairing=pairing or self.pairing,
                softness=self.softness,
                reduction=False if planning else self.reduction,
                beta=None if any(map(is_of_modes, errors)) else trust,
                error=errors or self.error,
                discrepancy=[table.build() for table in self.discrepancy],
                name=f"{self.name}, by {pairing or self.pairing}",
                engine=engine,
            )
        except BrokenError as error:
            raise ConfigurationError(source, error.mistakes) from None
        except ValueError as error:
            mistake = ArgumentError.of(error)
            mistake = mistake if of_frfs is None else of_frfs.place(mistake, errors)
            if mistake.key in ("use", "numbers", "counterparts"):
                mistake = mistake.under("measurement")
            raise ConfigurationError(source, [mistake]) from error

    def plan_options(self, source: str, folder: Path) -> dict[str, Any]:
        """Return the arguments for `fmu.plan` from the ``[plan]`` table, or the defaults if there is none.

        Raise ConfigurationError if the model cannot be built.
        """
        try:
            return (self.plan or PlanTable()).options(self.model.build(folder, self.structural))
        except BrokenError as error:
            raise ConfigurationError(source, error.mistakes) from None
        except ValueError as error:
            raise ConfigurationError(source, [ArgumentError.of(error)]) from error

    def _is_unmeasured(self, planning: bool) -> bool:
        return planning and self.plan is not None and self.measurement is None and self.tests is None

    def _build_unmeasured(
        self, built: Built, parameters: Mapping[str, Parameter], errors: Sequence[ErrorModel]
    ) -> UpdatingProblem:
        """Build the problem with predicted modes as data. Raise BrokenError or ValueError if this fails."""
        assert self.plan is not None  # for the type checker: see `_is_unmeasured`
        if isinstance(built.model, ModalModel):
            raise BrokenError(
                ArgumentError("measurement", "must be given for this type of model", self.model.type)
            )
        given, n_modes = list(parameters.values()), self.plan.count_modes()
        sensors = () if built.separable is not None else self.plan.all_sensors(built)
        try:
            data = expected_modes(built.model, given, n_modes, sensors=sensors)
        except ArgumentError as error:
            raise error.replace_key("n_modes", "plan.modes") from None
        of_frequencies = [one for one in errors if isinstance(one, OF_FREQUENCIES)]
        return UpdatingProblem(built.model, data, given, error=of_frequencies or "frequency", name=self.name)

    def _of_measurements(self, needs_trust: bool) -> list[ArgumentError]:
        """Return the errors in measurements and in keys for several tests that can be found without the model."""
        if self.measurement is None and self.tests is None and self._frfs is not None:
            return of_several_tests(self.parameters)
        if (self.measurement is None) == (self.tests is None):
            given = "none" if self.tests is None else "both"
            if self.plan is not None and self.tests is None:
                given = "a plan only, which fmu plan reads"
            return [ArgumentError("measurement", f"must be given, or several [[tests]] instead (got {given})")]
        others = with_own_sd(self._errors)
        if self.tests is None:
            keys = {"reference": self.reference, "correlation": self.correlation, "outliers": self.outliers}
            rule = "is allowed with several [[tests]] only"
            of_one = [ArgumentError(key, rule) for key, value in keys.items() if value is not None]
            return self.measured.mistakes(needs_trust, others) + of_several_tests(self.parameters) + of_one
        return [
            mistake.replace_key("measurement", f"tests.{i}")
            for i, table in enumerate(self.tests)
            for mistake in table.mistakes(needs_trust, others)
        ]

    @property
    def structural(self) -> list[ParameterTable]:
        """Tables of the structural parameters, without damping parameters."""
        return structural(self.parameters, self.damping)

    @property
    def _errors(self) -> list[ErrorTable]:
        """The ``[[error]]`` tables, or an empty list if ``error`` is a name."""
        return [] if isinstance(self.error, str) else self.error

    @property
    def _frfs(self) -> FRFsInFile | None:
        """The ``[[error]]`` table for FRFs and the FRF files to be read, or None if there is no such table."""
        return FRFsInFile.of(self._errors, self.tests)

    @property
    def decks(self) -> list[str]:
        """Names of the templates that ``fmu export`` fills: the model's decks and those in ``[export]``."""
        others = [] if self.export is None else self.export.templates
        return list(dict.fromkeys([*self.model.decks, *others]))

    @property
    def measured(self) -> MeasurementTable:
        """The ``[measurement]`` table. Raises ValueError if the file has none."""
        if self.measurement is None:
            raise ValueError("measurement: a file with several tests has none")
        return self.measurement

    def _joint(
        self,
        folder: Path,
        structure: Built,
        parameters: Mapping[str, Parameter],
        errors: Sequence[ErrorModel],
        pairing: str | None,
        beta: ArrayLike | None,
        engine: Engine | None,
    ) -> UpdatingProblem:
        from fmu.posterior.joint.joint_problem import JointProblem

        if beta is not None:
            raise ValueError(f"beta: must not be given for several tests (got {beta})")
        errors = with_places(errors, structure)
        of_frfs = None if self._frfs is None else self._frfs.by_test(errors)
        needs_trust = not any(map(is_of_modes, errors))
        tests, found = build_tests(self.tests or [], folder, structure, needs_trust, of_frfs)
        found += beside_tests(self._errors, errors, {f"tests of {one.where}": one.test.data for one in tests})
        if found:
            raise BrokenError(*found)
        varies, slopes = variations(self.parameters)
        try:
            return JointProblem(
                structure.model,
                [placed.test for placed in tests],
                list(parameters.values()),
                varies=varies,
                slopes=slopes,
                reference=self.reference,
                correlation=self.correlation,
                outliers=None if self.outliers is None else self.outliers.build(),
                pairing=pairing or self.pairing,
                error=errors or cast("str", self.error),
                discrepancy=[table.build() for table in self.discrepancy],
                reduction=self.reduction,
                engine=engine,
                name=f"{self.name}, by {pairing or self.pairing}",
            )
        except TestsError as error:
            raise BrokenError(*in_the_file(error, self.parameters, self.noise, tests)) from None

    def _data(self, folder: Path, built: Built, beta: ArrayLike | None, errors: Sequence[ErrorModel]) -> ModalData:
        """Build the measured data. Raise BrokenError on failure.

        A given `beta` becomes the data's uncertainty if there are error models of modes. Otherwise the data get no
        uncertainty, because the problem itself takes `beta`.
        """
        if self.measurement is None and self._frfs is not None:
            i = self._frfs.number
            try:
                data = self._frfs.table.pick(cast("FRFErrors", errors[i]), built)
            except BrokenError as error:
                raise BrokenError(*(mistake.under(f"error.{i}") for mistake in error.mistakes)) from None
        else:
            data = self.measured.build(folder, built, needs_trust=not any(map(is_of_modes, errors)))
        if beta is not None:
            of_modes = any(map(is_of_modes, errors))
            return with_trust(data, beta) if of_modes else replace(data, sd_hz=None, covariance_hz2=None)
        if self.error == "modal-residual":
            raise BrokenError(
                ArgumentError("measurement.beta", "must be given for the modal residual, as a number")
            )
        return data


def schema() -> dict[str, object]:
    """Return the JSON schema for problem files.

    Returns
    -------
    dict
        A schema of draft 2020-12. It contains keys, types and ranges. Most relations between tables are checked
        only by `fmu.load`, for example that a member's section exists.
    """
    found = json.loads(json.dumps(ProblemFile.model_json_schema()), object_hook=for_toml)
    measured = [{"required": [key]} for key in ("measurement", "tests")]
    of_frf = {"contains": {"properties": {"of": {"const": "frf"}}, "required": ["of"]}}
    other = [{"required": ["plan"]}, {"required": ["error"], "properties": {"error": {"type": "array"} | of_frf}}]
    one = [*measured, {"anyOf": other, "not": {"anyOf": measured}}]
    return {"$schema": DIALECT, "title": TITLE} | found | {"oneOf": one}
