"""Solver for the lowest modes of K φ = λ M φ, as accurate as K and M allow.

A dense solver that transforms M to the unit matrix has an error of 1e-16 λ_max in every λ. Stiff joints and fine
meshes can make λ_max 1e16 times as large as λ_1, and λ_1 is then lost completely. Here K is transformed to the
unit matrix instead, and the largest μ = 1/λ of M φ = μ K φ are computed. The error of each μ is then 1e-16 μ_1,
where μ_1 belongs to the lowest mode. M may be singular: degrees of freedom without mass have μ = 0 and follow the
other degrees of freedom statically.

A free structure has a singular K. Its strain-free motions N, with K N = 0, are computed from K alone, as
eigenvectors of K scaled to a unit diagonal. These motions have λ = 0 exactly. A low eigenvalue alone does not
distinguish a rigid-body motion from the motion of a soft part. The strain energy of a rigid-body motion must also
be mere rounding compared with the terms that cancel in it. The elastic modes are M-orthogonal to the rigid-body
modes. Let Nᵀ M N = I and P = I − N Nᵀ M. Fix just enough degrees of freedom to prevent the strain-free motions,
as statically determinate supports do, and let f be the remaining ones. With φ = P [y; 0],

    K_ff y = λ (Pᵀ M P)_ff y,

where K_ff is positive definite (Farhat & Géradin 1998, *Int. J. Numer. Meth. Eng.* 43, 675–696, on generalised
inverses of free structures under self-equilibrated loads).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
import scipy.sparse.linalg as ssl

from fmu.fem.modes.solver import LARGE, Factor, Matrix, ScaledFactor, factorise, scale_matrix, unit_diagonal
from fmu.fem.modes.stacks import WIDE, rayleigh_quotients
from fmu.types import BoolArray, FloatArray

# Up to this size LAPACK on dense matrices is faster than a sparse factorisation with Lanczos iterations.
DENSE_LIMIT = 400
# A smaller eigenvalue of a matrix scaled to a unit diagonal cannot be distinguished from zero. Rounding in
# assembled beams stays below 1e-15; the lowest eigenvalue of a cantilever of 1000 elements is 5e-13.
ZERO = 2e-14
# An eigenvalue of a matrix scaled to a unit diagonal that is further below zero than this is not rounding, even if
# the matrix was exported with ten digits.
NEGATIVE = 1e-8
_AT_ONCE = 12
# Largest energy of a motion without strain, in units of the rounding error of the terms that cancel in it. Values
# up to 1.1 were observed in frames, shells and solids.
_STRAINED = 10.0
# An estimate of the lowest eigenvalue must exceed `ZERO` by this factor to rule out a zero eigenvalue.
_CAUTION = 10.0


class SingularMassError(ValueError):
    """Raised when an eigenproblem cannot be solved, or a mass matrix is not positive semidefinite."""


def clear_factor(S: Matrix, scale: FloatArray) -> ScaledFactor | None:
    """Return the factors of A from S = D A D, or None unless A is clearly positive definite.

    S and `scale`, the diagonal of D, come from `unit_diagonal`. Explicit zeros in a large matrix are removed
    first. Its factors are stored and reused, so they must not depend on the order in which the matrix was summed.
    """
    if sp.issparse(S) and S.shape[0] >= LARGE:
        S = sp.csr_array(S, copy=True)
        S.eliminate_zeros()
        S.sort_indices()
    try:
        factor = _definite(S)
    except np.linalg.LinAlgError:
        return None
    return ScaledFactor(factor, scale) if is_clearly_definite(factor, np.ones(S.shape[0])) else None


def eigen(
    K: Matrix,
    M: Matrix,
    count: int,
    finite: int | None = None,
    factored: Callable[[Matrix, FloatArray], ScaledFactor | None] = clear_factor,
) -> tuple[FloatArray, FloatArray]:
    """Return the lowest modes of K φ = λ M φ.

    Parameters
    ----------
    K, M : ndarray or sparse arrays, shape (n_dof, n_dof)
        Symmetric; M positive semidefinite: degrees of freedom may have no mass. K may be singular (a free
        structure): its rigid-body modes and mechanisms have λ = 0 exactly.
    count : int
        Number of modes.
    finite : int, optional
        Number of modes with a finite frequency (the rank of M), if known; otherwise M is factorised to obtain it.
    factored : callable
        Returns the same as `clear_factor`, perhaps from stored factors.

    Returns
    -------
    eigenvalues : ndarray, shape (count,), (rad/s)², ascending; negative if K is negative for some motion
    shapes : ndarray, shape (n_dof, count), with φᵀ M φ = 1

    Raises
    ------
    ValueError
        If `count` is less than 1 or exceeds the number of degrees of freedom.
    SingularMassError
        If fewer than `count` modes have a finite frequency, M is negative for some motion, a motion has neither
        stiffness nor mass, the solver fails, or the modes overflow.
    MemoryError
        If the factors of a large matrix do not fit in memory.
    """
    n = K.shape[0]
    if not 1 <= count <= n:
        raise ValueError(f"count: must lie in 1..{n}, the degrees of freedom (got {count})")
    try:
        if finite is None:
            finite = rank(M)
        if count > finite:
            raise SingularMassError(f"M gives {finite} modes of finite frequency, {count} are needed")
        if n <= DENSE_LIMIT or count >= n - 1:
            K, M = _dense(K), _dense(M)
        S, scale = unit_diagonal(K)
        unit, top = abs(M).max(), np.max(scale)
        with np.errstate(all="ignore"):
            lam, y = _of_scaled(S, scale_matrix(M / unit, scale / top), count, factored(S, scale))
            lam, y = lam / top**2 / unit, (scale / top)[:, None] * y / np.sqrt(unit)
    except (np.linalg.LinAlgError, RuntimeError) as error:
        raise SingularMassError(f"eigenproblem of {n} DOF: {error}") from error
    if not (np.all(np.isfinite(lam)) and np.all(np.isfinite(y))):
        raise SingularMassError(f"eigenproblem of {n} DOF: the eigenvalues overflow")
    return lam, y


def _of_scaled(S: Matrix, M: Matrix, count: int, clear: ScaledFactor | None) -> tuple[FloatArray, FloatArray]:
    """Return the lowest eigenvalues (count,) and shapes (n, count) of S φ = λ M φ, where S has a unit diagonal.

    `clear` contains factors of S if S is clearly definite; otherwise it is None.
    """
    if clear is not None:
        factor = clear.scaled
    else:  # free, nearly free, or negative for some motion: the lowest eigenvalues show which
        nu, vectors = lowest(S)
        if nu[0] <= -NEGATIVE:
            return _polish(S, M, _highest(_factorise_shifted(S, M), M, count))
        rigid = (nu < ZERO) & ~_is_strained(S, vectors)
        if rigid.any():
            return _of_free(S, M, _mass_normalised(M, vectors[:, rigid]), count)
        factor = _definite(S)
    return _polish(S, M, _highest(factor, M, count))


def _is_strained(S: Matrix, X: FloatArray) -> BoolArray:
    """Return a mask (m,) of the motions in X (n, m) that strain the structure: their energy exceeds rounding."""
    sizes = np.sum(np.abs(X) * (abs(S) @ np.abs(X)), axis=0)
    return np.asarray(np.sum(X * (S @ X), axis=0) > _STRAINED * 0.5 * np.finfo(float).eps * sizes)


def _of_free(S: Matrix, M: Matrix, N: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the lowest modes of a free structure. The strain-free motions N (n, r), NᵀMN = I, come first."""
    n, r = N.shape
    if count <= r:
        return np.zeros(count), N[:, :count]
    # pivoted QR picks the r degrees of freedom that determine the rigid-body motion best; f are all others
    free = np.sort(sl.qr(N.T, mode="r", pivoting=True)[1][r:])
    MN = M @ N

    def elastic(x: FloatArray) -> FloatArray:
        return x - N @ (MN.T @ x)

    factor = _definite(S[free][:, free])
    X = np.zeros((n, count - r))
    if not sp.issparse(M):
        rest = M - MN @ MN.T  # Pᵀ M P, since Nᵀ M N = 1
        X[free] = _highest(factor, rest[np.ix_(free, free)], count - r)
    else:

        def solve(load: FloatArray) -> FloatArray:
            x = np.zeros(n)
            x[free] = factor.solve((load - MN @ (N.T @ load))[free])
            return elastic(x)

        X = _highest_sparse(solve, M, count - r)
    lam, X = _polish(S, M, X, elastic)
    return np.concatenate([np.zeros(r), lam]), np.concatenate([N, X], axis=1)


