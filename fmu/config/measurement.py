"""``[measurement]``: the modes measured in a test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, StringConstraints, field_validator, model_validator

from fmu.arguments import ArgumentError
from fmu.config.errors import IGNORED
from fmu.config.geometry import GeometryTable
from fmu.config.mistakes import BrokenError, Mistakes, rule_of_sensors
from fmu.config.tables import (
    Built,
    Declared,
    FileName,
    Name,
    NumberOrNumbers,
    Positive,
    SensorTable,
    TomlTable,
    arguments,
    declare_table,
    one_length,
    reading,
    required_arguments,
    with_keys,
)
from fmu.fem.pairing.matching import Matching
from fmu.formats.matrices.read import read_matrix
from fmu.formats.modes import READERS
from fmu.formats.modes.csv import read_frequencies, read_shapes, read_tests
from fmu.formats.modes.measured_modes import MOST_MODES, MeasuredModes, ModesFormat, Place, Sensors
from fmu.formats.shown import quote
from fmu.plain_data import list_in
from fmu.posterior.data.covariance import checked_covariance
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.data.repeated import RepeatedTests, mean_shapes, shapes_sd
from fmu.types import Dof, FloatArray

Missed = Annotated[float, Field(allow_inf_nan=True)]
"""A number, or nan for a mode that a test missed."""
Test = Annotated[list[Missed], Field(max_length=MOST_MODES)]
MOST_SENSORS = 10_000
NodeNumber = Annotated[str, StringConstraints(pattern=r"^\d{1,9}$")]
_SOURCES = ("frequencies", "tests", "tests_file", "file", *READERS)
_TESTS = ("tests", "tests_file")
_SHAPES = ("shapes", "shapes_file", "test_shapes")
_TRUST = ("sd", "beta", "covariance")
_ONE_TRUST = "must have either sd or beta or covariance"


_IN_A_FILE: dict[object, object] = {
    Path: FileName,
    Path | None: FileName | None,
    Mapping[int, Place] | None: dict[NodeNumber, Place] | None,
    Sensors: None,
    Sensors | None: None,
}
"""TOML types by the annotation of a reader's argument. None for sensors, which are a key of ``[measurement]``."""
_FILES = ("file", "deck")
"""Names of reader arguments that are file names."""


def _of_reader(key: str, form: ModesFormat) -> tuple[object, object]:
    table = declare_table(key, form.read, in_a_file=lambda annotation: _IN_A_FILE.get(annotation, annotation))
    return table | None, Field(None, description=table.__doc__)


