"""Manage the output directory of ``fmu run`` during a run: its lock, and the files for resuming the run."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Self

from fmu.config.kept import FILE, ORIGIN, KeptProblem
from fmu.runs.lock import FILE as PRESENCE
from fmu.runs.lock import LOCK, DirectoryLock, PhaseNote, announce
from fmu.runs.store import LEDGER

FOLDER = "checkpoints"


class RunDirectory:
    """A run's output directory, which only one process can use at a time.

    Its folder ``checkpoints`` contains a directory for each sampler (`fmu.runs.store.Store`), the run's problem
    and options, and the maxima that were found. The folder is removed at the end of the run, unless a sampler
    reached its limit on solves and can be resumed. If no steps have been saved yet, not even warm-up steps, the
    folder is also removed when the run fails with a ValueError, or when the problem cannot be built because of an
    OSError or conflicting options.

    Parameters
    ----------
    path : Path
        An existing directory.

    Raises
    ------
    ValueError
        If another process is running in the directory.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.folder = path, path / FOLDER
        self.folder.mkdir(exist_ok=True)
        self._lock = DirectoryLock(self.folder, f"--out: another fmu run is running in {path}")
        announce(self.folder)
        self.note = PhaseNote(self.folder).note

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None and issubclass(kind, ValueError):
            self.abandon()
        self._lock.release()

    def abandon(self) -> None:
        """Remove the folder ``checkpoints`` and release the lock, unless the folder contains saved steps."""
        if not any(self.folder.glob("*/*/state-*")):
            self.end_run()

    def begin(self, problem: KeptProblem) -> None:
        """Remove the files for resuming an earlier run, and save this run's problem and options."""
        for path in self.folder.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name not in (LOCK, PRESENCE, FILE, ORIGIN):  # the last two are replaced below
                path.unlink()
        problem.save(self.folder)

    def of_sampler(self, name: str) -> Path:
        """Return the directory for a sampler's checkpoint."""
        return self.folder / name

    def take_ledger(self, sampler: str, to: Path) -> None:
        """Copy the list of a sampler's failed solves to the file `to`. If there is no list, remove the file."""
        ledger = self.of_sampler(sampler) / LEDGER
        if ledger.is_file():
            shutil.copyfile(ledger, to)
        else:
            to.unlink(missing_ok=True)

    def finish_sampler(self, sampler: str, problem: KeptProblem) -> None:
        """Record that a sampler's trace has been written, and remove its checkpoint.

        `problem` must list the sampler among those that have finished.
        """
        for directory in (self.path, self.folder):
            problem.save(directory)
        shutil.rmtree(self.of_sampler(sampler), ignore_errors=True)

    def end_run(self) -> None:
        """Remove the files that only a resumed run needs, and release the lock."""
        (self.folder / ORIGIN).unlink(missing_ok=True)  # removed first: without it the folder is ignored
        self._lock.release()
        shutil.rmtree(self.folder, ignore_errors=True)


def folder_of_order(directory: Path) -> Path:
    """Return the folder with a run's problem and options: ``checkpoints`` until the run ends, then `directory`."""
    return directory / FOLDER if (directory / FOLDER / ORIGIN).is_file() else directory
