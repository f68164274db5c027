"""The command ``fmu watch``, which shows a run's progress as a table, as JSON or as a web page."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Never

import click

from fmu.cli.damage import DIRECTORY
from fmu.progress.words import as_json
from fmu.tables import text_table, wrap_text

if TYPE_CHECKING:
    from fmu.runs.status import RunReading

_LEFT_OUT = ("chains",)  # columns for which a terminal has no room
_CLEAR = "\033[H\033[2J"


@click.command()
@DIRECTORY
@click.option("--follow", is_flag=True, help="Repeat until the run ends.")
@click.option("--every", type=click.FloatRange(min=0, min_open=True), default=5.0, show_default=True,
              metavar="SECONDS", help="Interval with --follow and --web.")  # fmt: skip
@click.option("--json", "is_json", is_flag=True, help="Print one JSON object; with --follow, one per line.")
@click.option("--web", is_flag=True, help="Serve a page that follows the run and can stop it, until Ctrl-C.")
@click.option("--port", type=click.IntRange(0, 65535), default=0, metavar="PORT",
              help="Port of the page.  [default: any that is free]")  # fmt: skip
@click.option("--host", default="127.0.0.1", show_default=True, metavar="ADDRESS",
              help="Address of the page. At any other, other machines reach it, without encryption.")  # fmt: skip
def watch(directory: Path, follow: bool, every: float, is_json: bool, web: bool, port: int, host: str) -> None:
    """Show the progress of a run.

    DIRECTORY is the output directory of fmu run, or the checkpoint directory of an fmu.sample call. Only the
    files saved there are read; the run is not disturbed, unless it is stopped from the page of --web.
    """
    from fmu.runs.status import RUNNING, RunReader

    if web:
        if is_json or follow:
            raise click.UsageError("--web follows the run by itself: leave out --json and --follow.")
        _serve(directory, every, host, port)
        return
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


def _serve(directory: Path, every: float, host: str, port: int) -> Never:
    """Serve a run's web page until Ctrl-C ends the process."""
    from fmu.runs.web import LOOPBACK, WatchServer

    with WatchServer(directory, every, host, port) as server:
        click.echo(server.address)
        if host == LOOPBACK:
            there = f"{server.server_port}:{host}:{server.server_port}"
            click.echo(f"From another machine: ssh -L {there} {socket.gethostname()}, and the same address there.")
        click.echo("Ctrl-C closes the page; the run goes on.")
        sys.stdout.flush()
        # at exit, Python would stop the threads of open pages at any point, and a thread that holds the lock of
        # HDF5 keeps the process alive; a KeyboardInterrupt can be lost while an object is being deleted
        signal.signal(signal.SIGINT, lambda *_: os._exit(0))
        with suppress(KeyboardInterrupt):
            server.serve_forever()
    os._exit(0)


def _lines(reading: RunReading) -> Iterator[str]:
    """Yield the lines to print: the run's state, a table, verdicts, notes, and how to resume the run."""
    from fmu.runs.words import rows, state_of, to_resume

    yield f"{reading.directory}: {state_of(reading)}"
    if reading.samplers:
        yield ""
        yield from _table(rows(reading)).splitlines()
    verdicts = {sampler.name: sampler.verdict for sampler in reading.samplers if sampler.verdict}
    if verdicts:
        width = max(map(len, verdicts)) + 2
        yield ""
        for name, verdict in verdicts.items():
            yield from wrap_text(verdict, f"{name:{width}}", " " * width).splitlines()
    if reading.notes or reading.state not in ("running", "finished"):
        yield ""
    for note in reading.notes:
        yield f"Note: {note}"
    if to_resume(reading):
        yield f"To resume: {to_resume(reading)}"


def _table(rows: list[tuple[str, ...]]) -> str:
    """Return a table of rows as text, without empty columns and the columns in `_LEFT_OUT`."""
    from fmu.runs.words import HEADER, WORDS

    columns = [
        column for column in zip(HEADER, *rows, strict=True) if any(column[1:]) and column[0] not in _LEFT_OUT
    ]
    header, *cells = zip(*columns, strict=True)
    return text_table(header, cells, words=[i for i, name in enumerate(header) if name in WORDS])
