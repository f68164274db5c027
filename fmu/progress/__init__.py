"""Display progress as bars on a terminal or in a notebook, as JSON lines for programs, or as log lines.

Reading order: this file, `phases` (the source of the reports), `displays`, `lines`; then `pace` and `words`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

from fmu.progress.words import Info as Info
from fmu.progress.words import Report as Report

if TYPE_CHECKING:
    from fmu.progress.displays import JSONLines


@contextmanager
def progress_bars() -> Iterator[Report | None]:
    """Yield a callback that draws bars, one for each phase and group of chains, in a notebook or on a terminal.

    Yield None if there is neither a notebook nor a terminal.
    """
    from fmu.progress.displays import NotebookBars, SuccessiveBars

    if in_notebook():
        yield NotebookBars().report
    elif on_terminal():
        with SuccessiveBars() as report:
            yield report
    else:
        yield None


def json_lines(stream: TextIO) -> JSONLines:
    """Return a callback that writes JSON lines; see `fmu.progress.displays.JSONLines`.

    Use the callback as a context manager, or close it. Otherwise the last line of a phase that ends early is lost.
    """
    from fmu.progress.displays import JSONLines

    return JSONLines(stream)


@contextmanager
def reporting(progress: Report | bool | None, label: str) -> Iterator[Report | None]:
    """Yield the callback that an argument `progress` requests, or None if nothing is to be displayed.

    A callable is yielded unchanged. True gives bars in a notebook or on a terminal, and log lines on standard
    error elsewhere. None gives bars only in a notebook, and False gives no display. The `label` is shown before
    the name of the phase.
    """
    if callable(progress):
        yield progress
    elif progress and not (in_notebook() or on_terminal()):
        from fmu.progress.lines import ProgressLines

        with ProgressLines(sys.stderr, label) as lines:
            yield add_label(lines.report, label)
    elif progress or (progress is None and in_notebook()):
        with progress_bars() as report:
            yield report and add_label(report, label)
    else:
        yield None


def end_bars(report: Report | None) -> None:
    """Stop updating a callback's bars, so that text can be printed below them; do nothing for other callbacks."""
    getattr(report, "end", lambda: None)()


def add_label(report: Report, label: str) -> Report:
    """Return a callback that adds ``label`` to the `info` of each report without one, and then calls `report`."""

    def report_labelled(phase: str, done: int, total: int, info: Info) -> None:
        report(phase, done, total, {"label": label, **info})

    return report_labelled


def in_notebook() -> bool:
    """Return True if the code runs in a Jupyter notebook kernel."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return getattr(shell, "kernel", None) is not None


def on_terminal() -> bool:
    """Return True if standard output is a terminal."""
    return sys.stdout.isatty()
