"""LAPACK factorisation of definite matrices with a narrow band."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
from scipy.sparse.csgraph import reverse_cuthill_mckee

from fmu.types import FloatArray, IntArray

# Up to this half-width a band was faster than SuperLU to factorise and to solve, for 1000 to 5000 rows.
_NARROW = 256


class Band(NamedTuple):
    """Positions of a sparse matrix's entries in its band.

    Attributes
    ----------
    order : ndarray of int, shape (n,)
        Row order that makes the band narrow.
    half_width : int
        Number of diagonals on each side of the main diagonal.
    entries : ndarray of int, shape (n_lower,)
        Indices of the stored entries that lie in the lower triangle of the reordered matrix.
    at : ndarray of int, shape (n_lower,)
        Positions of these entries in the band, which is stored by columns.
    """

    order: IntArray
    half_width: int
    entries: IntArray
    at: IntArray


@lru_cache(maxsize=8)
def find_band(indptr: bytes, indices: bytes, dtype: str) -> Band | None:
    """Return the band for matrices with this sparsity pattern, or None if its half-width exceeds 256.

    `indptr` and `indices` contain the bytes of the CSR index arrays of type `dtype`. Rows are in reverse
    Cuthill–McKee order. The result is cached, because a model's matrices have the same pattern at every theta.
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
    return Band(order, half_width, entries, j[entries] * half_width + i[entries])


class BandedFactor:
    """Cholesky factors of a positive definite banded matrix. Raises LinAlgError if the matrix is not definite."""

    negative = 0
    L: FloatArray | None = None
    is_single = False

    def __init__(self, matrix: sp.csr_array, band: Band) -> None:
        self._order, n = band.order, matrix.shape[0]
        size = n * (band.half_width + 1)
        lower = np.bincount(band.at, matrix.data[band.entries], size).reshape(n, -1).T
        self._lower, failed = sl.lapack.dpbtrf(lower, lower=1, overwrite_ab=1)
        if failed:
            raise np.linalg.LinAlgError("the matrix is not positive definite")
        self.n_entries, self.n_bytes = 2 * size, 8 * size

    def solve(self, loads: FloatArray) -> FloatArray:
        """Return A⁻¹ b for b of shape (n,) or (n, m)."""
        found, solution = np.empty_like(loads), sl.lapack.dpbtrs(self._lower, loads[self._order], lower=1)[0]
        found[self._order] = solution
        return found