@with_keys({key: _of_reader(key, form) for key, form in READERS.items()})
class MeasurementTable(TomlTable):
    """The measured modes: ``frequencies``, ``tests``, ``tests_file``, ``file``, or the table of a file format.

    The frequency errors are given by ``sd`` in Hz, ``beta`` = 1/(2 sd²) or ``covariance`` in Hz², which replace
    the errors in a file. ``tests`` has one row of frequencies per repeated test, with nan for a missed mode. The
    scatter of the tests gives the errors. ``shapes`` has one row per mode and one value per sensor. Instead of
    ``shapes``, ``shapes_file`` may name a table, or ``test_shapes`` may contain the shapes from each test.
    """

    sources: ClassVar[tuple[str, ...]] = _SOURCES
    frequencies: Annotated[list[Positive], Field(min_length=1, max_length=MOST_MODES)] | None = None
    """Natural frequencies, Hz."""
    tests: Annotated[list[Test], Field(min_length=2), one_length("mode")] | None = None
    """Frequencies of repeated tests in Hz: one row per test in chronological order, nan if the test missed a
    mode."""
    tests_file: FileName | None = None
    """CSV table of repeated tests, relative to this file: one row per test in chronological order, one column per
    mode with its name as header, empty or nan if a test missed the mode. A column named test is ignored."""
    scatter: Literal["each", "pooled", "joint"] | None = None
    """How the scatter of the tests is used: one standard deviation per mode, one relative standard deviation for
    all modes (the default if a mode has fewer than ten values), or a covariance."""
    file: FileName | None = None
    """CSV table of frequencies, relative to this file."""
    sd: NumberOrNumbers | None = None
    """Standard deviation of the frequencies in Hz: one for all modes, or one per mode."""
    beta: NumberOrNumbers | None = None
    """Weight of a squared frequency error, 1/(2 sd²), in 1/Hz²: one for all modes, or one per mode."""
    covariance: list[list[float]] | FileName | None = None
    """Covariance of the frequencies in Hz²: rows of numbers, or the file of a matrix (CSV, .npz or .mat)."""
    numbers: list[Annotated[int, Field(ge=1)]] = []
    """Numbers of the modes, from 1, in the sorted spectrum or a function's order, for pairing by number."""
    counterparts: list[Annotated[int, Field(ge=1)]] = []
    """For pairing by shape without measured shapes: the number of each mode, counted from 1 among the elastic
    modes before updating that move a sensor."""
    labels: list[Name] = []
    """Names of the modes."""
    use: list[bool] = []
    """Which modes the parameters are updated with, one true or false per mode; all if not given. The others are
    paired and predicted too, and test the updated model."""
    sensors: Annotated[list[SensorTable], Field(max_length=MOST_SENSORS)] = []
    """Place and direction of each sensor: x, y, z, rx, ry, rz, with a minus sign if positive readings point in the
    opposite direction."""
    geometry: GeometryTable | None = None
    """Coordinates of the measurement points, if these are not nodes or places of the model."""
    shapes: Annotated[list[list[float]], one_length("sensor")] | None = None
    """One row per mode with one value per sensor, scaled arbitrarily."""
    shapes_file: FileName | None = None
    """CSV table of shapes with their sensors, relative to this file."""
    test_shapes: list[list[list[Missed]]] | None = None
    """Shapes of repeated tests: one list per test with one row per mode and one value per sensor, in any scale and
    sign, nan at every sensor if a test missed a mode. The mean is compared with the model, and the scatter gives
    its error."""

    @field_validator("covariance")
    @classmethod
    def _is_covariance(cls, value: list[list[float]] | str | None) -> list[list[float]] | str | None:
        matrix = list_in(value)
        if matrix is not None:
            checked_covariance(matrix, len(matrix), "")
        return value

    @model_validator(mode="after")
    def _fits(self) -> Self:
        given = self._find_given(self.sources)
        if len(given) != 1:
            raise ArgumentError("", f"must have one of {', '.join(self.sources)}", quote(given))
        trust = self._find_given(_TRUST)
        if len(trust) > 1:
            raise ArgumentError("", _ONE_TRUST, quote(trust))
        if trust and given[0] in _TESTS:
            raise ValueError(
                f"{trust[0]} must not be given together with {given[0]}, whose scatter gives the error"
            )
        shapes = self._find_given(_SHAPES)
        if len(shapes) > 1:
            raise ValueError(f"must have either {' or '.join(shapes)}")
        if self.test_shapes is not None and given[0] not in _TESTS:
            raise ValueError("test_shapes must be given with tests or tests_file, one list per test")
        if self.scatter is not None and given[0] not in _TESTS:
            raise ValueError(f"scatter must be given with tests or tests_file, not with {given[0]}")
        if self.shapes_file is not None and self.sensors:
            raise ValueError("sensors must not be given together with shapes_file, which defines them")
        if self._reads_shapes and shapes:
            raise ValueError(f"shapes must not be given together with {given[0]}, which defines them")
        if self._reads_shapes and not self.sensors and "sensors" in required_arguments(READERS[given[0]].read):
            raise ValueError(f"sensors must be given with {given[0]}, one per channel")
        self._check_lengths()
        return self

    def _check_lengths(self) -> None:
        n_modes = self._count_modes()
        if n_modes is None:
            return
        for key in (*_TRUST, "numbers", "counterparts", "labels", "use", "shapes"):
            value: ArrayLike | None = getattr(self, key)
            n = 0 if value is None else sum(np.shape(value)[:1])
            if n not in (0, n_modes):
                raise ValueError(f"{key} must be {n_modes}, one per mode (got {n})")

    def _count_modes(self) -> int | None:
        """Return the number of modes, or None if it is known only from a file."""
        rows = [self.frequencies] if self.frequencies is not None else self.tests or []
        return len(rows[0]) if rows else None

    def _find_given(self, keys: Sequence[str]) -> list[str]:
        """Return the names in `keys` that are given in this table of the file."""
        return [key for key in keys if key in self.model_fields_set]

    @property
    def _source(self) -> str:
        """Key that gives the frequencies."""
        return self._find_given(self.sources)[0]

    @property
    def _reads_shapes(self) -> bool:
        """Whether the frequencies come from a file format that also contains mode shapes."""
        return self._source in READERS and "sensors" in arguments(READERS[self._source].read)

    def mistakes(self, needs_trust: bool, others: Sequence[str]) -> list[ArgumentError]:
        """Return errors if ``frequencies`` lack a needed uncertainty, or if the keys `others` give it too."""
        trust = self._find_given(_TRUST)
        if not trust and needs_trust and self.frequencies is not None:
            return [ArgumentError("measurement", _ONE_TRUST, "[]")]
        return [ArgumentError(f"measurement.{key}", IGNORED.format(other)) for key in trust for other in others]

    def build(self, folder: Path, built: Built, needs_trust: bool = True) -> ModalData:
        """Build the measured data at model sensors. Raise BrokenError if they cannot be built.

        Parameters
        ----------
        folder : Path
            Folder to which file names are relative.
        built : Built
            The model with its named places.
        needs_trust : bool
            Whether the measurement must give the frequencies' uncertainty, because no error model does.
        """
        given = self._read(folder)
        points = None if self.geometry is None else self.geometry.build(folder, built)
        modes = self._turn_sensors(given.modes, points)
        parallel = points if points is not None and points.is_parallel else None
        sensors = self._sensors(modes.sensors, built, parallel)
        n, most = len(modes.frequencies_hz), built.most_modes
        if n > most:
            rule = f"must have at most {most} modes, one per degree of freedom of the model"
            raise BrokenError(ArgumentError("measurement", rule, n))
        sd_hz: ArrayLike | None = modes.sd_hz
        covariance: ArrayLike | None = given.covariance_hz2
        if self._find_given(_TRUST):
            sd_hz, covariance = self.sd, self._covariance(folder)
        elif needs_trust and sd_hz is None and covariance is None:
            rule = f"{_ONE_TRUST}, as the file has no standard deviations"
            raise BrokenError(ArgumentError("measurement", rule))
        try:
            return ModalData(
                modes.frequencies_hz,
                tuple(self.numbers) or modes.numbers,
                sensors,
                tuple(self.labels) or modes.labels,
                modes.shapes,
                sd_hz,
                covariance,
                modes.shapes_sd,
                tuple(self.counterparts),
                given.tests,
                tuple(self.use) or modes.use,
                modes.mpc,
                points,
            )
        except ValueError as error:
            wrong = ArgumentError.of(error)
            for key in ("frequencies", "sd", "covariance"):  # keys of the file have no units in their names
                wrong = wrong.replace_key(f"{key}_hz", key).replace_key(f"{key}_hz2", key)
            raise BrokenError(wrong.under("measurement")) from None

    def _covariance(self, folder: Path) -> ArrayLike | None:
        """Return the frequency covariance in Hz², shape (n_modes, n_modes), or None if it is not given.

        Raise BrokenError if its file cannot be read or has too many rows.
        """
        if not isinstance(self.covariance, str):
            return self.covariance
        try:
            matrix = read_matrix(folder / self.covariance)
            if matrix.shape[0] > MOST_MODES:
                raise ValueError(f"must have at most {MOST_MODES} rows (got {matrix.shape[0]})")
        except ValueError as error:
            raise BrokenError(
                ArgumentError.of(error).replace_key("variable", "").under("measurement.covariance")
            ) from None
        return np.asarray(matrix.toarray())

    def _turn_sensors(self, modes: MeasuredModes, points: Matching | None) -> MeasuredModes:
        """Return the modes with sensors and shapes rotated to the model's axes.

        The modes are returned unchanged if `points` is None, or if the test's axes are parallel to the model's
        axes. Rotated shapes lose their standard deviations. Raise BrokenError if shapes cannot be rotated, or if
        `test_shapes` have standard deviations.
        """
        if points is None or points.is_parallel:
            return modes
        if self.test_shapes is not None and modes.shapes_sd is not None:
            rule = "must have axes parallel to the model's, as the scatter of test_shapes is along them"
            raise BrokenError(ArgumentError("measurement.geometry", rule))
        try:
            sensors, shapes = points.turned(modes.sensors, modes.shapes)
        except ValueError as error:
            raise BrokenError(ArgumentError(f"measurement.{self._where}", str(error))) from None
        return replace(modes, sensors=sensors, shapes=shapes, shapes_sd=None)

    @property
    def _where(self) -> str:
        """Key that gives the sensors."""
        return "sensors" if self.sensors else self._source if self._reads_shapes else "shapes_file"

    def _sensors(self, given: Sensors, built: Built, points: Matching | None) -> tuple[Dof, ...]:
        """Return the model's sensor for each given (place, direction).

        Places are measurement points if `points` is given. Raise BrokenError if a sensor is unknown or cannot
        move.
        """
        sensors: list[Dof] = []
        found = Mistakes()
        for i, (place, direction) in enumerate(given):
            where = f"sensors.{i}" if self.sensors else self._where
            sensor: Dof = (built.places.get(str(place), place), str(direction))
            try:
                sensor = sensor if points is None else points.sensor(place, str(direction))
            except ValueError as error:
                found.add(f"measurement.{where}", str(error))
                continue
            sensors.append(sensor)
            if not built.model.sees(sensor):
                rule = rule_of_sensors(built.separable, sensor[0])
                found.add(f"measurement.{where}", rule, quote([place, direction]))
        if found:
            raise BrokenError(*found)
        return tuple(sensors)

    def _read(self, folder: Path) -> ModesGiven:
        """Read the modes, tests and covariance, and add shapes and sensors. Raise BrokenError on failure."""
        sensors = tuple((place, str(direction)) for place, direction in self.sensors)
        given = self._read_frequencies(folder, {"sensors": sensors} if sensors and self._reads_shapes else {})
        if self._reads_shapes:
            return given
        modes = replace(given.modes, sensors=sensors)
        if self.shapes is not None:
            modes = replace(modes, shapes=np.array(self.shapes, dtype=float).T)
        if self.test_shapes is not None and given.tests is not None:
            tests, shapes, sd = _repeated_shapes(self.test_shapes, given.tests)
            given, modes = given._replace(tests=tests), replace(modes, shapes=shapes, shapes_sd=sd)
        if self.shapes_file is not None:
            n_modes = len(modes.frequencies_hz)
            labels = modes.labels or tuple(self.labels) or tuple(str(i + 1) for i in range(n_modes))
            with reading("measurement.shapes_file"):
                read = read_shapes(folder / self.shapes_file, labels)
            modes = replace(modes, sensors=read.sensors, shapes=read.shapes)
        return given._replace(modes=modes)

    def _read_frequencies(self, folder: Path, options: Mapping[str, Sensors]) -> ModesGiven:
        """Read the frequencies and everything else that their source contains. Raise BrokenError on failure."""
        if self.frequencies is not None:
            return ModesGiven(MeasuredModes(np.array(self.frequencies), ()))
        if self.tests is not None:
            return _mean("tests", self.tests, self.scatter)
        with reading(f"measurement.{self._source}"):
            if self._source in READERS:
                table: Declared = getattr(self, self._source)
                files = {
                    key: folder / str(given) for key, given in table.given_arguments().items() if key in _FILES
                }
                return ModesGiven(table.build(**files, **options))
            if self.file is not None:
                return ModesGiven(read_frequencies(folder / self.file))
            values, labels = read_tests(folder / str(self.tests_file))
        return _mean("tests_file", values, self.scatter, labels)


