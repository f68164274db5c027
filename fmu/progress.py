"""Progress for people: bars on a terminal and in a notebook, nothing where nobody looks."""

from __future__ import annotations

import html
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

Report = Callable[[str, int, int, Mapping[str, str]], None]
"""Called as ``report(phase, done, total, info)``: steps done of a phase, and a few words by name."""

_REDRAW_S = 0.05


@contextmanager
def progress_bars() -> Iterator[Report | None]:
    """Give a callback that draws one bar a phase; None where there is neither a notebook nor a terminal."""
    if in_notebook():
        yield _NotebookBars().report
    elif on_terminal():
        with _terminal_bars() as report:
            yield report
    else:
        yield None


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
    """Return the callback with `label` before the names of the phases."""

    def report_labelled(phase: str, done: int, total: int, info: Mapping[str, str]) -> None:
        report(f"{label} {phase}", done, total, info)

    return report_labelled


def in_notebook() -> bool:
    """Say whether the code runs in the kernel of a Jupyter notebook."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return getattr(shell, "kernel", None) is not None


def on_terminal() -> bool:
    """Say whether someone may look at the standard output."""
    return sys.stdout.isatty()


class _Throttle:
    """Lets a phase through when it ends, and else only so often."""

    def __init__(self) -> None:
        self._drawn: dict[str, float] = {}

    def lets(self, phase: str, *, ends: bool) -> bool:
        now = time.monotonic()
        if not ends and now < self._drawn.get(phase, -1.0) + _REDRAW_S:
            return False
        self._drawn[phase] = now
        return True


@contextmanager
def _terminal_bars() -> Iterator[Report]:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
               TextColumn("{task.fields[words]}"))  # fmt: skip
    with Progress(*columns) as bars:
        tasks: dict[str, Any] = {}
        throttle = _Throttle()

        def report(phase: str, done: int, total: int, info: Mapping[str, str]) -> None:
            if phase not in tasks:
                tasks[phase] = bars.add_task(phase, total=total, words="")
            if throttle.lets(phase, ends=done >= total):
                bars.update(tasks[phase], completed=done, total=total, words=_words(info))

        yield report


class _NotebookBars:
    """Bars in HTML, which every front end shows, and of which a saved notebook keeps the last state."""

    def __init__(self) -> None:
        self._lines: dict[str, str] = {}
        self._began: dict[str, float] = {}
        self._throttle = _Throttle()
        self._handle: Any = None

    def report(self, phase: str, done: int, total: int, info: Mapping[str, str]) -> None:
        began = self._began.setdefault(phase, time.monotonic())
        if not self._throttle.lets(phase, ends=done >= total):
            return
        name, words = html.escape(phase), html.escape(_words(info))
        self._lines[phase] = (
            f'<div><progress value="{done}" max="{total}" aria-label="{name}"></progress> '
            f"{name}: {done} of {total}, {time.monotonic() - began:.1f} s {words}</div>"
        )
        self._show()

    def _show(self) -> None:
        from IPython.display import HTML, display

        content = HTML("".join(self._lines.values()))
        if self._handle is None:
            self._handle = display(content, display_id=True)
        else:
            self._handle.update(content)


def _words(info: Mapping[str, str]) -> str:
    return " ".join(f"{key} {value}" for key, value in info.items())
