"""Modes of K φ = λ M φ, how alike two shapes are, and how eigenvalues move with the parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
import scipy.sparse.linalg as ssl
from numpy.typing import NDArray

from fmu.fem.separable import SeparableModel
from fmu.fem.shape_derivatives import by_bordered_system
from fmu.fem.shape_maps import Mapped, Picked
from fmu.fem.terms import CoefficientMap, Term, coefficient_gradients, weighted_sum

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Up to this size LAPACK on the dense matrices beats a sparse factorisation and its Lanczos iterations.
DENSE_LIMIT = 400
# An eigenvalue this small beside the highest of interest is zero but for rounding: a rigid-body mode.
RIGID = 1e-9
# Below zero by more than this, beside the largest of a set of eigenvalues, is no rounding. The set is that of the
# measured modes, far below the highest of the structure, to which rounding is relative.
NEGATIVE = 1e-6


class SingularMassError(ValueError):
    """The mass matrix is not positive definite, or the eigensolver failed."""


def frequency_hz(eigenvalue: FloatArray) -> FloatArray:
    """Return √λ / 2π, NaN for a clearly negative λ: the structure has no such vibration.

    Parameters
    ----------
    eigenvalue : ndarray, shape (..., m), (rad/s)²
        Modes of one structure along the last axis. A λ below zero by less than 1e-6 of the largest |λ| beside it
        is a rigid-body mode that rounding left there, and counts as zero.
    """
    if np.count_nonzero(eigenvalue < 0.0):
        scale = np.fmax.reduce(np.abs(eigenvalue), axis=-1, keepdims=True)
        eigenvalue = np.where(eigenvalue < -NEGATIVE * scale, np.nan, np.maximum(eigenvalue, 0.0))
    return np.sqrt(eigenvalue) / (2.0 * np.pi)


def frequency_gradient(frequency: FloatArray, eigenvalue_gradient: FloatArray) -> FloatArray:
    """Return ∂f/∂θ = ∂λ/∂θ / (8 π² f); not finite for a rigid-body mode.

    Parameters
    ----------
    frequency : ndarray, shape (n, m), Hz
    eigenvalue_gradient : ndarray, shape (n, m, n_parameters)
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return eigenvalue_gradient / (8.0 * np.pi**2 * frequency[..., None])


def eigen(K: Any, M: Any, count: int, definite: bool = False) -> tuple[FloatArray, FloatArray]:
    """Return the lowest modes of K φ = λ M φ.

    Parameters
    ----------
    K, M : sparse arrays, shape (n_dof, n_dof)
        Symmetric; M positive definite. K may be singular (a free structure).
    count : int
        How many modes.
    definite : bool
        Whether M is known to be positive definite; to find that out costs a factorisation of a large sparse M.

    Returns
    -------
    eigenvalues : ndarray, shape (count,), (rad/s)², ascending
    shapes : ndarray, shape (n_dof, count), with φᵀ M φ = 1

    Raises
    ------
    ValueError
        If the structure has fewer than `count` modes.
    SingularMassError
        If the solver fails, as it does when M is not positive definite.
    """
    n = K.shape[0]
    if not 1 <= count <= n:
        raise ValueError(f"count: must lie in 1..{n}, the degrees of freedom (got {count})")
    try:
        if n <= DENSE_LIMIT or count >= n - 1:
            lam, phi = sl.eigh(_dense(K), _dense(M), subset_by_index=[0, count - 1], check_finite=False)
        else:
            if not definite and not np.all(symmetric_factor(M).U.diagonal() > 0.0):
                # by Sylvester's law of inertia; Lanczos itself does not notice
                raise SingularMassError(f"eigenproblem of {n} DOF: the mass matrix is not positive definite")
            lam, phi = _lanczos(K, M, count)
    except (np.linalg.LinAlgError, RuntimeError) as error:
        raise SingularMassError(f"eigenproblem of {n} DOF: {error}") from error
    if len(lam) < count:  # what LAPACK does on overflow, without a word
        raise SingularMassError(f"eigenproblem of {n} DOF: {len(lam)} of {count} eigenvalues found")
    return lam, phi


