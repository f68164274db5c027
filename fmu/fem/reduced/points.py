"""Points of a box, for training and for tests of it; bases orthonormal in the mass."""

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
from fmu.types import FloatArray

_MOST_VECTORS = 1000
MEMORY = 2**31
"""Bytes of the trial vectors of a block in training; while they grow they are there twice."""


def affordable(n_dof: int) -> int:
    """Return the largest useful number of basis vectors for a block of `n_dof` degrees of freedom.

    A reduced solve takes about 60 ns · r², more from r = 1000 on, and a sparse full one about 30 µs a degree of
    freedom (results/scale.md): at 12 √n the first is a third of the second. Dense blocks, up to
    `fmu.fem.modes.eigensolver.DENSE_LIMIT`, are solved a theta at a time, which is never faster.
    """
    return n_dof if n_dof <= DENSE_LIMIT else min(int(12.0 * np.sqrt(n_dof)), _MOST_VECTORS)


def most_trial_vectors(n_dof: int) -> int:
    """Return how many vectors training may have for a block: twice what is affordable, and no more than 2 GiB."""
    return n_dof if n_dof <= DENSE_LIMIT else min(2 * affordable(n_dof), n_dof, MEMORY // (8 * n_dof))


@dataclass(frozen=True)
class Trained:
    """A reduced model, the pairing to use with it, and the box that it was trained for.

    Attributes
    ----------
    model : BlockModel
    pairing : IndexPairing, ShapePairing or RankPairing
    lower, upper : ndarray, shape (n_parameters,)
    confirmed : bool
        Whether fresh points of the box were all within the tolerance, those of all candidate modes.
    anchors : mapping of int to Anchors
        The factorised points of each block, where training left them.
    elsewhere : float or None
        The tolerance of the box, where a smaller one was kept in a part of it.
    """

    model: Parts
    pairing: IndexPairing | ShapePairing | RankPairing
    lower: FloatArray
    upper: FloatArray
    confirmed: bool = True
    anchors: Mapping[int, Anchors] = field(default_factory=dict)
    elsewhere: float | None = None


def box_points(lower: FloatArray, upper: FloatArray, n: int, seed: int) -> FloatArray:
    """Return points that cover a box: `n` of a scrambled Sobol sequence, n/2 on its faces, and its corners.

    All corners up to 2⁶, as many at random beyond.
    """
    from scipy.stats import qmc

    ndim = len(lower)
    rng = np.random.default_rng(seed)
    inside = qmc.Sobol(ndim, rng=rng).random(n)
    faces = rng.uniform(size=(n // 2, ndim))
    fixed = rng.integers(0, 3, size=faces.shape)  # per coordinate: lower face, upper face or free
    faces = np.where(fixed == 0, 0.0, np.where(fixed == 1, 1.0, faces))
    if ndim <= 6:
        corners = np.array(np.meshgrid(*[[0.0, 1.0]] * ndim, indexing="ij")).reshape(ndim, -1).T
    else:
        corners = rng.integers(0, 2, size=(64, ndim)).astype(float)
    return lower + (upper - lower) * np.concatenate([inside, faces, corners])


def points_near_zero(lower: FloatArray, upper: FloatArray, n: int, seed: int = 0) -> FloatArray:
    """Return points (m, n_parameters), m ≤ n, of a box, near zero in parameters whose lower bound is zero.

    A stiffness that nearly vanishes has modes that neither the face shows, where
    it is gone, nor points that cover the box evenly.
    """
    rng = np.random.default_rng(n + seed)
    points = lower + (upper - lower) * rng.uniform(size=(n, len(lower)))
    near = (rng.integers(0, 2, size=points.shape) == 1) & (lower == 0.0)
    points = np.where(near, upper * 10.0 ** rng.uniform(-8.0, -1.0, size=points.shape), points)
    return points[near.any(axis=1)]


def mass_orthonormal(block: FullBlock, V: FloatArray, centre: FloatArray) -> FloatArray:
    """Return a basis of the space of V (size, r), orthonormal in the block's mass matrix at `centre`.

    Where degrees of freedom have no mass, in M + K/λ with the mean λ = tr Vᵀ K V / tr Vᵀ M V, as M does not see
    how they follow. SingularAnchorError if M is negative for a motion of the space.
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
