"""How far a run is, from the files in its directory alone: no lock is taken, and nothing is written."""

from __future__ import annotations

import csv
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fmu.config.kept import ORIGIN, kept
from fmu.durable_files import DamagedError
from fmu.runs.group_reading import GroupReader, KeptGroup
from fmu.runs.identity import FILE as IDENTITY
from fmu.runs.identity import Identity
from fmu.runs.lock import FILE as PRESENCE
from fmu.runs.lock import LOCK, ProcessInfo, noted_phase, present
from fmu.runs.run_directory import FOLDER, unfinished
from fmu.runs.sampler_reading import Progress, of_group, of_trace, together
from fmu.runs.store import numbered

WAITING, RUNNING, STOPPED, KILLED, SILENT, FINISHED = (
    "waiting", "running", "stopped", "killed", "silent", "finished",
)  # fmt: skip
SILENT_S = 600.0
"""A run on another machine, which cannot be asked from here, is silent if no file of it is younger than this."""
_BEGINS_S = 2.0
_TRIES = 5


@dataclass(frozen=True)
class SamplerReading:
    """How far a sampler is.

    Attributes
    ----------
    name : str
    state : {"waiting", "running", "stopped", "killed", "silent", "finished"}
    together : Progress
    groups : tuple of Progress
        Empty if there is but one, or the sampler has finished.
    verdict : str
        Of a finished one, where it has been given.
    """

    name: str
    state: str
    together: Progress
    groups: tuple[Progress, ...] = ()
    verdict: str = ""


@dataclass(frozen=True)
class RunReading:
    """How far a run is.

    Attributes
    ----------
    directory : Path
    state : {"running", "stopped", "killed", "silent", "finished"}
    at_work : ProcessInfo or None
        Who is at work, or was when the run was killed.
    samplers : tuple of SamplerReading
    is_of_command : bool
        Whether ``fmu run`` made it, and can resume it.
    phase : str
        The phase under way that is not one of a sampler's, and how far it is, such as ``certificate 32/64``; empty
        if there is none.
    notes : tuple of str
        What could not be read, in words.
    """

    directory: Path
    state: str
    at_work: ProcessInfo | None
    samplers: tuple[SamplerReading, ...]
    is_of_command: bool
    phase: str
    notes: tuple[str, ...]


