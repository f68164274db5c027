"""Points inside the bounds that have no finite log-likelihood, each with the reason."""

from __future__ import annotations

from collections.abc import Callable

from fmu.fem.programs.solves import Failure as Failure
from fmu.types import FloatArray

MOST_KEPT = 10_000
"""How many failures are kept, in `first` and until `take` is called."""


class FailureRecord:
    """The first failed points, and those since `take` was last called.

    At most `most` of each are kept with their reasons, so memory and time are bounded; `count` counts all. A copy
    in another process, or a pickled one, starts empty and records the failures there.

    Parameters
    ----------
    most : int

    Attributes
    ----------
    first : list of Failure
        A theta that fails again before `take` is called is recorded once.
    count : int
        Failed evaluations, including repeated ones.
    """

    def __init__(self, most: int = MOST_KEPT) -> None:
        self.most = most
        self.first: list[Failure] = []
        self.count = 0
        self._waiting: dict[bytes, Failure] = {}

    def __reduce__(self) -> tuple[type[FailureRecord], tuple[int]]:
        return FailureRecord, (self.most,)

    def add(self, points: FloatArray, why: Callable[[FloatArray], str]) -> None:
        """Record failed points (n, ndim); ``why(theta)`` gives the reason for those that are kept."""
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
        """Return the failures since this was last called, in order."""
        taken = list(self._waiting.values())
        self._waiting.clear()
        return taken
