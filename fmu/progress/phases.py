"""The phases of a run besides its draws: how far each has got, and how often the model was solved in it.

Code that may take long opens a `phase` and calls `Phase.advance`, models call `count_solves`, and `told_to` sets
who hears of it, so that no function between them has to pass a callback on.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

from fmu.progress import Report, in_notebook

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

AT_ONCE_S = 0.5
"""A phase is reported only after it has taken this long: most take no time."""

_PART_S = 0.1
_FIRST_ROWS = 16

Note = Callable[[str, int, int], None]
"""Called as ``note(phase, done, total)`` during a phase, from its first step; with an empty name after it."""


class _Count:
    solves = gradients = 0


class Phase:
    """A phase under way.

    Parameters
    ----------
    name : str
    total : int
        Number of steps, as far as it is known.
    report : Report or None
    notes : tuple of Note

    Attributes
    ----------
    said : dict of str to float
        Further numbers that a report tells.
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
        """Count steps that are done."""
        self.done += steps
        self.total = max(self.total, self.done)
        self.tell()

    def expect(self, steps: int) -> None:
        """Count steps that are to be done beyond those known so far."""
        self.total += steps

    def count_solves(self, n: int) -> None:
        """Count solves of the model at `n` theta."""
        self.solves += n
        self.tell()

    def tell(self) -> None:
        """Report the state of the phase, if it has taken long enough."""
        for note in self._notes:
            note(self.name, self.done, self.total)
        if self._report is not None and (self._is_told or time.monotonic() - self._began >= AT_ONCE_S):
            self._is_told = True
            self._report(self.name, self.done, self.total, {"solves": self.solves, **self.said})

    def end(self) -> None:
        """Report the end of the phase, if the phase was reported at all."""
        if self._is_told and self.done < self.total:
            self.total = self.done
            self.tell()


_phase: ContextVar[Phase | None] = ContextVar("phase", default=None)
_listeners: ContextVar[tuple[Report | None, tuple[Note, ...]]] = ContextVar("listeners", default=(None, ()))
_teller: ContextVar[Callable[[str], None] | None] = ContextVar("teller", default=None)


@contextmanager
def told_to(
    report: Report | None, note: Note | None = None, tell: Callable[[str], None] | None = None
) -> Iterator[None]:
    """Report the phases of a block to callbacks too; None leaves the callbacks that are set.

    Every `note` that is set is called, and the last `report` and `tell`.
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
    """Tell a log what is known by now, such as how large a model is; nothing happens where there is none."""
    tell = _teller.get()
    if tell is not None:
        tell(fact)


@contextmanager
def phase(name: str, total: int = 0) -> Iterator[Phase]:
    """Open a phase. One inside another is reported separately; its solves count for both."""
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
    """Count steps that are done in the phase under way, if there is one."""
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
    """Apply a function to points (n, ...) in batches, as a phase, and return the results of the batches.

    A batch takes some tenths of a second where possible, and has at least `least` rows and at most `most`.
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
    """Count solves of the model at `n` theta, for this process and for the phase under way."""
    _Count.solves += n
    _Count.gradients += n if with_gradients else 0
    under_way = _phase.get()
    if under_way is not None:
        under_way.count_solves(n)


def solves() -> int:
    """Return the number of solves that this process has counted."""
    return _Count.solves


def gradients() -> int:
    """Return how many of the solves that this process has counted gave an exact gradient too."""
    return _Count.gradients
