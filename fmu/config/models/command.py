"""``[model] type = "command"``: a program that fmu runs with a filled-in input deck for every theta."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from fmu.config.mistakes import BrokenError
from fmu.config.parameters import ModelTable, ParameterTable
from fmu.config.tables import Built, FileName, Of, Positive
from fmu.fem.programs.command import STEP, CommandError, CommandModel
from fmu.fem.programs.found_frequencies import FoundFrequencies
from fmu.formats.modes import READERS

if TYPE_CHECKING:
    ReaderName = str
else:
    ReaderName = Literal[tuple(READERS)]


class CommandTable(ModelTable):
    """A finite-element program. fmu fills in its template, runs the command and reads the modes."""

    type: Literal["command"]
    template: FileName
    """The input deck, relative to the folder of this file, with {NAME} for the value of each parameter: {E1},
    {E1:.9e}, or {E1:16} in a large field of Nastran. plate.inp.in becomes plate.inp."""
    command: Annotated[list[str], Field(min_length=1, max_length=1000)]
    """The program and its arguments; {job} and {deck} are the name of the deck without and with its suffix."""
    frequencies: Annotated[FoundFrequencies, Of("frequencies", FoundFrequencies)] | None = None
    """How to find the frequencies in the program's output."""
    reader: ReaderName | None = None
    """Instead of frequencies: the format of a file that the program writes, which may contain shapes at the
    sensors; "f06" for Nastran."""
    result: FileName | None = None
    """The file for the reader, with {job} and {deck}; by default {job}.dat for CalculiX, otherwise {job}.f06,
    {job}.uff or {job}.npz."""
    inputs: list[FileName] = []
    """Other files that the program needs, relative to the folder of this file; files included in Nastran bulk data
    are added automatically."""
    timeout: Positive = 600.0
    """Time limit for a run in s."""
    retries: Annotated[int, Field(ge=0, le=100)] = 0
    """How many times a failed run is repeated."""
    keep: bool = False
    """Whether to keep the folders of all runs, and not only of some failed runs."""
    store: FileName = "solves"
    """Folder of solved runs, relative to the folder of this file; these are not solved again."""
    step: Annotated[float, Field(gt=0, le=0.1)] = STEP
    """Central-difference step, relative to the range of each parameter."""

    @property
    def decks(self) -> list[str]:
        """List with the template's name."""
        return [self.template]

    def build(self, folder: Path, parameters: Sequence[ParameterTable]) -> Built:
        """Return the model that runs the program.

        Raise BrokenError if the keys are inconsistent, a file or the program is missing, or the template lacks a
        parameter.
        """
        given = {key: value for key, value in self if key != "type"}
        try:
            return Built(CommandModel([p.name for p in parameters], folder=folder, **given), {})
        except CommandError as error:
            raise BrokenError(*(mistake.under("model") for mistake in error.mistakes)) from error
