"""Factorisation of symmetric matrices by four solvers with a common protocol.

LAPACK factorises dense matrices, and definite matrices with a narrow band, such as those of beams, bridges and
towers: it takes a tenth to a half of the time of a sparse solver. Other sparse matrices are factorised by PARDISO
of Intel's MKL if the extra ``fmu[fast]`` is installed (package pypardiso), else by SuperLU, which comes with
SciPy. PARDISO is meant for 10⁵ degrees of freedom and more. From `LARGE` rows on it factorises on as many threads
as `n_threads` says; the factors are the same, bit for bit, with any number of threads. Where they would take more
than a sixth of the machine's memory, they are made in single precision, and solutions are refined to double
precision (`fmu.fem.refinement`).

None of the solvers reorders rows to obtain large pivots. The matrices are positive definite or nearly so, and the
signs of the pivots are then the signs of the eigenvalues (Sylvester's law of inertia).
"""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable
from functools import cache, lru_cache, partial
from importlib.util import find_spec
from typing import Any, NamedTuple, Protocol

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
import scipy.sparse.linalg as ssl
from scipy.sparse.csgraph import reverse_cuthill_mckee

from fmu.engines.memory import free_memory, total_memory
from fmu.fem.refinement import RefinedFactor
from fmu.numbers import significant, whole
from fmu.types import FloatArray, IntArray

type Matrix = FloatArray | sp.sparray
"""A matrix, dense or sparse."""

LAPACK, SUPERLU, PARDISO = "LAPACK", "SuperLU", "PARDISO"
LARGE = 20_000
"""Degrees of freedom of a block from which on a factorisation is dear: factors are kept and used again."""
# From PARDISO's manual: types of matrices, phases of a solution, the smallest pivot as a negative power of ten,
# and the number of its domain.
_DEFINITE, _INDEFINITE = 2, -2
_ANALYSE, _ELIMINATE, _SOLVE, _RELEASE = 11, 22, 33, -1
_TINY, _OF_PARDISO = 20, 4
# PARDISO divides its work among at most this many threads, and into the same parts with fewer threads.
_MOST_THREADS = 8
# Share of the machine's memory that factors in double precision may take. A run takes four to five times as much:
# factors of two matrices, copies of the matrices, and vectors. The share does not depend on what is free, so that
# results do not.
_SHARE = 1.0 / 6.0
# Up to this half-width a band was faster than SuperLU to factorise and to solve, for 1000 to 5000 rows.
_NARROW = 256


class Factor(Protocol):
    """The factors of a symmetric matrix A.

    Attributes
    ----------
    negative : int
        Number of eigenvalues of A that are not positive.
    L : ndarray, shape (n, n), or None
        The lower factor of a dense definite matrix, A = L Lᵀ.
    is_single : bool
        Whether the factors are in single precision. Solutions are in double precision in any case.
    """

    negative: int
    L: FloatArray | None
    is_single: bool

    @property
    def n_entries(self) -> int:
        """Number of entries in the factors, L and its transpose."""
        ...

    @property
    def n_bytes(self) -> int:
        """Memory of the factors, by PARDISO's own count, and otherwise by the number of their entries."""
        ...

    def solve(self, loads: FloatArray) -> FloatArray:
        """Return A⁻¹ b for b of shape (n,) or (n, m)."""
        ...


def sparse_solver() -> str:
    """Return the name of the solver of sparse matrices: "PARDISO" if pypardiso is installed, else "SuperLU"."""
    return PARDISO if find_spec("pypardiso") else SUPERLU


def n_threads() -> int:
    """Return the number of threads on which PARDISO factorises, at most 8.

    It is the environment variable ``MKL_NUM_THREADS`` or, without it, ``OMP_NUM_THREADS``; fmu's engines and Dask
    set both to 1 in their workers. Without both it is the number of processors that this process may use.
    """
    given = os.environ.get("MKL_NUM_THREADS") or os.environ.get("OMP_NUM_THREADS") or ""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(max(int(given) if given.isdecimal() else usable, 1), _MOST_THREADS)


def factorise(matrix: Matrix, solver: str | None = None, is_definite: bool = True) -> Factor:
    """Return the factors of a symmetric matrix, dense or sparse.

    Parameters
    ----------
    matrix : ndarray or sparse array, shape (n, n)
    solver : {"SuperLU", "PARDISO"}, optional
        Solver for sparse matrices. By default LAPACK for a definite matrix with a narrow band, else
        `sparse_solver`.
    is_definite : bool
        Whether the matrix is expected to be positive definite; the factorisation takes longer if it is not.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is singular to the last digit; a nearly singular matrix may pass.
    """
    if not sp.issparse(matrix):
        return DenseFactor(matrix)
    if solver is None and is_definite:
        matrix = sp.csr_array(matrix)
        band = _band(matrix.indptr.tobytes(), matrix.indices.tobytes(), matrix.indices.dtype.str)
        if band is not None:
            try:
                return _BandedFactor(matrix, band)
            except np.linalg.LinAlgError:  # indefinite or singular: the other solvers tell which
                pass
    return _by_pardiso(matrix, is_definite) if (solver or sparse_solver()) == PARDISO else _SuperLU(matrix)


