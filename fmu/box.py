"""Check whether points are inside a box, such as the parameter bounds."""

from __future__ import annotations

import numpy as np

from fmu.types import BoolArray, FloatArray


def find_inside(points: FloatArray, lower: FloatArray, upper: FloatArray) -> tuple[BoolArray, bool]:
    """Return a mask of the points inside a box, and whether all points are inside.

    A point with a NaN coordinate is outside; a point on the boundary is inside.

    Parameters
    ----------
    points : ndarray, shape (..., ndim)
    lower, upper : ndarray, shape (ndim,)

    Returns
    -------
    inside : ndarray of bool, shape (...)
    all_inside : bool
        Whether all points are inside; False if there are no points.
    """
    within = (points >= lower) & (points <= upper)
    if np.count_nonzero(within) == within.size > 0:  # the usual case, ten times faster than `all` on small arrays
        return np.ones(points.shape[:-1], dtype=bool), True
    return within.all(axis=-1), False
