"""Read a sampler's progress from the files of its chain groups or, if the sampler has finished, from its trace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fmu.analysis.convergence.effective import live_diagnostics
from fmu.durable_files import DamagedError
from fmu.runs.content import SavedState, Segment, numbered_files, read_segment, read_state, unpacked_steps
from fmu.samplers.loop.group import DRAWS, WARMUP
from fmu.types import FloatArray

_FEWEST = 20  # smallest number of draws for meaningful diagnostics
_TRIES = 5
"""Number of attempts to list the files of a group, because states are removed while new states appear."""


@dataclass(frozen=True)
class Progress:
    """Progress of one group of chains, or of all groups together. Unknown values are NaN or None.

    Attributes
    ----------
    group : str
        The group's number and the number of groups, such as ``2/4``; empty for all groups together.
    phase : str
        "warmup", "draws", or empty if nothing has been saved yet.
    done : int
        Number of completed steps in the phase; for all groups together, the smallest number in any group.
    total : int or None
        Total number of steps in the phase.
    kept_s : float or None
        Time in s since the last save; for all groups together, since the last save of any group.
    accept : float
        Fraction of accepted moves in the phase.
    rhat, ess : float
        Largest R-hat and smallest bulk ESS of any parameter, from all groups' draws; NaN in the progress of a
        single group.
    solves, failed : int
        Numbers of all solves and of failed solves, including warm-up.
    solves_per_s : float
    remaining_s : float or None
        Remaining time in s at the pace so far.
    chains : int
        Number of chains or, for an ensemble sampler, of ensembles; 0 if unknown.
    """

    group: str = ""
    phase: str = ""
    done: int = 0
    total: int | None = None
    kept_s: float | None = None
    accept: float = np.nan
    rhat: float = np.nan
    ess: float = np.nan
    solves: int = 0
    failed: int = 0
    solves_per_s: float = np.nan
    remaining_s: float | None = None
    chains: int = 0


class KeptGroup(NamedTuple):
    """A group of chains as last saved.

    Attributes
    ----------
    state : SavedState
    phase : {"warmup", "draws"}
        Phase of the last step.
    at : float
        Time of the save, in s since 1970.
    accept : float
        Fraction of accepted moves in the phase.
    draws : ndarray, shape (chains, steps, walkers, ndim), or None
        None if there are no draws, or if a step file is damaged.
    """

    state: SavedState
    phase: str
    at: float
    accept: float
    draws: FloatArray | None

    @property
    def done(self) -> dict[str, int]:
        """Number of completed steps in each phase, keyed by phase name."""
        return dict(self.state.group_state.done)

    @property
    def chains(self) -> int:
        """Number of chains; 0 if their start is not known yet."""
        at = self.state.group_state
        position = at.start if at.state is None else at.state.position
        return 0 if position is None else len(position)

    @property
    def elapsed_s(self) -> float:
        """Time in s that the run had taken when the group was saved."""
        return sum(self.state.elapsed_s.values())

    def seconds_left(self, warmup: int, draws: int | None) -> float | None:
        """Return the time in s that the group still needed when it was saved, or None if this is unknown.

        The time is extrapolated from the pace of the steps in the phase of the last step. `warmup` and `draws` are
        the planned numbers of steps.
        """
        done = self.done
        if draws is None or done[self.phase] == 0:
            return None
        left = warmup - done[WARMUP] + draws - done[DRAWS]
        return max(left, 0) * self.state.elapsed_s[self.phase] / done[self.phase]

    def progress(self, label: str, warmup: int, draws: int | None, now: float, runs: bool) -> Progress:
        """Return the group's progress.

        Parameters
        ----------
        label : str
            The group's label, such as ``2/4``.
        warmup : int
            Number of warm-up steps.
        draws : int or None
            Number of steps requested after the warm-up, if known.
        now : float
            Current time, in s since 1970.
        runs : bool
            Whether the group has been running since the save.
        """
        phase = WARMUP if self.done[WARMUP] < warmup else DRAWS
        if self.phase == DRAWS:  # more draws may have been requested since
            draws = max(self.state.total, draws or 0)
        solves = sum(segment.solves for segment in self.state.segments)
        kept_s, left_s = max(now - self.at, 0.0), self.seconds_left(warmup, draws)
        return Progress(
            label,
            phase,
            self.done[phase],
            warmup if phase == WARMUP else draws,
            kept_s,
            self.accept,
            solves=solves,
            failed=sum(segment.failed for segment in self.state.segments),
            solves_per_s=_per_s(solves, self.elapsed_s),
            remaining_s=left_s if left_s is None or not runs else max(left_s - kept_s, 0.0),
            chains=self.chains,
        )


class _Steps(NamedTuple):
    """Data from a step file for the diagnostics: the numbers of accepted moves and of all moves, and the draws.

    The draws are None in warm-up.
    """

    accepted: int
    moves: int
    position: FloatArray | None


class GroupReader:
    """Reads the files of a group of chains, repeatedly if needed. Each step file is read only once.

    Parameters
    ----------
    directory : Path
        The group's directory.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._read: dict[tuple[str, str], _Steps] = {}

    def read(self) -> tuple[KeptGroup | None, list[str]]:
        """Return the group and messages about damaged files. The group is None if there is no intact state."""
        damaged: list[str] = []
        found = self._last_state(damaged)
        if found is None:
            return None, damaged
        state, at = found
        phase = state.segments[-1].phase if state.segments else WARMUP
        files = []
        for segment in state.segments:
            if segment.phase == phase:
                try:
                    files.append(self._steps(segment))
                except DamagedError as error:
                    damaged.append(f"{self.directory.name} is damaged: {error}")
        moves = sum(file.moves for file in files)
        positions = [file.position for file in files if file.position is not None]
        is_whole = sum(x.shape[1] for x in positions) == state.group_state.done[DRAWS]
        accept = sum(file.accepted for file in files) / moves if moves else np.nan
        draws = np.concatenate(positions, axis=1) if positions and is_whole else None
        return KeptGroup(state, phase, at, accept, draws), damaged

    def _last_state(self, damaged: list[str]) -> tuple[SavedState, float] | None:
        """Return the newest undamaged state, and the time in s since 1970 at which its file was written.

        Return None if all states are damaged, if there are no states, or if an earlier version of fmu wrote the
        files. `damaged` is cleared, and a message about each file that cannot be used is appended to it.
        """
        for _ in range(_TRIES):
            damaged.clear()
            for _, path in reversed(numbered_files(self.directory, "state")):
                try:
                    return read_state(path), path.stat().st_mtime
                except FileNotFoundError:  # the state was removed after two newer states appeared
                    break
                except (DamagedError, OSError) as error:
                    damaged.append(f"{self.directory.name}/{path.name} is damaged: {why(error)}")
                except ValueError as error:  # written by an earlier version, as are all older states
                    damaged.append(str(error))
                    return None
            else:
                return None
        return None

    def _steps(self, segment: Segment) -> _Steps:
        key = (segment.name, segment.sha256)
        if key not in self._read:
            steps = unpacked_steps(read_segment(self.directory, segment))
            accepted = steps.stats["accepted"]
            position = steps.position if segment.phase == DRAWS else None
            self._read[key] = _Steps(int(np.sum(accepted)), accepted.size, position)
        return self._read[key]


