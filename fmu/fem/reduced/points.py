"""Points in a box for training and verification, basis sizes, and mass-orthonormal bases."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fmu.fem.modes.eigensolver import DENSE_LIMIT
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.terms import sum_at
from fmu.fem.pairing.rules import IndexPairing, RankPairing, ShapePairing
from fmu.fem.reduced.anchors import Anchors, SingularAnchorError
from fmu.fem.reduced.basis import Parts
from fmu.fem.reduced.residuals import FrequencyBound
from fmu.fem.reduced.shared import SharedResiduals
from fmu.types import FloatArray

_MOST_VECTORS = 1000
MEMORY = 2**31
"""Memory limit for a block's trial vectors in training, in bytes. While the space grows, two copies exist."""


def affordable(n_dof: int) -> int:
    """Return the largest useful number of basis vectors for a block with `n_dof` degrees of freedom.

    A reduced solve with r vectors takes about 60 ns · r², and more from r = 1000 on. A sparse solve of the full
    block takes about 30 µs per degree of freedom (results/scale.md), three times as long as a reduced solve with
    r = 12 √n_dof. The result is therefore 12 √n_dof, but at most 1000. A block with at most
    `fmu.fem.modes.eigensolver.DENSE_LIMIT` degrees of freedom may have all vectors, because a batch of reduced
    solves never takes longer than the full solves.
    """
    return n_dof if n_dof <= DENSE_LIMIT else min(int(12.0 * np.sqrt(n_dof)), _MOST_VECTORS)


def most_trial_vectors(n_dof: int) -> int:
    """Return the largest number of trial vectors for a block with `n_dof` degrees of freedom.

    It is twice `affordable`, but at most `n_dof`, and the vectors take at most 2 GiB of memory. A block with at
    most `fmu.fem.modes.eigensolver.DENSE_LIMIT` degrees of freedom may have all vectors.
    """
    return n_dof if n_dof <= DENSE_LIMIT else min(2 * affordable(n_dof), n_dof, MEMORY // (8 * n_dof))


@dataclass(frozen=True)
class Trained:
    """A reduced model, the pairing to use with it, and the box for which it was trained.

    Attributes
    ----------
    blocks : tuple of Block
        Blocks of the reduced model.
    pairing : IndexPairing, ShapePairing or RankPairing
        Rule that pairs its modes with the measured modes.
    lower, upper : ndarray, shape (n_parameters,)
        Bounds of the box.
    confirmed : bool
        False if training ended without success (`Training.run`, `Training.narrow`). True also for a model that was
        restored, or trained only at given points.
    anchors : mapping of int to Anchors
        Anchor points of each block, keyed by block index, if training used any.
    elsewhere : float or None
        Tolerance for the whole box if a smaller tolerance applies to part of it; otherwise None.
    shared : mapping of int to SharedResiduals or None
        Residuals of large blocks, keyed by block index.
    """

    blocks: Parts
    pairing: IndexPairing | ShapePairing | RankPairing
    lower: FloatArray
    upper: FloatArray
    confirmed: bool = True
    anchors: Mapping[int, Anchors] = field(default_factory=dict)
    elsewhere: float | None = None
    shared: Mapping[int, SharedResiduals | None] = field(default_factory=dict)

    def bound(self, full: tuple[FullBlock, ...]) -> FrequencyBound:
        """Return the object that bounds the frequency errors. `full` contains the blocks before reduction."""
        return FrequencyBound(full, self.blocks, self.lower, self.upper, self.anchors, self.shared)


def box_points(lower: FloatArray, upper: FloatArray, n: int, seed: int) -> FloatArray:
    """Return points (m, ndim) in a box: `n` from a scrambled Sobol sequence, n/2 mostly on faces, and the corners.

    If there are more than six parameters, 64 random corners replace the full set.
    """
    from scipy.stats import qmc

    ndim = len(lower)
    rng = np.random.default_rng(seed)
    inside = qmc.Sobol(ndim, rng=rng).random(n)
    faces = rng.uniform(size=(n // 2, ndim))
    fixed = rng.integers(0, 3, size=faces.shape)  # for each coordinate: on the lower face, upper face or free
    faces = np.where(fixed == 0, 0.0, np.where(fixed == 1, 1.0, faces))
    if ndim <= 6:
        corners = np.array(np.meshgrid(*[[0.0, 1.0]] * ndim, indexing="ij")).reshape(ndim, -1).T
    else:
        corners = rng.integers(0, 2, size=(64, ndim)).astype(float)
    return lower + (upper - lower) * np.concatenate([inside, faces, corners])


def points_near_zero(lower: FloatArray, upper: FloatArray, n: int, seed: int = 0) -> FloatArray:
    """Return up to `n` points (m, n_parameters) in a box, each with some parameters near zero.

    Only parameters whose lower bound is zero are set near zero. If no lower bound is zero, the result is empty.
    If a stiffness nearly vanishes, the structure has modes that do not exist where this stiffness is exactly zero,
    on the face of the box. Points that cover the box evenly miss these modes too.
    """
    rng = np.random.default_rng(n + seed)
    points = lower + (upper - lower) * rng.uniform(size=(n, len(lower)))
    near = (rng.integers(0, 2, size=points.shape) == 1) & (lower == 0.0)
    points = np.where(near, upper * 10.0 ** rng.uniform(-8.0, -1.0, size=points.shape), points)
    return points[near.any(axis=1)]


def mass_orthonormal(block: FullBlock, V: FloatArray, centre: FloatArray) -> FloatArray:
    """Return a basis of the span of V (size, r), orthonormal in the block's mass matrix at `centre`.

    If degrees of freedom have no mass, M is singular. The basis is then orthonormal in M + K/λ, with the mean
    λ = tr Vᵀ K V / tr Vᵀ M V. Raise SingularAnchorError if M is not positive definite in the space.
    """
    K, M = (sum_at(terms, centre) for terms in (block.K_terms, block.M_terms))
    if block.n_modes < block.size:
        M = M + K * (np.sum(V * (M @ V)) / np.sum(V * (K @ V)))
    for _ in range(2):  # Cholesky–QR, twice against rounding
        size = np.sum(V * (M @ V), axis=0)
        try:
            V = V / np.sqrt(np.where(size > 0.0, size, 1.0))
            V = np.linalg.solve(np.linalg.cholesky(V.T @ (M @ V)), V.T).T
        except np.linalg.LinAlgError:
            raise SingularAnchorError("M is not positive for every motion") from None
    return V
