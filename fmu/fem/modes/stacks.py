"""Modes of many pairs of small matrices at once, with NumPy's batched LAPACK.

Every operation treats each matrix separately, elementwise or in one small LAPACK or BLAS call per matrix. Each
result is therefore bitwise independent of the rest of the stack.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from fmu.types import FloatArray

# Up to this size a stack of matrices is solved faster than each matrix alone (25 times at 4 DOF, twice at 30).
SMALL = 32
# Modes with λ above this multiple of the lowest λ are improved by a separate Ritz problem, because the error of
# the inverse problem is relative to the lowest mode.
WIDE = 1e4
# The trace of the inverse of a matrix of unit diagonal bounds its condition. Below this limit the matrix is
# definite by far more than rounding, and its explicit inverse is accurate.
_CLEAR = 1e8


def assemble(matrices: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the sums Σ_k weights[:, k] · matrices[k], shape (n, r, r)."""
    # einsum without `optimize` adds term by term, so that a result does not depend on the rest of the batch
    return np.einsum("nk,kij->nij", weights, matrices)


def lowest_modes(K: FloatArray, M: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the lowest modes of K φ = λ M φ for each matrix pair, with NaN for pairs that need another solver.

    The method is that of `fmu.fem.modes.eigensolver`, without its treatment of free structures. NaN is returned if
    K is singular, nearly singular or indefinite, if the highest of the `count` eigenvalues is more than `WIDE`
    times the lowest, or on overflow.

    Parameters
    ----------
    K, M : ndarray, shape (n, r, r)
        Symmetric, finite; M positive semidefinite, of rank `count` or more.
    count : int

    Returns
    -------
    eigenvalues : ndarray, shape (n, count), (rad/s)², ascending
    shapes : ndarray, shape (n, r, count), with φᵀ M φ = 1
    """
    with np.errstate(all="ignore"):
        lam, phi = row_by_row(partial(_lowest_modes, count=count), K, M)
    return lam, phi


def _lowest_modes(K: FloatArray, M: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    diagonal = np.abs(np.diagonal(K, axis1=1, axis2=2))
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    S = scale[:, :, None] * K * scale[:, None, :]
    top, unit = np.max(scale, axis=1)[:, None], np.max(np.abs(M), axis=(1, 2))[:, None]
    scale = scale / top
    M = scale[:, :, None] * (M / unit[..., None]) * scale[:, None, :]
    inverse = np.linalg.inv(np.linalg.cholesky(S))
    _, Y = np.linalg.eigh(inverse @ M @ inverse.mT)
    lam, X = rayleigh_quotients(S, M, inverse.mT @ Y[:, :, : -count - 1 : -1])
    order = np.argsort(lam, axis=1, kind="stable")
    lam, X = np.take_along_axis(lam, order, 1), np.take_along_axis(X, order[:, None], 2)
    clear = (np.sum(inverse**2, axis=(1, 2)) < _CLEAR) & (lam[:, -1] <= WIDE * lam[:, 0])
    lam, X = lam / top**2 / unit, scale[..., None] * X / np.sqrt(unit)[..., None]
    clear &= np.isfinite(lam).all(axis=1) & np.isfinite(X).all(axis=(1, 2))
    return np.where(clear[:, None], lam, np.nan), np.where(clear[:, None, None], X, np.nan)


def rayleigh_quotients(
    S: Any, M: Any, X: FloatArray, elastic: Callable[[FloatArray], FloatArray] = lambda x: x
) -> tuple[FloatArray, FloatArray]:
    """M-orthonormalise the columns x of X (..., n, m), and return their quotients xᵀ S x (..., m) and the new X.

    `elastic` first removes rigid-body motions. The relative error of a quotient is of the order of the square of
    its vector's error. Raise LinAlgError if the columns are linearly dependent.
    """
    for _ in range(2):  # Cholesky–QR in the inner product of M, twice against rounding
        X = elastic(X)
        X = X / np.sqrt(np.sum(X * (M @ X), axis=-2, keepdims=True))
        X = np.linalg.solve(np.linalg.cholesky(X.mT @ (M @ X)), X.mT).mT
    return np.sum(X * (S @ X), axis=-2), X


def nan_where_singular(solve: Callable[..., FloatArray], *matrices: FloatArray) -> FloatArray:
    """Return the result of a batched solver of matrices (…, P, q), with NaN for those that raise LinAlgError."""
    try:
        return solve(*matrices)
    except np.linalg.LinAlgError:
        batch = np.broadcast_shapes(*(m.shape[:-2] for m in matrices))
        rows = (np.broadcast_to(m, (*batch, *m.shape[-2:])).reshape(-1, *m.shape[-2:]) for m in matrices)
        (found,) = row_by_row(lambda *each: (solve(*each),), *rows)
        return found.reshape(*batch, *found.shape[1:])


def row_by_row(solve: Callable[..., Sequence[FloatArray]], *matrices: FloatArray) -> tuple[FloatArray, ...]:
    """Call a batched solver. If it raises LinAlgError, solve each matrix alone, with NaN for those that fail."""
    try:
        return tuple(solve(*matrices))
    except np.linalg.LinAlgError:
        rows: list[tuple[FloatArray, ...] | None] = []
        for i in range(len(matrices[0])):
            try:
                rows.append(tuple(solve(*(m[i : i + 1] for m in matrices))))
            except np.linalg.LinAlgError:
                rows.append(None)
        shapes = next((row for row in rows if row is not None), None)
        if shapes is None:
            shapes = tuple(solve(*(np.broadcast_to(np.eye(*m.shape[-2:]), (1, *m.shape[1:])) for m in matrices)))
        failed = tuple(np.full_like(part, np.nan) for part in shapes)
        return tuple(np.concatenate(parts) for parts in zip(*(row or failed for row in rows), strict=True))
