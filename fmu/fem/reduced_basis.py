"""The parametric reduced basis: one fixed basis that serves every theta of a box.

K(theta) and M(theta) are sums of fixed matrices, so that the modes at all theta of a box lie close to a space of
few dimensions. The modes at sampled points are compressed by proper orthogonal decomposition in the inner product
of the mass matrix at the box's centre; every term is projected onto that basis once; a solve is then a dense
eigenproblem of order 10 to 50, whatever the size of the structure, and a batch of them is one call of NumPy's
batched LAPACK (Quarteroni, Manzoni & Negri 2016, *Reduced Basis Methods for Partial Differential Equations*,
chapter 6).
By Rayleigh's principle the reduced eigenvalues lie above the exact ones.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmu.fem.modal import RIGID, FullBlock, Seen, frequency_hz
from fmu.fem.shape_derivatives import by_all_modes
from fmu.fem.terms import CoefficientMap, Term, coefficients, weighted_sum

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Directions of the snapshots weaker than this, relative to the strongest, are rounding: the Gram matrix squares.
_SNAPSHOT_RANK = 1e-14


class ReducedBlock:
    """One block of a structure, projected onto a basis and solved in batches.

    Parameters
    ----------
    block : FullBlock
    basis : ndarray, shape (block.size, r)
        Orthonormal in the mass matrix at the box's centre.
    trusted : int
        How many of the lowest modes the basis was trained for.

    Notes
    -----
    Every step is done theta by theta inside NumPy's loops, elementwise or in one small LAPACK or BLAS call a
    theta, so that a result does not depend, in any bit, on what else is in the batch.
    """

    def __init__(self, block: FullBlock, basis: FloatArray, trusted: int) -> None:
        self.dofs = block.dofs
        self.basis = basis
        self.size = basis.shape[1]
        self.trusted = trusted
        self.n_parameters = block.n_parameters
        self._set_terms(_project(block.K_terms, basis), _project(block.M_terms, basis))
        self._K_map = CoefficientMap(block.K_terms)
        self._M_map = CoefficientMap(block.M_terms)
        # a basis orthonormal in a mass matrix that no parameter changes makes the problem a standard one
        self.constant_mass = all(term.constant for term in block.M_terms)

    def truncated(self, size: int) -> ReducedBlock:
        """Return the block reduced by the first `size` vectors of its basis alone."""
        leading = copy.copy(self)
        leading.basis, leading.size = self.basis[:, :size], size
        leading._set_terms(self._K[:, :size, :size].copy(), self._M[:, :size, :size].copy())
        return leading

    def eigenvalues(self, theta: FloatArray, count: int) -> FloatArray:
        """Return the lowest eigenvalues, shape (n, count); NaN where the solver fails."""
        A = _assemble(self._K, self._K_map(theta))
        if not self.constant_mass:
            A = _row_by_row(_whitened, A, _assemble(self._M, self._M_map(theta)))[0]
        return _row_by_row(_values, A)[0][:, :count]

    def modes(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return eigenvalues (n, count) and M-normalised shapes (n, r, count) in the basis; NaN on failure."""
        A = _assemble(self._K, self._K_map(theta))
        if self.constant_mass:
            lam, phi = _row_by_row(np.linalg.eigh, A)
            return lam[:, :count], phi[:, :, :count]
        A, inverse = _row_by_row(_whitened, A, _assemble(self._M, self._M_map(theta)))
        lam, y = _row_by_row(np.linalg.eigh, A)
        return lam[:, :count], np.swapaxes(inverse, 1, 2) @ y[:, :, :count]

    def eigenvalue_gradient(self, theta: FloatArray, lam: FloatArray, phi: FloatArray) -> FloatArray:
        """Return ∂λ/∂θ, shape (n, m, n_parameters), from the reduced terms (Fox & Kapoor 1968, eq. 5)."""
        gradient = self._K_map.contract(theta, self._forms(self._K_rows, phi))
        if not self.constant_mass:
            gradient -= lam[..., None] * self._M_map.contract(theta, self._forms(self._M_rows, phi))
        return gradient

    def needed(self, count: int, gradient: bool) -> int:
        """Return how many modes `seen` takes: for the derivatives all of them."""
        return self.size if gradient else count

    def seen(
        self,
        theta: FloatArray,
        count: int,
        rows: Any,
        gradient: bool = False,
        solved: tuple[FloatArray, FloatArray] | None = None,
    ) -> Seen:
        """Return the lowest modes as sensors see them, derivatives as sums over all modes of the basis."""
        return self.seen_in_basis(theta, count, rows @ self.basis, gradient, solved)

    def seen_in_basis(
        self,
        theta: FloatArray,
        count: int,
        sensors: FloatArray,
        gradient: bool = False,
        solved: tuple[FloatArray, FloatArray] | None = None,
    ) -> Seen:
        """Return `seen` for sensors that are given by what they see of the basis, shape (n_sensors, size)."""
        lam, phi = solved or self.modes(theta, self.needed(count, gradient))
        if not gradient:
            return Seen(lam[:, :count], sensors @ phi[:, :, :count])
        dK, dM = (
            self._slopes(theta, coefficient, matrices, phi, count)
            for coefficient, matrices in ((self._K_map, self._K_rows), (self._M_map, self._M_rows))
        )
        i = np.arange(count)
        slopes = by_all_modes(lam, phi, dK, dM, count)
        n, r, _, p = slopes.shape
        seen = (sensors @ slopes.reshape(n, r, -1)).reshape(n, len(sensors), count, p)
        lam_slopes = dK[:, i, i] - lam[:, :count, None] * dM[:, i, i]
        return Seen(lam[:, :count], sensors @ phi[:, :, :count], lam_slopes, seen)

    def _slopes(
        self, theta: FloatArray, coefficient: CoefficientMap, rows: FloatArray, phi: FloatArray, count: int
    ) -> FloatArray:
        """Return φ_kᵀ ∂K φ_i for all k and the lowest i, shape (n, r, count, n_parameters)."""
        n, r, _ = phi.shape
        products = (rows @ phi[:, :, :count]).reshape(n, -1, r, count)
        forms = np.swapaxes(phi, 1, 2)[:, None] @ products
        return coefficient.contract(theta, forms.reshape(n, forms.shape[1], -1)).reshape(n, r, count, -1)

    def observe(self, rows: Any, reference: FloatArray) -> tuple[Callable[[FloatArray], FloatArray], FloatArray]:
        """Return shapes at `rows` and the references in an orthonormal basis of what the block can show there."""
        seen = rows @ self.basis
        if len(seen) <= self.size:
            return lambda phi: seen @ phi, reference
        Q, R = np.linalg.qr(seen)
        return lambda phi: R @ phi, Q.T @ reference

    def _set_terms(self, K: FloatArray, M: FloatArray) -> None:
        self._K, self._M = K, M
        self._K_rows, self._M_rows = K.reshape(-1, K.shape[-1]), M.reshape(-1, M.shape[-1])

    def _forms(self, rows: FloatArray, phi: FloatArray) -> FloatArray:
        """Return φᵀ K_k φ, shape (n, n_terms, m), for symmetric K_k one below the other in `rows`."""
        n, r, m = phi.shape
        shapes = np.ascontiguousarray(np.swapaxes(phi, 1, 2))
        products = (shapes @ rows.T).reshape(n, m, len(rows) // r, r)
        return np.swapaxes((products @ shapes[..., None])[..., 0], 1, 2)


@dataclass(frozen=True)
class Snapshots:
    """Modes of one block at sampled points: theta (n, p), eigenvalues (n, m) and shapes (n, size, m)."""

    theta: FloatArray
    eigenvalues: FloatArray
    shapes: FloatArray

    @classmethod
    def solve(cls, block: FullBlock, theta: FloatArray, count: int) -> Snapshots:
        """Solve the full block at every theta."""
        return cls(theta, *block.modes(theta, min(count, block.size)))

    def __add__(self, other: Snapshots) -> Snapshots:
        """Return the snapshots of both."""
        pairs = zip(
            (self.theta, self.eigenvalues, self.shapes),
            (other.theta, other.eigenvalues, other.shapes),
            strict=True,
        )
        return Snapshots(*(np.concatenate(pair) for pair in pairs))

    def lowest(self, count: int) -> Snapshots:
        """Return the snapshots of the lowest `count` modes alone."""
        return Snapshots(self.theta, self.eigenvalues[:, :count], self.shapes[:, :, :count])

    def frequency_error(self, block: ReducedBlock) -> FloatArray:
        """Return |f_reduced − f| / f, shape (n, m); for a rigid-body mode 0 or infinity: is it one there too."""
        exact, reduced = self.eigenvalues, block.eigenvalues(self.theta, self.eigenvalues.shape[1])
        top = exact[:, -1:]
        rigid = exact <= RIGID * top
        error = np.where(reduced <= 10.0 * RIGID * top, 0.0, np.inf)
        f, f_reduced = frequency_hz(exact), frequency_hz(reduced)
        return np.divide(np.abs(f_reduced - f), f, out=error, where=~rigid)


def proper_orthogonal_basis(block: FullBlock, snapshots: Snapshots, centre: FloatArray) -> FloatArray:
    """Return the POD of mode shapes, shape (size, r_max), strongest direction first.

    Orthonormal in the block's mass matrix at `centre` (n_parameters,).

    Notes
    -----
    Each shape is weighted by 1/ω. What a truncated basis leaves out is made of high modes, of some frequency Ω,
    and raises an eigenvalue by Ω²‖e‖²/ω² of itself: with the weight an error of the same size counts the same in
    every relative frequency.
    """
    M = weighted_sum(block.M_terms, coefficients(block.M_terms, centre[None])[0])
    lam = snapshots.eigenvalues
    floor = 1e-6 * lam[:, -1:]
    # without any stiffness every vector is a mode, and none worth a place
    weight = np.divide(1.0, np.sqrt(np.maximum(lam, floor)), out=np.zeros_like(lam), where=floor > 0.0)
    X = np.concatenate(list(snapshots.shapes * weight[:, None, :]), axis=1)
    if X.shape[1] > block.size:  # the smaller of the two Gram matrices: with M = L Lᵀ, that of the rows of Lᵀ X
        L = np.linalg.cholesky(M.toarray())
        energy, U = np.linalg.eigh(L.T @ X @ X.T @ L)
        return np.linalg.solve(L.T, U[:, _strongest(energy)])
    energy, U = np.linalg.eigh(X.T @ (M @ X))
    order = _strongest(energy)
    V = X @ (U[:, order] / np.sqrt(energy[order]))
    for _ in range(2):  # the weak directions lose orthogonality to rounding; Cholesky–QR restores it
        L = np.linalg.cholesky(V.T @ (M @ V))
        V = np.linalg.solve(L, V.T).T
    return V


def _strongest(energy: FloatArray) -> IntArray:
    order = np.argsort(energy)[::-1]
    return order[energy[order] > _SNAPSHOT_RANK * energy[order[0]]]


def smallest_basis(
    reduced: ReducedBlock, acceptable: Callable[[ReducedBlock], bool], smallest: int
) -> ReducedBlock:
    """Return `reduced` by the fewest leading vectors of its basis that are acceptable, or as it is if none are.

    By bisection: in nested spaces the reduced eigenvalues fall monotonically towards the exact ones (Courant and
    Fischer), so that what is acceptable stays so as vectors are added.
    """
    low, high = max(smallest, reduced.trusted) - 1, reduced.size
    while high - low > 1:
        middle = (low + high) // 2
        if acceptable(reduced.truncated(middle)):
            high = middle
        else:
            low = middle
    return reduced.truncated(high)


def _project(terms: tuple[Term, ...], basis: FloatArray) -> FloatArray:
    projected = np.stack([basis.T @ (term.matrix @ basis) for term in terms])
    return 0.5 * (projected + np.swapaxes(projected, 1, 2))


def _assemble(matrices: FloatArray, weights: FloatArray) -> FloatArray:
    """Return Σ_k weights[:, k] · matrices[k], shape (n, r, r)."""
    # einsum without `optimize` adds term by term: a batch changes no bit
    return np.einsum("nk,kij->nij", weights, matrices)


def _whitened(K: FloatArray, M: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return L⁻¹ K L⁻ᵀ and L⁻¹, with M = L Lᵀ."""
    inverse = np.linalg.inv(np.linalg.cholesky(M))
    return inverse @ K @ np.swapaxes(inverse, 1, 2), inverse


def _values(A: FloatArray) -> tuple[FloatArray]:
    return (np.linalg.eigvalsh(A),)


def _row_by_row(solve: Callable[..., Sequence[FloatArray]], *matrices: FloatArray) -> tuple[FloatArray, ...]:
    """Apply a batched solver; where one matrix makes it fail, the others must not suffer: those rows give NaN."""
    try:
        return tuple(solve(*matrices))
    except np.linalg.LinAlgError:
        rows: list[tuple[FloatArray, ...] | None] = []
        for i in range(len(matrices[0])):
            try:
                rows.append(tuple(solve(*(m[i : i + 1] for m in matrices))))
            except np.linalg.LinAlgError:
                rows.append(None)
        shapes = next((row for row in rows if row is not None), None)
        if shapes is None:
            shapes = tuple(solve(*(np.broadcast_to(np.eye(m.shape[-1]), (1, *m.shape[1:])) for m in matrices)))
        failed = tuple(np.full_like(part, np.nan) for part in shapes)
        return tuple(np.concatenate(parts) for parts in zip(*(row or failed for row in rows), strict=True))
