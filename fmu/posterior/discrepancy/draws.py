"""Evaluate quantities at posterior draws, once for equal draws: a rejected step repeats the last draw."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from fmu.progress.phases import by_parts
from fmu.types import FloatArray, IntArray


def distinct_rows(theta: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the distinct rows of theta (n, ndim), and each row's index among them, shape (n,)."""
    distinct, index = np.unique(theta, axis=0, return_inverse=True)
    return distinct, index.reshape(-1)


def at_distinct_rows(
    function: Callable[[FloatArray], Sequence[FloatArray]], theta: FloatArray
) -> tuple[FloatArray, ...]:
    """Return the arrays that a function gives at theta (n, ndim), after one call with the distinct rows only.

    Parameters
    ----------
    function : callable
        Maps rows (m, ndim) to arrays (m, …).
    theta : ndarray, shape (n, ndim)
    """
    distinct, index = distinct_rows(theta)
    parts = by_parts("predictions", function, distinct)
    return tuple(np.concatenate(part)[index] for part in zip(*parts, strict=True))
