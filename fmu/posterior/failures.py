"""Points inside the bounds that have no finite log-likelihood, each with the reason."""

from __future__ import annotations

from collections.abc import Callable

from fmu.fem.black_box import Failure as Failure
from fmu.types import FloatArray

MOST_KEPT = 10_000
"""How many failures are kept for people, and how many until somebody takes them."""


class FailureRecord:
    """What failed: the first points for people, and those since somebody last took them.

    Of each the first `most` are kept, and the reasons found: however many fail, memory and time are bounded, and
    `count` says how many there were. A copy in another process, or a pickled one, starts empty: it is about what
    fails there.

    Parameters
    ----------
    most : int

    Attributes
    ----------
    first : list of Failure
        A theta that fails again while its record waits to be taken is not recorded twice.
    count : int
        Failed evaluations, repeated ones among them.
    """

    def __init__(self, most: int = MOST_KEPT) -> None:
        self.most = most
        self.first: list[Failure] = []
        self.count = 0
        self._waiting: dict[bytes, Failure] = {}

    def __reduce__(self) -> tuple[type[FailureRecord], tuple[int]]:
        return FailureRecord, (self.most,)

    def add(self, points: FloatArray, why: Callable[[FloatArray], str]) -> None:
        """Record failed points (n, ndim); ``why(theta)`` is asked for the reason of those that are kept."""
        self.count += len(points)
        for theta in points:
            if len(self._waiting) >= self.most:
                return
            key = theta.tobytes()
            if key in self._waiting:
                continue
            failure = Failure(theta.copy(), why(theta))
            self._waiting[key] = failure
            if len(self.first) < self.most:
                self.first.append(failure)

    def take(self) -> list[Failure]:
        """Return what failed since this was last called, in the order in which it did."""
        taken = list(self._waiting.values())
        self._waiting.clear()
        return taken
