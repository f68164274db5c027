"""Error bounds for a reduced model's modes, computed from their residuals.

Let (μ, u) be a Ritz pair, uᵀ M u = 1, and r = K u − μ M u its residual. Let A = K + s M with a shift s, σ = μ + s
and T = A⁻¹ M, which is self-adjoint in the inner product of A. Split the space into the span of the Ritz vectors
and the A-orthogonal complement of all trial vectors, on which T ≤ β. The highest eigenvalues of T are at most the
eigenvalues of the matrix

    diag(1/σ_i) + D G D,    G_ij = r_iᵀ A⁻¹ r_j / (σ_i σ_j)^(3/2),    D_ii = (1/σ_i − β)^(−1/2),

up to terms of second order in G. For a single mode far from all other modes, this gives the relative error
‖r‖²_{A⁻¹} / (σ (1 − σ β)) of σ (Horger, Wohlmuth & Dickopf 2017, *ESAIM: Math. Model. Numer. Anal.* 51, 443–465,
with β = 1/σ of the next mode). The matrix bound also holds for close and repeated modes.

Let Ā be A at an anchor point. If all terms are positive semidefinite, it is proven that A ≥ α Ā
(`fmu.fem.reduced.anchors`). The form r_iᵀ A⁻¹ r_j is then at most r_iᵀ Ā⁻¹ r_j / α.

The spectrum of σ T on the complement is estimated. The direction of the error is w = Ā⁻¹ r, which is Ā-orthogonal
to the trial vectors, because r is orthogonal to them. The mean x < 1 of the spectrum is taken as σ times the
Rayleigh quotient wᵀ M w / (α wᵀ Ā w). The upper end b of the spectrum is taken as the larger of √x and σ_i/σ_j,
where j is the lowest mode that the trial vectors do not represent; σ_j is estimated from the modes at the anchor
points. The mean of the convex function 1/(1 − σ T) of a spectrum in [0, b] with mean x is at most 1 + x/(1 − b)
(Edmundson and Madansky).

The matrix contains only the modes whose errors are bounded. The Ritz vectors above them have larger errors and are
coupled to the same complement, which this choice of b neglects. In one case, the last bounded mode of a chain with
uncertain masses, an error of 7e-9 was 0.4 % above its bound. With m bounded modes, b = σ_i/σ_{m+1} would be an
upper end for all directions.

If a needed mode were missing from the space, no residual would show it. Training therefore counts the modes at
some points by Sylvester's law of inertia.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import InitVar, dataclass, field
from typing import NamedTuple

import numpy as np

from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.modal import RIGID, ModalSolution
from fmu.fem.modes.solver import Matrix, factorise
from fmu.fem.reduced.anchors import Anchors, Far
from fmu.fem.reduced.basis import Parts
from fmu.fem.reduced.shared import SharedResiduals
from fmu.fem.reduced.space import Space
from fmu.types import BoolArray, FloatArray, IntArray

BUDGET = 2**28
"""Memory limit in bytes for dense arrays of full-length vectors in training."""


AHEAD = 3
"""Number of modes that are computed in addition to the bounded ones."""
# The trial vectors represent a mode if its λ in them is at most this times its λ in the anchors' modes.
_KNOWN = 1.1


class Bounded(NamedTuple):
    """A reduced model's modes at n points, with error bounds.

    Attributes
    ----------
    eigenvalues : ndarray, shape (n, m)
        Eigenvalues λ in (rad/s)².
    y : ndarray, shape (n, r, m)
        M-normalised shapes, as coefficients of the trial vectors.
    error : ndarray, shape (n, m)
        Bound on the relative frequency error; infinite where no bound is known.
    corrections : callable
        Maps a mask (n, m) of q modes to the vectors w / √σ, shape (n_dof, q), with the symbols of the module. Half
        the energy of each vector in Ā is about the error of its mode.
    """

    eigenvalues: FloatArray
    y: FloatArray
    error: FloatArray
    corrections: Callable[[BoolArray], FloatArray]


def bound_errors(
    space: Space, anchors: Anchors, theta: FloatArray, count: int, shared: SharedResiduals | None = None
) -> Bounded:
    """Return the lowest `count` modes at theta (n, p) and their error bounds.

    Where the solver fails, the modes are NaN and the bounds infinite. If the space's residuals are given in
    `shared`, no linear system is solved.
    """
    known = anchors.modes(count)
    wanted = min(known.size, space.size, count + AHEAD)
    lam, y = space.modes(theta, wanted)
    rest = _lowest_of_the_rest(lam, known.modes(theta, wanted)[0], count) + space.shift
    lam, y = lam[:, :count], y[:, :, :count]
    best, alpha = anchors.nearest(theta, space)
    sigma = lam + space.shift
    if shared is not None:
        z = shared.coefficients(theta, lam, y)
        error = frequency_error(lam, space.shift, *shared.forms(theta, z), alpha, rest)
        z = (z / np.sqrt(np.abs(sigma))[:, None]).swapaxes(1, 2)
        return Bounded(lam, y, error, lambda of: shared.corrections(z[of].T))
    W, G, mass = _solve_residuals(space, anchors, theta, best, lam, y)
    error = frequency_error(lam, space.shift, G, mass, alpha, rest)
    W /= np.sqrt(np.abs(sigma))
    return Bounded(lam, y, error, lambda of: W[:, of])


def _solve_residuals(
    space: Space, anchors: Anchors, theta: FloatArray, best: IntArray, lam: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the corrections w = Ā⁻¹ r, shape (n_dof, n, m), the products rᵢᵀ wⱼ, (n, m, m), and wᵀ M w, (n, m).

    r is the residual of a mode with λ in `lam` (n, m) and shape V y. `best` (n,) is the index of the anchor point
    used at each theta.
    """
    n_dof, (n, count) = space.block.size, lam.shape
    R = np.empty((n_dof, n, count), order="F")
    for i, (K, M) in enumerate(space.block._matrices(theta)):
        U = space.V @ y[i]
        R[:, i] = K @ U - (M @ U) * lam[i]
    W, G, mass = np.empty_like(R), np.empty((n, count, count)), np.empty((n, count))
    for a in np.unique(best):
        rows = np.flatnonzero(best == a)
        W[:, rows] = anchors.solve(int(a), R[:, rows].reshape(n_dof, -1)).reshape(n_dof, -1, count)
    for i, M in enumerate(space.block._masses(theta)):
        G[i] = R[:, i].T @ W[:, i]
        mass[i] = np.sum(W[:, i] * (M @ W[:, i]), axis=0)
    return W, G, mass


