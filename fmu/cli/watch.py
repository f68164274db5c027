"""``fmu watch``."""

from __future__ import annotations

import math
import sys
import textwrap
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fmu.numbers import fixed
from fmu.progress.words import as_json, duration, number

if TYPE_CHECKING:
    from fmu.runs.reading import Progress
    from fmu.runs.status import RunReading, SamplerReading

_WIDTH = 100
_HEADER = ("sampler", "group", "state", "phase", "steps", "save age", "accept", "R-hat", "ESS", "solves", "per s",
           "failed", "left")  # fmt: skip
_WORDS = 4  # columns of words, at the left of their place
_PHASES = {"warmup": "warm-up", "draws": "draws"}
_EXACT = 99_999  # steps told in full
_LONG_S = 36_000.0  # told in hours
_CLEAR = "\033[H\033[2J"


@click.command()
@click.argument("directory", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--follow", is_flag=True, help="Repeat until the run ends.")
@click.option("--every", type=click.FloatRange(min=0, min_open=True), default=5.0, show_default=True,
              metavar="SECONDS", help="Interval with --follow.")  # fmt: skip
@click.option("--json", "is_json", is_flag=True, help="Print one JSON object; with --follow, one per line.")
def watch(directory: Path, follow: bool, every: float, is_json: bool) -> None:
    """Show the progress of the run in DIRECTORY (of fmu run, or a checkpoint of fmu.sample).

    Reads only the files that the run saved last; the run is not disturbed.
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
    """Yield the lines that tell of a run."""
    yield f"{reading.directory}: {_state(reading)}"
    if reading.samplers:
        yield ""
        yield from _table([_HEADER, *(row for sampler in reading.samplers for row in _rows(sampler))])
    told = [sampler for sampler in reading.samplers if sampler.verdict]
    if told:
        width = max(len(sampler.name) for sampler in told) + 2
        yield ""
        for sampler in told:
            yield from textwrap.wrap(
                sampler.verdict, _WIDTH, initial_indent=f"{sampler.name:{width}}", subsequent_indent=" " * width
            )
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
    """Say what state a run is in, and whose it is."""
    who = reading.at_work
    if who is None or reading.state in ("stopped", "finished"):
        return reading.state
    process = f"process {who.pid} on {who.host}"
    if reading.state == "killed":
        return f"killed ({process})"
    if reading.state == "silent":
        return f"silent ({process} cannot be reached from here and has saved nothing for a long time)"
    doing = f", {reading.phase}" if reading.phase else ""
    return f"running for {duration(max(time.time() - who.began, 0.0))}{doing} ({process})"


def _rows(sampler: SamplerReading) -> Iterator[tuple[str, ...]]:
    """Yield the rows of a sampler: all groups together, then each."""
    yield _row(sampler.name, "all" if sampler.groups else "", sampler.state, sampler.together)
    for group in sampler.groups:
        yield _row("", group.group, "", group)


def _row(name: str, group: str, state: str, at: Progress) -> tuple[str, ...]:
    if not at.phase:
        return (name, group, state, *[""] * (len(_HEADER) - 3))
    steps = f"{_steps(at.done)}/{'?' if at.total is None else _steps(at.total)}"
    return (
        name,
        group,
        state,
        _PHASES[at.phase],
        steps,
        "" if at.kept_s is None else _ago(at.kept_s),
        _fixed(at.accept, 2),
        _fixed(at.rhat, 3),
        "" if math.isnan(at.ess) else number(at.ess),
        number(at.solves),
        "" if math.isnan(at.solves_per_s) else number(at.solves_per_s),
        number(at.failed),
        "" if at.remaining_s is None or at.done == at.total else _left(at.remaining_s),
    )


def _table(rows: list[tuple[str, ...]]) -> Iterator[str]:
    """Yield a table, its columns as wide as their cells; those without any are left out."""
    columns = [column for column in zip(*rows, strict=True) if any(column[1:])]
    words = {column for column in columns if column[0] in _HEADER[:_WORDS]}
    widths = [max(map(len, column)) for column in columns]
    between = "  " if sum(widths) + 2 * (len(widths) - 1) <= _WIDTH else " "
    for row in zip(*columns, strict=True):
        cells = (
            cell.ljust(width) if column in words else cell.rjust(width)
            for cell, column, width in zip(row, columns, widths, strict=True)
        )
        yield between.join(cells).rstrip()


def _steps(n: int) -> str:
    return str(n) if n <= _EXACT else number(n)


def _fixed(value: float, digits: int) -> str:
    if math.isnan(value):
        return ""
    return fixed(value, digits) if abs(value) < 10.0 else number(value)


def _ago(seconds: float) -> str:
    """Return an age, in one unit."""
    for unit, size in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= size:
            return f"{fixed(seconds / size, 0)} {unit}"
    return f"{fixed(seconds, 0)} s"


def _left(seconds: float) -> str:
    """Return a time to wait."""
    return duration(seconds) if seconds < _LONG_S else f"{number(seconds / 3600.0)} h"