class ScaledFactor:
    """Factors of a matrix A from the factors of D A D, for a diagonal matrix D.

    Attributes
    ----------
    scaled : Factor
        The factors of D A D.
    scale : ndarray, shape (n,)
        The diagonal of D.
    """

    L: FloatArray | None = None

    def __init__(self, scaled: Factor, scale: FloatArray) -> None:
        self.scaled, self.scale = scaled, scale
        self.negative, self.n_entries, self.n_bytes = scaled.negative, scaled.n_entries, scaled.n_bytes
        self.is_single = scaled.is_single

    def solve(self, loads: FloatArray) -> FloatArray:
        """Return A⁻¹ b for b of shape (n,) or (n, m)."""
        scale = self.scale if loads.ndim == 1 else self.scale[:, None]
        return scale * self.scaled.solve(scale * loads)


class LastFactor:
    """The factors of a block's stiffness at the last theta for which they were made. A copy or pickle has none.

    Attributes
    ----------
    factor : ScaledFactor or None
        The factors, if there are any.
    """

    def __init__(self) -> None:
        self._at: bytes | None = None
        self.factor: ScaledFactor | None = None

    def __reduce__(self) -> tuple[type[LastFactor], tuple[()]]:
        """Return the call that makes an empty one: factors cannot be pickled."""
        return LastFactor, ()

    def at(self, theta: FloatArray, make: Callable[[], ScaledFactor | None]) -> ScaledFactor | None:
        """Return the factors at theta (n_parameters,), from `make` unless they are kept; None if it gives none."""
        if self._at != theta.tobytes():
            self._at = self.factor = None  # before the next factors take memory
            self.factor = make()
            self._at = theta.tobytes()
        return self.factor


class DenseFactor:
    """Factors of a dense matrix: Cholesky factors L Lᵀ, or L D Lᵀ if indefinite (Bunch & Kaufman 1977)."""

    is_single = False

    def __init__(self, matrix: FloatArray) -> None:
        self.negative, self.n_entries, self.n_bytes = 0, matrix.size, 8 * matrix.size
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
        """Return A⁻¹ b for b of shape (n,) or (n, m)."""
        if self.L is not None:
            return sl.lapack.dpotrs(self.L, loads, lower=1)[0]
        return sl.lapack.dsytrs(self._ldl, self._pivots, loads, lower=1)[0]


class _Band(NamedTuple):
    """Positions of the entries of a sparse matrix in its band.

    Attributes
    ----------
    order : ndarray of int, shape (n,)
        The rows in the order that makes the band narrow.
    half_width : int
        Number of diagonals on each side of the main diagonal.
    entries, at : ndarray of int, shape (n_lower,)
        Indices of the entries of the lower triangle in that order, and indices of these entries in the band, which
        is stored by columns.
    """

    order: IntArray
    half_width: int
    entries: IntArray
    at: IntArray


@lru_cache(maxsize=8)
def _band(indptr: bytes, indices: bytes, dtype: str) -> _Band | None:
    """Return the band of the matrices with one pattern of entries (CSR); None if the band is too wide.

    The rows are ordered by the reversed algorithm of Cuthill & McKee. A model's matrices have one pattern at every
    theta.
    """
    rows, columns = np.frombuffer(indptr, dtype), np.frombuffer(indices, dtype)
    n = len(rows) - 1
    pattern = sp.csr_matrix((np.ones(len(columns)), columns, rows), shape=(n, n))
    order = reverse_cuthill_mckee(pattern, symmetric_mode=True)
    place = np.empty(n, dtype=np.int64)
    place[order] = np.arange(n)
    i, j = place[np.repeat(np.arange(n), np.diff(rows))], place[columns]
    half_width = int(np.max(np.abs(i - j), initial=0))
    if half_width > _NARROW:
        return None
    entries = np.flatnonzero(i >= j)
    return _Band(order, half_width, entries, j[entries] * half_width + i[entries])


class _BandedFactor:
    """Cholesky factors of a definite matrix in its band; LinAlgError if the matrix is not definite."""

    negative = 0
    L: FloatArray | None = None
    is_single = False

    def __init__(self, matrix: sp.csr_array, band: _Band) -> None:
        self._order, n = band.order, matrix.shape[0]
        size = n * (band.half_width + 1)
        lower = np.bincount(band.at, matrix.data[band.entries], size).reshape(n, -1).T
        self._lower, failed = sl.lapack.dpbtrf(lower, lower=1, overwrite_ab=1)
        if failed:
            raise np.linalg.LinAlgError("the matrix is not positive definite")
        self.n_entries, self.n_bytes = 2 * size, 8 * size

    def solve(self, loads: FloatArray) -> FloatArray:
        found, solution = np.empty_like(loads), sl.lapack.dpbtrs(self._lower, loads[self._order], lower=1)[0]
        found[self._order] = solution
        return found


