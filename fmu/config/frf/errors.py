"""``[[error]] of = "frf"``: measured frequency response functions, from a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import ConfigDict, Field, Tag

from fmu.arguments import ArgumentError
from fmu.config.mistakes import BrokenError
from fmu.config.tables import (
    Built,
    Declared,
    FileName,
    Maker,
    Name,
    NotNegative,
    Positive,
    SensorTable,
    by_kind,
    reading,
)
from fmu.formats.modes.measured_modes import Place
from fmu.formats.shown import names_shown, quote
from fmu.numbers import whole
from fmu.posterior.data.frf_data import FRFData, FRFKind
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.data.picked_modes import pick_modes
from fmu.posterior.data.read_frf import read_frf
from fmu.posterior.frf.damping import DampingModel
from fmu.posterior.frf.errors import CHANNEL_ERRORS, FRFErrors, points_of
from fmu.types import Dof

MOST_FRFS = 10_000
_Band = Annotated[list[NotNegative], Field(min_length=2, max_length=2)]
Bands = Annotated[
    Annotated[_Band, Tag("<list>")] | Annotated[list[_Band], Tag("<rows>")],
    by_kind("the lowest and the highest frequency, or a list of such pairs"),
]
_Sd = Annotated[NotNegative, Tag("<number>")]
Deviation = Annotated[
    _Sd | Annotated[Name, Tag("<text>")], by_kind("a number from 0, or the name of a [[noise]] table")
]
ByChannel = NotNegative | dict[Name, NotNegative]
FRFWindow = Annotated[tuple[str, Positive], Field(strict=False)] | None
_POINTS = Annotated[list[SensorTable], Field(max_length=MOST_FRFS)]


class FRFTable(Declared):
    """Measured frequency response functions (FRFs). The [[damping]] tables give the structure's damping."""

    model_config = ConfigDict(use_attribute_docstrings=True)
    makes: ClassVar[tuple[Maker, ...]] = (FRFErrors,)
    tag: ClassVar[str] = "of"
    is_complete: ClassVar[bool] = False

    of: Literal["frf"]
    data: FileName | None = None
    """File of the FRFs, relative to this file: .uff, .unv, .csv, .tsv, .txt, .npz, .mat, .h5 or .hdf5. With
    [[tests]], each test has its own key data, and this table applies to all of them."""
    kind: FRFKind | None = None
    """Response divided by force; needed if the file does not specify it."""
    factor: Positive = 1.0
    """Converts the file's values to SI units: 9.80665 for accelerations in g."""
    drives: _POINTS = []
    """Place and direction of the force of each FRF in the file, if the file does not name them."""
    responses: _POINTS = []
    """Place and direction of the response of each FRF in the file, if the file does not name them."""
    nodes: dict[Annotated[str, Field(pattern=r"^\d{1,9}$")], Place] = {}
    """For a universal file: the model location of each node in the file; other nodes are skipped."""
    variables: dict[Name, Name] = {}
    """For a file of arrays: the names in the file of frequencies_hz, values, coherence, sd, averages, kind, drives
    and responses."""
    frfs: list[Annotated[int, Field(ge=1)]] = []
    """Numbers of the FRFs to use, counted from 1 in the order of the file; all if not given."""
    band: Bands | None = None
    """Lowest and highest frequency to use, in Hz, or several such pairs. Lines left out between the used lines
    test the updated model."""
    use: list[bool] = []
    """Which FRFs the parameters are updated with, one true or false per FRF; all if not given. The others are
    predicted, and test the updated model."""
    averages: Annotated[float, Field(gt=1)] | None = None
    """Number of independent averages from which the coherences in the file were computed; it determines the
    errors."""
    sd: Positive | None = None
    """Standard deviation of the real and of the imaginary part, in SI units; replaces the one in the file."""
    window: FRFWindow = None
    """For FRFs of a random test: the window, such as "hann", and the length of its segments in s, by which the
    model's FRFs are smoothed as the measured ones were."""
    scale: Literal["linear", "log"] = "linear"
    """Whether the errors apply to H, or to log H, that is to log-amplitude and phase."""
    model_sd: Deviation = 0.0
    """Standard deviation of the model error relative to |H|, or the name of a noise to be inferred."""
    gain_sd: ByChannel = 0.0
    """Standard deviation of the relative gain error of each response channel: one number for all, or { "tip z" =
    0.05 } for some channels."""
    force_gain_sd: ByChannel = 0.0
    """Standard deviation of the relative gain error of each force, common to all its FRFs: one number, or one for
    each drive."""
    delay_sd: ByChannel = 0.0
    """Standard deviation of the delay of each response channel in s: one number for all, or by channel."""
    modes: list[Annotated[int, Field(ge=1)]] = []
    """Without [measurement]: the mode number of each picked resonance, counted from 1 among the elastic modes of
    the model that move a response. With pairing = "index", counted in the whole spectrum. 1, 2, … if not given."""

    def read(self, file: Path) -> FRFData:
        """Read the FRFs in a file, and mark the lines that this table excludes from updating.

        Raise BrokenError or ValueError if the file or the settings are invalid.
        """
        with reading("data"):
            data = read_frf(
                file,
                kind=self.kind,
                drives=_points(self.drives),
                responses=_points(self.responses),
                nodes={int(number): place for number, place in self.nodes.items()} or None,
                variables=self.variables or None,
                frfs=self.frfs or None,
                scale=self.factor,
                averages=self.averages,
                sd=self.sd,
                window=self.window,
            )
        if self.band is not None:
            pairs = np.reshape(self.band, (-1, 2)).tolist()
            for i, (low, high) in enumerate(pairs):
                if not low < high:
                    where = f"band.{i}" if len(pairs) > 1 else "band"
                    raise ArgumentError(
                        where, "must have a lower frequency below its upper one", quote([low, high])
                    )
            data = data.with_bands([(low, high) for low, high in pairs])
        if not self.use:
            return data
        if len(self.use) != data.n_frfs:
            raise ArgumentError("use", f"must be {data.n_frfs}, one per FRF", len(self.use))
        return data.without_lines(np.repeat(~np.array(self.use)[:, None], data.n_lines, axis=1))

    def errors(
        self, file: Path, damping: Sequence[DampingModel], test: str | None, **inferred: object
    ) -> FRFErrors:
        """Build the error model for the FRFs in a file. Raise BrokenError if the file or the settings are invalid.

        Parameters
        ----------
        file : Path
        damping : sequence of DampingModel
        test : str or None
            Name of the test in which the FRFs were measured, or None if there is only one test.
        **inferred
            The Parameter for each key whose value is the name of a noise table.
        """
        try:
            data = self.read(file)
            channels = {key: _by_channel(key, getattr(self, key), data) for key in CHANNEL_ERRORS}
            given: dict[str, Any] = {"scale": self.scale, "model_sd": self.model_sd} | inferred | channels
            return FRFErrors(data, list(damping), test=test, **given)
        except ValueError as error:
            raise BrokenError(_in_the_file(error)) from None

    def pick(self, errors: FRFErrors, built: Built, numbers: Sequence[int] = ()) -> ModalData:
        """Pick modes at the FRF resonances.

        If `numbers` is not empty, it is used instead of the table's mode numbers, ``modes``. Raise BrokenError if
        there is no resonance, if there is not one mode number per resonance, or if the modes or the responses do
        not fit the model.
        """
        try:
            modes = pick_modes(errors.data, tuple(numbers or self.modes))
        except ValueError as error:
            raise BrokenError(_in_the_file(error)) from None
        if modes.n_modes > built.most_modes:
            rule = (
                f"must have at most {whole(built.most_modes)} resonances, one per degree of freedom of the model"
            )
            raise BrokenError(ArgumentError("data", rule, modes.n_modes))
        sensors = tuple((built.at(place), way) for place, way in modes.sensors)
        rule = "must have responses at places and in directions of the model that are free to move"
        unseen = [
            ArgumentError("data", rule, f"{place} {way}")
            for (place, way), sensor in zip(modes.sensors, sensors, strict=True)
            if not built.model.sees(sensor)
        ]
        if unseen:
            raise BrokenError(*unseen)
        return replace(modes, sensors=sensors)