def _lanczos(K: Any, M: Any, count: int) -> tuple[FloatArray, FloatArray]:
    # A shift slightly below zero keeps K − σM regular when K has rigid-body modes; the start vector is fixed so
    # that a repeated solve repeats its bits; the shifted matrix is definite, so that no pivoting is needed.
    n = K.shape[0]
    shift = -1e-6 * K.diagonal().sum() / M.diagonal().sum()
    factor = symmetric_factor(K - shift * M)
    inverse = ssl.LinearOperator((n, n), matvec=factor.solve, dtype=float)
    start = np.random.default_rng(0).standard_normal(n)
    lam, phi = ssl.eigsh(K, count, M, sigma=shift, OPinv=inverse, v0=start, tol=1e-12)
    order = np.argsort(lam)
    return lam[order], phi[:, order]


def symmetric_factor(matrix: Any) -> Any:
    """Return the sparse LU factors of a symmetric matrix without pivoting: the diagonal of U has its inertia."""
    return ssl.splu(
        sp.csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


def mac(phi: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the modal assurance criterion between two sets of shapes (Allemang & Brown 1982).

    MAC = |φᵀψ|² / (φᵀφ · ψᵀψ) at the measured coordinates. A shape that is zero there has MAC 0 with all.

    Parameters
    ----------
    phi : ndarray, shape (..., n_coordinates, m)
    reference : ndarray, shape (..., n_coordinates, r)

    Returns
    -------
    ndarray, shape (..., r, m)
    """
    cross = np.swapaxes(reference, -1, -2) @ phi
    size = np.sum(reference**2, axis=-2)[..., :, None] * np.sum(phi**2, axis=-2)[..., None, :]
    return np.divide(cross**2, size, out=np.zeros_like(cross), where=size > 0.0)


class Seen(NamedTuple):
    """Modes of one block as sensors see them.

    Attributes
    ----------
    eigenvalues : ndarray, shape (n, m), (rad/s)²
    shapes : ndarray, shape (n, n_sensors, m), mass-normalised, of either sign
    eigenvalue_slopes : ndarray, shape (n, m, n_parameters), or None
    shape_slopes : ndarray, shape (n, n_sensors, m, n_parameters), or None
    """

    eigenvalues: FloatArray
    shapes: FloatArray
    eigenvalue_slopes: FloatArray | None = None
    shape_slopes: FloatArray | None = None


class FullBlock:
    """One decoupled part of a structure, solved as it stands, a theta at a time.

    Parameters
    ----------
    model : SeparableModel
    dofs : ndarray of int
        The block's degrees of freedom in the model, one of ``model.blocks``.
    """

    def __init__(self, model: SeparableModel, dofs: IntArray) -> None:
        self.dofs = dofs
        self.n_parameters = model.n_parameters
        self.K_terms = _restricted(model.K_terms, dofs)
        self.M_terms = _restricted(model.M_terms, dofs)
        self._K_map = CoefficientMap(self.K_terms)
        self._M_map = CoefficientMap(self.M_terms)
        self.size = self.trusted = len(dofs)

    def modes(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return eigenvalues (n, count) and M-normalised shapes (n, size, count) at theta (n, n_parameters).

        A theta at which the solver fails gives NaN.
        """
        lam = np.full((len(theta), count), np.nan)
        phi = np.full((len(theta), self.size, count), np.nan)
        constant_mass, definite = all(term.constant for term in self.M_terms), False
        K_weights, M_weights = self._K_map(theta), self._M_map(theta)
        for i in range(len(theta)):
            K, M = weighted_sum(self.K_terms, K_weights[i]), weighted_sum(self.M_terms, M_weights[i])
            if not (np.all(np.isfinite(K.data)) and np.all(np.isfinite(M.data))):
                continue
            try:
                lam[i], phi[i] = eigen(K, M, count, definite)
                definite = constant_mass
            except SingularMassError:
                continue
        return lam, phi

    def eigenvalues(self, theta: FloatArray, count: int) -> FloatArray:
        """Return the lowest eigenvalues, shape (n, count)."""
        return self.modes(theta, count)[0]

    def eigenvalue_gradient(self, theta: FloatArray, lam: FloatArray, phi: FloatArray) -> FloatArray:
        """Return ∂λ/∂θ, shape (n, m, n_parameters), for modes from `modes` (Fox & Kapoor 1968, eq. 5).

        ∂λ/∂θ_j = φᵀ (∂K/∂θ_j − λ ∂M/∂θ_j) φ, with φᵀ M φ = 1; for simple eigenvalues.
        """
        gradient = self._K_map.contract(theta, _quadratic_forms(self.K_terms, phi))
        return gradient - lam[..., None] * self._M_map.contract(theta, _quadratic_forms(self.M_terms, phi))

    def needed(self, count: int, gradient: bool) -> int:
        """Return `count`."""
        return count

    def seen(
        self,
        theta: FloatArray,
        count: int,
        rows: Any,
        gradient: bool = False,
        solved: tuple[FloatArray, FloatArray] | None = None,
    ) -> Seen:
        """Return the lowest modes as sensors see them, derivatives by a bordered system a mode."""
        lam, phi = self.modes(theta, count) if solved is None else (solved[0][:, :count], solved[1][:, :, :count])
        shapes = np.stack([rows @ shape for shape in phi]) if len(phi) else np.empty((0, rows.shape[0], count))
        if not gradient:
            return Seen(lam, shapes)
        lam_slopes = np.full((*lam.shape, self.n_parameters), np.nan)
        shape_slopes = np.full((*shapes.shape, self.n_parameters), np.nan)
        for i, point in enumerate(theta):
            if not np.all(np.isfinite(phi[i])):
                continue
            K, dK = self._with_slopes(self.K_terms, self._K_map, point)
            M, dM = self._with_slopes(self.M_terms, self._M_map, point)
            for k in range(count):
                slope, lam_slopes[i, k] = by_bordered_system(
                    K, M, lam[i, k], phi[i, :, k], dK(phi[i, :, k]), dM(phi[i, :, k])
                )
                shape_slopes[i, :, k] = rows @ slope
        return Seen(lam, shapes, lam_slopes, shape_slopes)

    @staticmethod
    def _with_slopes(
        terms: tuple[Term, ...], coefficient: CoefficientMap, theta: FloatArray
    ) -> tuple[Any, Callable[[FloatArray], FloatArray]]:
        """Return a matrix at theta, and what multiplies its derivatives with a shape, (size,) to (size, p)."""
        slopes = coefficient_gradients(terms, theta[None])[0]

        def times(phi: FloatArray) -> FloatArray:
            return np.stack([term.matrix @ phi for term in terms], axis=1) @ slopes

        return weighted_sum(terms, coefficient(theta[None])[0]), times

    def observe(self, rows: Any, reference: FloatArray) -> tuple[Callable[[FloatArray], FloatArray], FloatArray]:
        """Return what takes shapes (n, size, m) to the coordinates `rows`, and the references as they are."""
        if rows.nnz == rows.shape[0] and np.all(rows.data == 1.0) and np.all(np.diff(rows.indptr) == 1):
            return Picked(rows.indices), reference
        return Mapped(rows.toarray()), reference


def _quadratic_forms(terms: tuple[Term, ...], phi: FloatArray) -> FloatArray:
    """Return φᵀ K_k φ, shape (n, n_terms, m), for shapes (n, size, m)."""
    return np.stack(
        [np.stack([np.sum(shape * (term.matrix @ shape), axis=0) for shape in phi]) for term in terms], axis=1
    )


def _restricted(terms: tuple[Term, ...], dofs: IntArray) -> tuple[Term, ...]:
    if len(dofs) == terms[0].matrix.shape[0]:  # a single block: nothing to have, or to send, twice
        restricted = terms
    else:
        restricted = tuple(Term(sp.csr_array(t.matrix[dofs][:, dofs]), t.powers) for t in terms)
    nonzero = tuple(t for t in restricted if abs(t.matrix).max() > 0.0)
    return nonzero or (Term(sp.csr_array((len(dofs), len(dofs))), terms[0].powers),)


def _dense(matrix: Any) -> FloatArray:
    return matrix.toarray() if sp.issparse(matrix) else np.asarray(matrix)
