"""The trial space of one block: it grows by what the residuals of its modes ask for, and is cut at the end.

A correction w = Ā⁻¹ r is a step of Davidson's method (1975, *J. Comput. Phys.* 17, 87–94) that all points of the
box share, since one factorisation serves them all. Those of a few points are compressed by proper orthogonal
decomposition in the inner product of Ā before they join the space. In that inner product the energy of an error
is the relative error of an eigenvalue.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.modal import RIGID, Mapped
from fmu.fem.modes.solver import factorised
from fmu.fem.reduced.anchors import Anchors
from fmu.fem.reduced.basis import compressed
from fmu.fem.reduced.residuals import at_once, bounded
from fmu.fem.reduced.space import Space
from fmu.types import BoolArray, FloatArray

# A step of Davidson's method leaves about this share of an error: what is smaller need not be added.
_STEP = 0.05
# Of a tolerance: the space grows where an error exceeds the first share, and may have the second before it is cut.
GROWN, SHARE = 0.25, 0.45
# Of the tolerance: energy left out of the cut that no frequency feels.
_NEGLIGIBLE = 0.02
# Points that the cut is tuned at; all others are checked.
_TUNED = 24


class Learner:
    """The trial space of one block as it grows.

    Parameters
    ----------
    block : FullBlock
    lower, upper : ndarray, shape (n_parameters,)
    count : int
        Modes that may be needed.
    largest : int
        Most vectors that the space may have.

    Attributes
    ----------
    space : Space
    anchors : Anchors
    theta : ndarray, shape (n, n_parameters)
        Points visited so far.
    share : ndarray, shape (n,)
        What is allowed there, as a share of the tolerance.
    """

    def __init__(self, block: FullBlock, lower: FloatArray, upper: FloatArray, count: int, largest: int) -> None:
        self.block, self.count, self.largest = block, count, largest
        self.dofs, self.n_modes = block.dofs, block.n_modes
        self.anchors = Anchors(block, lower, upper)
        self.space = self.anchors.modes(count)
        self.theta, self.share = np.empty((0, len(lower))), np.empty(0)
        self._solved: tuple[Space, FloatArray, FloatArray] | None = None

    @property
    def is_whole(self) -> bool:
        """Whether the space holds every motion of the block."""
        return self.space.size >= self.block.size

    @property
    def is_full(self) -> bool:
        """Whether the space may not grow any more."""
        return self.space.size >= self.largest

    def visit(self, theta: FloatArray, allowed: FloatArray, share: float = 1.0) -> BoolArray:
        """Return at which points (n, p) errors keep to their share of `allowed` (m,); grow where they do not.

        Looks at the lowest m modes. At these points only `share` of what is allowed elsewhere is allowed.
        """
        allowed = share * allowed
        good = np.empty(len(theta), dtype=bool)
        step = at_once(self.block, len(allowed))
        for first in range(0, len(theta), step):
            rows = slice(first, first + step)
            found = bounded(self.space, self.anchors, theta[rows], len(allowed))
            self.theta = np.concatenate([self.theta, theta[rows]])
            self.share = np.concatenate([self.share, np.full(len(theta[rows]), share)])
            solved = np.isfinite(found.eigenvalues)
            error = np.where(solved & self.is_whole, 0.0, found.error)
            good[rows] = np.all(error <= SHARE * allowed, axis=1)
            wrong = solved & ~(error <= GROWN * allowed)
            if wrong.any() and not self.is_full:
                target = np.broadcast_to(GROWN * allowed, wrong.shape)
                self._correct(found.corrections[:, wrong], target[wrong])
        return good

    def solved(self) -> tuple[FloatArray, FloatArray]:
        """Return λ (n, count) and shapes (n, r, count) in V at all points visited; NaN on failure."""
        if self._solved is None or self._solved[0] is not self.space or len(self._solved[1]) != len(self.theta):
            self._solved = (self.space, *self.space.modes(self.theta, self.count))
        return self._solved[1:]

    def observe(self, rows: Any, reference: FloatArray) -> tuple[Callable[[FloatArray], FloatArray], FloatArray]:
        """Return how shapes in the trial vectors are compared with references, see `Block.observe`."""
        seen, reference = compressed(rows @ self.space.V, reference)
        return Mapped(seen), reference

    def add(self, X: FloatArray) -> None:
        """Add vectors (n_dof, m), such as modes of the full model."""
        self.space = self.space.grown(X, self.anchors.first)

    def _correct(self, C: FloatArray, target: FloatArray) -> None:
        """Add the corrections (n_dof, m), but for what is small beside the target (m,) or what the step leaves."""
        gram = C.T @ (self.anchors.first @ C)
        energy, U = np.linalg.eigh(0.5 * (gram + gram.T))
        energy, U = np.maximum(energy[::-1], 0.0), U[:, ::-1]
        size = np.diag(gram)
        left = size[:, None] - np.cumsum(U**2 * energy, axis=1)
        enough = np.all(left <= np.maximum(target, _STEP * size)[:, None], axis=0)
        n = int(np.argmax(enough)) + 1 if enough.any() else len(energy)
        n = min(n, self.largest - self.space.size)
        kept = energy[:n] > 0.0
        self.add(C @ (U[:, :n][:, kept] / np.sqrt(energy[:n][kept])))

    def counts_the_same(self, theta: FloatArray, needed: int) -> bool:
        """Say whether the full model has as many low modes as the space at theta (n, p), by Sylvester's law."""
        lam = self.space.modes(theta, min(self.count, self.space.size))[0]
        for values, (K, M) in zip(lam, self.block._matrices(theta), strict=True):
            # between two modes that are far apart, no lower than what is needed
            between = values[needed - 1 :]
            if len(between) < 2 or not np.isfinite(values).all():
                continue
            k = needed + int(np.argmax(between[1:] / np.maximum(between[:-1], RIGID * values[-1])))
            sigma = 0.5 * (values[k - 1] + values[k])
            try:
                if factorised(K - sigma * M).negative != k:
                    return False
            except np.linalg.LinAlgError:
                continue
        return True

    def cut(self, needed: int, tolerance: float, smallest: int, largest: int) -> Space:
        """Return a space of few vectors whose frequencies agree at all points visited, within `tolerance`.

        Proper orthogonal decomposition of the modes in the inner product of Ā, in which their errors are those of
        λ. Of the decomposition as many vectors as the worst points need. Where only a share of the tolerance is
        allowed, modes have more weight.
        """
        space, theta = self.space, self.theta
        lam, y = self.solved()
        lam, y = lam[:, :needed], y[:, :, :needed]
        solved = np.isfinite(lam).all(axis=1)
        theta, lam, y, share = theta[solved], lam[solved], y[solved], self.share[solved]
        sigma = np.maximum(lam + space.shift, RIGID * lam[:, -1:])
        Z = (y / np.sqrt(sigma * share[:, None])[:, None, :]).transpose(1, 0, 2).reshape(space.size, -1)
        _, Q = np.linalg.eigh(Z @ Z.T)
        Q = Q[:, ::-1][:, : max(largest, needed)]
        left = np.sum(Z**2, axis=0) - np.cumsum((Q.T @ Z) ** 2, axis=0)  # (r, n · m)
        left = np.max(left.reshape(Q.shape[1], len(theta), needed), axis=2)
        # far more vectors than any point needs are not worth their projection
        Q = Q[:, : max(needed, int(np.sum(np.max(left, axis=1) > _NEGLIGIBLE * tolerance)) + 1)]
        left = left[: Q.shape[1]]
        rotated = space.restricted(Q)

        def worst(size: int, rows: FloatArray) -> FloatArray:
            reduced = rotated.truncated(size).modes(theta[rows], needed)[0]
            return np.asarray(np.max(apart(reduced, lam[rows]), axis=1) / share[rows])

        low, high = max(smallest, needed) - 1, rotated.size
        guess = min(max(low + 1, int(np.sum(np.max(left, axis=1) > 2.0 * tolerance))), high)
        tuned = np.argsort(left[guess - 1])[::-1][:_TUNED]
        while True:
            top = high
            while top - low > 1:
                # the guess is rarely far off
                middle = guess if low < guess < top else top - max(1, (top - low) // 4)
                guess = -1
                if np.all(worst(middle, tuned) <= tolerance):
                    top = middle
                else:
                    low = middle
            others = np.setdiff1d(np.arange(len(theta)), tuned)
            bad = others[~(worst(top, others) <= tolerance)] if len(others) else others
            if not len(bad) or top == high:
                return rotated.truncated(top)
            low, tuned = top, np.concatenate([tuned, bad])


def apart(reduced: FloatArray, lam: FloatArray) -> FloatArray:
    """Return how far the frequencies of λ (n, m) are apart, relative; 0 for rigid-body modes in both."""
    rigid = (lam <= RIGID * lam[:, -1:]) & (reduced <= 10.0 * RIGID * lam[:, -1:])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(rigid, 0.0, np.abs(np.sqrt(reduced / lam) - 1.0))
