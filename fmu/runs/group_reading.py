"""Where a group of chains stands, read from its files while they may be written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fmu.durable_files import DamagedError, digest
from fmu.runs.content import SavedState, Segment, unpacked_steps
from fmu.runs.store import numbered, read_state
from fmu.samplers.loop.group import DRAWS, WARMUP
from fmu.types import FloatArray

_TRIES = 5
"""How often the files are listed anew: states go while others come."""


class _Read(NamedTuple):
    """What is needed of a file of steps: how many moves of how many were accepted, and where draws are."""

    accepted: int
    moves: int
    position: FloatArray | None


@dataclass(frozen=True)
class KeptGroup:
    """A group as it was kept last.

    Attributes
    ----------
    done : mapping of str to int
        Steps of the phases.
    phase : {"warmup", "draws"}
        Of the last step.
    total : int
        Steps of that phase, as far as it was known.
    at : float
        When it was kept, in seconds since 1970.
    elapsed_s : mapping of str to float
        What the phases of the run had taken.
    solves, failed : int
    accept : float
        Share of the moves of the phase that were accepted.
    draws : ndarray, shape (chains, steps, walkers, ndim), or None
        None if a file of them is damaged, or there are none.
    """

    done: Mapping[str, int]
    phase: str
    total: int
    at: float
    elapsed_s: Mapping[str, float]
    solves: int
    failed: int
    accept: float
    draws: FloatArray | None


class GroupReader:
    """Reads groups; a file of steps, which never changes, only once.

    Parameters
    ----------
    directory : Path
        Of the group.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._read: dict[tuple[str, str], _Read] = {}

    def read(self) -> tuple[KeptGroup | None, list[str]]:
        """Return the group, None if nothing whole is kept of it; and what is damaged, in words."""
        damaged: list[str] = []
        found = self._last_state(damaged)
        if found is None:
            return None, damaged
        state, at = found
        phase = state.segments[-1].phase if state.segments else WARMUP
        files = [file for segment in state.segments if (file := self._steps(segment, phase, damaged)) is not None]
        accepted, moves = sum(file.accepted for file in files), sum(file.moves for file in files)
        positions = [file.position for file in files if file.position is not None]
        is_whole = sum(x.shape[1] for x in positions) == state.group_state.done[DRAWS]
        group = KeptGroup(
            done=dict(state.group_state.done),
            phase=phase,
            total=state.total,
            at=at,
            elapsed_s=dict(state.elapsed_s),
            solves=sum(segment.solves for segment in state.segments),
            failed=sum(segment.failed for segment in state.segments),
            accept=accepted / moves if moves else np.nan,
            draws=np.concatenate(positions, axis=1) if positions and is_whole else None,
        )
        return group, damaged

    def _last_state(self, damaged: list[str]) -> tuple[SavedState, float] | None:
        """Return the newest state that is whole, and when it was written; put into words what is not."""
        for _ in range(_TRIES):
            damaged.clear()
            states = numbered(self.directory, "state")
            for _, path in reversed(states):
                try:
                    return read_state(path), path.stat().st_mtime
                except FileNotFoundError:  # two have come since
                    break
                except (DamagedError, OSError) as error:
                    damaged.append(_in_words(path, error))
            else:
                return None
        return None

    def _steps(self, segment: Segment, phase: str, damaged: list[str]) -> _Read | None:
        """Return what is needed of a file of steps, None if it is of no interest any more, or damaged."""
        if segment.phase != phase:
            return None
        key = (segment.name, segment.sha256)
        if key not in self._read:
            path = self.directory / segment.name
            try:
                content = path.read_bytes()
                if digest(content) != segment.sha256:
                    raise DamagedError("its checksum is wrong")
            except (DamagedError, OSError) as error:
                damaged.append(_in_words(path, error))
                return None
            steps = unpacked_steps(content)
            accepted = steps.stats["accepted"]
            position = steps.position if phase == DRAWS else None
            self._read[key] = _Read(int(np.sum(accepted)), accepted.size, position)
        return self._read[key]


def _in_words(path: Path, error: Exception) -> str:
    why = (error.strerror or str(error)) if isinstance(error, OSError) else str(error)
    return f"{path.parent.name}/{path.name} is damaged: {why}"
