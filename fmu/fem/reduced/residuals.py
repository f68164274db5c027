"""Bounds of the errors of a reduced model's modes, by their residuals.

Let (μ, u) be a Ritz pair, uᵀ M u = 1, and r = K u − μ M u its residual. With A = K + s M, σ = μ + s and T = A⁻¹
M, which is selfadjoint in the inner product of A, split the space into the Ritz vectors and what is A-orthogonal
to all trial vectors, on which T ≤ β. The highest eigenvalues 1/σ of T are at most those of

    diag(1/σ_i) + D G D,    G_ij = r_iᵀ A⁻¹ r_j / (σ_i σ_j)^(3/2),    D_ii = (1/σ_i − β)^(−1/2),

up to terms of second order in G. Of a single mode far from the others that is the relative error ‖r‖²_{A⁻¹} / (σ
(1 − σ β)) of σ (Horger, Wohlmuth & Dickopf 2017, *ESAIM: Math. Model. Numer. Anal.* 51, 443–465, with β of the
next mode); the matrix serves close and repeated modes as well.

Proven, for positive semidefinite terms: A ≥ α Ā at an anchor (`fmu.fem.reduced.anchors`), so that the form r_iᵀ
A⁻¹ r_j is at most 1/α that of Ā⁻¹. Estimated: what T is like on the rest of the space. The error's direction is
w = Ā⁻¹ r, which is Ā-orthogonal to the trial vectors, as r is orthogonal to them. Its Rayleigh quotient wᵀ M w /
(α wᵀ Ā w), times σ, is the mean x < 1 of the spectrum there. For its upper end b the larger of √x and σ_i/σ_j is
taken, where j is the lowest mode that the trial vectors do not know, estimated by the modes at the anchors: a
convex function of a spectrum in [0, b] with mean x is at most 1/(1 − σ T) → 1 + x/(1 − b) (Edmundson and
Madansky). Were a mode among those needed unknown to the space, no residual would show it: training counts the
modes at some points by Sylvester's law of inertia.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import InitVar, dataclass
from typing import NamedTuple

import numpy as np

from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.modal import RIGID, BlockModel, ModalSolution
from fmu.fem.modes.solver import Matrix, factorise
from fmu.fem.reduced.anchors import Anchors, Far
from fmu.fem.reduced.basis import Parts
from fmu.fem.reduced.space import Space
from fmu.types import FloatArray

BUDGET = 2**28
"""Bytes of a dense array of vectors of all degrees of freedom, wherever training needs many."""


AHEAD = 3
"""Modes above those that are bounded that are looked at."""
# A mode is in the trial vectors if its λ there is no more than this times the one by the anchors' modes.
_KNOWN = 1.1


class Bounded(NamedTuple):
    """Modes of a reduced model at n points, and how far off they may be.

    Attributes
    ----------
    eigenvalues : ndarray, shape (n, m)
    y : ndarray, shape (n, r, m)
        M-normalised, in the trial vectors.
    error : ndarray, shape (n, m)
        Bound of the relative error of the frequency; infinite where there is none.
    corrections : ndarray, shape (n_dof, n, m)
        w / √σ: half their energy in Ā is about the error.
    """

    eigenvalues: FloatArray
    y: FloatArray
    error: FloatArray
    corrections: FloatArray


def bound_errors(space: Space, anchors: Anchors, theta: FloatArray, count: int) -> Bounded:
    """Return the lowest `count` modes at theta (n, p) and bounds of their errors; NaN where the solver fails."""
    known = anchors.modes(count)
    wanted = min(known.size, space.size, count + AHEAD)
    lam, y = space.modes(theta, wanted)
    rest = _lowest_of_the_rest(lam, known.modes(theta, wanted)[0], count) + space.shift
    lam, y = lam[:, :count], y[:, :, :count]
    n_dof, n = space.block.size, len(theta)
    best, alpha = anchors.nearest(theta, space)
    sigma = lam + space.shift
    R = np.empty((n_dof, n, count), order="F")
    for i, (K, M) in enumerate(space.block._matrices(theta)):
        U = space.V @ y[i]
        R[:, i] = K @ U - (M @ U) * lam[i]
    W, G, mass = np.empty_like(R), np.empty((n, count, count)), np.empty((n, count))
    for a in np.unique(best):
        rows = np.flatnonzero(best == a)
        W[:, rows] = anchors.factor(int(a)).solve(R[:, rows].reshape(n_dof, -1)).reshape(n_dof, -1, count)
    for i, M in enumerate(space.block._masses(theta)):
        G[i] = R[:, i].T @ W[:, i]
        mass[i] = np.sum(W[:, i] * (M @ W[:, i]), axis=0)
    error = frequency_error(lam, space.shift, G, mass, alpha, rest)
    W /= np.sqrt(np.abs(sigma))
    return Bounded(lam, y, error, W)


def _lowest_of_the_rest(lam: FloatArray, known: FloatArray, count: int) -> FloatArray:
    """Return the lowest λ (n,) that the trial vectors do not know, for Ritz values in them and in known vectors.

    Of those after the first `count`, in the order of (n, m); infinite where there is none.
    """
    if lam.shape[1] == count:
        return np.full(len(lam), np.inf)
    missing = ~(lam[:, count:] <= _KNOWN * known[:, count:])
    missing[:, -1] = True
    return known[np.arange(len(lam)), count + np.argmax(missing, axis=1)]


def frequency_error(
    lam: FloatArray, shift: float, G: FloatArray, mass: FloatArray, alpha: FloatArray, rest: FloatArray
) -> FloatArray:
    """Return the bound of the relative error of every frequency, shape (n, m).

    Parameters
    ----------
    lam : ndarray, shape (n, m)
        Ritz values μ.
    shift : float
        s.
    G : ndarray, shape (n, m, m)
        r_iᵀ Ā⁻¹ r_j.
    mass : ndarray, shape (n, m)
        wᵀ M w.
    alpha : ndarray, shape (n,)
    rest : ndarray, shape (n,)
        The lowest σ of what is not in the trial vectors; infinite where nothing is known of it.
    """
    sigma = lam + shift
    with np.errstate(all="ignore"):
        alpha = np.where(alpha > 0.0, alpha, np.nan)[:, None]
        weight = 1.0 / np.sqrt(sigma * alpha)
        relative = weight[:, :, None] * G * weight[:, None, :]
        energy = np.maximum(np.einsum("nii->ni", relative), 0.0)
        blind = np.where(energy > 0.0, mass / (alpha**2 * energy), 0.0)
        end = np.maximum(np.sqrt(blind), sigma / rest[:, None])
        factor = np.where(end < 1.0, 1.0 + blind / (1.0 - end), np.inf)
        # an eigenvalue lies no further away than the residual (Weinstein), whatever else is near
        factor = np.where(energy > 0.0, np.fmin(factor, 1.0 / np.sqrt(energy)), 1.0)
        relative *= np.sqrt(factor[:, :, None] * factor[:, None, :])
        known = np.isfinite(relative).all(axis=(1, 2)) & (sigma > 0.0).all(axis=1)
        gain = np.full(lam.shape, np.inf)
        gain[known] = _gain(1.0 / sigma[known], relative[known])
        drop = np.where(np.isfinite(gain), sigma * gain / (1.0 + gain), sigma)
        error = 1.0 / np.sqrt(np.maximum(1.0 - drop / lam, 0.0)) - 1.0
        rigid = np.abs(lam) <= 10.0 * RIGID * lam[:, -1:]
        error = np.where(rigid, 0.0, error)
    return np.where(known[:, None] & ~np.isnan(error), error, np.inf)


def _gain(nu: FloatArray, relative: FloatArray) -> FloatArray:
    """Return by what share the eigenvalues ν (n, m), descending, rise with √ν_i ν_j relative_ij added."""
    size = np.sqrt(nu)
    B = size[:, :, None] * relative * size[:, None, :]
    added = B.copy()
    added[:, np.arange(nu.shape[1]), np.arange(nu.shape[1])] += nu
    values = np.linalg.eigvalsh(added)[:, ::-1]
    # a small rise is lost in the digits of ν; for modes apart it is the diagonal
    return np.maximum(values / nu - 1.0, np.einsum("nii->ni", relative))


@dataclass(eq=False)
class FrequencyBound:
    """Bounds of the frequencies of a trained model at any point of its box, a right-hand side a mode.

    Parameters
    ----------
    full, reduced : BlockModel
    lower, upper : ndarray, shape (n_parameters,)
        The box.
    anchors : mapping of int to Anchors
        Those of blocks for which they are there already.
    """

    full: BlockModel[FullBlock]
    reduced: Parts
    lower: FloatArray
    upper: FloatArray
    anchors: InitVar[Mapping[int, Anchors]]

    def __post_init__(self, anchors: Mapping[int, Anchors]) -> None:
        self._anchors = dict(anchors)

    def __call__(self, theta: FloatArray, modes: ModalSolution) -> FloatArray:
        """Return the bound of the relative error of every frequency, shape (n, m), for modes at theta (n, p)."""
        error = np.full(modes.rank.shape, np.inf)
        for b in np.unique(modes.block):
            row, column = np.nonzero(modes.block == b)
            rank = modes.rank[row, column]
            error[row, column] = self._of_block(int(b), theta, int(rank.max()) + 1)[row, rank]
        return error

    def find_far(self, theta: FloatArray, counts: Mapping[int, int], tolerance: float) -> Far | None:
        """Return where errors of so many modes of each block are not bounded to a tolerance, of theta (n, p).

        There is no anchor near; None if there is no such place.
        """
        for b, count in counts.items():
            space, anchors = self.trial(b)
            far = anchors.far(theta, space)
            if far and not np.all(bound_errors(space, anchors, far.theta[None], count).error <= tolerance):
                return far
        return None

    def trial(self, b: int) -> tuple[Space, Anchors]:
        """Return the space of the reduced block `b`, and its anchors, which are factorised at the first call."""
        if b not in self._anchors:
            self._anchors[b] = Anchors(self.full[b], self.lower, self.upper)
        anchors, reduced = self._anchors[b], self.reduced[b]
        assert reduced.is_reduced  # narrowed for the type checker
        return Space.of(reduced, anchors.block, anchors.shift), anchors

    def _of_block(self, b: int, theta: FloatArray, count: int) -> FloatArray:
        full, reduced = self.full[b], self.reduced[b]
        if not reduced.is_reduced or reduced.size == full.size:
            return np.zeros((len(theta), count))
        space, anchors = self.trial(b)
        step = at_once(full, count)
        parts = [theta[first : first + step] for first in range(0, len(theta), step)]
        return np.concatenate([bound_errors(space, anchors, part, count).error for part in parts])


def inertia_agrees(K: Matrix, M: Matrix, lam: FloatArray, first: int, last: int | None = None) -> bool | None:
    """Say whether K − σ M has as many negative eigenvalues as there are λ (m,) below σ; None if it is singular.

    By Sylvester's law no mode is then missing among them. σ lies in the widest gap after the λ with the numbers
    `first`, from 0, to `last`.
    """
    gap = lam[1:] / np.maximum(lam[:-1], RIGID * lam[-1])
    below = first + int(np.argmax(gap[first:last])) + 1
    sigma = 0.5 * (lam[below - 1] + lam[below])
    try:
        return factorise(K - sigma * M, is_definite=False).negative == below
    except np.linalg.LinAlgError:
        return None


def at_once(block: FullBlock, count: int) -> int:
    """Return at how many points the corrections of `count` modes keep to `BUDGET`."""
    return int(np.clip(BUDGET // (8 * 3 * block.size * count), 1, 16))
