"""Progress for programs: one JSON object a line."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, TextIO

from fmu.progress.pace import Pace
from fmu.progress.throttle import Throttle
from fmu.progress.words import bar_name

if TYPE_CHECKING:
    from types import TracebackType

    from fmu.progress.report import Info, Report

_LINE_S = 1.0


class JSONLines:
    """Writes what it is told as lines of JSON, each flushed.

    ``{"time": "2026-03-01T12:00:00.125Z", "label": "hmc", "phase": "draws", "done": 120, "total": 1000,
    "remaining_s": 41.2, "accept": 0.83, "rhat": 1.031, "ess": 212.0}``: the time in UTC; `label` where there is
    one; the seconds left at the pace of the last ones, null while that is not known; and all of ``info`` by its
    own names, numbers as numbers, null for what is not finite.

    Of each phase, and each ``group`` of chains where there are several, at most one line a second, the end, and,
    as it is closed, the last that was held back. A stream that breaks is not written to any more: it is no reason
    to end a run.

    Parameters
    ----------
    stream : text stream
        For a command whose standard output holds tables, the standard error.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream: TextIO | None = stream
        self._throttle = Throttle(_LINE_S)
        self._paces: dict[tuple[str, str], Pace] = {}
        self._held_back: dict[tuple[str, str], dict[str, Any]] = {}

    def __enter__(self) -> JSONLines:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        self.close()

    def __call__(self, phase: str, done: int, total: int, info: Info) -> None:
        """Report steps done of a phase."""
        self._report("", phase, done, total, info)

    def labelled(self, label: str) -> Report:
        """Return a callback that writes a label too."""

        def report_labelled(phase: str, done: int, total: int, info: Info) -> None:
            self._report(label, phase, done, total, info)

        return report_labelled

    def close(self) -> None:
        """Write what was held back; the stream stays open."""
        for line in self._held_back.values():
            self._write(line)
        self._held_back.clear()

    def _report(self, label: str, phase: str, done: int, total: int, info: Info) -> None:
        what, now = (label, bar_name(phase, info)), time.monotonic()
        pace = self._paces.setdefault(what, Pace())
        pace.add(now, done, total)
        stamp = datetime.now(UTC).isoformat(timespec="milliseconds").removesuffix("+00:00")
        left = pace.remaining(now)
        line: dict[str, Any] = {"time": f"{stamp}Z", "label": label, "phase": phase, "done": done, "total": total}
        line["remaining_s"] = left if left is None else round(left, 1)
        line |= {name: value for name, value in info.items() if name not in line}
        if not label:
            del line["label"]
        if self._throttle.lets(what, ends=done >= total):
            self._held_back.pop(what, None)
            self._write(line)
        else:
            self._held_back[what] = line

    def _write(self, line: Mapping[str, Any]) -> None:
        if self._stream is None:
            return
        try:
            self._stream.write(json.dumps({name: _plain(value) for name, value in line.items()}) + "\n")
            self._stream.flush()
        except (OSError, ValueError):  # broken, or closed
            self._stream = None


def _plain(value: Any) -> Any:
    """Return a value as JSON has it: NumPy's numbers as Python's, None for what is not finite."""
    if isinstance(value, str) or value is None:
        return value
    if isinstance(value, Integral):
        return int(value)
    if isinstance(value, Real):
        return float(value) if math.isfinite(value) else None
    return str(value)
