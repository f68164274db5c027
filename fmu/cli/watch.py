"""``fmu watch``: how far a run has got, as a table or as JSON."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fmu.numbers import fixed
from fmu.progress.words import as_json, duration, number
from fmu.tables import text_table, wrapped

if TYPE_CHECKING:
    from fmu.runs.reading import Progress
    from fmu.runs.status import RunReading, SamplerReading

_HEADER = ("sampler", "group", "state", "phase", "steps", "save age", "accept", "R-hat", "ESS", "solves", "per s",
           "failed", "left")  # fmt: skip
_WORDS = _HEADER[:4]  # columns that are aligned to the left
_PHASES = {"warmup": "warm-up", "draws": "draws"}
_EXACT = 99_999  # the most steps that are written in full
_LONG_S = 36_000.0  # a time from which on hours are given
_CLEAR = "\033[H\033[2J"


@click.command()
@click.argument("directory", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--follow", is_flag=True, help="Repeat until the run ends.")
@click.option("--every", type=click.FloatRange(min=0, min_open=True), default=5.0, show_default=True,
              metavar="SECONDS", help="Interval with --follow.")  # fmt: skip
@click.option("--json", "is_json", is_flag=True, help="Print one JSON object; with --follow, one per line.")
def watch(directory: Path, follow: bool, every: float, is_json: bool) -> None:
    """Show the progress of a run.

    DIRECTORY is the output directory of fmu run, or the checkpoint directory of an fmu.sample call. Only the
    files saved there are read; the run is not disturbed.
    """
    from fmu.runs.status import RUNNING, RunReader

    reader = RunReader(directory)
    while True:
        reading = reader.read()
        if is_json:
            click.echo(as_json(asdict(reading)))
        else:
            clear = _CLEAR if follow and sys.stdout.isatty() else ""
            click.echo(clear + "\n".join(_lines(reading)))
        if not follow or reading.state != RUNNING:
            return
        if not (is_json or sys.stdout.isatty()):
            click.echo()
        try:
            time.sleep(every)
        except KeyboardInterrupt:
            return


def _lines(reading: RunReading) -> Iterator[str]:
    """Yield the lines to print: the state of the run, a table, verdicts, notes, and how to resume it."""
    yield f"{reading.directory}: {_state(reading)}"
    if reading.samplers:
        yield ""
        yield from _table([row for sampler in reading.samplers for row in _rows(sampler)]).splitlines()
    verdicts = {sampler.name: sampler.verdict for sampler in reading.samplers if sampler.verdict}
    if verdicts:
        width = max(map(len, verdicts)) + 2
        yield ""
        for name, verdict in verdicts.items():
            yield from wrapped(verdict, f"{name:{width}}", " " * width).splitlines()
    if reading.notes or reading.state not in ("running", "finished"):
        yield ""
    for note in reading.notes:
        yield f"Note: {note}"
    if reading.state in ("stopped", "killed"):
        if reading.is_of_command:
            yield f"To resume: fmu run --resume {reading.directory}"
        else:
            yield f"To resume: repeat the same call of fmu.sample, with checkpoint={str(reading.directory)!r}"


def _state(reading: RunReading) -> str:
    """Return the state of a run in words, with the process that runs it."""
    who = reading.at_work
    if who is None or reading.state in ("stopped", "finished"):
        return reading.state
    process = f"process {who.pid} on {who.host}"
    if reading.state == "killed":
        return f"killed ({process})"
    if reading.state == "silent":
        return f"silent ({process} cannot be reached from here and has saved nothing for a long time)"
    phase = f", {reading.phase}" if reading.phase else ""
    return f"running for {duration(max(time.time() - who.began, 0.0))}{phase} ({process})"


def _table(rows: list[tuple[str, ...]]) -> str:
    """Return a table without its empty columns."""
    columns = [column for column in zip(_HEADER, *rows, strict=True) if any(column[1:])]
    header, *cells = zip(*columns, strict=True)
    return text_table(header, cells, words=[i for i, name in enumerate(header) if name in _WORDS])


def _rows(sampler: SamplerReading) -> Iterator[tuple[str, ...]]:
    """Yield the rows of a sampler: all groups together, then each group."""
    yield _row(sampler.name, "all" if sampler.groups else "", sampler.state, sampler.together)
    for group in sampler.groups:
        yield _row("", group.group, "", group)


def _row(name: str, group: str, state: str, at: Progress) -> tuple[str, ...]:
    if not at.phase:
        return (name, group, state, *[""] * (len(_HEADER) - 3))
    return (
        name,
        group,
        state,
        _PHASES[at.phase],
        f"{_steps(at.done)}/{'?' if at.total is None else _steps(at.total)}",
        "" if at.kept_s is None else _age(at.kept_s),
        _fixed(at.accept, 2),
        _fixed(at.rhat, 3),
        _number(at.ess),
        number(at.solves),
        _number(at.solves_per_s),
        number(at.failed),
        "" if at.remaining_s is None or at.done == at.total else _left(at.remaining_s),
    )


def _steps(n: int) -> str:
    return str(n) if n <= _EXACT else number(n)


def _number(value: float) -> str:
    return "" if math.isnan(value) else number(value)


def _fixed(value: float, digits: int) -> str:
    return fixed(value, digits) if abs(value) < 10.0 else _number(value)


def _age(seconds: float) -> str:
    """Return a time in one unit."""
    for unit, size in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= size:
            return f"{fixed(seconds / size, 0)} {unit}"
    return f"{fixed(seconds, 0)} s"


def _left(seconds: float) -> str:
    return duration(seconds) if seconds < _LONG_S else f"{number(seconds / 3600.0)} h"
