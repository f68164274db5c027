"""Describe a run's state as text: a sentence, a table of samplers and groups, and how to resume the run."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path

from fmu.numbers import fixed
from fmu.progress.words import duration, number
from fmu.runs.reading import Progress
from fmu.runs.status import FINISHED, KILLED, RUNNING, SILENT, STOPPED, RunReader, RunReading, SamplerReading

HEADER = ("sampler", "group", "state", "phase", "chains", "steps", "save age", "accept", "R-hat", "ESS", "solves",
          "per s", "failed", "left")  # fmt: skip
WORDS = HEADER[:4]
"""Names of the columns that contain words and not numbers."""
_PHASES = {"warmup": "warm-up", "draws": "draws"}
_EXACT = 99_999  # largest number of steps that is written in full
_LONG_S = 36_000.0  # time in s from which on only hours are given


def state_of(reading: RunReading) -> str:
    """Return a run's state in words, with the process if it is running, killed or silent."""
    who = reading.at_work
    if who is None or reading.state in (STOPPED, FINISHED):
        return reading.state
    process = f"process {who.pid} on {who.host}"
    if reading.state == KILLED:
        return f"killed ({process})"
    if reading.state == SILENT:
        return f"silent ({process} cannot be reached from here and has saved nothing for a long time)"
    phase = f", {reading.phase}" if reading.phase else ""
    return f"running for {duration(max(time.time() - who.began, 0.0))}{phase} ({process})"


def rows(reading: RunReading) -> list[tuple[str, ...]]:
    """Return the table rows below `HEADER`.

    Each sampler has one row for all groups. If there are several groups, one row for each follows.
    """
    return [row for sampler in reading.samplers for row in _rows(sampler)]


def to_resume(reading: RunReading) -> str:
    """Return the instruction for resuming a run that was stopped or killed; empty for any other run."""
    if reading.state not in (STOPPED, KILLED):
        return ""
    if reading.is_of_command:
        return f"fmu run --resume {reading.directory}"
    return f"repeat the same call of fmu.sample, with checkpoint={str(reading.directory)!r}"


def why_no_traces(directory: Path) -> str:
    """Return a message that a directory contains no traces.

    If a run in the directory is under way or can be resumed, the message says so.
    """
    try:
        reading = RunReader(directory).read()
    except (ValueError, OSError):
        return f"{directory} contains no traces (*.nc)"
    if to_resume(reading):
        return f"{directory} contains no traces yet: its run was interrupted. To resume: {to_resume(reading)}"
    if reading.state == RUNNING:
        return f"{directory} contains no traces yet: its run goes on; see fmu watch {directory}"
    return f"{directory} contains no traces (*.nc)"


def _rows(sampler: SamplerReading) -> Iterator[tuple[str, ...]]:
    yield _row(sampler.name, "all" if sampler.groups else "", sampler.state, sampler.together)
    for group in sampler.groups:
        yield _row("", group.group, "", group)


def _row(name: str, group: str, state: str, at: Progress) -> tuple[str, ...]:
    if not at.phase:
        return (name, group, state, *[""] * (len(HEADER) - 3))
    return (
        name,
        group,
        state,
        _PHASES[at.phase],
        str(at.chains or ""),
        f"{_steps(at.done)}/{'?' if at.total is None else _steps(at.total)}",
        "" if at.kept_s is None else _age(at.kept_s),
        _format_number(at.accept, 2),
        _format_number(at.rhat, 3),
        _number(at.ess),
        number(at.solves),
        _number(at.solves_per_s),
        number(at.failed),
        "" if at.remaining_s is None or at.done == at.total else _time_left(at.remaining_s),
    )


def _steps(n: int) -> str:
    return str(n) if n <= _EXACT else number(n)


def _number(value: float) -> str:
    return "" if math.isnan(value) else number(value)


def _format_number(value: float, digits: int) -> str:
    return fixed(value, digits) if abs(value) < 10.0 else _number(value)


def _age(seconds: float) -> str:
    """Return a time in s as text: a whole number in its largest unit (d, h, min or s)."""
    for unit, size in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= size:
            return f"{fixed(seconds / size, 0)} {unit}"
    return f"{fixed(seconds, 0)} s"


def _time_left(seconds: float) -> str:
    return duration(seconds) if seconds < _LONG_S else f"{number(seconds / 3600.0)} h"