class RunReader:
    """Reads a run, again and again if need be; files that do not change only once.

    Parameters
    ----------
    directory : Path
        Of ``fmu run``, or the checkpoint of `fmu.sample`.
    """

    def __init__(self, directory: Path) -> None:
        is_inner = directory.name == FOLDER and (directory / ORIGIN).is_file()
        self.directory = directory.parent if is_inner else directory
        self._groups: dict[Path, GroupReader] = {}
        self._traces: dict[tuple[Path, int], Progress] = {}
        self._notes: dict[str, None] = {}

    def read(self) -> RunReading:
        """Return how far the run is.

        Raises
        ------
        ValueError
            If the directory holds no run.
        """
        for _ in range(_TRIES):
            self._notes.clear()
            where = unfinished(self.directory)
            is_store = any((self.directory / name).exists() for name in (IDENTITY, PRESENCE, LOCK, "group-1"))
            reading = self._of_python() if is_store else self._of_command(where)
            if unfinished(self.directory) == where:  # else it has begun, or ended, meanwhile
                break
        return reading

    def _of_python(self) -> RunReading:
        """Return how far the run is whose checkpoint the directory is."""
        at_work = present(self.directory)
        sampler = self._unfinished("", self.directory, _state(at_work, self.directory), {})
        whole = [group.phase == "draws" and group.done == group.total for group in _each(sampler)]
        if at_work is None and all(whole):
            sampler = SamplerReading(sampler.name, FINISHED, sampler.together, sampler.groups)
        return RunReading(self.directory, sampler.state, at_work, (sampler,), False, "", tuple(self._notes))

    def _of_command(self, where: Path) -> RunReading:
        """Return how far a run of ``fmu run`` is, which keeps what was asked for in `where`."""
        folder = self.directory / FOLDER
        at_work = present(folder)
        traces = sorted(path.stem for path in self.directory.glob("*.nc"))
        orders, finished = self._asked(where)
        if not (orders or traces or folder.is_dir()):
            raise ValueError(f"directory: must be the directory of a run (got {self.directory})")
        if not orders and not folder.is_dir():  # only traces are known of it
            orders, finished = {"samplers": traces}, tuple(traces)
        begun = [path.parent.name for path in sorted(folder.glob("*/group-1"))]
        names = list(dict.fromkeys(orders.get("samplers", begun)))
        ended = where != folder and at_work is None and names and set(names) <= set(finished)
        now = FINISHED if ended else _state(at_work, folder)
        verdicts = _verdicts(self.directory) if ended else {}
        samplers, its = [], now
        for name in names:
            if name in finished:
                path = self.directory / f"{name}.nc"
                samplers.append(SamplerReading(name, FINISHED, self._trace(path), (), verdicts.get(name, "")))
            else:
                samplers.append(self._unfinished(name, where / name, its, orders))
                its = WAITING
        phase = noted_phase(folder) if now == RUNNING else None
        under_way = "" if phase is None else f"{phase[0]} {phase[1]}/{phase[2]}"
        return RunReading(self.directory, now, at_work, tuple(samplers), True, under_way, tuple(self._notes))

    def _asked(self, where: Path) -> tuple[Mapping[str, Any], tuple[str, ...]]:
        """Return what was asked for and which samplers are done, as far as that can be read."""
        if not (where / ORIGIN).is_file():
            return {}, ()
        try:
            found = kept(where)
        except (ValueError, OSError) as error:
            self._note(str(error))
            return {}, ()
        return found.orders, found.finished

    def _unfinished(self, name: str, directory: Path, state: str, orders: Mapping[str, Any]) -> SamplerReading:
        """Return how far a sampler is that has not finished."""
        try:
            identity = Identity.read(directory)
        except (DamagedError, OSError) as error:
            identity = None
            self._note(f"{directory / IDENTITY} is damaged: {error}")
        known = {} if identity is None else identity.configuration
        run = known.get("run", {})
        files = dict(numbered(directory, "group"))
        n = max([run.get("groups") or 1, *files])
        found = [self._group(files[k]) if k in files else None for k in range(1, n + 1)]
        warmup, draws = run.get("warmup", orders.get("warmup", 0)), orders.get("draws")
        now = time.time()
        runs = state == RUNNING
        groups = [of_group(one, f"{k}/{n}", warmup, draws, now, runs) for k, one in enumerate(found, 1)]
        name = name or known.get("sampler", {}).get("name", "sampler")
        return SamplerReading(name, state, together(groups, found), tuple(groups) if n > 1 else ())

    def _group(self, directory: Path) -> KeptGroup | None:
        if directory not in self._groups:
            self._groups[directory] = GroupReader(directory)
        found, damaged = self._groups[directory].read()
        for words in damaged:
            self._note(words)
        return found

    def _trace(self, path: Path) -> Progress:
        """Return what a trace says; nothing if it cannot be read."""
        try:
            key = (path, path.stat().st_mtime_ns)
            if key not in self._traces:
                self._traces[key] = of_trace(path)
            return self._traces[key]
        except (OSError, ValueError, KeyError) as error:
            why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            self._note(f"{path} cannot be read: {why}")
            return Progress()

    def _note(self, words: str) -> None:
        self._notes[words] = None


def _each(sampler: SamplerReading) -> tuple[Progress, ...]:
    return sampler.groups or (sampler.together,)


def _state(at_work: ProcessInfo | None, directory: Path) -> str:
    """Return the state of a run that has not come to its end."""
    if at_work is None:  # or it has but made the directory, and is about to say so
        return RUNNING if _begins(directory) else STOPPED
    alive = at_work.is_alive()
    if alive is not None:
        return RUNNING if alive else KILLED
    return RUNNING if time.time() - _youngest(directory) < SILENT_S else SILENT


def _begins(directory: Path) -> bool:
    """Say whether a directory has just been made, and holds nothing yet."""
    try:
        held = {path.name for path in directory.iterdir() if not path.name.startswith(".")}
        return held <= {LOCK} and time.time() - directory.stat().st_mtime < _BEGINS_S
    except OSError:  # it is not there
        return False


def _youngest(directory: Path) -> float:
    """Return when a file was written last, in seconds since 1970."""
    times = [0.0]
    for path in directory.rglob("*"):
        try:
            times.append(path.stat().st_mtime)
        except OSError:  # it has gone
            continue
    return max(times)


def _verdicts(directory: Path) -> dict[str, str]:
    """Return the verdicts that the comparison gave, by sampler; none if it is not there, or damaged."""
    try:
        with open(directory / "comparison.csv", encoding="utf-8", newline="") as file:
            return {str(row["sampler"]): str(row["verdict"]) for row in csv.DictReader(file)}
    except (OSError, ValueError, KeyError, csv.Error):
        return {}
