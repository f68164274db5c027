"""Progress as log lines, for use without a terminal: one line half a second into a stage, then one every 30 s."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from types import TracebackType
from typing import Self, TextIO

from fmu.progress.pace import Pace
from fmu.progress.words import Info, LineStream, bar_name, duration, in_words

FIRST_S = 0.5
"""Time in s after which the first line of a stage is written; most stages end earlier."""
EVERY_S = 30.0


class ProgressLines:
    """Writes log lines with the current stage, its steps, the elapsed time and the remaining time.

    A line is ``training: 120 of 400, 0:12 so far, 0:28 to go``. A thread writes the lines, so a stage without
    reports also gets lines. If the stream breaks, nothing more is written, and the work continues.

    Parameters
    ----------
    stream : text stream
    stage : str
        Name of the stage before the first phase and between phases.
    look_s : float
        Interval in s at which the thread checks whether a line is due.
    """

    def __init__(self, stream: TextIO, stage: str, look_s: float = 0.1) -> None:
        self._look_s = look_s
        self._lines = LineStream(stream)
        self._outer = stage
        self._began = self._last = time.monotonic()
        self._told: set[str] = set()
        self._lock, self._over = threading.Lock(), threading.Event()
        self._paces: dict[str, Pace] = defaultdict(Pace)
        self._words = ""
        self._waiting: list[str] = []
        self._enter(stage)

    def __enter__(self) -> Self:
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()

    def report(self, phase: str, done: int, total: int, info: Info) -> None:
        """Record a report about a phase; see `fmu.progress.words.Report`."""
        with self._lock:
            self._step(bar_name(phase, info), done, total)
            self._words = in_words(info)

    def note(self, phase: str, done: int, total: int) -> None:
        """Record the steps of the current phase; see `fmu.progress.phases.Note`. An empty `phase` ends it."""
        with self._lock:
            self._step(phase or self._outer, done, total)

    def tell(self, fact: str) -> None:
        """Queue a fact, such as the size of the model, to be written before the next line."""
        with self._lock:
            self._waiting.append(fact)

    def _enter(self, stage: str) -> None:
        self._stage, self._since = stage, self._began if stage == self._outer else time.monotonic()
        self._done = self._total = 0
        self._words = ""

    def _step(self, stage: str, done: int, total: int) -> None:
        if stage != self._stage:
            self._enter(stage)
        self._done, self._total = done, total
        self._paces[stage].add(time.monotonic(), done, total)

    def _watch(self) -> None:
        while not self._over.wait(self._look_s):
            now = time.monotonic()
            with self._lock:
                is_first = self._stage not in self._told
                is_due = now - self._since >= FIRST_S if is_first else now - self._last >= EVERY_S
                lines = [*self._waiting, self._line(now)] if is_due else []
                if is_due:
                    self._waiting, self._last = [], now
                    self._told.add(self._stage)
            for line in lines:
                self._lines.write(line)

    def _line(self, now: float) -> str:
        parts = [f"{self._done} of {self._total}"] if self._total else []
        parts += [f"{duration(now - self._since)} so far"]
        left = self._paces[self._stage].remaining(now) if self._total else None
        parts += [f"{duration(left)} to go"] if left is not None else []
        parts += [self._words] if self._words else []
        return f"{self._stage}: {', '.join(parts)}"
