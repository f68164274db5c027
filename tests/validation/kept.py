"""Units of work of a study, each kept as soon as it is done: a study that was killed goes on where it was.

Every study takes the same arguments::

    python -m tests.validation.NAME OUT [--kept DIRECTORY] [--minutes M]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

PROGRESS = "progress.json"
"""Beside the units: how many of each kind are done, and how many there are."""


CORE = "FMU_STUDY_CORE"
"""Environment variable with the number of the processor core that no other study uses, from 0."""


def study_parser(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser with the arguments of every study: OUT, ``--kept`` and ``--minutes``."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=_made, help="directory of the page")
    parser.add_argument("--kept", type=Path, help="directory of the units that are done; it is continued")
    parser.add_argument(
        "--minutes", type=float, default=np.inf, help="time of all units together after which none is begun"
    )
    return parser


def _made(name: str) -> Path:
    """Return a directory, which is created: a study should not fail at its end."""
    directory = Path(name)
    directory.mkdir(parents=True, exist_ok=True)
    return directory


def fields_of[Run](kind: Callable[..., Run], of_list: Callable[[list[Any]], Any] = tuple) -> Callable[[Any], Run]:
    """Return the function that makes a dataclass of its kept fields, lists among them as `of_list`."""

    def read(fields: dict[str, Any]) -> Run:
        return kind(**{name: of_list(x) if isinstance(x, list) else x for name, x in fields.items()})

    return read


def as_kept(value: Any) -> Any:
    """Return the value unchanged, as JSON gives it back."""
    return value


def each[Key](keys: Iterable[Key]) -> list[tuple[Key, Key]]:
    """Return jobs that are their own keys."""
    return [(key, key) for key in keys]


@dataclass(frozen=True)
class Unit:
    """A unit of work: its key, its result as JSON has it, and what it took."""

    key: Any
    result: Any
    processor_s: float
    wall_s: float


class Units:
    """The units of a study.

    Parameters
    ----------
    kept : path, optional
        Directory with a file of JSON for each kind of unit, a unit a line.
    minutes : float
        Wall time of all units, those of earlier runs included, after which no further one is begun.
    """

    def __init__(self, kept: Path | None = None, minutes: float = np.inf) -> None:
        self._kept = kept
        self._budget_s = 60.0 * minutes
        self._progress: dict[str, tuple[int, int]] = {}
        self._earlier: dict[str, dict[str, Unit]] = {}
        if kept is not None:
            kept.mkdir(parents=True, exist_ok=True)
            self._earlier = {path.stem: _units_in(path) for path in sorted(kept.glob("*.jsonl"))}
        known = [unit for units in self._earlier.values() for unit in units.values()]
        self.processor_s = sum(unit.processor_s for unit in known)
        self.wall_s = sum(unit.wall_s for unit in known)

    def completed[Job, Run](
        self,
        kind: str,
        jobs: Iterable[tuple[Any, Job]],
        make: Callable[[Job], Run],
        read: Callable[[Any], Run] = as_kept,
        at_once: int = 1,
        least: int = 1,
    ) -> list[Run]:
        """Return the results of the jobs that are done, in their order; those not known are done first.

        Parameters
        ----------
        kind : str
            Name of the file and in the line of progress.
        jobs : iterable of (key, job)
            The key tells a job from others of its kind; JSON must be able to write it.
        make : callable
            Does a job. Its result is a dataclass, or something that JSON can write.
        read : callable
            Makes the result of its JSON. New results go through JSON too, so that killed studies give equal pages.
        at_once : int
            Threads that do jobs side by side; it is for jobs that wait for processes of their own.
        least : int
            How many jobs, the first ones, are done even when the budget is spent: the page needs them.
        """
        jobs, known = list(jobs), self._earlier.setdefault(kind, {})
        keyed = [(json.dumps(key), key, job) for key, job in jobs]
        missing = [(i < least, *one) for i, one in enumerate(keyed) if one[0] not in known]
        self._report(kind, len(jobs) - len(missing), len(jobs))

        def do(one: tuple[bool, str, Any, Job]) -> Run | None:
            return make(one[3]) if one[0] or self.wall_s <= self._budget_s else None

        with ThreadPoolExecutor(at_once) as pool:
            results = pool.map(do, missing) if at_once > 1 else map(do, missing)
            began = _processor_s(), time.monotonic()
            for n, ((_, name, key, _), result) in enumerate(zip(missing, results, strict=True), 1):
                if result is None:
                    break
                ended = _processor_s(), time.monotonic()
                known[name] = self._keep(kind, key, result, ended[0] - began[0], ended[1] - began[1])
                began = ended
                self._report(kind, len(jobs) - len(missing) + n, len(jobs))
                print(f"{self.counts} ({self.wall_s / 60.0:.1f} min): {key}", flush=True)
        return [read(known[name].result) for name, _, _ in keyed if name in known]

    @property
    def counts(self) -> str:
        """The units that are done, such as ``17 of 300 sets``."""
        return ", ".join(f"{done} of {of} {kind}" for kind, (done, of) in self._progress.items())

    def _keep(self, kind: str, key: Any, result: Any, processor_s: float, wall_s: float) -> Unit:
        fields = asdict(result) if is_dataclass(result) and not isinstance(result, type) else result
        line = json.dumps(asdict(Unit(key, fields, processor_s, wall_s)), default=_plain)
        if self._kept is not None:
            with (self._kept / f"{kind}.jsonl").open("a", encoding="utf-8") as file:
                file.write(line + "\n")
        self.processor_s += processor_s
        self.wall_s += wall_s
        return Unit(**json.loads(line))

    def _report(self, kind: str, done: int, of: int) -> None:
        self._progress[kind] = (done, of)
        if self._kept is not None:
            (self._kept / PROGRESS).write_text(json.dumps(self._progress), encoding="utf-8")


def _units_in(path: Path) -> dict[str, Unit]:
    """Return the units of a file by their keys; the last line may have been cut short by a kill."""
    text = path.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        path.write_text(whole, encoding="utf-8")
    units = [Unit(**json.loads(line)) for line in whole.splitlines()]
    return {json.dumps(unit.key): unit for unit in units}


def _processor_s() -> float:
    """Return the time of this process and of its children that have ended."""
    return sum(os.times()[:4])


def _plain(value: Any) -> Any:
    """Return arrays and numbers of NumPy, and dataclasses, as JSON has them."""
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else value.tolist()