class ModesGiven(NamedTuple):
    """Data from one source: modes, the repeated tests that were averaged, and the mean's covariance in Hz²."""

    modes: MeasuredModes
    tests: RepeatedTests | None = None
    covariance_hz2: ArrayLike | None = None


def _mean(key: str, values: ArrayLike, scatter: str | None, labels: tuple[str, ...] = ()) -> ModesGiven:
    """Return the mean of repeated tests, with its uncertainty.

    Raise BrokenError at `key` if the tests are invalid.
    """
    try:
        tests = RepeatedTests(values, scatter)
    except ValueError as error:
        raise BrokenError(ArgumentError.of(error).replace_key("frequencies", f"measurement.{key}")) from None
    mean = tests.mean()
    return ModesGiven(MeasuredModes(mean.frequencies_hz, labels, mean.sd_hz), tests, mean.covariance_hz2)


def _repeated_shapes(
    shapes: list[list[list[float]]], tests: RepeatedTests
) -> tuple[RepeatedTests, FloatArray, FloatArray | None]:
    """Return the tests with shapes, their mean shapes, (n_sensors, n_modes), and these shapes' sds or None.

    Raise BrokenError if the shapes do not match the tests, or their numbers of sensors differ.
    """
    where, (n_tests, n_modes) = "measurement.test_shapes", np.shape(tests.frequencies_hz)
    wrong = (
        [ArgumentError(where, f"must be {n_tests}, one per test", len(shapes))] if len(shapes) != n_tests else []
    )
    wrong = wrong or [
        ArgumentError(f"{where}.{i}", f"must be {n_modes}, one per mode", len(test))
        for i, test in enumerate(shapes)
        if len(test) != n_modes
    ]
    lengths = sorted({len(row) for test in shapes for row in test})
    if not wrong and len(lengths) > 1:
        wrong = [ArgumentError(where, "must have rows of one length, one value per sensor", quote(lengths))]
    if wrong:
        raise BrokenError(*wrong)
    values = np.swapaxes(np.array(shapes, dtype=float), 1, 2)
    try:
        return replace(tests, shapes=values), mean_shapes(values), shapes_sd(values)
    except ValueError as error:
        raise BrokenError(ArgumentError.of(error).replace_key("shapes", where)) from None
