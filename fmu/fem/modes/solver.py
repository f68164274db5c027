"""Factorisation of symmetric matrices by four solvers with a common protocol.

LAPACK factorises dense matrices, and definite matrices with a narrow band (beams, bridges, towers), for which it
takes a tenth to a half of a sparse solver's time. Other sparse matrices are factorised by PARDISO in Intel's MKL
if the extra ``fmu[fast]`` is installed (package pypardiso), otherwise by SuperLU, which comes with SciPy. PARDISO
is meant for 10⁵ degrees of freedom and more. For matrices with at least `LARGE` rows it uses the number of threads
given by `n_threads` in `fmu.fem.modes.factors.pardiso`; the factors are bitwise equal for any number of threads.
If PARDISO's factors would take more than a sixth of the machine's memory, they are computed in single precision,
and solutions are refined to double precision (`fmu.fem.refinement`). The sparse solvers check the free memory
first. If it is too small, PARDISO stores the factors in files. SuperLU raises MemoryError, but checks only from
`LARGE` rows on.

Except for dense indefinite matrices, no solver reorders rows to obtain large pivots. The matrices are positive
definite or nearly so, and the signs of the pivots are then the signs of the eigenvalues (Sylvester's law of
inertia).
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Protocol

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp

from fmu.fem.modes.factors.banded import BandedFactor, find_band
from fmu.fem.modes.factors.memory import LARGE as LARGE
from fmu.fem.modes.factors.pardiso import by_pardiso
from fmu.fem.modes.factors.superlu import SuperLU
from fmu.types import FloatArray

type Matrix = FloatArray | sp.sparray
"""A matrix, dense or sparse."""

LAPACK, SUPERLU, PARDISO = "LAPACK", "SuperLU", "PARDISO"


class Factor(Protocol):
    """Factors of a symmetric matrix A.

    Attributes
    ----------
    negative : int
        Number of eigenvalues of A that are not positive.
    L : ndarray, shape (n, n), or None
        The lower factor in A = L Lᵀ if A is dense and definite, otherwise None.
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
        """Bytes of memory for the factors: reported by PARDISO, otherwise estimated from the number of entries."""
        ...

    def solve(self, loads: FloatArray) -> FloatArray:
        """Return A⁻¹ b for b of shape (n,) or (n, m)."""
        ...


def sparse_solver() -> str:
    """Return the name of the sparse solver in use: "PARDISO" if pypardiso is installed, otherwise "SuperLU"."""
    return PARDISO if find_spec("pypardiso") else SUPERLU


def factorise(matrix: Matrix, solver: str | None = None, is_definite: bool = True) -> Factor:
    """Factorise a symmetric matrix, dense or sparse.

    Parameters
    ----------
    matrix : ndarray or sparse array, shape (n, n)
    solver : {"SuperLU", "PARDISO"}, optional
        Solver for sparse matrices. By default, LAPACK factorises a definite matrix with a narrow band, and the
        solver that `sparse_solver` names factorises all others.
    is_definite : bool
        Whether the matrix is expected to be positive definite. If it is expected to be but is not, the
        factorisation takes longer. Not used for a dense matrix.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is singular to the last digit, or is dense and not finite. A nearly singular matrix may be
        factorised without an error.
    MemoryError
        If the factors of a large sparse matrix do not fit in memory, or fit only in single precision, which is too
        inaccurate for this matrix.
    OSError
        If PARDISO cannot write its factors to files.
    """
    if not sp.issparse(matrix):
        return DenseFactor(matrix)
    if solver is None and is_definite:
        matrix = sp.csr_array(matrix)
        band = find_band(matrix.indptr.tobytes(), matrix.indices.tobytes(), matrix.indices.dtype.str)
        if band is not None:
            try:
                return BandedFactor(matrix, band)
            except np.linalg.LinAlgError:  # indefinite or singular: the other solvers show which
                pass
    return by_pardiso(matrix, is_definite) if (solver or sparse_solver()) == PARDISO else SuperLU(matrix)


class ScaledFactor:
    """Factors of a matrix A, obtained from the factors of D A D with a diagonal matrix D.

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
    """The factors of a block's stiffness matrix at the latest theta for which they were computed.

    A copy starts without factors.

    Attributes
    ----------
    factor : ScaledFactor or None
        None if nothing is stored, or if the matrix was not clearly definite.
    """

    def __init__(self) -> None:
        self._at: bytes | None = None
        self.factor: ScaledFactor | None = None

    def __reduce__(self) -> tuple[type[LastFactor], tuple[()]]:
        """Pickle as an object without factors, because factors cannot be pickled."""
        return LastFactor, ()

    def at(self, theta: FloatArray, make: Callable[[], ScaledFactor | None]) -> ScaledFactor | None:
        """Return the factors stored for theta (n_parameters,), or compute and store them with `make`.

        Return None if `make` returns None.
        """
        if self._at != theta.tobytes():
            self._at = self.factor = None  # before the next factors take memory
            self.factor = make()
            self._at = theta.tobytes()
        return self.factor


class DenseFactor:
    """Factors of a dense matrix: Cholesky factors L Lᵀ, or L D Lᵀ if indefinite (Bunch & Kaufman 1977).

    Raises LinAlgError if the matrix is singular or not finite.
    """

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


def unit_diagonal(matrix: Matrix) -> tuple[Matrix, FloatArray]:
    """Scale A, dense or sparse, to S = D A D with ±1 or 0 on the diagonal, and return S and D's diagonal."""
    diagonal = np.abs(matrix.diagonal())
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    return scale_matrix(matrix, scale), scale


def scale_matrix(matrix: Matrix, scale: FloatArray) -> Matrix:
    """Return D A D for a matrix A and the diagonal `scale` of D."""
    if not sp.issparse(matrix):
        return scale[:, None] * matrix * scale
    matrix = sp.csr_array(matrix, copy=True)
    matrix.data *= scale[np.repeat(np.arange(len(scale)), np.diff(matrix.indptr))] * scale[matrix.indices]
    return matrix
