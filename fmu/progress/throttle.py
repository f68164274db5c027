"""Not every step is shown."""

from __future__ import annotations

import time
from collections.abc import Hashable


class Throttle:
    """Lets something through at its end, and else only so often.

    Parameters
    ----------
    interval_s : float
    """

    def __init__(self, interval_s: float) -> None:
        self.interval_s = interval_s
        self._shown: dict[Hashable, float] = {}

    def lets(self, what: Hashable, *, ends: bool) -> bool:
        """Say whether `what` may be shown now."""
        now = time.monotonic()
        if not ends and what in self._shown and now < self._shown[what] + self.interval_s:
            return False
        self._shown[what] = now
        return True
