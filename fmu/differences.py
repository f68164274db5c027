"""Points for finite differences, which are central within the bounds and one-sided at the bounds."""

from __future__ import annotations

import numpy as np

from fmu.types import FloatArray


def both_sides(
    centre: FloatArray, step: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the points on both sides of each centre along every coordinate, and the distances between them.

    A point outside the bounds is moved to the boundary. If the centre itself is outside, the point farther outside
    is replaced by the centre, and the other stays where it is.

    Parameters
    ----------
    centre : ndarray, shape (n, ndim)
    step : ndarray, shape (ndim,)
    lower, upper : ndarray, shape (ndim,) or (n, ndim)

    Returns
    -------
    points : ndarray, shape (2, n, ndim, ndim)
        ``points[0, :, k]`` are above the centres along coordinate k, ``points[1, :, k]`` are below.
    distance : ndarray, shape (n, ndim)
        Distance between the two points along each coordinate.
    """
    shift, at = np.diag(step), centre[:, None, :]
    lower, upper = (np.broadcast_to(wall, centre.shape)[:, None, :] for wall in (lower, upper))
    points = np.stack(
        [np.minimum(at + shift, np.maximum(upper, at)), np.maximum(at - shift, np.minimum(lower, at))]
    )
    return points, np.asarray(np.diagonal(points[0] - points[1], axis1=1, axis2=2))
