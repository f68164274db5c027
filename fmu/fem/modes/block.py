"""Decoupled parts of a structure, full or reduced, and the modes of their eigenproblems."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Self

import numpy as np
import scipy.sparse as sp

from fmu.fem.modes.solver import Matrix
from fmu.fem.modes.terms import CoefficientMap, Term
from fmu.types import FloatArray, IntArray

Observation = tuple[Callable[[FloatArray], FloatArray], FloatArray]
"""The map from a block's shapes to the coordinates of comparison, and the reference shapes there."""
Solved = dict[int, tuple[FloatArray, FloatArray]]
"""Eigenvalues and shapes by index of the block."""


class BlockPrediction(NamedTuple):
    """Modes of one block as seen by the sensors.

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


class Block:
    """One decoupled part of a structure: an independent eigenproblem, full or reduced.

    Parameters
    ----------
    dofs : ndarray of int, shape (n,)
        Indices of the block's degrees of freedom in the model.
    K_terms, M_terms : sequence of Term
        Stiffness and mass terms of the block.

    Attributes
    ----------
    size : int
        Number of unknowns of the eigenproblem.
    n_modes, n_trained : int
        Number of modes with a finite frequency, and number of the lowest modes that are accurate.
    is_reduced : bool
        Whether the block approximates a full block.
    massless : bool
        Whether degrees of freedom of the full block have no mass.
    constant_mass : bool
        Whether no parameter changes the mass of the block.
    """

    is_reduced: ClassVar[bool] = False
    size: int
    n_modes: int
    n_trained: int
    massless: bool

    def __init__(self, dofs: IntArray, K_terms: Sequence[Term], M_terms: Sequence[Term]) -> None:
        self.dofs = dofs
        self.n_parameters = len(K_terms[0].powers)
        self._K_map, self._M_map = CoefficientMap(K_terms), CoefficientMap(M_terms)
        self.constant_mass = all(term.constant for term in M_terms)

    def modes(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the lowest eigenvalues (n, count), (rad/s)², and mass-normalised shapes (n, size, count).

        Both belong to theta (n, n_parameters); they are NaN where the solver fails.
        """
        raise NotImplementedError

    def eigenvalues(self, theta: FloatArray, count: int) -> FloatArray:
        """Return the lowest eigenvalues, shape (n, count), (rad/s)²; NaN where the solver fails."""
        return self.modes(theta, count)[0]

    def eigenvalue_gradient(self, theta: FloatArray, lam: FloatArray, phi: FloatArray) -> FloatArray:
        """Return ∂λ/∂θ, shape (n, m, n_parameters), of modes from `modes` (Fox & Kapoor 1968, eq. 5).

        ∂λ/∂θ_j = φᵀ (∂K/∂θ_j − λ ∂M/∂θ_j) φ, with φᵀ M φ = 1; for simple eigenvalues.
        """
        gradient = self._K_map.contract(theta, self._forms(phi, of_mass=False))
        if self.constant_mass:
            return gradient
        return gradient - lam[..., None] * self._M_map.contract(theta, self._forms(phi, of_mass=True))

    def eigenvalue_curvature(
        self, theta: FloatArray, lam: FloatArray, phi: FloatArray, d: FloatArray
    ) -> FloatArray:
        """Return the derivative of the gradient of each eigenvalue along a direction of its own.

        With the derivatives ∂_d along d, of λ, of φ and of the matrices,

        ∂_d(∂λ/∂θ_j) = 2 ∂_dφᵀ (∂K/∂θ_j − λ ∂M/∂θ_j) φ + φᵀ (∂_d∂K/∂θ_j − λ ∂_d∂M/∂θ_j) φ − ∂_dλ φᵀ ∂M/∂θ_j φ.

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        lam, phi : ndarray, shape (n, r) and (n, size, r)
            The result of `modes` for `n_required` modes with derivatives, or more.
        d : ndarray, shape (n, m, n_parameters)
            Directions for the lowest m modes.

        Returns
        -------
        ndarray, shape (n, m, n_parameters)
            H_i d_i, with the matrix H_i of the second derivatives of λ_i. It does not depend on modes whose
            eigenvalues are equal to λ_i (`fmu.fem.modes.derivatives`).
        """
        own, value = phi[:, :, : d.shape[1]], lam[:, : d.shape[1], None]
        dK_phi, dM_phi = (
            self._apply(own, of.along(theta, d), of_mass)
            for of, of_mass in ((self._K_map, False), (self._M_map, True))
        )
        turned = self._shape_slopes_along(theta, lam, phi, dK_phi, dM_phi)
        found = 2.0 * self._K_map.contract(theta, self._forms(own, False, turned))
        found += self._K_map.contract_along(theta, self._forms(own, False), d)
        if self.constant_mass:
            return found
        forms = self._forms(own, of_mass=True)
        found -= value * (
            2.0 * self._M_map.contract(theta, self._forms(own, True, turned))
            + self._M_map.contract_along(theta, forms, d)
        )
        value_slope = np.sum(own * (dK_phi - np.swapaxes(value, 1, 2) * dM_phi), axis=1)[..., None]
        return found - value_slope * self._M_map.contract(theta, forms)

    def _forms(self, phi: FloatArray, of_mass: bool, left: FloatArray | None = None) -> FloatArray:
        """Return the products leftᵀ K_k φ, or leftᵀ M_k φ if `of_mass`, of every term, shape (n, n_terms, m).

        Without `left` (n, size, m) it is φ.
        """
        raise NotImplementedError

    def _apply(self, phi: FloatArray, weights: FloatArray, of_mass: bool) -> FloatArray:
        """Return Σ_k weights[:, k] K_k φ, or Σ_k weights[:, k] M_k φ if `of_mass`, shape (n, size, m).

        The `weights` have the shape (n, n_terms, m).
        """
        raise NotImplementedError

    def _shape_slopes_along(
        self, theta: FloatArray, lam: FloatArray, phi: FloatArray, dK_phi: FloatArray, dM_phi: FloatArray
    ) -> FloatArray:
        """Return the derivatives of shapes along directions, given ∂_dK φ and ∂_dM φ, each (n, size, m)."""
        raise NotImplementedError

    def coarser(self, share: float) -> Self:
        """Return the block reduced to the leading share of its basis; the block itself if it is not reduced."""
        return self

    def coordinates(self, rows: sp.csr_array) -> Matrix:
        """Return sensor rows (n_sensors, n) on degrees of freedom as sensor rows on the block's unknowns."""
        return rows

    def compress_rows(self, rows: Matrix, reference: FloatArray) -> tuple[Matrix, FloatArray]:
        """Return fewer rows, from `coordinates`, and references (_, n_modes) with equal norms and products."""
        return rows, reference

    def observe(self, rows: sp.csr_array, reference: FloatArray) -> Observation:
        """Return the map from shapes (n, size, m) to the coordinates of comparison, and the references there.

        Parameters
        ----------
        rows : sparse, shape (q, n)
            Coordinates of comparison as rows on the block's degrees of freedom.
        reference : ndarray, shape (q, n_modes)
            Reference shapes at the coordinates of comparison.
        """
        raise NotImplementedError

    def n_required(self, count: int, gradient: bool) -> int:
        """Return the number of modes that `seen` needs for `count` modes, with derivatives if `gradient`."""
        return count

    def seen(
        self,
        theta: FloatArray,
        count: int,
        rows: Matrix,
        gradient: bool = False,
        solved: tuple[FloatArray, FloatArray] | None = None,
    ) -> BlockPrediction:
        """Return the lowest `count` modes at the sensors, with derivatives if `gradient`.

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        count : int
        rows : array or sparse, shape (n_sensors, size)
            Sensor rows from `coordinates`.
        gradient : bool
        solved : tuple of ndarray, optional
            Result of `modes` for `n_required` modes or more, if available.
        """
        lam, phi = solved or self.modes(theta, self.n_required(count, gradient))
        seen = BlockPrediction(lam[:, :count], self._at(rows, phi[:, :, :count]))
        if not gradient:
            return seen
        lam_slopes, shape_slopes = self._slopes_seen(theta, count, rows, lam, phi)
        return seen._replace(eigenvalue_slopes=lam_slopes, shape_slopes=shape_slopes)

    def _at(self, rows: Matrix, phi: FloatArray) -> FloatArray:
        """Return the shapes (n, size, m) at the sensors, (n, n_sensors, m)."""
        raise NotImplementedError

    def _slopes_seen(
        self, theta: FloatArray, count: int, rows: Matrix, lam: FloatArray, phi: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return ∂λ (n, count, n_parameters) and ∂φ at the sensors (n, n_sensors, count, n_parameters)."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class Picked:
    """Map from shapes (n, size, m) to some of their degrees of freedom (q,), which other processes can receive."""

    dofs: IntArray

    def __call__(self, phi: FloatArray) -> FloatArray:
        """Return the shapes at these degrees of freedom, (n, q, m)."""
        return phi[:, self.dofs]


@dataclass(frozen=True, eq=False)
class Mapped:
    """Map of shapes (n, size, m) by a matrix (q, size), which other processes can receive."""

    matrix: FloatArray

    def __call__(self, phi: FloatArray) -> FloatArray:
        """Return the product of the matrix and the shapes, (n, q, m)."""
        return self.matrix @ phi
