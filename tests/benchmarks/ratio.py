"""Ratios of times on a busy machine: two sides take turns in one process, and the median of the pairs is used."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray


def paired_ratios(
    ours: Callable[[], object],
    theirs: Callable[[], object],
    seconds: float = 1.0,
    clock: Callable[[], float] = time.process_time,
) -> NDArray[np.float64]:
    """Return time of ours / time of theirs for interleaved pairs, at least nine of them.

    The default clock is processor time, which stops while another process has the core, and adds up all threads.
    Each side is repeated until one measurement takes a hundredth of `seconds`.
    """
    repeats = [_repeats(side, seconds / 100, clock) for side in (ours, theirs)]
    ratios: list[float] = []
    end = time.perf_counter() + seconds
    while len(ratios) < 9 or time.perf_counter() < end:
        a, b = (_timed(side, n, clock) for side, n in zip((ours, theirs), repeats, strict=True))
        ratios.append(a / b)
    return np.array(ratios)


def spread(ratios: NDArray[np.float64], budget: float | None = None) -> str:
    """Return the median and, in brackets, the quartiles.

    The median has three digits, or four if it looks equal to the budget with three.
    """
    low, median, high = np.quantile(ratios, [0.25, 0.5, 0.75])
    digits = 4 if budget is not None and float(f"{median:.3g}") == budget else 3
    return f"{median:.{digits}g} × ({low:.3g}–{high:.3g})"


def _timed(side: Callable[[], object], repeats: int, clock: Callable[[], float]) -> float:
    """Return the mean time of a call, after one untimed call that warms the caches after the other side."""
    side()
    began = clock()
    for _ in range(repeats):
        side()
    return (clock() - began) / repeats


def _repeats(side: Callable[[], object], seconds: float, clock: Callable[[], float]) -> int:
    """Return how often `side` fits into `seconds`, by doubling the number of calls."""
    repeats = 1
    while (took := repeats * _timed(side, repeats, clock)) < seconds / 2:
        repeats *= 2
    return max(1, round(repeats * seconds / took))


def spd(n: int, size: int, seed: int = 0) -> NDArray[np.float64]:
    """Return `n` symmetric positive definite matrices of order `size`."""
    a = np.random.default_rng(seed).standard_normal((n, size, size))
    return a @ np.swapaxes(a, 1, 2) + size * np.eye(size)
