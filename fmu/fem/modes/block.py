"""Interface of a structure's decoupled blocks, full or reduced, and the derivatives of their modes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, NamedTuple, Self

import numpy as np
import scipy.sparse as sp

from fmu.fem.modes.solver import Matrix
from fmu.fem.modes.terms import ParametricMatrix, Term
from fmu.types import FloatArray, IntArray

Observation = tuple[Matrix, FloatArray]
"""A matrix that maps a block's unknowns to comparison coordinates, and the reference shapes there."""
Solved = dict[int, tuple[FloatArray, FloatArray]]
"""Eigenvalues and shapes, keyed by block index."""


class BlockPrediction(NamedTuple):
    """Predicted modes of one block at the sensors.

    Attributes
    ----------
    eigenvalues : ndarray, shape (n, m), (rad/s)²
    shapes : ndarray, shape (n, n_sensors, m), mass-normalised, with arbitrary signs
    eigenvalue_slopes : ndarray, shape (n, m, n_parameters), or None
    shape_slopes : ndarray, shape (n, n_sensors, m, n_parameters), or None
    """

    eigenvalues: FloatArray
    shapes: FloatArray
    eigenvalue_slopes: FloatArray | None = None
    shape_slopes: FloatArray | None = None


class Block:
    """A decoupled block of a structure: an independent eigenproblem, full or reduced.

    Parameters
    ----------
    dofs : ndarray of int, shape (n,)
        The model's degrees of freedom that belong to the block, by index.
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
        Whether the full block's mass matrix is singular, for example because degrees of freedom have no mass.
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
        self._K_map, self._M_map = ParametricMatrix(K_terms), ParametricMatrix(M_terms)
        self.constant_mass = all(term.constant for term in M_terms)

    def modes(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the lowest eigenvalues (n, count), (rad/s)², and mass-normalised shapes (n, size, count).

        Both are NaN where the solver fails. `theta` has shape (n, n_parameters).
        """
        raise NotImplementedError

    def eigenvalues(self, theta: FloatArray, count: int) -> FloatArray:
        """Return the lowest eigenvalues, shape (n, count), (rad/s)², with NaN where the solver fails."""
        return self.modes(theta, count)[0]

    def eigenvalue_gradient(self, theta: FloatArray, lam: FloatArray, phi: FloatArray) -> FloatArray:
        """Return eigenvalue gradients ∂λ/∂θ, (n, m, n_parameters), for modes computed by `modes`.

        ∂λ/∂θ_j = φᵀ (∂K/∂θ_j − λ ∂M/∂θ_j) φ, with φᵀ M φ = 1, for simple eigenvalues (Fox & Kapoor 1968, eq. 5).
        """
        gradient = self._K_map.contract(theta, self._forms(phi, of_mass=False))
        if self.constant_mass:
            return gradient
        return gradient - lam[..., None] * self._M_map.contract(theta, self._forms(phi, of_mass=True))

    def eigenvalue_curvature(
        self, theta: FloatArray, lam: FloatArray, phi: FloatArray, d: FloatArray, slopes: FloatArray | None = None
    ) -> FloatArray:
        """Return the derivative of each eigenvalue's gradient along that mode's direction d.

        Let ∂_d be the derivative along d. Then

        ∂_d(∂λ/∂θ_j) = 2 ∂_dφᵀ (∂K/∂θ_j − λ ∂M/∂θ_j) φ + φᵀ (∂_d∂K/∂θ_j − λ ∂_d∂M/∂θ_j) φ − ∂_dλ φᵀ ∂M/∂θ_j φ.

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        lam, phi : ndarray, shape (n, r) and (n, size, r)
            The result of `modes` for at least ``n_required(m, True)`` modes.
        d : ndarray, shape (n, m, n_parameters)
            Directions for the lowest m modes.
        slopes : ndarray, shape (n, size, m, n_parameters), optional
            ∂φ/∂θ for these modes, if known from `shape_curvature`.

        Returns
        -------
        ndarray, shape (n, m, n_parameters)
            H_i d_i, where H_i is the matrix of second derivatives of λ_i. Rotations of mode i into modes with
            nearly the same eigenvalue are omitted as in `_shape_slopes_along`.
        """
        own, value = phi[:, :, : d.shape[1]], lam[:, : d.shape[1], None]
        dK_phi, dM_phi = (
            self._apply(own, of.along(theta, d), of_mass)
            for of, of_mass in ((self._K_map, False), (self._M_map, True))
        )
        if slopes is None:
            turned = self._shape_slopes_along(theta, lam, phi, dK_phi[..., None], dM_phi[..., None])[..., 0]
        else:
            turned = np.einsum("nsmp,nmp->nsm", slopes, d)
        found = 2.0 * self._K_map.contract(theta, self._forms(own, False, turned))
        if self._K_map.is_curved:
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

    def shape_curvature(
        self, theta: FloatArray, lam: FloatArray, phi: FloatArray, left: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return Σ_j left_jᵀ ∂²φ/∂θ_j∂θ for the lowest m modes, (n, m, n_parameters), and their ∂φ/∂θ.

        With A = K − λM, A_j = ∂A/∂θ_j and φ_j = ∂φ/∂θ_j, the second derivatives solve

        A φ_jk = −(A_j φ_k + A_k φ_j + A_jk φ),
        φᵀM φ_jk = −(φ_jᵀM φ_k + φᵀ∂_jM φ_k + φᵀ∂_kM φ_j + ½ φᵀ∂_jkM φ).

        One adjoint y_j for each left_j is enough for all k: A y_j = left_j − (φᵀleft_j) Mφ, φᵀM y_j = 0. These are
        the equations of a shape derivative with −left_j in place of ∂Kφ. Then left_jᵀφ_jk is y_jᵀ times the right
        side of the first equation plus φᵀleft_j times the right side of the second. As y_jᵀMφ = 0, the second
        derivatives of λ drop out.

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        lam, phi : ndarray
            As in `eigenvalue_curvature`.
        left : ndarray, shape (n, size, m, n_parameters)
            The vectors left_j of each mode. ∂φ/∂θ has this shape too.
        """
        n, size, m, p = left.shape
        own, value = phi[:, :, :m], lam[:, :m, None]
        maps = (self._K_map,) if self.constant_mass else (self._K_map, self._M_map)
        products = [self._products(own, bool(of_mass)) for of_mass in range(len(maps))]
        dK, *dM = (
            of.contract(theta, x.reshape(n, -1, size * m)).reshape(n, size, m, p)
            for of, x in zip(maps, products, strict=True)
        )
        slope = np.einsum("nsm,nsmp->nmp", own, dK - value[:, None] * dM[0] if dM else dK)
        loads_K = np.concatenate([dK, -left], axis=3)
        loads_M = np.concatenate([dM[0], np.zeros(left.shape)], axis=3) if dM else None
        turned, y = np.split(self._shape_slopes_along(theta, lam, phi, loads_K, loads_M), 2, axis=3)
        along = np.einsum("nsm,nsmp->nmp", own, left)  # the part of each left that changes the length of φ
        found, traces = np.zeros((n, m, p)), [self._traces(y, turned, of_mass) for of_mass in (False, True)]
        for of_mass, of in enumerate(maps):
            # Σ_j y_jᵀ (∂_jX φ_k + ∂_kX φ_j + ∂_jkX φ) with X = K, and X = M times −λ
            weights = of.along(theta, y.reshape(n, size * m, p)).reshape(n, -1, size, m)
            of_terms = self._sum_products(weights, bool(of_mass))
            total = np.einsum("nsm,nsmp->nmp", of_terms, turned) + of.contract(theta, traces[of_mass])
            if of.is_curved:
                total += of.contract_twice(theta, np.einsum("nsmp,nksm->nkmp", y, products[of_mass]))
            found += value * total if of_mass else -total
        # the terms with ∂λ, and the terms from the length
        rest = np.einsum("nmp,nsmp->nsm", slope, y) - np.einsum("nmp,nsmp->nsm", along, turned)
        masses = self._M_map.coefficients(theta)
        pulled = self._sum_products(masses[:, :, None, None] * rest[:, None], True)
        by_slope = np.einsum("nk,nkm->nm", masses, traces[1])
        for of_M in dM:
            pulled -= np.einsum("nmp,nsmp->nsm", along, of_M)
            found += np.einsum("nsm,nsmp->nmp", rest, of_M)
            by_slope += np.einsum("nsmp,nsmp->nm", y, of_M)
        found += np.einsum("nsm,nsmp->nmp", pulled, turned)
        found += by_slope[..., None] * slope
        if self._M_map.is_curved:
            forms = np.einsum("nsm,nksm->nkm", own, products[1])
            found -= 0.5 * self._M_map.contract_along(theta, forms, along)
        return found, turned

    def _forms(self, phi: FloatArray, of_mass: bool, left: FloatArray | None = None) -> FloatArray:
        """Return leftᵀ K_k φ for every term k, or leftᵀ M_k φ if `of_mass`, shape (n, n_terms, m).

        `left` has shape (n, size, m) and defaults to φ.
        """
        raise NotImplementedError

    def _apply(self, phi: FloatArray, weights: FloatArray, of_mass: bool) -> FloatArray:
        """Return Σ_k weights[:, k] K_k φ, or Σ_k weights[:, k] M_k φ if `of_mass`, shape (n, size, m).

        The `weights` have shape (n, n_terms, m).
        """
        raise NotImplementedError

    def _products(self, x: FloatArray, of_mass: bool) -> FloatArray:
        """Return K_k x for every term k, or M_k x if `of_mass`, (n, n_terms, size, m), for x (n, size, m)."""
        raise NotImplementedError

    def _sum_products(self, x: FloatArray, of_mass: bool) -> FloatArray:
        """Return Σ_k K_k x_k, or Σ_k M_k x_k if `of_mass`, shape (n, size, m).

        `x` has shape (n, n_terms, size, m).
        """
        raise NotImplementedError

    def _traces(self, left: FloatArray, right: FloatArray, of_mass: bool) -> FloatArray:
        """Return Σ_p left_pᵀ K_k right_p for every term k, or with M_k if `of_mass`, shape (n, n_terms, m).

        `left` and `right` have shape (n, size, m, q), and p runs over their last axis.
        """
        raise NotImplementedError

    def _shape_slopes_along(
        self, theta: FloatArray, lam: FloatArray, phi: FloatArray, dK_phi: FloatArray, dM_phi: FloatArray | None
    ) -> FloatArray:
        """Return the derivatives of the lowest m shapes, each along q directions d, shape (n, size, m, q).

        `dK_phi` and `dM_phi`, of the same shape, are ∂_dK φ and ∂_dM φ; `dM_phi` is None if the mass is constant.
        Rotations between modes whose eigenvalues are closer than `fmu.fem.modes.derivatives.CLOSE` are omitted,
        unless the block is reduced and `massless`.
        """
        raise NotImplementedError

    def coarser(self, share: float) -> Self:
        """Return the block with only a leading share of its reduced basis, or itself if it is not reduced."""
        return self

    def coordinates(self, rows: sp.csr_array) -> Matrix:
        """Convert sensor rows (n_sensors, n) for degrees of freedom to sensor rows for the block's unknowns."""
        return rows

    def compress_rows(self, rows: Matrix, reference: FloatArray) -> tuple[Matrix, FloatArray]:
        """Return fewer sensor rows and reference rows, if possible, with the same inner products.

        `rows`, shape (q, size), come from `coordinates`, and the columns of `reference`, shape (q, m), are
        reference shapes. The inner products of the block's shapes with each other and with the reference shapes
        stay the same, but norms of the reference shapes may decrease. By default, both are returned unchanged.
        """
        return rows, reference

    def observe(self, rows: sp.csr_array, reference: FloatArray) -> Observation:
        """Return the comparison coordinates as rows for the block's unknowns, and the reference shapes there.

        Parameters
        ----------
        rows : sparse, shape (q, n)
            Comparison coordinates as rows for the block's degrees of freedom.
        reference : ndarray, shape (q, m)
            Reference shapes at these coordinates, one per column.
        """
        return self.compress_rows(self.coordinates(rows), reference)

    def n_required(self, count: int, gradient: bool) -> int:
        """Return how many modes `seen` must compute to return `count` modes, with derivatives if `gradient`."""
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
        seen = BlockPrediction(lam[:, :count], shapes_at(rows, phi[:, :, :count]))
        if not gradient:
            return seen
        lam_slopes, shape_slopes = self._slopes_seen(theta, count, rows, lam, phi)
        return seen._replace(eigenvalue_slopes=lam_slopes, shape_slopes=shape_slopes)

    def _slopes_seen(
        self, theta: FloatArray, count: int, rows: Matrix, lam: FloatArray, phi: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of eigenvalues, (n, count, n_parameters), and of mode shapes at the sensors.

        The derivatives of the shapes have shape (n, n_sensors, count, n_parameters).
        """
        raise NotImplementedError


def shapes_at(rows: Matrix, phi: FloatArray) -> FloatArray:
    """Return shapes (n, size, m) at sensors with rows (n_sensors, size), as an array (n, n_sensors, m)."""
    if not sp.issparse(rows):
        return np.asarray(rows @ phi)
    # a sparse matrix multiplies the shapes of one theta at a time
    return np.stack([rows @ of for of in phi]) if len(phi) else np.empty((0, rows.shape[0], phi.shape[2]))
