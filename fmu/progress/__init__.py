"""Progress: bars for people on a terminal and in a notebook, lines of JSON for programs, else nothing."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

from fmu.progress.report import Info as Info
from fmu.progress.report import Report as Report

if TYPE_CHECKING:
    from fmu.progress.lines import JSONLines


@contextmanager
def progress_bars() -> Iterator[Report | None]:
    """Give a callback that draws one bar a phase; None where there is neither a notebook nor a terminal."""
    from fmu.progress.bars import NotebookBars, terminal_bars

    if in_notebook():
        yield NotebookBars().report
    elif on_terminal():
        with terminal_bars() as report:
            yield report
    else:
        yield None


def json_lines(stream: TextIO) -> JSONLines:
    """Return a callback that writes lines of JSON; `fmu.progress.lines.JSONLines` says what is in them.

    To be used as a context manager, or closed, so that the last line of a phase that ends early is written too.
    """
    from fmu.progress.lines import JSONLines

    return JSONLines(stream)


@contextmanager
def reporting(progress: Report | bool | None, label: str) -> Iterator[Report | None]:
    """Give the callback that is meant by `progress`: itself; for True bars, for None bars in a notebook only.

    The bars' phases are named after `label`.
    """
    if callable(progress):
        yield progress
    elif progress or (progress is None and in_notebook()):
        with progress_bars() as report:
            yield report and labelled(report, label)
    else:
        yield None


def labelled(report: Report, label: str) -> Report:
    """Return the callback with `label` before the names of the phases; lines of JSON have a place for it."""
    if hasattr(report, "labelled"):
        return report.labelled(label)

    def report_labelled(phase: str, done: int, total: int, info: Info) -> None:
        report(f"{label} {phase}", done, total, info)

    return report_labelled


def in_notebook() -> bool:
    """Say whether the code runs in the kernel of a Jupyter notebook."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return getattr(shell, "kernel", None) is not None


def on_terminal() -> bool:
    """Say whether someone may look at the standard output."""
    return sys.stdout.isatty()
