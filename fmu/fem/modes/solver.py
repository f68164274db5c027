"""Factors of symmetric matrices: one small protocol, three solvers.

LAPACK for dense matrices. For sparse ones PARDISO of Intel's MKL where the extra ``fmu[fast]`` is installed
(package pypardiso), else SuperLU, which comes with SciPy. PARDISO is meant for 10⁵ degrees of freedom and more; it
uses one thread, or as many as the environment variable ``MKL_NUM_THREADS`` says.

None of them changes the order of rows for the sake of large pivots. The matrices are positive definite or nearly
so, and the signs of the pivots then are those of the eigenvalues (Sylvester's law of inertia).
"""

from __future__ import annotations

import os
import weakref
from functools import cache
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
import scipy.sparse.linalg as ssl

from fmu.types import FloatArray

LAPACK, SUPERLU, PARDISO = "LAPACK", "SuperLU", "PARDISO"
# From PARDISO's manual: types of matrices, phases of a solution, the smallest pivot as a negative power of ten,
# and the number of its domain.
_DEFINITE, _INDEFINITE = 2, -2
_FACTORISE, _SOLVE, _RELEASE = 12, 33, -1
_TINY, _OF_PARDISO = 20, 4


class Factor(Protocol):
    """The factors of a symmetric matrix A.

    Attributes
    ----------
    negative : int
        How many eigenvalues of A are not positive.
    """

    negative: int

    @property
    def n_entries(self) -> int:
        """Numbers in the factors, of L and its transpose."""
        ...

    def solve(self, loads: FloatArray) -> FloatArray:
        """Return A⁻¹ b for b of shape (n,) or (n, m)."""
        ...


def sparse_solver() -> str:
    """Return the name of the solver of sparse matrices: "PARDISO" if pypardiso is installed, else "SuperLU"."""
    return PARDISO if find_spec("pypardiso") else SUPERLU


def factorised(matrix: Any, solver: str | None = None, is_definite: bool = True) -> Factor:
    """Return the factors of a symmetric matrix, dense or sparse.

    Parameters
    ----------
    matrix : ndarray or sparse array, shape (n, n)
    solver : {"SuperLU", "PARDISO"}, optional
        For sparse matrices; `sparse_solver` if not given.
    is_definite : bool
        Whether a positive definite matrix is expected: another one then takes longer.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is singular to the last digit; one that is nearly so may pass.
    """
    if not sp.issparse(matrix):
        return DenseFactor(matrix)
    return _Pardiso(matrix, is_definite) if (solver or sparse_solver()) == PARDISO else _SuperLU(matrix)


class DenseFactor:
    """Cholesky factors L Lᵀ, or those of an indefinite matrix, L D Lᵀ (Bunch & Kaufman 1977)."""

    def __init__(self, matrix: FloatArray) -> None:
        self.negative, self.n_entries = 0, matrix.size
        self.L: FloatArray | None = None
        try:
            self.L = np.linalg.cholesky(matrix)
        except np.linalg.LinAlgError:
            if not np.all(np.isfinite(matrix)):
                raise
            self._ldl, self._pivots, failed = sl.lapack.dsytrf(matrix, lower=1)
            if failed:
                raise np.linalg.LinAlgError("the matrix is singular") from None
            self.negative = int(np.sum(np.linalg.eigvalsh(matrix) <= 0.0))

    def solve(self, loads: FloatArray) -> FloatArray:
        """Return A⁻¹ b."""
        if self.L is not None:
            return sl.lapack.dpotrs(self.L, loads, lower=1)[0]
        return sl.lapack.dsytrs(self._ldl, self._pivots, loads, lower=1)[0]


class _SuperLU:
    def __init__(self, matrix: Any) -> None:
        options = {"SymmetricMode": True}
        try:
            self._lu = ssl.splu(
                sp.csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
            )
        except RuntimeError as error:
            raise np.linalg.LinAlgError(str(error)) from error
        self.negative = int(np.sum(~(self._lu.U.diagonal() > 0.0)))
        self.n_entries = int(self._lu.nnz)

    def solve(self, loads: FloatArray) -> FloatArray:
        return self._lu.solve(loads)


class _Pardiso:
    """Cholesky factors, or those of an indefinite matrix, L D Lᵀ with a diagonal D."""

    def __init__(self, matrix: Any, is_definite: bool = True) -> None:
        self._upper, self.negative = _upper_triangle(matrix), 0
        if is_definite:
            try:
                self._factorise(_DEFINITE)
                return
            except np.linalg.LinAlgError:
                pass
        self._factorise(_INDEFINITE)
        self.negative = matrix.shape[0] - int(self._solver.get_iparm(22))
        if self._solver.get_iparm(14):
            raise np.linalg.LinAlgError("the matrix is singular")

    @property
    def n_entries(self) -> int:
        return 2 * int(self._solver.get_iparm(18))

    def solve(self, loads: FloatArray) -> FloatArray:
        return _call(self._solver, self._upper, _SOLVE, loads)

    def _factorise(self, of: int) -> None:
        self._solver = _pardiso()(mtype=of)
        weakref.finalize(self, _call, self._solver, self._upper, _RELEASE).atexit = False
        # METIS, and pivots as they come: PARDISO's own settings would change those below 1e-8 of the largest entry
        for i, value in {1: 1, 2: 2, 10: _TINY}.items():
            self._solver.iparm[i - 1] = value
        _call(self._solver, self._upper, _FACTORISE)


def _call(solver: Any, upper: Any, phase: int, loads: FloatArray | None = None) -> FloatArray:
    from pypardiso.pardiso_wrapper import PyPardisoError

    solver.set_phase(phase)
    try:
        return solver._call_pardiso(upper, np.zeros(upper.shape[0]) if loads is None else np.asfortranarray(loads))
    except PyPardisoError as error:
        raise np.linalg.LinAlgError(f"PARDISO ended with error {error.value}") from error


def _upper_triangle(matrix: Any) -> Any:
    """Return the upper triangle with every entry of the diagonal, zeros too."""
    entries = sp.triu(matrix, format="coo")
    n = matrix.shape[0]
    rows, columns = (np.concatenate([of, np.arange(n)]) for of in entries.coords)
    upper = sp.csr_array((np.concatenate([entries.data, np.zeros(n)]), (rows, columns)), shape=matrix.shape)
    upper.sum_duplicates()
    return upper


@cache
def _pardiso() -> Any:
    from pypardiso import PyPardisoSolver

    threads = int(os.environ.get("MKL_NUM_THREADS") or 1)
    PyPardisoSolver().libmkl.MKL_Domain_Set_Num_Threads(threads, _OF_PARDISO)
    return PyPardisoSolver
