"""The parametric reduced basis: one fixed basis for every theta in a parameter box.

K(theta) and M(theta) are sums of fixed matrices with coefficients that depend on theta, so the modes at all theta
in a box lie close to a space of few dimensions. The modes at sampled points are compressed by proper orthogonal
decomposition to a basis that is orthonormal in the mass matrix at the box's centre. Every term is projected onto
the basis once. A solve is then a dense eigenproblem, usually of order 10 to 50, whatever the size of the
structure. A batch of solves is usually one call to NumPy's batched LAPACK (Quarteroni, Manzoni & Negri 2016,
*Reduced Basis Methods for Partial Differential Equations*, chapter 6). By Rayleigh's principle the reduced
eigenvalues are never below the exact ones.
"""

from __future__ import annotations

import copy
import math
from functools import partial
from typing import Any, ClassVar, Literal, Self

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp

from fmu.fem.modes.block import Block
from fmu.fem.modes.derivatives import CLOSE, by_all_modes, by_bordered_matrices
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.stacks import assemble, row_by_row
from fmu.fem.modes.terms import ParametricMatrix, Term
from fmu.types import FloatArray

# In a block of more than _LARGE degrees of freedom, a term whose fraction of non-empty rows is at most _FEW is
# projected by these rows alone.
_LARGE, _FEW = 2000, 0.125
# From this size on, computing a few of the lowest modes of a reduced matrix is cheaper than computing all modes.
_PARTIAL = 128
# An eigenvalue ν below this fraction of the highest ν belongs to no mode of finite frequency.
_FINITE = 1e-14