class FRFFile(NamedTuple):
    """An FRF file: its name, the key that gives it, and, for several tests, the test and its window."""

    where: str
    name: str
    test: str | None = None
    window: FRFWindow = None


def read_frfs(
    number: int,
    table: FRFTable,
    *,
    files: Sequence[FRFFile],
    folder: Path,
    damping: Sequence[DampingModel],
    **inferred: object,
) -> tuple[list[FRFErrors], list[ArgumentError]]:
    """Build the error models for the FRFs in all files, and return them with the errors found.

    Parameters
    ----------
    number : int
        Index of the table in ``[[error]]``, from 0.
    table : FRFTable
    files : sequence of FRFFile
    folder : Path
        Folder to which file names are relative.
    damping : sequence of DampingModel
    **inferred
        The Parameter for each key whose value is the name of a noise table.
    """
    models: list[FRFErrors] = []
    found: dict[str, ArgumentError] = {}
    for file in files:
        try:
            own = table.model_copy(update={"window": file.window}) if file.window else table
            models.append(own.errors(folder / file.name, damping, file.test, **inferred))
        except BrokenError as error:
            for mistake in error.mistakes:
                key = mistake.key.split(".")[0]
                placed = mistake.replace_key("data", file.where)
                if key == "window" and file.window:
                    placed = mistake.under(file.where.rpartition(".")[0])
                elif key != "data":
                    placed = mistake.under(f"error.{number}")
                found[str(placed)] = placed
    return models, list(found.values())


def _points(given: Sequence[Sequence[int | str]]) -> tuple[tuple[int | str, str], ...] | None:
    return tuple((place, str(direction)) for place, direction in given) or None


def _by_channel(key: str, given: float | Mapping[str, float], data: FRFData) -> float | dict[Dof, float]:
    """Return a setting keyed by channel (place, direction) instead of by a name such as ``"tip z"``.

    A plain number is returned unchanged. Raise ArgumentError if there is no such channel.
    """
    if not isinstance(given, Mapping):
        return given
    channels = {f"{place} {direction}": (place, direction) for place, direction in points_of(key, data)}
    unknown = next((name for name in given if name not in channels), None)
    if unknown is not None:
        raise ArgumentError(key, f"must name {CHANNEL_ERRORS[key]} among {names_shown(channels)}", quote(unknown))
    return {channels[name]: value for name, value in given.items()}


def _in_the_file(error: ValueError) -> ArgumentError:
    """Return an error with its argument's name replaced by the key of the table that sets this argument.

    An error that concerns no key of the table, such as an error in the FRF file, gets the key ``data``.
    """
    wrong = ArgumentError.of(error).replace_key("path", "data").replace_key("numbers", "modes")
    return wrong if wrong.key.split(".")[0] in FRFTable.model_fields else ArgumentError("data", str(wrong))
