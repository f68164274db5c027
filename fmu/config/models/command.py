"""``[model] type = "command"``: a program that is run on a filled input deck for every theta."""

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
    """A finite-element program that fmu starts: it fills the template, runs the command, and reads the modes."""

    type: Literal["command"]
    template: FileName
    """The input deck, from the folder of this file, with {NAME} for the value of each parameter: {E1}, {E1:.9e},
    or {E1:8} in a field of Nastran. plate.inp.in gives plate.inp."""
    command: Annotated[list[str], Field(min_length=1, max_length=1000)]
    """The program and its arguments; {job} and {deck} are the deck's name without and with its suffix."""
    frequencies: Annotated[FoundFrequencies, Of("frequencies", FoundFrequencies)] | None = None
    """How to find the frequencies in what the program writes."""
    reader: ReaderName | None = None
    """Instead of frequencies: reads a file of the program, shapes at the sensors too; "f06" for Nastran's."""
    result: FileName | None = None
    """The file for the reader, with {job} and {deck}; by default {job}.dat of CalculiX, {job}.f06, {job}.uff and
    {job}.npz."""
    inputs: list[FileName] = []
    """Other files that the program needs, from the folder of this file; what bulk data include is added."""
    timeout: Positive = 600.0
    """Seconds that a run may take."""
    retries: Annotated[int, Field(ge=0, le=100)] = 0
    """How often a run that fails is repeated."""
    keep: bool = False
    """Whether to keep the folders of all runs, not only of some that fail."""
    store: FileName = "solves"
    """Folder of what was solved, from the folder of this file. It is not solved again."""
    step: Annotated[float, Field(gt=0, le=0.1)] = STEP
    """Of central differences, relative to the range of each parameter."""

    @property
    def decks(self) -> list[str]:
        """The list of the template's name."""
        return [self.template]

    def build(self, folder: Path, parameters: Sequence[ParameterTable]) -> Built:
        """Return the model; BrokenError if a file or the program is missing, or the template lacks a parameter."""
        given = {key: value for key, value in self if key != "type"}
        try:
            return Built(CommandModel([p.name for p in parameters], folder=folder, **given), {})
        except CommandError as error:
            raise BrokenError(*(mistake.under("model") for mistake in error.mistakes)) from error
