"""Bars on a terminal and in a notebook: one a phase and group of chains."""

from __future__ import annotations

import html
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from fmu.numbers import fixed
from fmu.progress.pace import Pace
from fmu.progress.throttle import Throttle
from fmu.progress.words import bar_name, duration, in_words

if TYPE_CHECKING:
    from rich.console import Console

    from fmu.progress.report import Info, Report

_REDRAW_S = 0.05
_BAR_WIDTH = 8
_NARROW = 100
# of a terminal, for what is written below the bars
_ROWS_SPARED = 2


@contextmanager
def terminal_bars(console: Console | None = None) -> Iterator[Report]:
    """Give a callback that draws bars on the terminal, the finished ones making room where there are many."""
    from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
    from rich.table import Column
    from rich.text import Text

    class Remaining(ProgressColumn):
        def render(self, task: Task) -> Text:
            if task.finished:
                return Text(duration(task.finished_time), style="progress.elapsed")
            return Text(duration(task.fields["pace"].remaining(time.monotonic())), style="progress.remaining")

    columns = (
        TextColumn("{task.description}", table_column=Column(no_wrap=True)),
        BarColumn(_BAR_WIDTH, finished_style="green"),
        TextColumn("{task.completed:.0f}/{task.total:.0f}", table_column=Column(justify="right", no_wrap=True)),
        Remaining(table_column=Column(justify="right", no_wrap=True)),
        TextColumn("{task.fields[words]}", table_column=Column(no_wrap=True, overflow="ellipsis")),
    )
    with Progress(*columns, console=console) as bars:
        tasks: dict[str, Any] = {}
        paces: dict[str, Pace] = {}
        throttle, brief = Throttle(_REDRAW_S), bars.console.width < _NARROW

        def report(phase: str, done: int, total: int, info: Info) -> None:
            name = bar_name(phase, info)
            if name not in tasks:
                paces[name] = Pace()
                tasks[name] = bars.add_task(name, total=total, words="", pace=paces[name])
                _make_room(bars)
            paces[name].add(time.monotonic(), done, total)
            if throttle.lets(name, ends=done >= total):
                bars.update(tasks[name], completed=done, total=total, words=in_words(info, brief))

        yield report


def _make_room(bars: Any) -> None:
    """Hide the first bars that are done with, where all of them do not fit on the terminal."""
    shown = [task for task in bars.tasks if task.visible]
    for task in shown[: max(len(shown) - (bars.console.size.height - _ROWS_SPARED), 0)]:
        bars.update(task.id, visible=not task.finished)


class NotebookBars:
    """Bars in HTML, which every front end shows, and of which a saved notebook keeps the last state."""

    def __init__(self) -> None:
        self._lines: dict[str, str] = {}
        self._began: dict[str, float] = {}
        self._paces: dict[str, Pace] = {}
        self._throttle = Throttle(_REDRAW_S)
        self._handle: Any = None

    def report(self, phase: str, done: int, total: int, info: Mapping[str, str | int | float]) -> None:
        """Report steps done of a phase."""
        name, now = bar_name(phase, info), time.monotonic()
        began = self._began.setdefault(name, now)
        pace = self._paces.setdefault(name, Pace())
        pace.add(now, done, total)
        if not self._throttle.lets(name, ends=done >= total):
            return
        left = "" if done >= total else f", {duration(pace.remaining(now))} left"
        shown, words = html.escape(name), html.escape(in_words(info))
        self._lines[name] = (
            f'<div><progress value="{done}" max="{total}" aria-label="{shown}"></progress> '
            f"{shown}: {done} of {total}, {fixed(now - began, 1)} s{left} {words}</div>"
        )
        self._show()

    def _show(self) -> None:
        from IPython.display import HTML, display

        content = HTML("".join(self._lines.values()))
        if self._handle is None:
            self._handle = display(content, display_id=True)
        else:
            self._handle.update(content)