def _definite(matrix: Matrix) -> Factor:
    """Factorise a positive definite matrix. Raise LinAlgError if it is not definite."""
    factor = factorise(matrix)
    if factor.negative:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return factor


def is_clearly_definite(factor: Factor, scale: FloatArray) -> bool:
    """Return True if a positive definite matrix A has no eigenvalue near zero when scaled to a unit diagonal.

    `factor` factorises A, and `scale` is the diagonal of D for which D A D has a unit diagonal. It is not checked
    that A is definite.
    """
    # four steps of inverse iteration: the estimate is never below the lowest eigenvalue
    x = _start(len(scale))
    for _ in range(4):
        x = factor.solve(x / np.linalg.norm(x) / scale) / scale
    return bool(np.linalg.norm(x) * _CAUTION * ZERO < 1.0)


@lru_cache
def _start(n: int) -> FloatArray:
    return np.random.default_rng(0).standard_normal(n)


def _factorise_shifted(S: Matrix, M: Matrix) -> Factor:
    """Factorise S + s M with a shift s that makes it definite. Raise SingularMassError if 24 shifts fail."""
    start = 1e-6 * np.abs(S.diagonal()).sum() / M.diagonal().sum()
    for power in range(24):
        try:
            return _definite(S + start * 10.0**power * M)
        except np.linalg.LinAlgError:
            continue
    raise SingularMassError("K is not positive definite for the motions without mass")


