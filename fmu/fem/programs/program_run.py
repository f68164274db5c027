"""One run of a program in its own folder: the deck is filled, the program started, its results are read."""

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
"""Folders of failed runs that are kept."""


@dataclass(frozen=True)
class ProgramRun:
    """A program that is run at one theta (n_parameters,), as a function that returns frequencies and shapes.

    Attributes
    ----------
    program : Path
    store : SolveStore
        Its folder has those of the runs under way, and of those that failed.
    sensors : tuple of (place, direction)
        Where shapes are read.
    command, names, template, deck, folder, inputs, found, reader, result, timeout, keep
        See `fmu.CommandModel`; the template is the text, and the deck the name of the file that is written.
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
        """Return frequencies, and shapes if there are any; AnswerError if the program fails."""
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
        """Say whether a run took longer than a limit that is higher now."""
        return TOO_LONG in solve.reason and solve.seconds < self.timeout

    def _prepare(self, theta: FloatArray, folder: Path) -> None:
        """Make the folder of a run anew, with the deck and the other inputs."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        deck = fill_deck(self.template, dict(zip(self.names, theta.tolist(), strict=True)))
        write_deck(folder / self.deck, deck)
        for name in self.inputs:
            copy = folder / place_beside(name)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(self.folder / name, copy)

    def _read(self, folder: Path) -> tuple[FloatArray, FloatArray | None]:
        """Return frequencies and shapes that a run has written; ValueError if they are not all finite."""
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
        """Return a text with the deck's name for ``{job}`` and ``{deck}``."""
        return text.replace("{job}", self.deck.stem).replace("{deck}", self.deck.name)

    def _keep_files(self, reason: str, folder: Path, failed: Path) -> str:
        """Keep the files of a failed run, unless many are kept; return the reason with their place."""
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
    """Return the file of a name: MYSTRAN writes ``job.F06`` where others write ``job.f06``."""
    if not path.exists():
        names = [other for other in path.parent.glob("*") if other.name.lower() == path.name.lower()]
        return names[0] if len(names) == 1 else path
    return path


def place_beside(name: str) -> Path:
    """Return where a copy of an input is, in the folder of a run: a path within the folder of the file is kept."""
    path = Path(name)
    return path if not path.is_absolute() and ".." not in path.parts else Path(path.name)
