"""Factorisation of sparse symmetric matrices by PARDISO from Intel's MKL (package pypardiso)."""

from __future__ import annotations

import os
import shutil
import tempfile
import warnings
import weakref
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from fmu.engines.memory import free_memory, total_memory
from fmu.fem.modes.factors.memory import LARGE, is_short, needed_in_words, require_memory
from fmu.fem.refinement import RefinedFactor
from fmu.numbers import whole
from fmu.types import FloatArray

# From PARDISO's manual: types of matrices, phases of a solution, the smallest pivot as a negative power of ten,
# and the number of its domain.
_DEFINITE, _INDEFINITE = 2, -2
_ANALYSE, _ELIMINATE, _SOLVE, _RELEASE = 11, 22, 33, -1
_TINY, _OF_PARDISO = 20, 4
# PARDISO divides its work among at most this many threads, and into the same parts with fewer threads.
_MOST_THREADS = 8
# Share of the machine's memory that factors in double precision may take. A run takes four to five times as much:
# factors of two matrices, copies of the matrices, and vectors. The share does not depend on the free memory, so
# results do not depend on it either.
_SHARE = 1.0 / 6.0
# Parameters of PARDISO: to count the entries of the factors, and to keep factors in files. Environment variables
# that it reads at the analysis: the folder of the files, and the megabytes of factors in memory.
_COUNT, _IN_FILES = -1, 2
_PATH, _CORE = "MKL_PARDISO_OOC_PATH", "MKL_PARDISO_OOC_MAX_CORE_SIZE"
_USERS_FOLDER = os.environ.get(_PATH)
_PACKAGE = (f"{Path(__file__).parents[3]}{os.sep}",)  # a warning names the caller's line
# Errors of PARDISO: without memory, and with files that cannot be opened, read or written.
_WITHOUT_MEMORY, _WITHOUT_FILES = (-2, -9), (-10, -11)


def n_threads() -> int:
    """Return the number of threads with which PARDISO factorises a matrix of at least `LARGE` rows, from 1 to 8.

    The number is taken from the environment variable ``MKL_NUM_THREADS`` or, if that is not set, from
    ``OMP_NUM_THREADS``. In the workers of fmu's engines, each of these variables is 1 unless the user has set it.
    If neither is set, or the value is not a whole number, the number of processors that this process may use is
    taken. Smaller matrices are factorised in one thread.
    """
    given = os.environ.get("MKL_NUM_THREADS") or os.environ.get("OMP_NUM_THREADS") or ""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(max(int(given) if given.isdecimal() else usable, 1), _MOST_THREADS)


class _LargeFactorsError(Exception):
    """Raised if factors are so large that they should be computed in single precision."""


def by_pardiso(matrix: sp.csr_array, is_definite: bool) -> Pardiso | RefinedFactor:
    """Factorise a symmetric matrix.

    If factors in double precision would take more than a sixth of the machine's memory, they are computed in
    single precision, and solutions are refined. The function raises the same exceptions as `Pardiso` and
    `RefinedFactor`, except _LargeFactorsError.
    """
    try:
        return Pardiso(matrix, is_definite)
    except _LargeFactorsError:
        pass  # the exception would keep the analysis in memory
    return RefinedFactor(matrix, partial(Pardiso, is_single=True), is_definite)