def _mass_normalised(M: Matrix, N: FloatArray) -> FloatArray:
    """Return an M-orthonormal basis of the motions N (n, r). Raise SingularMassError if a motion has no mass."""
    G = N.T @ (M @ N)
    if np.linalg.eigvalsh(G)[0] <= ZERO * np.trace(G):
        raise SingularMassError("a motion without strain moves no mass")
    return np.asarray(np.linalg.solve(np.linalg.cholesky(G), N.T).T)


def _highest(factor: Factor, M: Matrix, count: int) -> FloatArray:
    """Return the eigenvectors (n, count) of M x = μ A x for the highest μ, in descending order of μ."""
    if factor.L is None:
        return _highest_sparse(factor.solve, M, count)
    # the standard problem of L⁻¹ M L⁻ᵀ, with A = L Lᵀ
    C, failed = sl.lapack.dsygst(M, factor.L, itype=1, lower=1)
    if failed:
        raise np.linalg.LinAlgError(f"dsygst returned {failed}")
    n = len(C)
    _, Y = sl.eigh(C, lower=True, subset_by_index=[n - count, n - 1], driver="evr", check_finite=False)
    if Y.shape[1] < count:  # LAPACK returns fewer vectors on overflow, without an error
        raise np.linalg.LinAlgError(f"{Y.shape[1]} of {count} eigenvalues found")
    X, _ = sl.lapack.dtrtrs(factor.L, Y, lower=1, trans=1)
    return np.asarray(X[:, ::-1])


