"""Progress displays: bars on a terminal or in a notebook, one per phase and group of chains, and JSON lines."""

from __future__ import annotations

import html
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Self, TextIO

from fmu.numbers import fixed
from fmu.progress.pace import Pace, Throttle
from fmu.progress.words import Info, LineStream, Report, as_json, bar_name, duration, in_words

if TYPE_CHECKING:
    from IPython.display import DisplayHandle
    from rich.console import Console
    from rich.progress import Progress, TaskID

_LINE_S = 1.0
_REDRAW_S = 0.05
_BAR_WIDTH = 8
_NARROW = 100
_ROWS_SPARED = 2
"""Number of terminal rows that are kept free for output below the bars."""


@contextmanager
def terminal_bars(console: Console | None = None) -> Iterator[Report]:
    """Yield a callback that draws bars on the terminal. If the bars do not all fit, finished ones are hidden."""
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
        tasks: dict[str, TaskID] = {}
        paces: dict[str, Pace] = defaultdict(Pace)
        throttle, brief = Throttle(_REDRAW_S), bars.console.width < _NARROW

        def report(phase: str, done: int, total: int, info: Info) -> None:
            name = bar_name(phase, info)
            if name not in tasks:
                tasks[name] = bars.add_task(name, total=total, words="", pace=paces[name])
                _make_room(bars)
            paces[name].add(time.monotonic(), done, total)
            if throttle.lets(name, ends=done >= total):
                bars.update(tasks[name], completed=done, total=total, words=in_words(info, brief))

        yield report


class SuccessiveBars:
    """Bars on the terminal that can be ended before text is printed. Later reports draw new bars below it."""

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._report: Report | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.end()

    def __call__(self, phase: str, done: int, total: int, info: Info) -> None:
        """Show that `done` of the `total` steps of a phase are done."""
        if self._report is None:
            self._report = self._stack.enter_context(terminal_bars())
        self._report(phase, done, total, info)

    def end(self) -> None:
        """Leave the bars as they are, so that the next report starts new bars."""
        self._stack.close()
        self._report = None


def _make_room(bars: Progress) -> None:
    """If the bars do not all fit on the terminal, hide the oldest ones that are finished."""
    shown = [task for task in bars.tasks if task.visible]
    for task in shown[: max(len(shown) - (bars.console.size.height - _ROWS_SPARED), 0)]:
        bars.update(task.id, visible=not task.finished)


class NotebookBars:
    """Bars in a notebook, as HTML, which every front end shows. A saved notebook keeps their last state."""

    def __init__(self) -> None:
        self._lines: dict[str, str] = {}
        self._began: dict[str, float] = {}
        self._paces: dict[str, Pace] = defaultdict(Pace)
        self._throttle = Throttle(_REDRAW_S)
        self._handle: DisplayHandle | None = None

    def report(self, phase: str, done: int, total: int, info: Info) -> None:
        """Show that `done` of the `total` steps of a phase are done."""
        name, now = bar_name(phase, info), time.monotonic()
        began = self._began.setdefault(name, now)
        self._paces[name].add(now, done, total)
        if not self._throttle.lets(name, ends=done >= total):
            return
        left = "" if done >= total else f", {duration(self._paces[name].remaining(now))} left"
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


class JSONLines:
    """A callback that writes reports as JSON objects, one per line, and flushes the stream after each line.

    A line is ``{"time": "2026-03-01T12:00:00.125Z", "label": "hmc", "phase": "draws", "done": 120, "total": 1000,
    "remaining_s": 41.2, "accept": 0.83, "rhat": 1.031, "ess": 212.0}``. The time is in UTC. `label` is present if
    the report has a label. `remaining_s` is the remaining time in s at the current pace, or null if the pace is
    zero or not known. Phases other than warm-up and draws have ``elapsed_s``, the time in s since they began. The
    items of ``info`` follow under their own names; numbers that are not finite become null.

    At most one line per second is written for each phase and ``group`` of chains, but the last report is always
    written. `close` writes the last line of a phase that ends early. If the stream breaks, nothing more is
    written, and the run continues.

    Parameters
    ----------
    stream : text stream
        For example standard error, if a command prints tables on standard output.
    """

    def __init__(self, stream: TextIO) -> None:
        self._lines = LineStream(stream)
        self._throttle = Throttle(_LINE_S)
        self._paces: dict[str, Pace] = defaultdict(Pace)
        self._held_back: dict[str, dict[str, object]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __call__(self, phase: str, done: int, total: int, info: Info) -> None:
        """Write a line with a phase's `done` and `total` steps, or defer it if the last line is too recent."""
        name, now = bar_name(phase, info), time.monotonic()
        self._paces[name].add(now, done, total)
        left = self._paces[name].remaining(now)
        stamp = datetime.now(UTC).isoformat(timespec="milliseconds").removesuffix("+00:00")
        line: dict[str, object] = {
            "time": f"{stamp}Z",
            **({"label": info["label"]} if "label" in info else {}),
            "phase": phase,
            "done": done,
            "total": total,
            "remaining_s": left if left is None else round(left, 1),
        }
        line |= {key: value for key, value in info.items() if key not in line}
        if self._throttle.lets(name, ends=done >= total):
            self._held_back.pop(name, None)
            self._lines.write(as_json(line))
        else:
            self._held_back[name] = line

    def close(self) -> None:
        """Write the deferred lines, but do not close the stream."""
        for line in self._held_back.values():
            self._lines.write(as_json(line))
        self._held_back.clear()
