"""The box of a density: which points are inside it."""

from __future__ import annotations

import numpy as np

from fmu.types import BoolArray, FloatArray


def find_inside(points: FloatArray, lower: FloatArray, upper: FloatArray) -> tuple[BoolArray, bool]:
    """Return a mask of the points inside a box, and whether there are points and all are inside.

    A coordinate that is NaN is outside, one on a wall inside.

    Parameters
    ----------
    points : ndarray, shape (..., ndim)
    lower, upper : ndarray, shape (ndim,)

    Returns
    -------
    inside : ndarray of bool, shape (...)
    all_inside : bool
    """
    within = (points >= lower) & (points <= upper)
    if np.count_nonzero(within) == within.size > 0:  # as a rule; a tenth of what `all` takes on a small array
        return np.ones(points.shape[:-1], dtype=bool), True
    return within.all(axis=-1), False