def _highest_sparse(solve: Callable[[FloatArray], FloatArray], M: Matrix, count: int) -> FloatArray:
    """Return the same eigenvectors as `_highest`, where ``solve(b)`` returns A⁻¹ b.

    They come from Lanczos iterations with A⁻¹ M or, if few degrees of freedom have mass, from a dense matrix. The
    starting vector is fixed, so that results are reproducible.
    """
    n = M.shape[0]
    with_mass = np.flatnonzero(M.diagonal() > 0.0)
    if len(with_mass) <= DENSE_LIMIT:
        # Lanczos could run out of vectors: with M = V E Vᵀ solve the dense problem of √E Vᵀ A⁻¹ V √E
        energy, V = np.linalg.eigh(_dense(M[with_mass][:, with_mass]))
        loads = np.zeros((n, len(with_mass)))
        loads[with_mass] = V * np.sqrt(np.maximum(energy, 0.0))
        moved = np.stack([solve(load) for load in loads.T], axis=1)
        C = loads.T @ moved
        return np.asarray(moved @ np.linalg.eigh(0.5 * (C + C.T))[1][:, : -count - 1 : -1])
    inverse = ssl.LinearOperator((n, n), matvec=solve, dtype=float)
    start = solve(M @ np.random.default_rng(0).standard_normal(n))
    mu, X = ssl.eigsh(M, count, M, sigma=0.0, OPinv=inverse, v0=start, tol=1e-12)
    # where M is singular, Lanczos vectors may contain motions without mass: one more iteration removes them
    return np.stack([solve(M @ X[:, k]) for k in np.argsort(mu)], axis=1)


def _polish(
    S: Matrix, M: Matrix, X: FloatArray, elastic: Callable[[FloatArray], FloatArray] = lambda x: x
) -> tuple[FloatArray, FloatArray]:
    """Return eigenvalues (m,), ascending, and mass-normalised vectors (n, m), improved in the span of X's columns.

    The columns of X (n, m) are ordered from the lowest mode. The eigenvalues are Rayleigh quotients. Modes with λ
    above `WIDE` times the lowest are inaccurate, and are replaced by Ritz vectors of their span. Raise LinAlgError
    on overflow.
    """
    lam, X = rayleigh_quotients(S, M, X, elastic)
    if not np.all(np.isfinite(lam)):
        raise np.linalg.LinAlgError("the eigenvalues overflow")
    first = 0
    while (wide := first + int(np.sum(np.abs(lam[first:]) <= WIDE * np.abs(lam[first])))) < len(lam):
        Y = X[:, wide:]
        A = Y.T @ (S @ Y)
        lam[wide:], U = np.linalg.eigh(0.5 * (A + A.T))
        X[:, wide:] = Y @ U
        first = wide
    order = np.argsort(lam, kind="stable")
    return lam[order], X[:, order]


def _dense(matrix: Any) -> FloatArray:
    return matrix.toarray() if sp.issparse(matrix) else np.asarray(matrix)


# The lowest eigenvalues of a symmetric matrix scaled to a unit diagonal show whether it is singular or indefinite.
# With this scaling, metres and radians, and stiff and soft parts, count equally. An eigenvalue that should be zero
# is then of the order of 1e-16, whatever the units and the mesh.


def lowest(S: Matrix) -> tuple[FloatArray, FloatArray]:
    """Return all near-zero and negative eigenvalues of a matrix with unit diagonal, and usually a few larger ones.

    Returns
    -------
    eigenvalues : ndarray, shape (m,), ascending
        If a matrix of more than `DENSE_LIMIT` rows has eigenvalues below −`NEGATIVE`, only the lowest is given.
    vectors : ndarray, shape (n, m), orthonormal
    """
    n = S.shape[0]
    if n <= DENSE_LIMIT:
        S = _dense(S)
        return _all_below_zero(lambda count: sl.eigh(S, subset_by_index=[0, count - 1], check_finite=False), n)
    unit, shift = sp.csr_array(sp.eye_array(n)), NEGATIVE
    # the pivots show whether an eigenvalue lies below the shift (Sylvester); Lanczos might miss one far below zero
    while (factor := factorise(S + shift * unit)).negative:
        shift *= 10.0
    if shift > NEGATIVE:
        return _nearest(S, factor, -shift, 1)
    return _all_below_zero(lambda count: _nearest(S, factor, -shift, count), n - 1)


