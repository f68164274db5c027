"""Covariance matrices for measured frequencies."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError
from fmu.numbers import significant
from fmu.types import FloatArray

_SYMMETRIC = 1e-9
"""Largest asymmetry allowed in the correlation matrix."""


def checked_covariance(covariance: ArrayLike, n: int, name: str = "covariance_hz2") -> FloatArray:
    """Check a covariance matrix and return it as a read-only array, symmetric to the last bit.

    Parameters
    ----------
    covariance : array_like, shape (n, n)
    n : int
        Number of modes.
    name : str
        Name of the matrix in error messages.

    Raises
    ------
    ValueError
        If the matrix does not have the shape (n, n), is not finite, is not symmetric (correlations may differ by
        1e-9), or is not positive definite (the lowest eigenvalue of the correlation matrix must be at least
        1e-12).
    """
    matrix = np.array(covariance, dtype=float)
    if matrix.shape != (n, n):
        raise ArgumentError(name, f"must have shape {(n, n)}, modes x modes", matrix.shape)
    if not np.all(np.isfinite(matrix)):
        raise ArgumentError(name, "must be finite", matrix.tolist())
    variance = np.diag(matrix)
    if not np.all(variance > 0):
        at = int(np.argmin(variance > 0))
        raise ArgumentError(f"{at}.{at}", "must be positive, a variance", f"{variance[at]} Hz²").under(name)
    sd = np.sqrt(variance)
    correlation = matrix / sd[:, None] / sd
    off = np.abs(correlation - correlation.T)
    if off.max() > _SYMMETRIC:
        i, j = map(int, np.unravel_index(np.argmax(off), off.shape))
        raise ArgumentError(name, "must be symmetric", f"{matrix[i, j]} at {i}.{j} and {matrix[j, i]} at {j}.{i}")
    lowest = float(np.linalg.eigvalsh(0.5 * (correlation + correlation.T))[0])
    if lowest < 1e-12:
        raise ArgumentError(
            name, "must be positive definite", f"a lowest eigenvalue of the correlations of {significant(lowest)}"
        )
    matrix = 0.5 * (matrix + matrix.T)
    matrix.flags.writeable = False
    return matrix


def mode_weights(weights: ArrayLike | None, n: int) -> FloatArray:
    """Return the weights of `n` modes, shape (n,); 1 for each mode if `weights` is None.

    Raise ValueError unless there are n weights, all positive and finite.
    """
    if weights is None:
        return np.ones(n)
    given = np.asarray(weights, dtype=float)
    if given.shape != (n,) or not np.all(np.isfinite(given) & (given > 0)):
        raise ArgumentError("weights", f"must be {n} positive numbers, one per mode", given.tolist())
    return given


def times(A: FloatArray, x: FloatArray, axis: int = -1) -> FloatArray:
    """Return the product A x along an axis of `x`, summed in the same order for all batch sizes, unlike BLAS."""
    total = np.zeros(x.shape)
    along = (slice(None),) * (axis % x.ndim)
    columns = A.T.reshape(len(A), -1, *(1,) * (x.ndim - 1 - axis % x.ndim))
    for j, column in enumerate(columns):
        total += column * x[*along, j : j + 1]
    return total
