"""A space of trial vectors with every term of K and M projected onto it: what training solves, and lets grow."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg as sl
import scipy.sparse.linalg as ssl

from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.separable import Term, coefficients
from fmu.types import FloatArray

# From this size on Lanczos iterations on the dense matrices are cheaper than LAPACK.
_LANCZOS = 200
# Numbers in the assembled matrices of a few points: 64 MiB.
_AT_ONCE = 2**23
# Of unit vectors, directions with less energy than this are in the space already, but for rounding.
_RANK = 1e-12


class Space:
    """Trial vectors V of a block, and the reduced eigenproblem Vᵀ (K + s M) V y = (λ + s) Vᵀ M V y.

    Parameters
    ----------
    block : FullBlock
    shift : float
        s ≥ 0, which makes K + s M positive definite.
    V : ndarray, shape (block.size, r)
    K, M : ndarray, shapes (n_K_terms, r, r), (n_M_terms, r, r)
        The projected terms.
    """

    def __init__(self, block: FullBlock, shift: float, V: FloatArray, K: FloatArray, M: FloatArray) -> None:
        self.block, self.shift = block, shift
        self.V, self.K, self.M = V, K, M

    @classmethod
    def empty(cls, block: FullBlock, shift: float) -> Space:
        """Return the space of no vectors."""
        K, M = (np.empty((len(terms), 0, 0)) for terms in (block.K_terms, block.M_terms))
        return cls(block, shift, np.empty((block.size, 0)), K, M)

    @property
    def size(self) -> int:
        """Number of vectors."""
        return self.V.shape[1]

    def grown(self, X: FloatArray, A: Any) -> Space:
        """Return the space with vectors X (size, q) added, what is new of them orthonormal in A and to V."""
        X = X / np.sqrt(np.sum(X * (A @ X), axis=0))
        for new in (_RANK, 0.5):  # twice against rounding
            X = X - self.V @ (self.V.T @ (A @ X))
            gram = X.T @ (A @ X)
            energy, U = np.linalg.eigh(0.5 * (gram + gram.T))
            X = X @ (U[:, energy > new] / np.sqrt(energy[energy > new]))
        if not X.shape[1]:
            return self
        V = np.concatenate([self.V, X], axis=1)
        K = _bordered(self.K, self.block.K_terms, self.V, X)
        M = _bordered(self.M, self.block.M_terms, self.V, X)
        return Space(self.block, self.shift, V, K, M)

    def restricted(self, Q: FloatArray) -> Space:
        """Return the space of the vectors V Q, for Q of shape (r, q)."""
        K, M = (np.stack([Q.T @ (term @ Q) for term in terms]) for terms in (self.K, self.M))
        return Space(self.block, self.shift, self.V @ Q, K, M)

    def truncated(self, size: int) -> Space:
        """Return the space of the first `size` vectors."""
        return Space(self.block, self.shift, self.V[:, :size], self.K[:, :size, :size], self.M[:, :size, :size])

    def modes(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the lowest λ (n, count) and M-normalised y (n, r, count) at theta (n, p); NaN on failure."""
        r, n = self.size, len(theta)
        lam, y = np.full((n, count), np.nan), np.full((n, r, count), np.nan)
        at_once = max(1, _AT_ONCE // r**2)
        for first in range(0, n, at_once):
            rows = slice(first, min(first + at_once, n))
            stiff, heavy = self.assembled(theta[rows])
            stiff = stiff + self.shift * heavy
            for i, (A, B) in enumerate(zip(stiff, heavy, strict=True), start=first):
                try:
                    nu, x = _highest(B, A, count)
                except (np.linalg.LinAlgError, ssl.ArpackError):
                    continue
                with np.errstate(all="ignore"):
                    lam[i], y[i] = 1.0 / nu - self.shift, x / np.sqrt(nu)
        return lam, y

    def assembled(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the reduced K and M at theta (n, p), each of shape (n, r, r)."""
        r = self.size
        return tuple(  # type: ignore[return-value]
            (coefficients(terms, theta) @ reduced.reshape(len(terms), -1)).reshape(-1, r, r)
            for terms, reduced in ((self.block.K_terms, self.K), (self.block.M_terms, self.M))
        )


def _bordered(reduced: FloatArray, terms: tuple[Term, ...], V: FloatArray, X: FloatArray) -> FloatArray:
    """Return the terms projected onto [V X], of which those onto V are known."""
    r, q = V.shape[1], X.shape[1]
    whole = np.empty((len(terms), r + q, r + q))
    whole[:, :r, :r] = reduced
    for term, of in zip(terms, whole, strict=True):
        rows = np.flatnonzero(np.diff(term.matrix.indptr))
        KX = term.matrix[rows] @ X
        of[:r, r:] = V[rows].T @ KX
        of[r:, :r] = of[:r, r:].T
        corner = X[rows].T @ KX
        of[r:, r:] = 0.5 * (corner + corner.T)
    return whole


def _highest(B: FloatArray, A: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the highest ν of B x = ν A x, descending, and x with xᵀ A x = 1."""
    r = len(A)
    if r < _LANCZOS or 4 * count > r:
        nu, x = sl.eigh(B, A, subset_by_index=[r - count, r - 1], check_finite=False)
        if len(nu) < count:  # LAPACK returns fewer on overflow, without an error
            raise np.linalg.LinAlgError(f"{len(nu)} of {count} eigenvalues found")
        return nu[::-1], x[:, ::-1]
    L = np.linalg.cholesky(A)

    def apply(v: FloatArray) -> FloatArray:
        half = sl.solve_triangular(L, v, lower=True, trans=1, check_finite=False)
        return sl.solve_triangular(L, B @ half, lower=True, check_finite=False)

    start = np.random.default_rng(0).standard_normal(r)
    nu, z = ssl.eigsh(ssl.LinearOperator((r, r), matvec=apply, dtype=float), count, v0=start, tol=1e-10)
    order = np.argsort(nu)[::-1]
    return nu[order], sl.solve_triangular(L, z[:, order], lower=True, trans=1, check_finite=False)