class _SuperLU:
    L: FloatArray | None = None
    is_single = False

    def __init__(self, matrix: sp.csr_array) -> None:
        options = {"SymmetricMode": True}
        try:
            self._lu = ssl.splu(
                sp.csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
            )
        except RuntimeError as error:
            raise np.linalg.LinAlgError(str(error)) from error
        self.negative = int(np.sum(~(self._lu.U.diagonal() > 0.0)))
        self.n_entries = int(self._lu.nnz)
        self.n_bytes = 12 * self.n_entries

    def solve(self, loads: FloatArray) -> FloatArray:
        return self._lu.solve(loads)


class _LargeFactorsError(Exception):
    """The error for factors that are to be made in single precision."""


def _by_pardiso(matrix: sp.csr_array, is_definite: bool) -> Factor:
    try:
        return _Pardiso(matrix, is_definite)
    except _LargeFactorsError:
        pass  # the exception would keep the analysis in memory
    return RefinedFactor(matrix, partial(_Pardiso, is_single=True), is_definite)


class _Pardiso:
    """Cholesky factors, or the factors L D Lᵀ of an indefinite matrix, with a diagonal D.

    LinAlgError if factors in single precision are not definite as expected.
    """

    L: FloatArray | None = None

    def __init__(self, matrix: sp.csr_array, is_definite: bool = True, is_single: bool = False) -> None:
        self._upper, self.negative, self.is_single = _upper_triangle(matrix), 0, is_single
        if is_single:
            self._upper = self._upper.astype(np.float32)
        if is_definite:
            try:
                self._factorise(_DEFINITE)
                return
            except np.linalg.LinAlgError:
                if is_single:
                    raise
        self._factorise(_INDEFINITE)
        self.negative = matrix.shape[0] - int(self._solver.get_iparm(22))
        if self._solver.get_iparm(14):
            raise np.linalg.LinAlgError("the matrix is singular")

    @property
    def n_entries(self) -> int:
        return 2 * int(self._solver.get_iparm(18))

    @property
    def n_bytes(self) -> int:
        return sum(1024 * int(self._solver.get_iparm(i)) for i in (16, 17))

    def solve(self, loads: FloatArray) -> FloatArray:
        return _call(self._solver, self._upper, _SOLVE, loads)

    def _factorise(self, of: int) -> None:
        self._solver = _pardiso()(mtype=of)
        weakref.finalize(self, _call, self._solver, self._upper, _RELEASE).atexit = False
        # METIS, and unmodified pivots: PARDISO's own settings would change pivots below 1e-8 of the largest entry
        for i, value in {1: 1, 2: 2, 10: _TINY, 18: -1, 28: self.is_single, 34: _MOST_THREADS}.items():
            self._solver.iparm[i - 1] = value
        _call(self._solver, self._upper, _ANALYSE)
        of_analysis, lasting, of_factors = (1024 * int(self._solver.get_iparm(i)) for i in (15, 16, 17))
        if not self.is_single and lasting + of_factors > _SHARE * total_memory():
            raise _LargeFactorsError
        _require_memory(max(of_analysis, lasting + of_factors), self._upper.shape[0])
        _call(self._solver, self._upper, _ELIMINATE)


def _require_memory(needed: int, n_dof: int) -> None:
    """Raise MemoryError if factors of `n_dof` rows need more bytes than are free."""
    free = free_memory()
    if free is not None and needed > free:
        raise MemoryError(
            f"the factors of {whole(n_dof)} degrees of freedom need {significant(needed / 2**30, 3)} GiB, "
            f"and {significant(free / 2**30, 3)} GiB of memory are free; coarsen or condense the model"
        )


def _call(solver: Any, upper: sp.csr_array, phase: int, loads: FloatArray | None = None) -> FloatArray:
    from pypardiso.pardiso_wrapper import PyPardisoError

    n = upper.shape[0]
    # the solution of several right-hand sides on several threads would depend on their number
    solver.libmkl.MKL_Domain_Set_Num_Threads(n_threads() if phase == _ELIMINATE and n >= LARGE else 1, _OF_PARDISO)
    solver.set_phase(phase)
    try:
        loads = np.zeros(n) if loads is None else loads
        return solver._call_pardiso(upper, np.asfortranarray(loads, dtype=upper.dtype)).astype(float, copy=False)
    except PyPardisoError as error:
        raise np.linalg.LinAlgError(f"PARDISO ended with error {error.value}") from error


def _upper_triangle(matrix: sp.csr_array) -> sp.csr_array:
    """Return the upper triangle with every diagonal entry stored, even if it is zero."""
    entries = sp.triu(matrix, format="coo")
    n = matrix.shape[0]
    rows, columns = (np.concatenate([of, np.arange(n)]) for of in entries.coords)
    upper = sp.csr_array((np.concatenate([entries.data, np.zeros(n)]), (rows, columns)), shape=matrix.shape)
    upper.sum_duplicates()
    return upper


@cache
def _pardiso() -> Any:
    from pypardiso import PyPardisoSolver

    # each new solver would look for the library in all directories, which takes a second
    os.environ.setdefault("PYPARDISO_MKL_RT", PyPardisoSolver().libmkl._name)
    return PyPardisoSolver
