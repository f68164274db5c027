"""How fast something goes on, from its last seconds."""

from __future__ import annotations

from collections import deque

WINDOW_S = 15.0
_SAMPLES = 50


class Pace:
    """The steps of a phase over the last seconds: what was slow before, a warm-up, does not count.

    Parameters
    ----------
    window_s : float
        How far back; where reports are rarer than that, back to the last but one.
    """

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self.window_s = window_s
        self.total = 0
        self._steps: deque[tuple[float, int]] = deque()

    def add(self, now: float, done: int, total: int) -> None:
        """Note at `now`, in seconds of any clock, that `done` of `total` steps are done."""
        if self._steps and done < self._steps[-1][1]:  # it began again
            self._steps.clear()
        self.total = total
        if len(self._steps) > 1 and now - self._steps[-2][0] < self.window_s / _SAMPLES:
            self._steps.pop()  # reports may come by the thousand
        self._steps.append((now, done))
        while len(self._steps) > 2 and self._steps[1][0] <= now - self.window_s:
            self._steps.popleft()

    def per_s(self) -> float | None:
        """Return the steps a second; None where too little is known."""
        if len(self._steps) < 2:
            return None
        (began, before), (ended, done) = self._steps[0], self._steps[-1]
        return (done - before) / (ended - began) if ended > began else None

    def remaining(self, now: float) -> float | None:
        """Return the seconds that are left at `now`; None where too little is known, or nothing moves."""
        if not self._steps:
            return None
        at, done = self._steps[-1]
        if done >= self.total:
            return 0.0
        speed = self.per_s()
        return max((self.total - done) / speed - (now - at), 0.0) if speed else None
