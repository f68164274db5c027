"""One run of a program in its own folder: fill the deck, start the program and read its results."""

from __future__ import annotations

import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fmu.engines.program import TOO_LONG, last_lines, run_program
from fmu.fem.programs.answers import AnswerError
from fmu.fem.programs.found_frequencies import FoundFrequencies
from fmu.fem.programs.store import Solve, SolveStore
from fmu.formats.decks import fill_deck, write_deck
from fmu.formats.modes import READERS
from fmu.formats.shown import in_words, one_line, quote
from fmu.types import Dof, FloatArray

OUTPUT = "output.txt"
MOST_KEPT = 20
"""Largest number of folders of failed runs that are kept."""


@dataclass(frozen=True)
class ProgramRun:
    """The function that runs a program at one theta (n_parameters,) and returns frequencies and shapes.

    Attributes
    ----------
    program : Path
        Path of the executable.
    store : SolveStore
        The store whose folder contains the folders of current and of failed runs.
    sensors : tuple of (place, direction)
        The sensors at which shapes are read.
    command, names, template, deck, folder, inputs, found, reader, result, timeout, keep
        See `fmu.CommandModel`. Here `template` is its text, `deck` the name of the filled deck, and `found` is
        `frequencies`.
    """

    program: Path
    command: tuple[str, ...]
    names: tuple[str, ...]
    template: str
    deck: Path
    folder: Path
    inputs: tuple[str, ...]
    found: FoundFrequencies | None
    reader: str | None
    result: str | None
    timeout: float
    keep: bool
    sensors: tuple[Dof, ...]
    store: SolveStore

    def __call__(self, theta: FloatArray) -> dict[str, FloatArray | None]:
        """Return a dict of frequencies in Hz and shapes, None without a reader; AnswerError if the run fails."""
        folder, failed = self.store.running_folder(theta), self.store.failed_folder(theta)
        shutil.rmtree(failed, ignore_errors=True)
        self._prepare(theta, folder)
        arguments = [self._name(part) for part in self.command[1:]]
        why = run_program([str(self.program), *arguments], folder, folder / OUTPUT, self.timeout)
        if not why:
            try:
                frequencies, shapes = self._read(folder)
            except ValueError as error:
                why = str(error)
            except (OSError, RecursionError, MemoryError) as error:
                why = in_words(error)
        if why:
            said = last_lines(folder / OUTPUT)
            reason = f"{self.command[0]}: {why}" + (f"; it printed at the end: {said}" if said else "")
            raise AnswerError(self._keep_files(one_line(reason), folder, failed))
        if not self.keep:
            shutil.rmtree(folder, ignore_errors=True)
        return {"frequencies": frequencies, "shapes": shapes}

    def is_outdated(self, solve: Solve) -> bool:
        """Return True if a stored run exceeded a time limit that has since been raised."""
        return TOO_LONG in solve.reason and solve.seconds < self.timeout

    def _prepare(self, theta: FloatArray, folder: Path) -> None:
        """Create the folder of a run, in place of an older one, with the filled deck and the other inputs."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        deck = fill_deck(self.template, dict(zip(self.names, theta.tolist(), strict=True)))
        write_deck(folder / self.deck, deck)
        for name in self.inputs:
            copy = folder / place_beside(name)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(self.folder / name, copy)

    def _read(self, folder: Path) -> tuple[FloatArray, FloatArray | None]:
        """Return the frequencies and the shapes, or None, that a run has written; ValueError if not all finite."""
        shapes = None
        if self.found is not None:
            frequencies = self.found.read(folder / self._name(self.found.file), self.timeout)
        else:
            form = READERS[str(self.reader)]
            path = _find_in_any_case(folder / self._name(self.result or form.result))
            frequencies, shapes = form.computed(path, self.sensors, folder / self.deck)
        for what, values in (("frequencies", frequencies), ("shapes", shapes)):
            if values is not None and not np.all(np.isfinite(values)):
                raise ValueError(f"{what}: must be finite (got {quote(values.ravel().tolist())})")
        return frequencies, shapes

    def _name(self, text: str) -> str:
        """Return a text with ``{job}`` and ``{deck}`` replaced by the deck's name, without and with its suffix."""
        return text.replace("{job}", self.deck.stem).replace("{deck}", self.deck.name)

    def _keep_files(self, reason: str, folder: Path, failed: Path) -> str:
        """Keep the files of a failed run, unless many are kept already; return the reason with their folder."""
        failed.parent.mkdir(parents=True, exist_ok=True)
        kept = sum(path.is_dir() for path in failed.parent.iterdir())
        if kept >= MOST_KEPT and not self.keep:
            shutil.rmtree(folder, ignore_errors=True)
            return reason
        with suppress(OSError):
            folder.replace(failed)
            return f"{reason}; its files are in {failed}"
        return reason


def _find_in_any_case(path: Path) -> Path:
    """Return the path of a file, whatever the case of its name: MYSTRAN writes ``job.F06``, not ``job.f06``."""
    if not path.exists():
        names = [other for other in path.parent.glob("*") if other.name.lower() == path.name.lower()]
        return names[0] if len(names) == 1 else path
    return path


def place_beside(name: str) -> Path:
    """Return the path of the copy of an input, relative to the folder of a run.

    A relative path without ``..`` is kept; of any other path only the file name is.
    """
    path = Path(name)
    return path if not path.is_absolute() and ".." not in path.parts else Path(path.name)
