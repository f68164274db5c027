"""A run's checkpoint. Draws are added in files that never change, and new states replace old ones."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Self

import numpy as np

from fmu.analysis.trace.failure_ledger import FailedSolves, failures_csv
from fmu.durable_files import DamagedError, append_durably, digest, make_directory, write_durably
from fmu.posterior.failures import Failure
from fmu.runs import Checkpoint
from fmu.runs.content import (
    SavedState,
    Segment,
    numbered_files,
    packed_steps,
    read_segment,
    read_state,
    state_file,
    unpacked_failures,
    unpacked_steps,
    writable,
)
from fmu.runs.identity import Identity, arithmetic
from fmu.runs.lock import DirectoryLock, announce
from fmu.samplers.loop.record import Steps
from fmu.samplers.loop.run import LIVE_S
from fmu.samplers.loop.saving import PendingGroup, SavedGroup

LEDGER = "failures.csv"
_STATES = 2  # number of states to keep: if the last one is damaged, the previous one is used


class CheckpointWarning(UserWarning):
    """Warns that a file in a checkpoint is damaged, so that some steps must be drawn again."""


class OtherArithmeticWarning(UserWarning):
    """Warns that a run is resumed with another CPU or BLAS. The draws are valid, but differ in the last bits."""


class Store:
    """A run's checkpoint in a directory, in which the groups of chains are saved and from which they are restored.

    Each group has its own directory; the first is ``group-1``. Its step files ``steps-000001.h5``, … contain the
    draws in HDF5. A state file such as ``state-000007`` contains the data that the sampler needs to continue after
    these draws, and a list of the step files with their checksums. These files are written atomically, so they
    can be read at any time. Step files that are not listed in a state are ignored, and their steps are drawn
    again. ``failures.csv`` lists the failed solves, if there are any.

    Parameters
    ----------
    settings : Checkpoint
    identity : Identity
    names, units : sequence of str
        Names and units of the parameters.

    Raises
    ------
    ValueError
        If the directory contains another run, or the same run with other versions of fmu, NumPy, SciPy or emcee,
        or if another run is going on in it.
    OSError
        If the directory cannot be created or written to.
    """

    def __init__(
        self, settings: Checkpoint, identity: Identity, names: Sequence[str], units: Sequence[str]
    ) -> None:
        self.settings, self.identity = settings, identity
        self._names, self._units = names, units
        self.directory = Path(settings.directory)
        self.most_steps, self.most_seconds = settings.draws, settings.seconds
        self._is_named = self._has_ledger = False
        self._groups: dict[int, _GroupFiles] = {}
        self._saved_at: dict[int, float] = {}
        self.directory.mkdir(parents=True, exist_ok=True)
        self._lock = DirectoryLock(self.directory, f"checkpoint: another run is running in {self.directory}")
        try:
            identity.check(self.directory)
            self._tidy()
            announce(self.directory)
        except BaseException:
            self.close()
            raise

    def kept(self, group: int) -> SavedGroup | None:
        """Return a group in its newest undamaged state, or None if there is no such state.

        Raises
        ------
        ValueError
            If the state belongs to another run, or an earlier version of fmu wrote it.
        OSError
            If the failed solves cannot be written to ``failures.csv``.

        Warns
        -----
        CheckpointWarning
            If a file is damaged.
        OtherArithmeticWarning
            If the state was saved with a different type of CPU or BLAS.
        """
        self._saved_at[group] = time.monotonic()
        files = self._files(group)
        state = files.last_intact(self.identity.hash)
        if state is None:
            return None
        if state.arithmetic != arithmetic():
            warnings.warn(
                f"{self.directory} was written with another kind of CPU or BLAS ({state.arithmetic}; here "
                f"{arithmetic()}): the run is resumed, but not bit for bit",
                OtherArithmeticWarning,
                stacklevel=4,
            )
        self._note(files.failures(group))
        return SavedGroup(state.group_state, state.elapsed_s, files.steps())

    def is_due(self, group: int, steps: int) -> bool:
        """Return True if a group must be saved now. `steps` is the number of steps since its last save."""
        waited = time.monotonic() - self._saved_at[group]
        return steps >= self.most_steps or waited >= self.most_seconds - LIVE_S

    def keep(self, group: int, pending: PendingGroup) -> None:
        """Save the new steps of a group, and its state after these steps.

        Raises
        ------
        OSError
            If the directory cannot be written to, for example because the disk is full. Earlier saves are intact.
        """
        failures = [Failure(failure.theta, writable(failure.reason)) for failure in pending.failures]
        pending = pending._replace(failures=failures)
        try:
            if not self._is_named:  # with the first draws: an earlier failure leaves the directory free
                self.identity.write(self.directory)
                self._is_named = True
            segment = self._files(group).append(self.identity.hash, pending)
            if segment.failed:
                self._note([_failed_solves(group, segment, failures)])
        except OSError as error:
            raise OSError(
                f"checkpoint: cannot write to {self.directory} ({error.strerror or error}); everything before "
                f"{pending.phase} step {pending.first + 1} of group {group + 1} is saved there"
            ) from error
        self._saved_at[group] = time.monotonic()

    def close(self) -> None:
        """Remove this process's notes, and release the lock on the directory."""
        self._lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _tidy(self) -> None:
        """Remove unfinished files of killed processes, and ``failures.csv``, which is rebuilt from the steps."""
        for leftover in (*self.directory.rglob(".*.part"), self.directory / LEDGER):
            with suppress(OSError):  # a remaining file does no harm
                leftover.unlink(missing_ok=True)

    def _note(self, failed: list[FailedSolves]) -> None:
        """Append failed solves to ``failures.csv``."""
        if failed:
            rows = failures_csv(self._names, self._units, failed, header=not self._has_ledger)
            append_durably(self.directory / LEDGER, rows.encode())
            self._has_ledger = True

    def _files(self, group: int) -> _GroupFiles:
        if group not in self._groups:
            self._groups[group] = _GroupFiles(self.directory / f"group-{group + 1}")
        return self._groups[group]