def _all_below_zero(
    solve: Callable[[int], tuple[FloatArray, FloatArray]], most: int
) -> tuple[FloatArray, FloatArray]:
    """Return the lowest eigenpairs: all that are below `ZERO`, and at least one more, but at most `most`.

    ``solve(count)`` returns the lowest `count` pairs.
    """
    count = min(_AT_ONCE, most)
    lam, vectors = solve(count)
    while lam[-1] < ZERO and count < most:
        count = min(2 * count, most)
        lam, vectors = solve(count)
    return lam, vectors


def rank(matrix: Matrix) -> int:
    """Return the rank of a positive semidefinite matrix. Raise SingularMassError if it is not semidefinite.

    The zero eigenvalues of a large sparse matrix are counted by inertia (Sylvester's law). There may be hundreds,
    as in solids with reduced integration, and a search for all of them would take too long. With the diagonal
    scaled to one, eigenvalues within ±`NEGATIVE` then count as zero, because a matrix exported with few digits has
    zero eigenvalues only to that accuracy. In a small matrix, eigenvalues below `ZERO` count as zero.
    """
    matrix = _dense(matrix) if matrix.shape[0] <= DENSE_LIMIT else matrix
    diagonal = matrix.diagonal()
    with_mass = np.flatnonzero(diagonal > 0.0)
    S = unit_diagonal(matrix)[0]
    others = np.flatnonzero(diagonal <= 0.0)
    if len(others) and abs(S[others]).max() > 0.0:
        raise SingularMassError("the mass matrix is not positive semidefinite")
    part = S[with_mass][:, with_mass] if len(others) else S
    if len(with_mass) == 0 or _is_definite(part):
        return len(with_mass)
    if len(with_mass) > DENSE_LIMIT:
        part = sp.csr_array(part)
        if not is_semidefinite(part):
            raise SingularMassError("the mass matrix is not positive semidefinite")
        unit = sp.eye_array(part.shape[0])
        return len(with_mass) - factorise(part - NEGATIVE * unit, is_definite=False).negative
    if (lam := lowest(part)[0])[0] <= -NEGATIVE:
        raise SingularMassError("the mass matrix is not positive semidefinite")
    return len(with_mass) - int(np.sum(lam < ZERO))


def is_semidefinite(matrix: sp.csr_array) -> bool:
    """Return True if a sparse symmetric matrix, scaled to a unit diagonal, has no eigenvalue below −`NEGATIVE`."""
    rows = np.flatnonzero(np.diff(matrix.indptr))
    if not len(rows):
        return True
    S, _ = unit_diagonal(matrix[rows][:, rows])
    if len(rows) <= DENSE_LIMIT:
        return bool(np.linalg.eigvalsh(_dense(S))[0] > -NEGATIVE)
    try:
        return factorise(S + NEGATIVE * sp.eye_array(len(rows))).negative == 0
    except np.linalg.LinAlgError:
        return False


def _is_definite(S: Matrix) -> bool:
    """Return True if all eigenvalues of a matrix with unit diagonal exceed 1e-6."""
    unit = sp.eye_array(S.shape[0]) if sp.issparse(S) else np.eye(S.shape[0])
    try:
        # consistent mass matrices have eigenvalues of at least 1e-3; otherwise the lowest ones are computed
        return factorise(S - 1e-6 * unit).negative == 0
    except np.linalg.LinAlgError:
        return False


def _nearest(S: Matrix, factor: Factor, sigma: float, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the `count` eigenpairs of S nearest to `sigma`, ascending. `factor` factorises S − sigma I."""
    n = S.shape[0]
    inverse = ssl.LinearOperator((n, n), matvec=factor.solve, dtype=float)
    start = np.random.default_rng(0).standard_normal(n)
    lam, vectors = ssl.eigsh(S, count, sigma=sigma, OPinv=inverse, v0=start, tol=1e-12)
    order = np.argsort(lam)
    return lam[order], vectors[:, order]
