"""One run's directory: draws are appended as files that never change again, states replace each other."""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from fmu.analysis.trace.failure_ledger import FailedSolves, failures_csv
from fmu.durable_files import (
    DamagedError,
    append_durably,
    digest,
    make_directory,
    payload_of,
    signed,
    write_durably,
)
from fmu.posterior.failures import Failure
from fmu.runs.content import (
    SavedState,
    Segment,
    packed_state,
    packed_steps,
    unpacked_failures,
    unpacked_state,
    unpacked_steps,
    writable,
)
from fmu.runs.identity import Identity, arithmetic
from fmu.runs.lock import DirectoryLock, announce
from fmu.runs.settings import Checkpoint
from fmu.samplers.loop.record import Steps
from fmu.samplers.loop.run import LIVE_S, PendingGroup, SavedGroup

LEDGER = "failures.csv"
TITLE = "fmu state 2"
_STATES = 2  # kept at a time: should the last be damaged, the one before it is there


class CheckpointWarning(UserWarning):
    """A file of a kept run is damaged: some of what was drawn has to be drawn again."""


class OtherArithmeticWarning(UserWarning):
    """A run goes on with another kind of CPU or BLAS: its draws are as good, but differ in their last bits."""


class Store:
    """Keeps the groups of a run in a directory, and gives them back.

    There is one directory a group, ``group-1`` for the first. ``steps-000001.h5`` and so on in it hold the draws,
    in HDF5; ``state-000007`` what the sampler needs to go on after them, the list of these files and their
    checksums. A file appears whole or not at all, so that the directory can be read at any time; whatever lies
    there that no state lists, counts for nothing and is drawn again. ``failures.csv`` is the ledger of failed
    solves, where there are some.

    Parameters
    ----------
    settings : Checkpoint
    identity : Identity
    names, units : sequence of str
        Of the parameters.

    Raises
    ------
    ValueError
        If the directory holds another run, or another process is at this one.
    OSError
        If the directory cannot be made or written to.
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
        self._kept_at: dict[int, float] = {}
        self.directory.mkdir(parents=True, exist_ok=True)
        self._hold = DirectoryLock(self.directory, f"checkpoint: another run is running in {self.directory}")
        try:
            identity.check(self.directory)
            self._tidy()
            announce(self.directory)
        except BaseException:
            self.close()
            raise

    def kept(self, group: int) -> SavedGroup | None:
        """Return a group as it was kept last and intact, None if there is no such thing.

        Warns
        -----
        CheckpointWarning
            If something is damaged.
        OtherArithmeticWarning
            If it was kept by another kind of machine.
        """
        self._kept_at[group] = time.monotonic()
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
        return SavedGroup(state.group_state, state.elapsed_s, files.steps(state))

    def is_due(self, group: int, steps: int) -> bool:
        """Say whether a group that has since taken so many steps is to be kept again."""
        waited = time.monotonic() - self._kept_at[group]
        return steps >= self.most_steps or waited >= self.settings.seconds - LIVE_S

    def keep(self, group: int, pending: PendingGroup) -> None:
        """Append the steps to what is kept, and note where they led to.

        Raises
        ------
        OSError
            If the disk is full, or gone. What was kept before is intact.
        """
        failures = [Failure(failure.theta, writable(failure.reason)) for failure in pending.failures]
        pending = pending._replace(failures=failures)
        try:
            if not self._is_named:  # not before there are draws: a call that fails leaves the directory to another
                self.identity.write(self.directory)
                self._is_named = True
            segment = self._files(group).append(self.identity.hash, pending)
            if segment.failed:
                self._note([_failed(group, segment, failures)])
        except OSError as error:
            done = pending.first
            raise OSError(
                f"checkpoint: cannot write to {self.directory} ({error.strerror or error}); what was drawn before "
                f"{pending.phase} step {done + 1} of group {group + 1} is saved there"
            ) from error
        self._kept_at[group] = time.monotonic()

    def close(self) -> None:
        """Let others at the directory."""
        self._hold.release()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _tidy(self) -> None:
        """Take away what killed processes have left half written, and the ledger, which the segments hold too."""
        for leftover in (*self.directory.rglob(".*.part"), self.directory / LEDGER):
            with suppress(OSError):  # it does no harm
                leftover.unlink(missing_ok=True)

    def _note(self, failed: list[FailedSolves]) -> None:
        """Append failed solves to the ledger."""
        if failed:
            rows = failures_csv(self._names, self._units, failed, header=not self._has_ledger)
            append_durably(self.directory / LEDGER, rows.encode())
            self._has_ledger = True

    def _files(self, group: int) -> _GroupFiles:
        if group not in self._groups:
            self._groups[group] = _GroupFiles(self.directory / f"group-{group + 1}")
        return self._groups[group]


class _GroupFiles:
    """The files of one group."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.segments: list[Segment] = []
        self._number = 0
        self._intact: list[Path] = []

    def last_intact(self, configuration: str) -> SavedState | None:
        """Return the newest state that is whole, with all its segments, and go on from there."""
        states = numbered(self.directory, "state")
        for _, path in reversed(states):
            try:
                state = read_state(path)
                if state.configuration != configuration:
                    raise ValueError(f"checkpoint: {path} belongs to another run")
                for segment in state.segments:
                    self._content(segment)
            except (DamagedError, OSError) as error:
                then = "starts again" if path == states[0][1] else "resumes from the state before it"
                warnings.warn(f"{path} is damaged ({error}): the group {then}", CheckpointWarning, stacklevel=5)
                continue
            self.segments, self._number = list(state.segments), states[-1][0]
            self._intact = [path]
            return state
        self._number = states[-1][0] if states else 0
        return None

    def steps(self, state: SavedState) -> Iterator[tuple[str, int, Steps]]:
        """Read the segments of a state, one after the other."""
        for segment in state.segments:
            yield segment.phase, segment.first, unpacked_steps(self._content(segment))

    def failures(self, group: int) -> list[FailedSolves]:
        """Return what failed in all segments."""
        failing = (segment for segment in self.segments if segment.failed)
        return [_failed(group, segment, unpacked_failures(self._content(segment))) for segment in failing]

    def append(self, configuration: str, pending: PendingGroup) -> Segment:
        """Write a segment, then the state that lists it, and forget older states; the segment is returned."""
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
        write_durably(path, signed(TITLE, packed_state(state)))
        self.segments.append(segment)
        self._number += 1
        self._intact = [*self._intact, path][-_STATES:]
        for _, old in numbered(self.directory, "state"):
            if old not in self._intact:
                with suppress(OSError):  # it does no harm
                    old.unlink()
        return segment

    def _content(self, segment: Segment) -> bytes:
        """Return the bytes of a segment; DamagedError unless they are those that were written."""
        try:
            content = (self.directory / segment.name).read_bytes()
        except OSError as error:
            raise DamagedError(f"{segment.name} cannot be read: {error.strerror}") from error
        if digest(content) != segment.sha256:
            raise DamagedError(f"the checksum of {segment.name} is wrong")
        return content


def _failed(group: int, segment: Segment, failures: Sequence[Failure]) -> FailedSolves:
    return FailedSolves(group, segment.phase, segment.first + segment.steps, failures, segment.failed)


def numbered(directory: Path, kind: str) -> list[tuple[int, Path]]:
    """Return the files of one kind in a directory, such as ``state-000007``, by number."""
    matches = ((re.fullmatch(rf"{kind}-(\d+)", path.name), path) for path in directory.glob(f"{kind}-*"))
    return sorted((int(match[1]), path) for match, path in matches if match)


def read_state(path: Path) -> SavedState:
    """Return the state in a file; DamagedError if it is not as it was written."""
    return unpacked_state(payload_of(TITLE, path.read_bytes()))