class _GroupFiles:
    """The files of one group: all step files so far, and the latest states."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.segments: list[Segment] = []
        self._number = 0
        self._intact: list[Path] = []

    def last_intact(self, configuration: str) -> SavedState | None:
        """Return the newest state that is undamaged and whose step files are undamaged, or None if there is none.

        Later calls of `append` continue from this state. Each damaged file causes a CheckpointWarning. Raise
        ValueError if a state belongs to another run or was written by an earlier version of fmu.
        """
        states = numbered_files(self.directory, "state")
        self._number = states[-1][0] if states else 0
        for _, path in reversed(states):
            try:
                state = read_state(path)
                if state.configuration != configuration:
                    raise ValueError(f"checkpoint: {path} belongs to another run")
                for segment in state.segments:
                    read_segment(self.directory, segment)
            except (DamagedError, OSError) as error:
                then = "starts again" if path == states[0][1] else "resumes from the state before it"
                warnings.warn(f"{path} is damaged ({error}): the group {then}", CheckpointWarning, stacklevel=5)
                continue
            self.segments, self._intact = list(state.segments), [path]
            return state
        return None

    def steps(self) -> Iterator[tuple[str, int, Steps]]:
        """Yield each file's phase, the index of its first step, and its steps, in order.

        Raise DamagedError if a file is missing or has changed.
        """
        for segment in self.segments:
            yield segment.phase, segment.first, unpacked_steps(read_segment(self.directory, segment))

    def failures(self, group: int) -> list[FailedSolves]:
        """Return the failed solves, with one entry per step file that contains any.

        Raise DamagedError if a file is missing or has changed.
        """
        return [
            _failed_solves(group, segment, unpacked_failures(read_segment(self.directory, segment)))
            for segment in self.segments
            if segment.failed
        ]

    def append(self, configuration: str, pending: PendingGroup) -> Segment:
        """Write a step file and a state that lists it; return the step file's entry. Only two states are kept."""
        make_directory(self.directory)
        content = packed_steps(pending.steps, pending.failures)
        stats = pending.steps.stats
        segment = Segment(
            f"steps-{len(self.segments) + 1:06d}.h5",
            digest(content),
            pending.phase,
            pending.first,
            len(pending.steps),
            int(stats["n_solves"].sum()),
            max(int(np.sum(stats.get("n_nonfinite", 0))), len(pending.failures)),
        )
        write_durably(self.directory / segment.name, content)
        segments = [*self.segments, segment]
        state = SavedState(
            configuration, arithmetic(), pending.group_state, pending.elapsed_s, segments, pending.total
        )
        path = self.directory / f"state-{self._number + 1:06d}"
        write_durably(path, state_file(state))
        self.segments = segments
        self._number += 1
        self._intact = [*self._intact, path][-_STATES:]
        for _, old in numbered_files(self.directory, "state"):
            if old not in self._intact:
                with suppress(OSError):  # a remaining file does no harm
                    old.unlink()
        return segment


def _failed_solves(group: int, segment: Segment, failures: Sequence[Failure]) -> FailedSolves:
    return FailedSolves(group, segment.phase, segment.first + segment.steps, failures, segment.failed)
