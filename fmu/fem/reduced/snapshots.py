"""Modes at sampled points of a box, and their compression to a basis by proper orthogonal decomposition."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.modal import RIGID, frequency_hz, is_rigid
from fmu.fem.modes.separable import coefficients, weighted_sum
from fmu.fem.reduced.basis import ReducedBlock
from fmu.types import FloatArray, IntArray

# Directions of the snapshots weaker than this, relative to the strongest, are rounding: the Gram matrix squares.
_SNAPSHOT_RANK = 1e-14
# More shapes than this, of more degrees of freedom than that, are compressed by and by.
MANY_SHAPES, LARGE = 4096, 2000
# Points that are compared at once: what a batch of reduced matrices takes in memory.
AT_ONCE = 16


@dataclass(frozen=True)
class Snapshots:
    """Modes of one block at sampled points: theta (n, p), eigenvalues (n, m) and shapes (n, size, m)."""

    theta: FloatArray
    eigenvalues: FloatArray
    shapes: FloatArray

    @classmethod
    def solve(cls, block: FullBlock, theta: FloatArray, count: int) -> Snapshots:
        """Solve the full block at every theta."""
        return cls(theta, *block.modes(theta, min(count, block.n_modes)))

    @classmethod
    def joined(cls, parts: Sequence[Snapshots]) -> Snapshots:
        """Return the snapshots of all parts."""
        rows = zip(*((part.theta, part.eigenvalues, part.shapes) for part in parts), strict=True)
        return cls(*(np.concatenate(row) for row in rows))

    def __add__(self, other: Snapshots) -> Snapshots:
        """Return the snapshots of both."""
        return Snapshots.joined([self, other])

    def lowest(self, count: int) -> Snapshots:
        """Return the snapshots of the lowest `count` modes alone."""
        return Snapshots(self.theta, self.eigenvalues[:, :count], self.shapes[:, :, :count])

    def rows(self, picked: Any) -> Snapshots:
        """Return the snapshots at some of the points."""
        return Snapshots(self.theta[picked], self.eigenvalues[picked], self.shapes[picked])

    def parts(self, n: int) -> Iterator[Snapshots]:
        """Yield the snapshots at `n` points at a time."""
        return (self.rows(slice(first, first + n)) for first in range(0, len(self.theta), n))

    def largest_error(self, block: ReducedBlock) -> FloatArray:
        """Return the largest `frequency_error` at every point, shape (n,), solving a few at a time."""
        return np.concatenate([np.max(part.frequency_error(block), axis=1) for part in self.parts(AT_ONCE)])

    def frequency_error(self, block: ReducedBlock) -> FloatArray:
        """Return |f_reduced − f| / f, shape (n, m); for a rigid-body mode 0 or infinity: is it one there too."""
        exact, reduced = self.eigenvalues, block.eigenvalues(self.theta, self.eigenvalues.shape[1])
        top = exact[:, -1:]
        rigid = is_rigid(exact)
        error = np.where(reduced <= 10.0 * RIGID * top, 0.0, np.inf)
        f, f_reduced = frequency_hz(exact), frequency_hz(reduced)
        return np.divide(np.abs(f_reduced - f), f, out=error, where=~rigid)


def proper_orthogonal_basis(block: FullBlock, snapshots: Snapshots, centre: FloatArray) -> FloatArray:
    """Return the POD of mode shapes, shape (size, r_max), strongest direction first.

    Orthonormal in the block's mass matrix at `centre` (n_parameters,); where degrees of freedom have no mass, in
    M + K/λ with the highest λ of the snapshots, as M does not see how they follow.

    Notes
    -----
    Each shape is weighted by 1/ω. What a truncated basis leaves out is made of high modes, of some frequency Ω,
    and raises an eigenvalue by Ω²‖e‖²/ω² of itself: with the weight an error of the same size counts the same in
    every relative frequency.
    """
    M = weighted_sum(block.M_terms, coefficients(block.M_terms, centre[None])[0])
    lam = snapshots.eigenvalues
    if block.n_modes < block.size:
        M = M + weighted_sum(block.K_terms, coefficients(block.K_terms, centre[None])[0]) / np.max(lam)
    floor = 1e-6 * lam[:, -1:]
    # without any stiffness every vector is a mode, and none worth a place
    weight = np.divide(1.0, np.sqrt(np.maximum(lam, floor)), out=np.zeros_like(lam), where=floor > 0.0)
    many = lam.size > MANY_SHAPES and block.size > LARGE
    X = _merged(M, snapshots.shapes, weight) if many else _columns(snapshots.shapes, weight)
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


def _columns(shapes: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the shapes (n, size, m) with their weights (n, m) side by side, (size, n · m)."""
    n, size, m = shapes.shape
    X = np.empty((size, n * m))
    for i in range(n):
        np.multiply(shapes[i], weight[i], out=X[:, i * m : (i + 1) * m])
    return X


def _merged(M: Any, shapes: FloatArray, weight: FloatArray) -> FloatArray:
    """Return fewer columns with the same POD, but for what is weaker than `_SNAPSHOT_RANK`.

    A part of the shapes at a time, with the scaled directions of those before it (Himpel, Leibner & Rave 2018,
    *Hierarchical approximate proper orthogonal decomposition*, SIAM J. Sci. Comput. 40, A3267).
    """
    at_once = max(1, MANY_SHAPES // (2 * shapes.shape[2]))
    X = np.empty((shapes.shape[1], 0))
    for first in range(0, len(shapes), at_once):
        part = slice(first, first + at_once)
        X = np.concatenate([X, _columns(shapes[part], weight[part])], axis=1)
        energy, U = np.linalg.eigh(X.T @ (M @ X))
        X = X @ U[:, _strongest(energy)]
    return X


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
    low, high = max(smallest, reduced.n_trained) - 1, reduced.size
    while high - low > 1:
        middle = (low + high) // 2
        if acceptable(reduced.truncated(middle)):
            high = middle
        else:
            low = middle
    return reduced.truncated(high)
