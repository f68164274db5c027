"""The largest memory that a process has taken."""

from __future__ import annotations

import resource


def peak_gib(who: int = resource.RUSAGE_SELF) -> float:
    """Return the largest resident set of this process so far, or of those that it started."""
    return resource.getrusage(who).ru_maxrss / 2**20
