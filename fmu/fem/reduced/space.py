"""Spaces of trial vectors, onto which every term of K and M is projected, and their eigenproblems."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg as sl
import scipy.sparse.linalg as ssl

from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.solver import Matrix
from fmu.fem.modes.terms import Term, coefficients
from fmu.fem.reduced.basis import ReducedBlock
from fmu.types import FloatArray

# From this size on, Lanczos iterations on the dense matrices are cheaper than LAPACK.
_LANCZOS = 200
# Tolerance of a mode's residual; the relative error of λ is about its square.
_CONVERGED = 1e-7
# Largest number of elements of the matrices that are assembled for several points together: 128 MiB.
_AT_ONCE = 2**24
# A direction whose energy outside the space is less than this, relative to a unit vector, is not added.
_RANK = 1e-12
# Number of vectors that are added to a space together.
_TOGETHER = 64


class Space:
    """Trial vectors V of a block, and the reduced eigenproblem Vᵀ (K + s M) V y = (λ + s) Vᵀ M V y.

    Parameters
    ----------
    block : FullBlock
    shift : float
        The shift s ≥ 0, which makes K + s M positive definite.
    V : ndarray, shape (block.size, r)
        The trial vectors.
    K, M : sequence of ndarray, each of shape (n_terms, q, width)
        The lower triangles of the projected terms, in strips of q rows; `width` is the number of rows up to the
        end of the strip. The space can thus be enlarged without copying the existing strips.
    """

    def __init__(
        self, block: FullBlock, shift: float, V: FloatArray, K: Sequence[FloatArray], M: Sequence[FloatArray]
    ) -> None:
        self.block, self.shift = block, shift
        self.V, self.K, self.M = V, tuple(K), tuple(M)

    @classmethod
    def empty(cls, block: FullBlock, shift: float) -> Space:
        """Return a space without vectors."""
        return cls(block, shift, np.empty((block.size, 0)), (), ())

    @classmethod
    def of(cls, reduced: ReducedBlock, block: FullBlock, shift: float) -> Space:
        """Return the space whose trial vectors are a reduced block's basis."""
        return cls(block, shift, reduced.basis, *([terms] for terms in reduced.terms))

    @property
    def size(self) -> int:
        """Number of trial vectors."""
        return self.V.shape[1]

    def grown(self, X: FloatArray, A: Matrix) -> Space:
        """Return the space enlarged by the new directions in X (block.size, q); see `new_directions`."""
        return self.join(new_directions(self.V, X, A))

    def join(self, X: FloatArray) -> Space:
        """Return the space spanned by V and X (block.size, q), in this order."""
        V, K, M = self.V, self.K, self.M
        for first in range(0, X.shape[1], _TOGETHER):
            new = X[:, first : first + _TOGETHER]
            K, M = (*K, _rows(self.block.K_terms, V, new)), (*M, _rows(self.block.M_terms, V, new))
            V = np.concatenate([V, new], axis=1)
        return Space(self.block, self.shift, V, K, M)

    def restrict(self, Q: FloatArray) -> Space:
        """Return the space with trial vectors V Q, for Q of shape (r, q)."""
        return Space.empty(self.block, self.shift).join(self.V @ Q)

    def truncate(self, size: int) -> Space:
        """Return the space spanned by the first `size` vectors."""
        return Space(self.block, self.shift, self.V[:, :size], _leading(self.K, size), _leading(self.M, size))

    def modes(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the lowest eigenvalues λ (n, count) and M-normalised vectors y (n, r, count) at theta (n, p).

        Both are NaN where the solver fails, and for modes without mass.
        """
        r, n = self.size, len(theta)
        lam, y = np.full((n, count), np.nan), np.full((n, r, count), np.nan)
        at_once = max(1, _AT_ONCE // r**2)
        for first in range(0, n, at_once):
            rows = slice(first, min(first + at_once, n))
            stiff, heavy = self.assemble(theta[rows])
            stiff = stiff + self.shift * heavy if self.shift else stiff
            for i, (A, B) in enumerate(zip(stiff, heavy, strict=True), start=first):
                try:
                    nu, x = _highest(B, A, count)
                except (np.linalg.LinAlgError, ssl.ArpackError):
                    continue
                nu = np.where(nu > 0.0, nu, np.nan)
                lam[i], y[i] = 1.0 / nu - self.shift, x / np.sqrt(nu)
        return lam, y

    def assemble(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the lower triangles of the reduced K and M at theta (n, p), each of shape (n, r, r)."""
        K = self._assemble(self.K, coefficients(self.block.K_terms, theta))
        if not self.block.constant_mass:
            return K, self._assemble(self.M, coefficients(self.block.M_terms, theta))
        M = self._assemble(self.M, coefficients(self.block.M_terms, theta[:1]))
        return K, np.broadcast_to(M, K.shape)

    def _assemble(self, rows: Sequence[FloatArray], weights: FloatArray) -> FloatArray:
        n, n_terms = weights.shape
        whole = np.zeros((n, self.size, self.size))
        first = 0
        for part in rows:
            q, width = part.shape[1:]
            whole[:, first : first + q, :width] = (weights @ part.reshape(n_terms, -1)).reshape(n, q, width)
            first += q
        return whole


def new_directions(V: FloatArray, X: FloatArray, A: Matrix) -> FloatArray:
    """Return the directions that X (n, q) adds to V (n, r): A-orthonormal columns, A-orthogonal to V.

    V must be A-orthonormal. Directions that lie in its span to rounding are left out.
    """
    X = X / np.sqrt(np.sum(X * (A @ X), axis=0))
    for new in (_RANK, 0.5):  # twice against rounding
        X = X - V @ (V.T @ (A @ X))
        gram = X.T @ (A @ X)
        energy, U = np.linalg.eigh(0.5 * (gram + gram.T))
        X = X @ (U[:, energy > new] / np.sqrt(energy[energy > new]))
    return X


def _rows(terms: tuple[Term, ...], V: FloatArray, X: FloatArray) -> FloatArray:
    """Return the new rows Xᵀ K [V X] of each projected term K, shape (n_terms, q, r + q)."""
    r, q = V.shape[1], X.shape[1]
    projected = np.empty((len(terms), q, r + q))
    for term, of in zip(terms, projected, strict=True):
        rows = np.flatnonzero(np.diff(term.matrix.indptr))
        KX = term.matrix[rows] @ X
        of[:, :r] = KX.T @ V[rows]
        corner = X[rows].T @ KX
        of[:, r:] = 0.5 * (corner + corner.T)
    return projected


def _leading(rows: Sequence[FloatArray], size: int) -> list[FloatArray]:
    """Return the strips of the lower triangles, cut to the first `size` rows and columns."""
    leading: list[FloatArray] = []
    for part in rows:
        left = size - sum(of.shape[1] for of in leading)
        if left > 0:
            leading.append(part if part.shape[1] <= left else part[:, :left, :size].copy())
    return leading


def _highest(B: FloatArray, A: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the highest eigenvalues ν (count,) of B x = ν A x, descending, and vectors (r, count), xᵀ A x = 1.

    Only the lower triangles of A and B are read.
    """
    r = len(A)
    if r < _LANCZOS or 4 * count > r:
        nu, x = sl.eigh(B, A, subset_by_index=[r - count, r - 1], check_finite=False)
        if len(nu) < count:  # LAPACK returns fewer on overflow, without an error
            raise np.linalg.LinAlgError(f"{len(nu)} of {count} eigenvalues found")
        return nu[::-1], x[:, ::-1]
    # LAPACK stores matrices by columns, and sees the rows of a lower triangle as columns of an upper one
    U, B = np.linalg.cholesky(A).T, B.T

    def apply(v: FloatArray) -> FloatArray:
        return sl.blas.dtrsv(U, sl.blas.dsymv(1.0, B, sl.blas.dtrsv(U, v)), trans=1)

    operator = ssl.LinearOperator((r, r), matvec=apply, dtype=float)
    start = np.random.default_rng(0).standard_normal(r)
    nu, z = ssl.eigsh(operator, count, v0=start, tol=_CONVERGED, ncv=max(20, 3 * count))
    order = np.argsort(nu)[::-1]
    return nu[order], sl.solve_triangular(U, z[:, order], check_finite=False)
