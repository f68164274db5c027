"""Gradients compared with central differences: one way for all tests."""

import numpy as np
from numpy.testing import assert_allclose

WEIGHTS = {2: (1 / 2,), 4: (8 / 12, -1 / 12), 6: (45 / 60, -9 / 60, 1 / 60)}
"""Weights of the differences at 1, 2, … steps, by the order of their error."""


def differences(function, x, step, order=2):
    """Return ∂ function/∂x by central differences with an error of O(step^order), shape (n, …, ndim).

    Parameters
    ----------
    function : callable
        Maps points (n, ndim) to values (n, …).
    x : ndarray, shape (n, ndim)
    step : float or ndarray, shape (ndim,) or (n, ndim)
    """
    step, weights = np.broadcast_to(step, x.shape), WEIGHTS[order]
    h = step * np.eye(x.shape[1])[:, None]  # (ndim, n, ndim)
    points = np.stack([(x + i * h, x - i * h) for i in range(1, len(weights) + 1)])
    values = np.asarray(function(points.reshape(-1, x.shape[1])))  # all at once, which takes as long as one
    values = values.reshape(*points.shape[:-1], *values.shape[1:])
    moved = sum(w * (above - below) for w, (above, below) in zip(weights, values, strict=True))
    columns = [(of.T / step[:, k]).T for k, of in enumerate(moved)]
    return np.stack(columns, axis=-1)


def assert_gradient(gradient, function, x, step, order=2, *, rtol=0.0, atol=0.0, of_largest=0.0):
    """Fail unless a gradient is that of central differences, see `differences`.

    A single point (ndim,) may be given with its gradient (…, ndim). `of_largest` is an absolute tolerance as a
    fraction of the point's largest change over a step of one coordinate; `atol` has the unit of the gradient.
    """
    if np.ndim(x) == 1:
        x, gradient = np.asarray(x)[None], np.asarray(gradient)[None]
    expected = differences(function, x, step, order)
    if of_largest:
        over_step = np.broadcast_to(step, x.shape).reshape(len(x), *[1] * (gradient.ndim - 2), -1)
        gradient, expected = gradient * over_step, expected * over_step
        largest = np.max(np.abs(gradient), axis=tuple(range(1, gradient.ndim)), keepdims=True)
        gradient, expected, atol = gradient / largest, expected / largest, of_largest
    assert_allclose(gradient, expected, rtol=rtol, atol=atol)
