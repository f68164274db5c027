"""Record the points inside the bounds that have no finite log-likelihood, and the reason for each."""

from __future__ import annotations

from collections.abc import Callable

from fmu.fem.programs.solves import Failure as Failure
from fmu.types import FloatArray

MOST_KEPT = 10_000
"""Largest number of failures stored in `first`, and of failures stored until `take` is called."""


class FailureRecord:
    """A record of the first failed points, and of the points that failed since `take` was last called.

    At most `most` points of either kind are stored with their reasons, so memory and time are bounded; `count` is
    the number of all failures. A pickled copy is empty, so that another process records only its own failures.

    Parameters
    ----------
    most : int
        Largest number of points to store.

    Attributes
    ----------
    first : list of Failure
        The first failures. A theta that fails again before `take` is called is recorded once.
    count : int
        Number of failed evaluations, including repeated evaluations of one theta.
    """

    def __init__(self, most: int = MOST_KEPT) -> None:
        self.most = most
        self.first: list[Failure] = []
        self.count = 0
        self._waiting: dict[bytes, Failure] = {}

    def __reduce__(self) -> tuple[type[FailureRecord], tuple[int]]:
        return FailureRecord, (self.most,)

    def add(self, points: FloatArray, why: Callable[[FloatArray], str]) -> None:
        """Record failed points (n, ndim). ``why(theta)``, called only for stored points, returns the reason."""
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
        """Return the failures since the last call of this method, in order."""
        taken = list(self._waiting.values())
        self._waiting.clear()
        return taken