def together(groups: Sequence[Progress], kept: Sequence[KeptGroup | None]) -> Progress:
    """Combine the progress of a sampler's chain groups. The result is empty if no group has saved anything yet."""
    begun = [group for group in groups if group.phase]
    if not begun:
        return Progress()
    phase = WARMUP if any(group.phase != DRAWS for group in groups) else DRAWS
    behind = [group for group in begun if group.phase == phase]
    totals = [group.total for group in behind if group.total is not None]
    left = [group.remaining_s for group in groups]
    accept = [group.accept for group in behind if not np.isnan(group.accept)]
    solves = sum(group.solves for group in groups)
    return Progress(
        "",
        phase,
        min(group.done if group.phase else 0 for group in groups if group.phase in ("", phase)),
        max(totals, default=None),
        min(group.kept_s for group in begun if group.kept_s is not None),
        float(np.mean(accept)) if accept else np.nan,
        **_diagnostics(kept),
        solves=solves,
        failed=sum(group.failed for group in groups),
        solves_per_s=_per_s(solves, max(one.elapsed_s for one in kept if one is not None)),
        remaining_s=None if None in left else max(s for s in left if s is not None),
        chains=sum(group.chains for group in groups),
    )


def of_trace(path: Path) -> Progress:
    """Return a finished sampler's progress, from its trace.

    Raises
    ------
    OSError, ValueError, KeyError
        If the trace is missing or damaged, or lacks data.
    """
    from fmu.analysis.trace.conversion import load_trace
    from fmu.analysis.trace.reading import parameter_draws, walkers_of

    trace = load_trace(path)
    attrs, stats = trace.attrs, [trace[group] for group in ("warmup_sample_stats", "sample_stats")]
    solves, draws = int(attrs["n_solves"]) + int(attrs["warmup_n_solves"]), int(attrs["draws"])
    live = live_diagnostics(parameter_draws(trace), walkers_of(trace), ended=True)
    return Progress(
        phase=DRAWS,
        done=draws,
        total=draws,
        accept=float(stats[1]["accepted"].mean()),
        rhat=live["rhat"],
        ess=live["ess"],
        solves=solves,
        failed=sum(int(group["n_nonfinite"].sum()) for group in stats if "n_nonfinite" in group),
        solves_per_s=_per_s(solves, float(attrs["wall_s"])),
        chains=int(trace["posterior"].sizes["chain"]),
    )


def why(error: Exception) -> str:
    """Return the reason in an error message, without the path that an OSError contains."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def _per_s(solves: int, seconds: float) -> float:
    return solves / seconds if seconds > 0 else np.nan


def _diagnostics(kept: Sequence[KeptGroup | None]) -> dict[str, float]:
    """Return R-hat and effective sample size, computed from the steps that all groups have.

    The dict is empty if a group has no readable draws, or fewer than 20 steps.
    """
    draws = [one.draws for one in kept if one is not None and one.draws is not None]
    steps = min((x.shape[1] for x in draws), default=0)
    if len(draws) < len(kept) or steps < _FEWEST:
        return {}
    return live_diagnostics(np.concatenate([x[:, :steps] for x in draws]))
