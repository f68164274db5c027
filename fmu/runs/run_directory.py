"""The directory of ``fmu run`` while the run goes on: one process at a time, and what it needs to go on later."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from fmu.config.kept import ORIGIN, KeptProblem, keep
from fmu.runs.lock import FILE as PRESENCE
from fmu.runs.lock import LOCK, DirectoryLock, PhaseNote, announce
from fmu.runs.maxima import keep_maxima, kept_maxima
from fmu.runs.store import LEDGER

if TYPE_CHECKING:
    from fmu.analysis.maxima.results import Maxima

FOLDER = "checkpoints"


class RunDirectory:
    """Holds a run's directory for one process.

    Below ``checkpoints`` there is a directory a sampler (`fmu.runs.store.Store`), the problem with what was
    asked for, and what the search for maxima found. It is taken away when the run has ended.

    Parameters
    ----------
    path : Path
        It exists.

    Raises
    ------
    ValueError
        If another process is at work in it.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.folder = path, path / FOLDER
        self.folder.mkdir(exist_ok=True)
        self._hold = DirectoryLock(self.folder, f"--out: another fmu run is running in {path}")
        announce(self.folder)
        self._phase = PhaseNote(self.folder)

    def __enter__(self) -> RunDirectory:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and issubclass(kind, ValueError):  # the run could not be made
            self.abandon()
        self._hold.release()

    def note(self, phase: str, done: int, total: int) -> None:
        """Note how far a phase is that keeps nothing, for who looks on."""
        self._phase.note(phase, done, total)

    def keep(self, problem: KeptProblem) -> None:
        """Keep the problem and what is asked for, to go on with."""
        self._keep(problem, self.folder)

    def begin(self, problem: KeptProblem) -> None:
        """Forget what an earlier run has left to go on from, and keep the problem and what is asked for."""
        for path in self.folder.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name not in (LOCK, PRESENCE):
                path.unlink()
        self.keep(problem)

    def abandon(self) -> None:
        """Take everything away, if nothing has been drawn: the run was not one that could be made."""
        if not any(self.folder.glob("*/*/state-*")):
            self.ended()

    def of_sampler(self, name: str) -> Path:
        """Return the directory where the run of a sampler is kept."""
        return self.folder / name

    def maxima(self, search: Callable[[], Maxima]) -> Maxima:
        """Return what the search for maxima found, now or before the run was broken off."""
        found = kept_maxima(self.folder)
        if found is None:
            found = search()
            keep_maxima(self.folder, found)
        return found

    def take_ledger(self, sampler: str, to: Path) -> None:
        """Copy a sampler's ledger of failed solves; without one, take away that of an earlier run."""
        ledger = self.of_sampler(sampler) / LEDGER
        if ledger.is_file():
            shutil.copyfile(ledger, to)
        else:
            to.unlink(missing_ok=True)

    def finished(self, sampler: str, problem: KeptProblem) -> None:
        """Note that the trace of a sampler is written, and take away what it has left to go on from."""
        for directory in (self.path, self.folder):
            self._keep(problem, directory)
        shutil.rmtree(self.of_sampler(sampler), ignore_errors=True)

    def ended(self) -> None:
        """Take away what is only needed to go on: nothing is left to be done."""
        (self.folder / ORIGIN).unlink(missing_ok=True)  # first: so the rest counts for nothing
        self._hold.release()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _keep(self, problem: KeptProblem, directory: Path) -> None:
        pairing = str(problem.pairing)
        keep(problem.file, directory, pairing, problem.orders, problem.finished, problem.folder)


def unfinished(directory: Path) -> Path:
    """Return where the run in a directory keeps what it was asked for: below, as long as it is not done with."""
    return directory / FOLDER if (directory / FOLDER / ORIGIN).is_file() else directory
