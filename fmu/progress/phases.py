"""Phases of a run other than warm-up and draws: their progress, and the number of model solves in each phase.

Code that may take long opens a `phase` and calls `Phase.advance`. Models call `count_solves`. `told_to` sets the
callbacks that receive the reports, so the functions in between need not pass them on.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

from fmu.progress import Report, in_notebook
from fmu.progress.lines import ProgressLines

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

AT_ONCE_S = 0.5
"""Time in s after which a phase is first reported; most phases end earlier."""

_PART_S = 0.1
_FIRST_ROWS = 16

Note = Callable[[str, int, int], None]
"""Called as ``note(phase, done, total)`` whenever a phase begins or advances; the name is empty after the last
phase."""


class _Count:
    solves = gradients = 0


class Phase:
    """An open phase of a run.

    Parameters
    ----------
    name : str
    total : int
        Number of steps known so far.
    report : Report or None
    notes : tuple of Note
        Callbacks that receive the progress; see `tell`.

    Attributes
    ----------
    said : dict of str to float
        Further numbers to include in each report, keyed by name.
    """

    def __init__(self, name: str, total: int, report: Report | None, notes: tuple[Note, ...] = ()) -> None:
        self.name, self.total = name, total
        self.done = self.solves = 0
        self.said: dict[str, float] = {}
        self._report, self._notes = report, notes
        self._began = time.monotonic()
        self._is_told = False
        self.tell()

    def advance(self, steps: int = 1) -> None:
        """Add `steps` to the number of completed steps, raise the total if it is exceeded, and report."""
        self.done += steps
        self.total = max(self.total, self.done)
        self.tell()

    def expect(self, steps: int) -> None:
        """Add `steps` to the total number of steps."""
        self.total += steps

    def count_solves(self, n: int) -> None:
        """Add `n` to the number of model solves, and report."""
        self.solves += n
        self.tell()

    def tell(self) -> None:
        """Call the `Note` callbacks, and also `report` unless the phase is shorter than `AT_ONCE_S` so far."""
        for note in self._notes:
            note(self.name, self.done, self.total)
        if self._report is not None and (self._is_told or time.monotonic() - self._began >= AT_ONCE_S):
            self._is_told = True
            elapsed = {"elapsed_s": round(time.monotonic() - self._began, 1)}
            self._report(self.name, self.done, self.total, {"solves": self.solves, **elapsed, **self.said})

    def end(self) -> None:
        """Report the phase as complete, unless this was reported before or the phase took less than `AT_ONCE_S`.

        In this report, the total is the number of completed steps, but at least 1.
        """
        is_long = time.monotonic() - self._began >= AT_ONCE_S
        if (self._is_told and self.done < self.total) or (is_long and not self._is_told):
            self.total = self.done = max(self.done, 1)
            self.tell()


_phase: ContextVar[Phase | None] = ContextVar("phase", default=None)
_listeners: ContextVar[tuple[Report | None, tuple[Note, ...]]] = ContextVar("listeners", default=(None, ()))
_teller: ContextVar[Callable[[str], None] | None] = ContextVar("teller", default=None)


@contextmanager
def told_to(
    report: Report | None, note: Note | None = None, tell: Callable[[str], None] | None = None
) -> Iterator[None]:
    """Set the callbacks for the phases within a block. If one is None, the current callback stays in place.

    In nested blocks, every `note` is called, but only the innermost `report` and `tell`.
    """
    outer_report, notes = _listeners.get()
    token = _listeners.set((report or outer_report, (*notes, note) if note else notes))
    of_facts = _teller.set(tell or _teller.get())
    try:
        yield
    finally:
        _listeners.reset(token)
        _teller.reset(of_facts)


def tell_fact(fact: str) -> None:
    """Write a fact, such as the size of the model, to the current log; do nothing if there is no log."""
    tell = _teller.get()
    if tell is not None:
        tell(fact)


@contextmanager
def phase(name: str, total: int = 0) -> Iterator[Phase]:
    """Open a phase for a block. A nested phase is reported separately, but its solves count for both phases.

    If no `report` callback is set, a notebook shows bars. A block that raises an exception is not reported as
    complete.
    """
    outer, (report, notes) = _phase.get(), _listeners.get()
    if report is None and in_notebook():
        from fmu.progress.displays import NotebookBars

        report = NotebookBars().report
    opened = Phase(name, total, report, notes)
    token = _phase.set(opened)
    try:
        yield opened
        opened.end()
    finally:
        _phase.reset(token)
        if outer is not None:
            outer.solves += opened.solves
        for note in notes:
            note("" if outer is None else outer.name, 0 if outer is None else outer.done, 0)


def advance_phase(steps: int = 1) -> None:
    """Add `steps` to the number of completed steps in the current phase, if there is one."""
    under_way = _phase.get()
    if under_way is not None:
        under_way.advance(steps)


def by_parts[Found](
    name: str,
    function: Callable[[NDArray[np.float64]], Found],
    points: NDArray[np.float64],
    most: int = 4096,
    least: int = 1,
) -> list[Found]:
    """Apply a function to batches of points (n, ...), and return the list of results.

    The work is reported as a phase. The batch size is adapted so that a batch takes about a tenth of a second. A
    batch has at least `least` and at most `most` rows; the last one may have fewer. If there are no points, the
    function is called once with an empty batch.
    """
    found: list[Found] = []
    first, rows = 0, max(min(_FIRST_ROWS, most), least)
    with phase(name, len(points)) as under_way:
        while first < len(points) or not found:
            began = time.monotonic()
            part = points[first : first + rows]
            found.append(function(part))
            under_way.advance(len(part))
            took, first = time.monotonic() - began, first + rows
            rows = min(2 * rows, most) if took < _PART_S else max(rows // 2, least)
    return found


def count_solves(n: int = 1, *, with_gradients: bool = False) -> None:
    """Count `n` solves of the model, for this process and for the current phase.

    `with_gradients` says whether the solves also gave exact gradients.
    """
    _Count.solves += n
    _Count.gradients += n if with_gradients else 0
    under_way = _phase.get()
    if under_way is not None:
        under_way.count_solves(n)


def solves() -> int:
    """Return the number of solves counted in this process."""
    return _Count.solves


def gradients() -> int:
    """Return the number of solves in this process that also gave an exact gradient."""
    return _Count.gradients


@contextmanager
def progress_lines(stage: str) -> Iterator[Report | None]:
    """Yield a callback whose reports are written as log lines to standard error while the block runs.

    If standard error is a terminal, nothing is written, and None is yielded.
    """
    if sys.stderr.isatty():
        yield None
        return
    with ProgressLines(sys.stderr, stage) as lines, told_to(lines.report, lines.note, lines.tell):
        yield lines.report
