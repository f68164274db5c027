"""Ratios that survive a noisy machine: two sides take turns in one process, and the median of the pairs counts."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np


def paired_ratio(ours: Callable[[], object], theirs: Callable[[], object], seconds: float = 2.0) -> float:
    """Return the median of (time of ours / time of theirs) over interleaved pairs, at least nine of them.

    Each side is repeated until one measurement takes about a hundredth of `seconds`.
    """
    repeats = [_repeats(side, seconds / 100) for side in (ours, theirs)]
    ratios: list[float] = []
    end = time.perf_counter() + seconds
    while len(ratios) < 9 or time.perf_counter() < end:
        a, b = (_timed(side, n) for side, n in zip((ours, theirs), repeats, strict=True))
        ratios.append(a / b)
    return float(np.median(ratios))


def _timed(side: Callable[[], object], repeats: int) -> float:
    began = time.perf_counter()
    for _ in range(repeats):
        side()
    return (time.perf_counter() - began) / repeats


def _repeats(side: Callable[[], object], seconds: float) -> int:
    side()
    return max(1, int(seconds / _timed(side, 1)))


def spd(n, size, seed=0):
    """Return n symmetric positive definite matrices of that size."""
    a = np.random.default_rng(seed).standard_normal((n, size, size))
    return a @ np.swapaxes(a, 1, 2) + size * np.eye(size)
