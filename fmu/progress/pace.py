"""Estimate how fast a phase of a run progresses, and limit how often progress is reported."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Hashable

WINDOW_S = 15.0
_SAMPLES = 50


class Pace:
    """Pace of a phase over the last few seconds, so that a slow beginning does not affect it.

    Parameters
    ----------
    window_s : float
        Length of the window in s. If reports come less often, the last two reports are used.
    """

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self.window_s = window_s
        self.total = 0
        self._steps: deque[tuple[float, int]] = deque()

    def add(self, now: float, done: int, total: int) -> None:
        """Record that `done` of `total` steps are done at time `now`, in seconds on any clock.

        If `done` decreases, the phase has started again, and earlier reports are forgotten.
        """
        if self._steps and done < self._steps[-1][1]:  # the phase has started again
            self._steps.clear()
        self.total = total
        if len(self._steps) > 1 and now - self._steps[-2][0] < self.window_s / _SAMPLES:
            self._steps.pop()  # limits the memory if there are thousands of reports
        self._steps.append((now, done))
        while len(self._steps) > 2 and self._steps[1][0] <= now - self.window_s:
            self._steps.popleft()

    def per_s(self) -> float | None:
        """Return the number of steps per second.

        Return None if there are fewer than two reports, or if no time has passed between them.
        """
        if len(self._steps) < 2:
            return None
        (began, before), (ended, done) = self._steps[0], self._steps[-1]
        return (done - before) / (ended - began) if ended > began else None

    def remaining(self, now: float) -> float | None:
        """Return the time in s that remains at time `now`: 0 at the end, None if the pace is zero or not known."""
        if not self._steps:
            return None
        at, done = self._steps[-1]
        if done >= self.total:
            return 0.0
        speed = self.per_s()
        return max((self.total - done) / speed - (now - at), 0.0) if speed else None


class Throttle:
    """Limits the reports about one thing to one per interval, but always allows the last report.

    Parameters
    ----------
    interval_s : float
        Shortest time in s between two reports.
    """

    def __init__(self, interval_s: float) -> None:
        self.interval_s = interval_s
        self._shown: dict[Hashable, float] = {}

    def lets(self, what: Hashable, *, ends: bool) -> bool:
        """Return True if a report about `what` may be shown now; always True if `ends` marks it as the last."""
        now = time.monotonic()
        if not ends and what in self._shown and now < self._shown[what] + self.interval_s:
            return False
        self._shown[what] = now
        return True
