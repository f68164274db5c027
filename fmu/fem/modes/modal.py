"""Modes of K φ = λ M φ, how alike two shapes are, and how eigenvalues move with the parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from fmu.fem.modes.derivatives import by_bordered_system
from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.null_space import DENSE_LIMIT, SingularMassError, rank
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.shape_maps import Mapped, Picked
from fmu.fem.modes.terms import CoefficientMap, Term, WeightedSum, coefficient_gradients, weighted_sum
from fmu.types import BoolArray, FloatArray, IntArray

# An eigenvalue this small beside the highest of interest is that of a rigid-body mode. Where K is singular to the
# last digit it is 0 exactly (`fmu.fem.modes.eigensolver`); matrices exported with ten digits leave more.
RIGID = 1e-9
# Below zero by more than this, beside the largest of a set of eigenvalues, is no rounding. The set is that of the
# measured modes, far below the highest of the structure, to which rounding is relative.
NEGATIVE = 1e-6
# Up to this size a dense solve for a shape's slopes takes less time than a sparse one.
_DENSE_SLOPES = 128


def is_rigid(eigenvalues: FloatArray) -> BoolArray:
    """Say which of the lowest modes of a structure, shape (..., m), move it as a rigid body."""
    return eigenvalues <= RIGID * np.fmax.reduce(eigenvalues, axis=-1, keepdims=True)


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


class BlockPrediction(NamedTuple):
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

    Attributes
    ----------
    n_modes : int
        How many modes have a finite frequency: fewer than `size` where degrees of freedom have no mass.
    """

    is_reduced = False

    def __init__(self, model: SeparableModel, dofs: IntArray) -> None:
        self.dofs = dofs
        self.n_parameters = model.n_parameters
        self.K_terms = _restricted(model.K_terms, dofs)
        self.M_terms = _restricted(model.M_terms, dofs)
        self._K_map = CoefficientMap(self.K_terms)
        self._M_map = CoefficientMap(self.M_terms)
        self.size = len(dofs)
        self.n_modes = self.n_trained = _finite_modes(self.M_terms)
        self.massless = self.n_modes < self.size

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what is prepared when needed."""
        return {name: value for name, value in self.__dict__.items() if name != "_sums"}

    @cached_property
    def _sums(self) -> tuple[WeightedSum, WeightedSum]:
        """What puts K and M together."""
        dense = self.size <= DENSE_LIMIT
        return WeightedSum(self.K_terms, dense), WeightedSum(self.M_terms, dense)

    def _matrices(self, theta: FloatArray) -> Iterator[tuple[Any, Any]]:
        """Give K and M at each theta (n, n_parameters) in turn."""
        K_sum, M_sum = self._sums
        return zip(map(K_sum, self._K_map(theta)), map(M_sum, self._M_map(theta)), strict=True)

    def modes(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return eigenvalues (n, count) and M-normalised shapes (n, size, count) at theta (n, n_parameters).

        A theta at which the solver fails gives NaN.
        """
        lam = np.full((len(theta), count), np.nan)
        phi = np.full((len(theta), self.size, count), np.nan)
        if count == 0:
            return lam, phi
        constant_mass, finite = all(term.constant for term in self.M_terms), None
        for i, (K, M) in enumerate(self._matrices(theta)):
            if not (_is_finite(K) and _is_finite(M)):
                continue
            try:
                if finite is None or not constant_mass:
                    finite = rank(M)
                lam[i], phi[i] = eigen(K, M, count, finite)
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

    def n_required(self, count: int, gradient: bool) -> int:
        """Return `count`."""
        return count

    def seen(
        self,
        theta: FloatArray,
        count: int,
        rows: Any,
        gradient: bool = False,
        solved: tuple[FloatArray, FloatArray] | None = None,
    ) -> BlockPrediction:
        """Return the lowest modes as sensors see them, derivatives by a bordered system a mode."""
        lam, phi = self.modes(theta, count) if solved is None else (solved[0][:, :count], solved[1][:, :, :count])
        shapes = np.stack([rows @ shape for shape in phi]) if len(phi) else np.empty((0, rows.shape[0], count))
        if not gradient:
            return BlockPrediction(lam, shapes)
        lam_slopes = np.full((*lam.shape, self.n_parameters), np.nan)
        shape_slopes = np.full((*shapes.shape, self.n_parameters), np.nan)
        for i, (K, M) in enumerate(self._matrices(theta)):
            if not np.all(np.isfinite(phi[i])):
                continue
            if self.size > _DENSE_SLOPES:
                K, M = sp.csc_array(K), sp.csc_array(M)
            dK, dM = (_slopes_times(terms, theta[i], phi[i]) for terms in (self.K_terms, self.M_terms))
            for k in range(count):
                slope, lam_slopes[i, k] = by_bordered_system(K, M, lam[i, k], phi[i, :, k], dK[k], dM[k])
                shape_slopes[i, :, k] = rows @ slope
        return BlockPrediction(lam, shapes, lam_slopes, shape_slopes)

    def observe(self, rows: Any, reference: FloatArray) -> tuple[Callable[[FloatArray], FloatArray], FloatArray]:
        """Return what takes shapes (n, size, m) to the coordinates `rows`, and the references as they are."""
        if rows.nnz == rows.shape[0] and np.all(rows.data == 1.0) and np.all(np.diff(rows.indptr) == 1):
            return Picked(rows.indices), reference
        return Mapped(rows.toarray()), reference


def _finite_modes(M_terms: tuple[Term, ...]) -> int:
    """Return how many modes of finite frequency a structure has, the rank of M where no term vanishes."""
    total = weighted_sum(M_terms, np.array([1.0 / max(abs(term.matrix).max(), 1e-300) for term in M_terms]))
    try:
        return rank(total)
    except SingularMassError:  # terms that are differences: their sum says nothing, but for what is empty
        empty = np.all([np.diff(term.matrix.indptr) == 0 for term in M_terms], axis=0)
        return int(np.sum(~empty))


def _is_finite(matrix: Any) -> bool:
    return bool(np.all(np.isfinite(matrix.data if sp.issparse(matrix) else matrix)))


def _slopes_times(terms: tuple[Term, ...], theta: FloatArray, phi: FloatArray) -> FloatArray:
    """Return ∂K/∂theta_j φ, shape (m, size, n_parameters), for shapes (size, m)."""
    forms = np.stack([(term.matrix @ phi).T for term in terms], axis=-1)
    return np.asarray(forms @ coefficient_gradients(terms, theta[None])[0])


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