class Pardiso:
    """Cholesky factors of a matrix or, if it is indefinite, factors L D Lᵀ with a diagonal D.

    Factors that do not fit in free memory are stored in files, and PARDISO loads a part of them at a time. Factors
    in files differ from factors in memory by rounding errors.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is singular, if `is_definite` and `is_single` are True but the matrix is not positive
        definite in single precision, or if PARDISO fails for another reason.
    MemoryError
        If the factors do not fit in memory, and cannot be stored in files because the disk is too full or the part
        that remains in memory is too large.
    _LargeFactorsError
        If factors in double precision would take more than a sixth of the machine's memory.
    OSError
        If the files cannot be created, written or read.

    Warns
    -----
    UserWarning
        If the factors are stored in files.
    """

    L: FloatArray | None = None

    def __init__(self, matrix: sp.csr_array, is_definite: bool = True, is_single: bool = False) -> None:
        self._upper, self.negative, self.is_single = _upper_triangle(matrix), 0, is_single
        if is_single:
            self._upper = self._upper.astype(np.float32)
        self._in_memory: int | None = None  # bytes of factors in files that PARDISO may hold in memory
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
        """Number of entries in L and its transpose."""
        return 2 * int(self._solver.get_iparm(18))

    @property
    def n_bytes(self) -> int:
        """Bytes of memory for the factors or, if the factors are in files, for the part that may be loaded."""
        n_bytes = sum(1024 * int(self._solver.get_iparm(i)) for i in (16, 17))
        return n_bytes if self._in_memory is None else min(n_bytes, self._in_memory)

    def solve(self, loads: FloatArray) -> FloatArray:
        """Return A⁻¹ b for b of shape (n,) or (n, m)."""
        return _call(self._solver, self._upper, _SOLVE, loads)

    def _factorise(self, of: int) -> None:
        self._analyse(of)
        of_analysis, lasting, of_factors = (1024 * int(self._solver.get_iparm(i)) for i in (15, 16, 17))
        needed, n = max(of_analysis, lasting + of_factors), self._upper.shape[0]
        if not self.is_single and lasting + of_factors > _SHARE * total_memory():
            raise _LargeFactorsError
        half = (free_memory() or 0) // 2  # other factors and vectors need memory too
        if is_short(needed) and lasting < half and (folder := _folder_for(needed)):
            kept = f"they are kept in files in {Path(folder).parent}, which takes longer"
            warnings.warn(f"{needed_in_words(needed, n)}, more than are free; {kept}", skip_file_prefixes=_PACKAGE)
            self._in_memory = half
            os.environ |= {_PATH: folder, _CORE: str(half // 2**20)}
            weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)  # after PARDISO has let go of it
            self._analyse(of, _IN_FILES)
        else:
            require_memory(needed, n)
        _call(self._solver, self._upper, _ELIMINATE)

    def _analyse(self, of: int, where: int = 0) -> None:
        self._solver = _pardiso()(mtype=of)
        weakref.finalize(self, _call, self._solver, self._upper, _RELEASE).atexit = False
        # METIS, a count of the entries, and unmodified pivots: PARDISO's default would change pivots below 1e-8 of
        # the largest entry
        parameters = {1: 1, 2: 2, 10: _TINY, 18: _COUNT, 28: self.is_single, 34: _MOST_THREADS, 60: where}
        for i, value in parameters.items():
            self._solver.iparm[i - 1] = value
        _call(self._solver, self._upper, _ANALYSE)


def _folder_for(n_bytes: int) -> str | None:
    """Create and return a folder on a disk with at least `n_bytes` free, or return None if the disk has no room.

    It is inside the folder named by the environment variable ``MKL_PARDISO_OOC_PATH`` or, by default, inside the
    folder for temporary files. Raise OSError if it cannot be created.
    """
    folder = tempfile.mkdtemp(prefix="fmu-factors-", dir=_USERS_FOLDER)
    if shutil.disk_usage(folder).free > n_bytes:
        return folder
    os.rmdir(folder)
    return None


def _call(solver: Any, upper: sp.csr_array, phase: int, loads: FloatArray | None = None) -> FloatArray:
    from pypardiso.pardiso_wrapper import PyPardisoError

    n = upper.shape[0]
    # The analysis plans the work of as many threads as it may use. The solution of several right-hand sides on
    # several threads would depend on their number.
    has_threads = phase in (_ANALYSE, _ELIMINATE) and n >= LARGE
    solver.libmkl.MKL_Domain_Set_Num_Threads(n_threads() if has_threads else 1, _OF_PARDISO)
    solver.set_phase(phase)
    try:
        loads = np.zeros(n) if loads is None else loads
        return solver._call_pardiso(upper, np.asfortranarray(loads, dtype=upper.dtype)).astype(float, copy=False)
    except PyPardisoError as error:
        if error.value in _WITHOUT_MEMORY:
            raise MemoryError(f"the factors of {whole(n)} degrees of freedom do not fit in memory") from error
        if error.value in _WITHOUT_FILES:
            raise OSError(f"the factors of {whole(n)} degrees of freedom could not be kept in files") from error
        raise np.linalg.LinAlgError(f"PARDISO ended with error {error.value}") from error


def _upper_triangle(matrix: sp.csr_array) -> sp.csr_array:
    """Return the upper triangle, with every diagonal entry stored even if it is zero."""
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
