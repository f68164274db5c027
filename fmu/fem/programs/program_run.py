"""One run of a program in its own folder: fill in the deck, start the program and read its results."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fmu.engines.program import TOO_LONG
from fmu.fem.programs.answers import AnswerError
from fmu.fem.programs.deck_run import DeckRun
from fmu.fem.programs.found_frequencies import FoundFrequencies
from fmu.fem.programs.store import Solve, SolveStore
from fmu.formats.modes import READERS
from fmu.formats.shown import in_words, quote
from fmu.types import Dof, FloatArray

MOST_KEPT = 20
"""Largest number of failed runs whose folders are kept."""


@dataclass(frozen=True)
class ProgramRun:
    """Callable that runs a program at one theta (n_parameters,) and returns frequencies and shapes.

    Attributes
    ----------
    run : DeckRun
        The deck and the program.
    names : tuple of str
        Parameter names in the order of theta.
    found, reader, result, keep
        See `fmu.CommandModel`, where `found` is called `frequencies`.
    sensors : tuple of (place, direction)
        Sensors at which shapes are read.
    store : SolveStore
        The store whose folder contains the folders of current and of failed runs.
    """

    run: DeckRun
    names: tuple[str, ...]
    found: FoundFrequencies | None
    reader: str | None
    result: str | None
    keep: bool
    sensors: tuple[Dof, ...]
    store: SolveStore

    def __call__(self, theta: FloatArray) -> dict[str, FloatArray | None]:
        """Return a dict of frequencies in Hz and shapes, or raise AnswerError if the run fails.

        The shapes are None if there is no reader or no sensor.
        """
        folder, failed = self.store.running_folder(theta), self.store.failed_folder(theta)
        shutil.rmtree(failed, ignore_errors=True)
        why = self.run.execute(dict(zip(self.names, theta.tolist(), strict=True)), folder)
        if not why:
            try:
                frequencies, shapes = self._read(folder)
            except ValueError as error:
                why = str(error)
            except (OSError, RecursionError, MemoryError) as error:
                why = in_words(error)
        if why:
            raise AnswerError(self._keep_files(self.run.explain(why, folder), folder, failed))
        if not self.keep:
            shutil.rmtree(folder, ignore_errors=True)
        return {"frequencies": frequencies, "shapes": shapes}

    def is_outdated(self, solve: Solve) -> bool:
        """Return True if a stored run exceeded a time limit that has since been raised."""
        return TOO_LONG in solve.reason and solve.seconds < self.run.timeout

    def _read(self, folder: Path) -> tuple[FloatArray, FloatArray | None]:
        """Read the frequencies and the shapes (or None) from a run.

        Raise ValueError if they cannot be read or are not all finite.
        """
        shapes = None
        if self.found is not None:
            frequencies = self.found.read(folder / self.run.name(self.found.file), self.run.timeout)
        else:
            form = READERS[str(self.reader)]
            path = self.run.find_output(self.result or form.result, folder)
            frequencies, shapes = form.computed(path, self.sensors, folder / self.run.deck)
        for what, values in (("frequencies", frequencies), ("shapes", shapes)):
            if values is not None and not np.all(np.isfinite(values)):
                raise ValueError(f"{what}: must be finite (got {quote(values.ravel().tolist())})")
        return frequencies, shapes

    def _keep_files(self, reason: str, folder: Path, failed: Path) -> str:
        """Save a failed run's files, and return the reason with their folder added.

        If `MOST_KEPT` runs are saved already and not all runs are to be kept, delete the files and return the
        reason unchanged.
        """
        kept = sum(path.is_dir() for path in failed.parent.glob("*"))
        if kept >= MOST_KEPT and not self.keep:
            shutil.rmtree(folder, ignore_errors=True)
            return reason
        return self.run.move_failed(reason, folder, failed)
