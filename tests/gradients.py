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
    step = np.broadcast_to(step, x.shape)
    columns = []
    for k in range(x.shape[1]):
        h = step * np.eye(x.shape[1])[k]
        moved = sum(w * (function(x + i * h) - function(x - i * h)) for i, w in enumerate(WEIGHTS[order], 1))
        columns.append((moved.T / step[:, k]).T)
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
