"""Full-model modes computed from the reduced model's modes, to confirm the error bounds of large structures.

The method is the block version of Davidson's method (1975, *J. Comput. Phys.* 17, 87–94; Crouzeix, Philippe &
Sadkane 1994, *SIAM J. Sci. Comput.* 15, 62–76). It starts from the Ritz vectors of the basis and of the modes at
the anchor points. The correction for a residual r is Ā⁻¹ r, where Ā is the matrix K + s M at an anchor point
(`fmu.fem.reduced.anchors`). If training has factorised Ā, its factors are reused.

To find out whether a mode is missing, K − σ M is factorised at the first point, with σ between two modes. By
Sylvester's law, the number of its negative eigenvalues is the number of eigenvalues λ below σ. If this number does
not agree with the modes found, the ordinary eigensolver is used from then on. The ordinary eigensolver is also
used where the iterations do not converge. If the block has an engine, its workers solve several points in
parallel.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.solver import LARGE, Factor, Matrix
from fmu.fem.reduced.anchors import Anchors
from fmu.fem.reduced.residuals import FrequencyBound, inertia_agrees
from fmu.fem.reduced.space import Space, new_directions
from fmu.types import FloatArray

CONVERGED = 1e-8
"""Estimated relative frequency error at which the iterations end; the last corrections are still added."""
_MOST_STEPS = 12
# Number of modes above the requested ones, and how many ranks below the highest requested mode σ may lie.
_BEYOND = 3


class _Start(NamedTuple):
    """Initial data for the iterations at one point.

    Attributes
    ----------
    theta : ndarray, shape (1, n_parameters)
        The point.
    vectors : list of ndarray, each of shape (n_dof, m)
        Ritz vectors of the basis and of the modes at the anchor points.
    anchor : int
        Index of the anchor point whose factors are used.
    alpha : float
        The factor α in A ≥ α Ā, where A is K + s M at the point and Ā at the anchor point.
    n_wanted, n_converged : int
        Number of modes to compute, and number of modes that must converge.
    """

    theta: FloatArray
    vectors: list[FloatArray]
    anchor: int
    alpha: float
    n_wanted: int
    n_converged: int


class ConfirmedBlock(FullBlock):
    """A large block whose modes are computed by iterations that start from the modes of its reduced model.

    At points where the iterations do not converge, all modes are computed as in `FullBlock`. This is done at every
    point once a mode was found to be missing or the modes could not be counted.

    Parameters
    ----------
    block : FullBlock
    space : Space
        The space spanned by the reduced basis.
    anchors : Anchors
    """

    def __init__(self, block: FullBlock, space: Space, anchors: Anchors) -> None:
        self.__dict__.update(block.__dict__)
        self._last = None
        self._space, self._anchors = space, anchors
        self._is_counted, self._is_complete = False, True

    def _count_with_further(self, count: int) -> int:
        return count

    def _solve_all(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        lam = np.full((len(theta), count), np.nan)
        phi = np.full((len(theta), self.size, count), np.nan)
        if self._is_complete:
            for i, (values, X) in self._from_ritz(theta, count).items():
                lam[i], phi[i] = values[:count], X[:, :count]
        others = np.isnan(lam[:, 0])
        if others.any():
            lam[others], phi[others] = super()._solve_all(theta[others], count)
        return lam, phi

    def _from_ritz(self, theta: FloatArray, count: int) -> dict[int, tuple[FloatArray, FloatArray]]:
        """Return the modes found by iteration at theta (n, p), keyed by point index.

        Each entry contains λ (m,) and shapes (size, m), with m > `count`. Points where the iterations do not
        converge are omitted. The dict is empty if a mode was found to be missing, or if the modes could not be
        counted.
        """
        started: list[int] = []

        def starts() -> Iterator[_Start]:
            for i in range(len(theta)):
                start = self._start(theta[i : i + 1], count)
                if start is not None:
                    started.append(i)
                    yield start

        outcome = self._anchors.run_tasks(_iterate_there, starts())
        found = {i: pairs for i, pairs in zip(started, outcome, strict=True) if pairs is not None}
        if found and not self._is_counted:
            self._is_counted, first = True, min(found)
            ((K, M),) = self._matrices(theta[first : first + 1])
            lam = found[first][0]
            self._is_complete = bool(inertia_agrees(K, M, lam, max(count - 1 - _BEYOND, 0), count))
        return found if self._is_complete else {}

    def _start(self, theta: FloatArray, count: int) -> _Start | None:
        """Return the initial data at theta (1, p), or None if iterations cannot start there.

        The iterations cannot start if α is not positive, a reduced problem fails, or a space has no more than
        `count` vectors.
        """
        space, known = self._space, self._anchors.modes(count)
        wanted = min(count + _BEYOND, space.size, known.size)
        (best,), (alpha,) = self._anchors.nearest(theta, space)
        if not (wanted > count and alpha > 0.0):
            return None
        vectors = [of.V @ of.modes(theta, wanted)[1][0] for of in (space, known)]
        if not all(np.isfinite(part).all() for part in vectors):
            return None
        return _Start(theta, vectors, int(best), float(alpha), wanted, count)


def _iterate_there(anchors: Anchors, start: _Start, _: object) -> tuple[FloatArray, FloatArray] | None:
    ((K, M),) = anchors.block._matrices(start.theta)
    A = K + anchors.shift * M if anchors.shift else K
    factor = anchors.factor(start.anchor)
    return davidson(A, M, anchors.shift, start.vectors, factor, start.n_wanted, start.n_converged, start.alpha)


def confirm_blocks(bound: FrequencyBound) -> tuple[FullBlock, ...]:
    """Return the full blocks of `bound`, with a `ConfirmedBlock` for each large block that was reduced."""
    blocks = list(bound.full)
    for b, (full, reduced) in enumerate(zip(bound.full, bound.reduced, strict=True)):
        if full.size >= LARGE and reduced.is_reduced and reduced.size < full.size:
            blocks[b] = ConfirmedBlock(full, *bound.trial(b))
    return tuple(blocks)


def davidson(
    A: Matrix,
    M: Matrix,
    shift: float,
    start: list[FloatArray],
    factor: Factor,
    wanted: int,
    count: int,
    alpha: float,
) -> tuple[FloatArray, FloatArray] | None:
    """Iterate Ritz pairs of A x = (λ + s) M x until the lowest `count` converge.

    Parameters
    ----------
    A, M : sparse arrays, shape (n, n)
        K + s M and M; A is positive definite.
    shift : float
        The shift s.
    start : list of ndarray, each of shape (n, m)
        Starting vectors.
    factor : Factor
        Factors of a matrix Ā with A ≥ α Ā.
    wanted : int
        Number of pairs to return.
    count : int
        Number of lowest pairs that must converge.
    alpha : float
        The factor α.

    Returns
    -------
    tuple of ndarray, or None
        λ (wanted,), ascending, and M-normalised vectors (n, wanted); None if the pairs do not converge.
    """
    V = MV = np.empty((len(start[0]), 0))
    new, is_converged = np.concatenate(start, axis=1), False
    small = np.zeros(count)  # ν at which the error of a pair was small enough
    for _ in range(_MOST_STEPS):
        new = new_directions(V, new, A)
        V, MV = np.concatenate([V, new], axis=1), np.concatenate([MV, M @ new], axis=1)
        gram = V.T @ MV
        nu, y = np.linalg.eigh(0.5 * (gram + gram.T))
        nu, y = nu[::-1][:wanted], y[:, ::-1][:, :wanted]
        if not nu[-1] > 0.0:
            return None
        X = V @ (y / np.sqrt(nu))
        if is_converged:
            return 1.0 / nu - shift, X
        # ν grows with the space; where it has hardly changed since, the pair is still accurate
        (open_,) = np.nonzero(~(nu[:count] <= (1.0 + CONVERGED) * small))
        R = A @ X[:, open_] - MV @ (y[:, open_] * nu[open_] ** -1.5)
        new = factor.solve(R)
        # error of a frequency: half the relative error of λ + s, if no other mode is near
        error = 0.5 * np.sum(R * new, axis=0) * nu[open_] / alpha
        if not np.isfinite(error).all():
            return None
        wrong = ~(error <= CONVERGED)
        small[open_] = np.where(wrong, 0.0, nu[open_])
        is_converged = not wrong.any()
        if not is_converged:
            new = new[:, wrong]
    return None