class ReducedBlock(Block):
    """A block of a structure projected onto a reduced basis, and solved in batches.

    Parameters
    ----------
    block : FullBlock
    basis : ndarray, shape (block.size, r)
        Basis vectors, made orthonormal at the box's centre by `fmu.fem.reduced.points.mass_orthonormal`.
    n_trained : int
        Number of lowest modes for which the basis was trained.

    Attributes
    ----------
    n_modes : int
        Number of modes with a finite frequency, at most `size`.

    Notes
    -----
    If degrees of freedom have no mass, the reduced M may also be singular. Then the inverse problem M x = ν
    (K + s M) x is solved, with λ = 1/ν − s (as in `fmu.fem.modes.eigensolver`). The shift s = tr K/tr M makes
    K + s M definite for a free structure too.

    Every operation treats each theta separately, elementwise or in one small LAPACK or BLAS call per theta. Each
    result is therefore bitwise independent of the rest of the batch.
    """

    is_reduced: ClassVar[Literal[True]] = True

    def __init__(self, block: FullBlock, basis: FloatArray, n_trained: int) -> None:
        super().__init__(block.dofs, block.K_terms, block.M_terms)
        self.basis = basis
        self.size = basis.shape[1]
        self.n_trained = n_trained
        self.n_modes = min(block.n_modes, self.size)
        self.massless = block.massless
        self._set_terms(_project(block.K_terms, basis), _project(block.M_terms, basis))

    def __getstate__(self) -> dict[str, object]:
        """Return the state for pickling. It omits arrays that are only views of the projected terms."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_K_rows", "_M_rows")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._set_terms(self._K, self._M)

    @property
    def terms(self) -> tuple[FloatArray, FloatArray]:
        """Projected stiffness and mass terms, each an array of shape (n_terms, r, r)."""
        return self._K, self._M

    def truncate(self, size: int) -> Self:
        """Return a copy of the block with only the first `size` basis vectors."""
        leading = copy.copy(self)
        leading.basis, leading.size = self.basis[:, :size], size
        leading.n_modes = min(self.n_modes, size)
        leading._set_terms(self._K[:, :size, :size].copy(), self._M[:, :size, :size].copy())
        return leading

    def coarser(self, share: float) -> Self:
        """Return the block with the leading fraction `share` of its basis, or itself if no vector is removed.

        At least `n_trained` vectors remain. A basis with as many vectors as degrees of freedom is not truncated.
        """
        few = max(self.n_trained, math.ceil(share * self.size))
        return self.truncate(few) if few < self.size < len(self.dofs) else self

    def eigenvalues(self, theta: FloatArray, count: int) -> FloatArray:
        """Return the lowest eigenvalues in (rad/s)², shape (n, count).

        They are NaN where the solver fails, and for modes beyond the rank of M.
        """
        if self.massless:
            return self.modes(theta, count)[0]
        A = assemble(self._K, self._K_map.coefficients(theta))
        # a basis orthonormal in a mass matrix that no parameter changes makes the problem a standard one
        if not self.constant_mass:
            A = row_by_row(_whiten, A, assemble(self._M, self._M_map.coefficients(theta)))[0]
        return row_by_row(_values, A)[0][:, :count]

    def modes(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return eigenvalues (n, count) and M-normalised shapes in the basis, (n, r, count).

        They are NaN where the solver fails, and for modes beyond the rank of M.
        """
        A = assemble(self._K, self._K_map.coefficients(theta))
        few = self.size >= _PARTIAL and 4 * count <= self.size
        if self.massless:
            M = assemble(self._M, self._M_map.coefficients(theta))
            lam, phi = row_by_row(partial(_solve_inverse, count=count if few else None), A, M)
            return lam[:, :count], phi[:, :, :count]
        solve: Any = partial(_lowest, count=count) if few else np.linalg.eigh
        if self.constant_mass:
            lam, phi = row_by_row(solve, A)
            return lam[:, :count], phi[:, :, :count]
        A, inverse = row_by_row(_whiten, A, assemble(self._M, self._M_map.coefficients(theta)))
        lam, y = row_by_row(solve, A)
        return lam[:, :count], np.swapaxes(inverse, 1, 2) @ y[:, :, :count]

    def matrices(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the projected K and M at theta (n, n_parameters), each of shape (n, r, r)."""
        K, M = self._K_map.coefficients(theta), self._M_map.coefficients(theta)
        return assemble(self._K, K), assemble(self._M, M)

    def changes(self, theta: FloatArray, phi: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the modal products φᵀ ∂K φ and φᵀ ∂M φ, each of shape (n, n_parameters, r, r).

        The columns of `phi` (n, r, r) are r shapes φ.
        """
        m = phi.shape[2]
        both = (
            self._slopes(theta, coefficient, rows, phi, m)
            for coefficient, rows in ((self._K_map, self._K_rows), (self._M_map, self._M_rows))
        )
        dK, dM = (np.moveaxis(part, 3, 1) for part in both)
        return dK, dM

    def stiffness_terms(self, theta: FloatArray) -> FloatArray:
        """Return the projected stiffness terms times their coefficients at theta, (n, n_terms, r, r)."""
        return self._K_map.coefficients(theta)[:, :, None, None] * self._K

    def stiffness_changes(self, theta: FloatArray, weights: FloatArray) -> FloatArray:
        """Return the weighted stiffness derivatives Σ_k w_k ∂c_k/∂θ K_k, shape (n, n_parameters, r, r).

        The `weights` w have shape (n, n_terms), and c_k is the coefficient of the stiffness term K_k.
        """
        n, r = len(theta), self.size
        weighted = weights[:, :, None] * self._K.reshape(len(self._K), -1)
        return np.moveaxis(self._K_map.contract(theta, weighted).reshape(n, r, r, -1), 3, 1)

    def pull_back_terms(self, theta: FloatArray, by_terms: FloatArray) -> FloatArray:
        """Convert derivatives with respect to K's coefficients to derivatives with respect to theta.

        `by_terms` has shape (n, n_terms), and the result (n, n_parameters).
        """
        return self._K_map.contract(theta, by_terms[..., None])[:, 0]

    def pull_back(self, theta: FloatArray, by_K: FloatArray, by_M: FloatArray) -> FloatArray:
        """Convert derivatives with respect to K and M, each (n, r, r), to derivatives with respect to theta.

        The result has shape (n, n_parameters).
        """
        of_K, of_M = (
            coefficient.contract(theta, np.einsum("nij,kij->nk", by, matrices)[..., None])[:, 0]
            for coefficient, by, matrices in ((self._K_map, by_K, self._K), (self._M_map, by_M, self._M))
        )
        return of_K + of_M

    def n_required(self, count: int, gradient: bool) -> int:
        """Return how many modes `seen` must compute to return `count` modes.

        If `gradient`, it must compute all modes, unless the block is `massless`.
        """
        return self.size if gradient and not self.massless else count

    def coordinates(self, rows: sp.csr_array) -> FloatArray:
        """Return the sensor rows projected onto the basis, as a dense array of shape (n_sensors, r)."""
        return rows @ self.basis

    def compress_rows(self, rows: Any, reference: FloatArray) -> tuple[Any, FloatArray]:
        """Compress sensor rows and reference shapes to at most r rows each; see `compress_rows` in this module."""
        return compress_rows(rows, reference)

    def _slopes_seen(
        self, theta: FloatArray, count: int, rows: Any, lam: FloatArray, phi: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        if self.massless:
            # a sum over all modes excludes modes of infinite frequency: one bordered system per mode instead
            lam, phi = lam[:, :count], phi[:, :, :count]
            slopes, lam_slopes = self._bordered_slopes(theta, lam, phi), self.eigenvalue_gradient(theta, lam, phi)
        else:
            i, dM = np.arange(count), None
            dK = self._slopes(theta, self._K_map, self._K_rows, phi, count)
            lam_slopes = dK[:, i, i]
            if not self.constant_mass:
                dM = self._slopes(theta, self._M_map, self._M_rows, phi, count)
                lam_slopes = lam_slopes - lam[:, :count, None] * dM[:, i, i]
            slopes = by_all_modes(lam, phi, dK, dM, count)
        n, r, _, p = slopes.shape
        return lam_slopes, (rows @ slopes.reshape(n, r, -1)).reshape(n, len(rows), count, p)

    def _bordered_slopes(self, theta: FloatArray, lam: FloatArray, phi: FloatArray) -> FloatArray:
        """Return the shape derivatives ∂φ/∂θ, (n, r, m, n_parameters), from one linear system per mode.

        They are NaN where a system is singular, as for repeated eigenvalues.
        """
        n, r, count = phi.shape
        dK, dM = (
            coefficient.contract(theta, (rows @ phi).reshape(n, -1, r * count)).reshape(n, r, count, -1)
            for coefficient, rows in ((self._K_map, self._K_rows), (self._M_map, self._M_rows))
        )
        return self._solve_borders(theta, lam, phi, dK, dM)

    def _solve_borders(
        self, theta: FloatArray, lam: FloatArray, phi: FloatArray, dK: FloatArray, dM: FloatArray
    ) -> FloatArray:
        """Return the shape derivatives ∂φ, (n, r, m, q), along q directions, from one linear system per mode.

        `dK` and `dM`, of the same shape, are ∂K φ and ∂M φ. The derivatives are NaN where a system is singular.
        """
        K, M = self.matrices(theta)
        slopes = np.empty(dK.shape)
        for k in range(phi.shape[2]):
            mode = lam[:, k], phi[:, :, k], dK[:, :, k], dM[:, :, k]
            slopes[:, :, k] = row_by_row(_solve_bordered, K, M, *mode)[0]
        return slopes

    def _slopes(
        self, theta: FloatArray, coefficient: ParametricMatrix, rows: FloatArray, phi: FloatArray, count: int
    ) -> FloatArray:
        """Return φ_kᵀ (∂A/∂θ) φ_i for A = K or M, shape (n, r, count, n_parameters).

        Index k runs over all r modes, and i over the lowest `count`. `coefficient` and `rows` belong to A: its
        coefficients, and the matrices of its terms on top of one another.
        """
        n, r, _ = phi.shape
        products = (rows @ phi[:, :, :count]).reshape(n, -1, r, count)
        forms = np.swapaxes(phi, 1, 2)[:, None] @ products
        return coefficient.contract(theta, forms.reshape(n, forms.shape[1], -1)).reshape(n, r, count, -1)

    def _set_terms(self, K: FloatArray, M: FloatArray) -> None:
        self._K, self._M = K, M
        self._K_rows, self._M_rows = K.reshape(-1, K.shape[-1]), M.reshape(-1, M.shape[-1])

    def _forms(self, phi: FloatArray, of_mass: bool, left: FloatArray | None = None) -> FloatArray:
        products, shapes = self._products_of_shapes(phi, of_mass)
        if left is not None:
            shapes = np.ascontiguousarray(np.swapaxes(left, 1, 2))
        return np.swapaxes((products @ shapes[..., None])[..., 0], 1, 2)

    def _apply(self, phi: FloatArray, weights: FloatArray, of_mass: bool) -> FloatArray:
        products = self._products_of_shapes(phi, of_mass)[0]
        return np.swapaxes(np.einsum("nkm,nmkr->nmr", weights, products), 1, 2)

    def _products(self, x: FloatArray, of_mass: bool) -> FloatArray:
        n, r, m = x.shape
        return ((self._M_rows if of_mass else self._K_rows) @ x).reshape(n, -1, r, m)

    def _sum_products(self, x: FloatArray, of_mass: bool) -> FloatArray:
        return np.sum((self._M if of_mass else self._K) @ x, axis=1)

    def _traces(self, left: FloatArray, right: FloatArray, of_mass: bool) -> FloatArray:
        n, r, m, _ = left.shape
        rows = (self._M_rows if of_mass else self._K_rows).reshape(-1, r * r)
        outer = np.moveaxis(left, 2, 1) @ np.moveaxis(right, 2, 1).swapaxes(2, 3)  # (n, m, r, r)
        return np.swapaxes(outer.reshape(n, m, r * r) @ rows.T, 1, 2)

    def _products_of_shapes(self, phi: FloatArray, of_mass: bool) -> tuple[FloatArray, FloatArray]:
        """Return K_k φ for every term, or M_k φ if `of_mass`, (n, m, n_terms, r), and the shapes (n, m, r)."""
        n, r, m = phi.shape
        rows = self._M_rows if of_mass else self._K_rows  # the symmetric terms, stacked vertically
        shapes = np.ascontiguousarray(np.swapaxes(phi, 1, 2))
        return (shapes @ rows.T).reshape(n, m, len(rows) // r, r), shapes

    def _shape_slopes_along(
        self, theta: FloatArray, lam: FloatArray, phi: FloatArray, dK_phi: FloatArray, dM_phi: FloatArray | None
    ) -> FloatArray:
        count = dK_phi.shape[2]
        if self.massless:
            dM_phi = np.zeros(dK_phi.shape) if dM_phi is None else dM_phi
            return self._solve_borders(theta, lam[:, :count], phi[:, :, :count], dK_phi, dM_phi)
        n, r, _, q = dK_phi.shape
        modes = np.swapaxes(phi, 1, 2)
        dK, dM = (
            None if x is None else (modes @ x.reshape(n, r, count * q)).reshape(n, r, count, q)
            for x in (dK_phi, dM_phi)
        )
        return by_all_modes(lam, phi, np.asarray(dK), dM, count, CLOSE)


Parts = tuple[FullBlock | ReducedBlock, ...]
"""Blocks of a structure, some of which may be reduced."""


def compress_rows(rows: FloatArray, reference: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Project rows (q, r) and reference shapes (q, m) onto an orthonormal basis of the rows' column space.

    They are returned unchanged if q ≤ r.
    """
    if rows.shape[0] <= rows.shape[1]:
        return rows, reference
    Q, R = np.linalg.qr(rows)
    return R, Q.T @ reference


def _project(terms: tuple[Term, ...], basis: FloatArray) -> FloatArray:
    projected = np.stack([_project_matrix(term.matrix, basis) for term in terms])
    return 0.5 * (projected + np.swapaxes(projected, 1, 2))


def _project_matrix(matrix: sp.csr_array, basis: FloatArray) -> FloatArray:
    """Return Vᵀ K V. If K is large and few of its rows are nonempty, only these rows are multiplied."""
    rows = np.flatnonzero(np.diff(matrix.indptr))
    if len(basis) <= _LARGE or len(rows) > _FEW * len(basis):
        return np.asarray(basis.T @ (matrix @ basis))
    return np.asarray(basis[rows].T @ (matrix[rows] @ basis))


def _whiten(K: FloatArray, M: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Transform K φ = λ M φ to a standard problem: return L⁻¹ K L⁻ᵀ and L⁻¹, (n, r, r) each, with M = L Lᵀ."""
    inverse = np.linalg.inv(np.linalg.cholesky(M))
    return inverse @ K @ np.swapaxes(inverse, 1, 2), inverse


def _solve_inverse(K: FloatArray, M: FloatArray, count: int | None) -> tuple[FloatArray, FloatArray]:
    """Solve the inverse problem M φ = ν (K + s M) φ, for a mass matrix M that may be singular.

    Parameters
    ----------
    K, M : ndarray, shape (n, r, r)
    count : int or None
        Number of lowest modes to return; all r if None.

    Returns
    -------
    ndarray, shape (n, m)
        Eigenvalues λ = 1/ν − s in ascending order; NaN beyond the rank of M.
    ndarray, shape (n, r, m)
        M-normalised shapes.
    """
    # K + s M is definite for a free structure too, and with s of the size of λ neither matrix loses digits
    shift = np.array([np.trace(k) / np.trace(m) for k, m in zip(K, M, strict=True)])
    C, inverse = _whiten(M, K + shift[:, None, None] * M)
    if count is None:
        nu, y = np.linalg.eigh(C)
        nu, y = nu[:, None, ::-1], y[:, :, ::-1]
    else:
        nu, y = _lowest(-C, count)
        nu = -nu[:, None]
    nu = np.where(nu > _FINITE * nu[:, :, :1], nu, np.nan)
    return 1.0 / nu[:, 0] - shift[:, None], np.swapaxes(inverse, 1, 2) @ (y / np.sqrt(nu))


def _solve_bordered(*parts: FloatArray) -> tuple[FloatArray]:
    return (by_bordered_matrices(*parts),)


def _lowest(A: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the lowest eigenvalues (n, count) and eigenvectors (n, r, count), with NaN where A is not finite."""
    lam, phi = np.full((len(A), count), np.nan), np.full((*A.shape[:2], count), np.nan)
    for i in np.flatnonzero(np.isfinite(A).all(axis=(1, 2))):
        lam[i], phi[i] = sl.eigh(A[i], subset_by_index=[0, count - 1], check_finite=False)
    return lam, phi


def _values(A: FloatArray) -> tuple[FloatArray]:
    return (np.linalg.eigvalsh(A),)
