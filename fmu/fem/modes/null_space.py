"""What is singular or negative in a symmetric matrix: its lowest eigenvalues at a unit diagonal.

Scaled so, metres and radians, stiff and soft parts count alike, and what rounding leaves of a zero is of the order
of 1e-16 whatever the units and the mesh.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
import scipy.sparse.linalg as ssl

from fmu.types import FloatArray

# Up to this size LAPACK on the dense matrices beats a sparse factorisation and its Lanczos iterations.
DENSE_LIMIT = 400
# Of a matrix scaled to a unit diagonal: a smaller eigenvalue cannot be told from zero. Rounding in assembled beams
# stays below 1e-15; a cantilever of 1000 elements has 5e-13.
ZERO = 2e-14
# Of the same: further below zero is no rounding, not even of matrices exported with ten digits.
NEGATIVE = 1e-8
_AT_ONCE = 12


class SingularMassError(ValueError):
    """The eigenproblem has no solution: of the mass or stiffness matrix, or of the solver."""


def symmetric_factor(matrix: Any) -> Any:
    """Return the sparse LU factors of a symmetric matrix without pivoting: the diagonal of U has its inertia."""
    return ssl.splu(
        sp.csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


def unit_diagonal(matrix: Any) -> tuple[Any, FloatArray]:
    """Return S = D A D with a diagonal of ones (or zeros), and the diagonal of D, for a dense or sparse A."""
    diagonal = np.abs(matrix.diagonal())
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    return scaled(matrix, scale), scale


def scaled(matrix: Any, scale: FloatArray) -> Any:
    """Return D A D for the diagonal of D."""
    if not sp.issparse(matrix):
        return scale[:, None] * matrix * scale
    matrix = sp.csr_array(matrix, copy=True)
    matrix.data *= scale[np.repeat(np.arange(len(scale)), np.diff(matrix.indptr))] * scale[matrix.indices]
    return matrix


def lowest(S: Any) -> tuple[FloatArray, FloatArray]:
    """Return the eigenvalues near and below zero of a matrix from `unit_diagonal`, and at least one more.

    Returns
    -------
    eigenvalues : ndarray, shape (m,)
        Of a large matrix with eigenvalues below −`NEGATIVE`, only one of those.
    vectors : ndarray, shape (n, m), orthonormal
    """
    n = S.shape[0]
    if n <= DENSE_LIMIT:
        S, count = S.toarray() if sp.issparse(S) else S, min(_AT_ONCE, n)
        lam, vectors = sl.eigh(S, subset_by_index=[0, count - 1], check_finite=False)
        while lam[-1] < ZERO and count < n:
            count = min(2 * count, n)
            lam, vectors = sl.eigh(S, subset_by_index=[0, count - 1], check_finite=False)
        return lam, vectors
    unit, shift = sp.csr_array(sp.eye_array(n)), NEGATIVE
    # pivots tell the signs (Sylvester); Lanczos would not see what lies far below zero
    while np.any((factor := symmetric_factor(S + shift * unit)).U.diagonal() <= 0.0):
        shift *= 10.0
    if shift > NEGATIVE:
        return _nearest(S, factor, -shift, 1)
    count = _AT_ONCE
    lam, vectors = _nearest(S, factor, -shift, count)
    while lam[-1] < ZERO and count < n - 1:
        count = min(2 * count, n - 1)
        lam, vectors = _nearest(S, factor, -shift, count)
    return lam, vectors


def rank(matrix: Any) -> int:
    """Return the rank of a positive semidefinite matrix.

    Raises
    ------
    SingularMassError
        If it is negative for some vector.
    """
    if matrix.shape[0] <= DENSE_LIMIT and sp.issparse(matrix):
        matrix = matrix.toarray()
    diagonal = matrix.diagonal()
    with_mass = np.flatnonzero(diagonal > 0.0)
    S = unit_diagonal(matrix)[0]
    others = np.flatnonzero(diagonal <= 0.0)
    if len(others) and abs(S[others]).max() > 0.0:
        raise SingularMassError("the mass matrix is not positive semidefinite")
    part = S[with_mass][:, with_mass] if len(others) else S
    if len(with_mass) == 0 or _is_definite(part):
        return len(with_mass)
    lam, _ = lowest(part)
    if lam[0] <= -NEGATIVE:
        raise SingularMassError("the mass matrix is not positive semidefinite")
    return len(with_mass) - int(np.sum(lam < ZERO))


def _is_definite(S: Any) -> bool:
    """Say whether no eigenvalue of a matrix of unit diagonal can be zero."""
    try:
        pivots = symmetric_factor(S).U.diagonal() if sp.issparse(S) else np.diag(np.linalg.cholesky(S)) ** 2
    except (np.linalg.LinAlgError, RuntimeError):
        return False
    # consistent masses have pivots of at least 1e-3; where one is smaller, its eigenvalues decide
    return bool(np.min(pivots) > 1e-6)


def _nearest(S: Any, factor: Any, sigma: float, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the eigenvalues of S nearest to `sigma`, given the factors of S − sigma."""
    n = S.shape[0]
    inverse = ssl.LinearOperator((n, n), matvec=factor.solve, dtype=float)
    start = np.random.default_rng(0).standard_normal(n)
    lam, vectors = ssl.eigsh(S, count, sigma=sigma, OPinv=inverse, v0=start, tol=1e-12)
    order = np.argsort(lam)
    return lam[order], vectors[:, order]
