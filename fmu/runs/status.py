"""Read a run's state from the files in its directory, without taking its lock or writing anything."""

from __future__ import annotations

import csv
import time
from dataclasses import dataclass, replace
from pathlib import Path

from fmu.config.kept import ORIGIN, Orders, read_saved
from fmu.durable_files import DamagedError
from fmu.runs.content import numbered_files
from fmu.runs.identity import FILE as IDENTITY
from fmu.runs.identity import Identity
from fmu.runs.lock import FILE as PRESENCE
from fmu.runs.lock import LOCK, ProcessInfo, noted_phase, present
from fmu.runs.reading import GroupReader, KeptGroup, Progress, of_trace, together, why
from fmu.runs.run_directory import FOLDER, folder_of_order

WAITING, RUNNING, STOPPED, KILLED, SILENT, FINISHED = (
    "waiting", "running", "stopped", "killed", "silent", "finished",
)  # fmt: skip
SILENT_S = 600.0
"""Age in s of the newest file beyond which a run on another machine, whose process cannot be checked, is
silent."""
_BEGINS_S = 2.0
_TRIES = 5


@dataclass(frozen=True)
class SamplerReading:
    """State and progress of a sampler.

    Attributes
    ----------
    name : str
    state : {"waiting", "running", "stopped", "killed", "silent", "finished"}
        The unfinished sampler that wrote a file last has the state of the run; if no unfinished sampler has begun,
        the first one has it. Any other unfinished sampler is stopped if it has begun, for example because it
        reached its limit on solves; otherwise it is waiting.
    together : Progress
        Progress of all groups together.
    groups : tuple of Progress
        Progress of each group; empty if there is only one group, or if the progress was read from a trace.
    verdict : str
        Verdict in ``comparison.csv``; empty until the whole run has finished.
    """

    name: str
    state: str
    together: Progress
    groups: tuple[Progress, ...] = ()
    verdict: str = ""


@dataclass(frozen=True)
class RunReading:
    """State and progress of a run.

    Attributes
    ----------
    directory : Path
    state : {"running", "stopped", "killed", "silent", "finished"}
        A run is silent if it is on another machine and has written nothing for `SILENT_S` seconds.
    at_work : ProcessInfo or None
        The process that is running in the directory, or was killed in it.
    samplers : tuple of SamplerReading
    is_of_command : bool
        Whether the run was started by ``fmu run``, which can then resume it.
    phase : str
        The current phase outside the samplers, such as ``certificate 32/64``; empty if there is none.
    notes : tuple of str
        Messages about files that could not be read.
    """

    directory: Path
    state: str
    at_work: ProcessInfo | None
    samplers: tuple[SamplerReading, ...]
    is_of_command: bool
    phase: str
    notes: tuple[str, ...]


