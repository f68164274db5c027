"""Differentiate functions of the frequency and shape derivatives with respect to the parameters.

The results are exact if the model has second derivatives; otherwise they are finite differences.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from fmu.fem.pairing.prediction import ModalPrediction
from fmu.fem.pairing.sensitivities import Sensitivities
from fmu.posterior.errors.base import ErrorTerm
from fmu.posterior.errors.slopes import split_by_term
from fmu.types import FloatArray, IntArray

_STEP = 1e-4  # relative parameter step; the error of a difference is of the order of its square


def by_second_derivatives(
    terms: Sequence[ErrorTerm],
    seen: ModalPrediction,
    exact: Sensitivities,
    noise: FloatArray,
    by_slope: FloatArray,
) -> FloatArray:
    """Differentiate a function of the residuals' slopes with respect to the parameters.

    Return an array (n, m, p) for m modes. For each mode, `exact` computes the one weighted sum of second
    derivatives that is needed.

    Parameters
    ----------
    terms : sequence of ErrorTerm
    seen : ModalPrediction
        Predicted modes with their derivatives.
    exact : Sensitivities
        Sensitivities of the same modes.
    noise : ndarray, shape (n, n_noise)
        Inferred error sds.
    by_slope : ndarray, shape (n, m, k, p)
        Derivatives of the function with respect to the slopes of a mode's k residuals, one error model after the
        other.
    """
    d, of_shapes = np.zeros(exact.gradient.shape), None if exact.shape_slopes is None else 0.0 * exact.shape_slopes
    found = np.zeros(d.shape)
    for term, by in zip(terms, split_by_term(terms, by_slope), strict=True):
        of_frequency, of_shape, direct = term.change_of_slopes(seen, noise, by)
        found += direct
        if of_frequency is not None:
            d += of_frequency
        if of_shapes is not None and of_shape is not None:
            of_shapes += of_shape
    if not np.any(d) and (of_shapes is None or not np.any(of_shapes)):  # the slopes do not matter
        return found
    return found + exact.curvature(d, of_shapes)


def by_parameters(
    function: Callable[[FloatArray], FloatArray],
    values: FloatArray,
    scale: FloatArray,
    bounds: FloatArray,
    test: IntArray,
) -> FloatArray:
    """Return the derivatives of m functions with respect to the parameters of their own tests, shape (n, m, p).

    They are central differences. Each parameter is perturbed in all tests at once, so that each of the n rows of
    `values` requires 2 p evaluations. Near a limit, both points are shifted to lie within it. The derivative is 0
    if the limits leave no room for a step.

    Parameters
    ----------
    function : callable
        Returns the m functions, (n, k, m), at k points for each row of `values`, (n, k, n_tests, p). It is called
        once, with k = 2 p.
    values : ndarray, shape (n, n_tests, p)
        The structural parameters in every test.
    scale : ndarray, shape (n, n_tests, p)
        Magnitudes of the parameters, which set the step sizes.
    bounds : ndarray, shape (2, n_tests, p)
        Limits of the values, beyond which a reduced model is not trained.
    test : ndarray of int, shape (m,)
        Index of each function's test.
    """
    p = values.shape[-1]
    low, high = np.minimum(values, bounds[0]), np.maximum(values, bounds[1])
    step = np.minimum(_STEP * scale, 0.5 * (high - low))
    step = np.min(step / scale, axis=1, keepdims=True) * scale  # the same part of the scale in all tests
    middle = np.maximum(np.minimum(values, high - step), low + step)
    points = np.repeat(values[:, None], 2 * p, axis=1)
    k = np.arange(p)
    for first, moved in ((0, middle + step), (p, middle - step)):
        points[:, first + k, :, k] = np.moveaxis(moved, 2, 0)
    found = function(points)
    change = np.moveaxis(found[:, :p] - found[:, p:], 1, 2)
    return np.asarray(change / np.where(step > 0.0, 2.0 * step, 1.0)[:, test])
