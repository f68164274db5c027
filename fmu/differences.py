"""Points on both sides of others, between which differences are taken: central ones, and one-sided at a wall."""

from __future__ import annotations

import numpy as np

from fmu.types import FloatArray


def both_sides(
    centre: FloatArray, step: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return points on both sides of others along every coordinate, and the distances between them.

    A point that would leave the box is put on its wall. A centre outside the box stays a side of itself.

    Parameters
    ----------
    centre : ndarray, shape (n, ndim)
    step : ndarray, shape (ndim,)
    lower, upper : ndarray, shape (ndim,) or (n, ndim)

    Returns
    -------
    points : ndarray, shape (2, n, ndim, ndim)
        ``points[0, :, k]`` lie above along coordinate k, ``points[1, :, k]`` below.
    distance : ndarray, shape (n, ndim)
    """
    shift, at = np.diag(step), centre[:, None, :]
    lower, upper = (np.broadcast_to(wall, centre.shape)[:, None, :] for wall in (lower, upper))
    points = np.stack(
        [np.minimum(at + shift, np.maximum(upper, at)), np.maximum(at - shift, np.minimum(lower, at))]
    )
    return points, np.asarray(np.diagonal(points[0] - points[1], axis1=1, axis2=2))