class RunReader:
    """Reads a run's state, repeatedly if needed. A step file or trace is read again only if it has changed.

    Parameters
    ----------
    directory : Path
        Output directory of ``fmu run``, or checkpoint directory of `fmu.sample`.
    """

    def __init__(self, directory: Path) -> None:
        is_inner = directory.name == FOLDER and (directory / ORIGIN).is_file()
        self.directory = directory.parent if is_inner else directory
        self._groups: dict[Path, GroupReader] = {}
        self._traces: dict[tuple[Path, int], Progress] = {}
        self._notes: dict[str, None] = {}

    def read(self) -> RunReading:
        """Read the state of the run.

        Raises
        ------
        ValueError
            If the directory contains no run.
        """
        for _ in range(_TRIES):
            self._notes.clear()
            where = folder_of_order(self.directory)
            is_store = any((self.directory / name).exists() for name in (IDENTITY, PRESENCE, LOCK, "group-1"))
            reading = self._of_python() if is_store else self._of_command(where)
            if folder_of_order(self.directory) == where:  # otherwise the run began or ended during the reading
                break
        return reading

    def _of_python(self) -> RunReading:
        """Return the state of a run started by `fmu.sample`, whose checkpoint is the directory."""
        at_work = present(self.directory)
        sampler = self._read_sampler("", self.directory, _state(at_work, self.directory), {})
        groups = sampler.groups or (sampler.together,)
        if at_work is None and all(group.phase == "draws" and group.done == group.total for group in groups):
            sampler = replace(sampler, state=FINISHED)
        return RunReading(self.directory, sampler.state, at_work, (sampler,), False, "", tuple(self._notes))

    def _of_command(self, where: Path) -> RunReading:
        """Return the state of a run started by ``fmu run``; `where` contains its problem and options.

        Raise ValueError if the directory contains no run.
        """
        folder = self.directory / FOLDER
        at_work = present(folder)
        traces = sorted(path.stem for path in self.directory.glob("*.nc"))
        orders, finished = self._read_order(where)
        if not (orders or traces or folder.is_dir()):
            raise ValueError(f"directory: must be the directory of a run (got {self.directory})")
        if not orders and not folder.is_dir():  # there are only traces
            orders, finished = {"samplers": traces}, tuple(traces)
        begun = [path.parent.name for path in sorted(folder.glob("*/group-1"))]
        names = list(dict.fromkeys(orders.get("samplers", begun)))
        ended = where != folder and at_work is None and names and set(names) <= set(finished)
        now = FINISHED if ended else _state(at_work, folder)
        verdicts = _verdicts(self.directory) if ended else {}
        unfinished = [name for name in names if name not in finished]
        started = [name for name in unfinished if (where / name).is_dir()]
        latest = max(started, key=lambda name: _youngest(where / name), default=next(iter(unfinished), ""))
        samplers = []
        for name in names:
            if name in finished:
                path = self.directory / f"{name}.nc"
                samplers.append(SamplerReading(name, FINISHED, self._trace(path), (), verdicts.get(name, "")))
            else:  # an earlier one reached its limit of solves
                its = now if name == latest else STOPPED if name in started else WAITING
                samplers.append(self._read_sampler(name, where / name, its, orders))
        phase = noted_phase(folder) if now == RUNNING else None
        under_way = "" if phase is None else f"{phase[0]} {phase[1]}/{phase[2]}"
        return RunReading(self.directory, now, at_work, tuple(samplers), True, under_way, tuple(self._notes))

    def _read_order(self, where: Path) -> tuple[Orders, tuple[str, ...]]:
        """Return the run's options and the finished samplers' names. Both are empty if they cannot be read."""
        if not (where / ORIGIN).is_file():
            return {}, ()
        try:
            found = read_saved(where)
        except (ValueError, OSError) as error:
            self._note(str(error))
            return {}, ()
        return found.orders, found.finished

    def _read_sampler(self, name: str, directory: Path, state: str, orders: Orders) -> SamplerReading:
        """Return a sampler's reading: the given `state`, and the progress found in its checkpoint in `directory`.

        If `name` is empty, the name of the sampler is taken from the checkpoint.
        """
        try:
            identity = Identity.read(directory)
        except (DamagedError, OSError) as error:
            identity = None
            self._note(f"{directory / IDENTITY} is damaged: {error}")
        known = {} if identity is None else identity.configuration
        run = known.get("run", {})
        files = dict(numbered_files(directory, "group"))
        n = max([run.get("groups") or 1, *files])
        found = [self._group(files[k]) if k in files else None for k in range(1, n + 1)]
        length = run.get("warmup", orders.get("warmup") or 0), orders.get("draws")
        now = time.time()
        groups = tuple(
            Progress(label) if one is None else one.progress(label, *length, now, state == RUNNING)
            for one, label in zip(found, (f"{k}/{n}" for k in range(1, n + 1)), strict=True)
        )
        name = name or known.get("sampler", {}).get("name", "sampler")
        return SamplerReading(name, state, together(groups, found), groups if n > 1 else ())

    def _group(self, directory: Path) -> KeptGroup | None:
        found, damaged = self._groups.setdefault(directory, GroupReader(directory)).read()
        for words in damaged:
            self._note(words)
        return found

    def _trace(self, path: Path) -> Progress:
        """Return a finished sampler's progress from its trace, or an empty `Progress` if it cannot be read."""
        try:
            key = (path, path.stat().st_mtime_ns)
            if key not in self._traces:
                self._traces[key] = of_trace(path)
            return self._traces[key]
        except (OSError, ValueError, KeyError) as error:
            self._note(f"{path} cannot be read: {why(error)}")
            return Progress()

    def _note(self, words: str) -> None:
        self._notes[words] = None


def _state(at_work: ProcessInfo | None, directory: Path) -> str:
    """Return the state of an unfinished run: ``"running"``, ``"stopped"``, ``"killed"`` or ``"silent"``.

    A run on another machine is silent if it has written nothing for `SILENT_S` seconds.
    """
    if at_work is None:  # stopped, unless a process has just created the directory
        return RUNNING if _begins(directory) else STOPPED
    alive = at_work.is_alive()
    if alive is not None:
        return RUNNING if alive else KILLED
    return RUNNING if time.time() - _youngest(directory) < SILENT_S else SILENT


def _begins(directory: Path) -> bool:
    """Return True if a process has probably just created a directory.

    The directory must have changed less than `_BEGINS_S` seconds ago and must contain no files other than a lock
    and hidden files.
    """
    try:
        held = {path.name for path in directory.iterdir() if not path.name.startswith(".")}
        return held <= {LOCK} and time.time() - directory.stat().st_mtime < _BEGINS_S
    except OSError:  # there is no directory
        return False


def _youngest(directory: Path) -> float:
    """Return the time in s since 1970 of the last change below a directory, or 0 if the directory is empty."""
    times = [0.0]
    for path in directory.rglob("*"):
        try:
            times.append(path.stat().st_mtime)
        except OSError:  # the file has been removed
            continue
    return max(times)


def _verdicts(directory: Path) -> dict[str, str]:
    """Return the verdicts in ``comparison.csv``, keyed by sampler.

    The dict is empty if the file is missing or damaged.
    """
    try:
        with open(directory / "comparison.csv", encoding="utf-8", newline="") as file:
            return {str(row["sampler"]): str(row["verdict"]) for row in csv.DictReader(file)}
    except (OSError, ValueError, KeyError, csv.Error):
        return {}