def _lowest_of_the_rest(lam: FloatArray, known: FloatArray, count: int) -> FloatArray:
    """Return the lowest λ (n,), beyond the first `count` modes, of a mode that the trial vectors do not represent.

    The modes are compared by rank: `lam` (n, m) are their Ritz values in the trial vectors, and `known` (n, m) in
    the space of the modes at the anchor points. If all modes but the last are represented, the last one is
    returned. The result is infinite if m = `count`.
    """
    if lam.shape[1] == count:
        return np.full(len(lam), np.inf)
    missing = ~(lam[:, count:] <= _KNOWN * known[:, count:])
    missing[:, -1] = True
    return known[np.arange(len(lam)), count + np.argmax(missing, axis=1)]


def frequency_error(
    lam: FloatArray, shift: float, G: FloatArray, mass: FloatArray, alpha: FloatArray, rest: FloatArray
) -> FloatArray:
    """Return bounds on the relative errors of the frequencies, shape (n, m).

    A bound is 0 for a rigid-body mode, and infinite where none is known. The symbols are those of the module.

    Parameters
    ----------
    lam : ndarray, shape (n, m)
        Ritz values μ.
    shift : float
        The shift s.
    G : ndarray, shape (n, m, m)
        The forms r_iᵀ Ā⁻¹ r_j.
    mass : ndarray, shape (n, m)
        The forms wᵀ M w.
    alpha : ndarray, shape (n,)
        The factors α in A ≥ α Ā; there is no bound where α is not positive.
    rest : ndarray, shape (n,)
        The lowest σ of a mode that the trial vectors do not represent; infinite where it is unknown.
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
        # the residual bounds the distance to the nearest eigenvalue (Weinstein), even if modes are close
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
    """Return the relative increases (n, m) of the eigenvalues of diag(ν), ν (n, m) descending, when B is added.

    B has the elements √(ν_i ν_j) relative_ij. An increase is at least the diagonal element of `relative`.
    """
    size = np.sqrt(nu)
    B = size[:, :, None] * relative * size[:, None, :]
    added = B.copy()
    added[:, np.arange(nu.shape[1]), np.arange(nu.shape[1])] += nu
    values = np.linalg.eigvalsh(added)[:, ::-1]
    # a small increase is lost in rounding; for well-separated modes it is the diagonal of `relative`
    return np.maximum(values / nu - 1.0, np.einsum("nii->ni", relative))


@dataclass(eq=False)
class FrequencyBound:
    """Error bounds for a trained model's frequencies at any point in its box.

    They cost at most one linear solve per mode and point. Missing anchor points are computed at the first call.

    Parameters
    ----------
    full, reduced : tuple of Block
    lower, upper : ndarray, shape (n_parameters,)
        Bounds of the box.
    anchors : mapping of int to Anchors
        Existing anchor points, keyed by block index; missing ones are computed when they are needed.
    shared : mapping of int to SharedResiduals or None, optional
        Residuals of reduced blocks, keyed by block index. If they are missing, each residual needs its own solve.
    """

    full: tuple[FullBlock, ...]
    reduced: Parts
    lower: FloatArray
    upper: FloatArray
    anchors: InitVar[Mapping[int, Anchors]]
    shared: Mapping[int, SharedResiduals | None] = field(default_factory=dict)

    def __post_init__(self, anchors: Mapping[int, Anchors]) -> None:
        self._anchors = dict(anchors)

    def __call__(self, theta: FloatArray, modes: ModalSolution) -> FloatArray:
        """Return bounds on the relative frequency errors, shape (n, m), for modes at theta (n, p).

        They are 0 in blocks that are not reduced or whose basis is complete, and infinite where no bound is known.
        """
        error = np.full(modes.rank.shape, np.inf)
        for b in np.unique(modes.block):
            row, column = np.nonzero(modes.block == b)
            rank = modes.rank[row, column]
            error[row, column] = self._of_block(int(b), theta, int(rank.max()) + 1)[row, rank]
        return error

    def find_far(self, theta: FloatArray, counts: Mapping[int, int], tolerance: float) -> Far | None:
        """Return the point in theta (n, p) farthest from a block's anchor points, if error bounds are poor there.

        The reduced blocks in `counts` are tried in turn: the bounds of the lowest ``counts[b]`` modes at the
        farthest point of block b are compared with `tolerance`. Return None if, in every block, no point is far or
        the bounds are small enough.
        """
        for b, count in counts.items():
            space, anchors = self.trial(b)
            far = anchors.far(theta, space)
            if far and not np.all(self._of_block(b, far.theta[None], count) <= tolerance):
                return far
        return None

    def trial(self, b: int) -> tuple[Space, Anchors]:
        """Return the trial space of reduced block `b`, and its anchor points.

        If training stored no anchor points for the block, they are chosen and factorised at the first call.
        """
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
        shared = self.shared.get(b)
        return np.concatenate([bound_errors(space, anchors, part, count, shared).error for part in parts])


def inertia_agrees(K: Matrix, M: Matrix, lam: FloatArray, first: int, last: int | None = None) -> bool | None:
    """Return True if K − σ M has as many negative eigenvalues as there are λ (m,) below σ, otherwise False.

    If the numbers agree, no mode below σ is missing (Sylvester's law). Return None if the matrix is singular. σ
    lies above one of the λ with indices `first` to `last` − 1 (to the end if `last` is None), in the gap with the
    largest ratio between its two λ.
    """
    gap = lam[1:] / np.maximum(lam[:-1], RIGID * lam[-1])
    below = first + int(np.argmax(gap[first:last])) + 1
    sigma = 0.5 * (lam[below - 1] + lam[below])
    try:
        return factorise(K - sigma * M, is_definite=False).negative == below
    except np.linalg.LinAlgError:
        return None


def at_once(block: FullBlock, count: int) -> int:
    """Return the number of points, 1 to 16, whose corrections for `count` modes fit within `BUDGET`."""
    return int(np.clip(BUDGET // (8 * 3 * block.size * count), 1, 16))
