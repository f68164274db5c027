"""The trial space of one block in training: it grows by corrections of modes, and is finally truncated.

Let Ā = K + s M at an anchor point. A correction w = Ā⁻¹ r from a mode's residual r is a step of Davidson's method
(1975, *J. Comput. Phys.* 17, 87–94). One factorisation of Ā serves all points in the box. The corrections at a few
points are compressed by proper orthogonal decomposition in the inner product of Ā before they are added to the
space. In that inner product the energy of an error is the relative error of an eigenvalue.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import scipy.sparse as sp

from fmu.fem.modes.block import Observation
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.modal import RIGID
from fmu.fem.pairing.rules import IndexPairing, RankPairing, ShapePairing
from fmu.fem.reduced.anchors import Anchors, NoModesError
from fmu.fem.reduced.basis import compress_rows
from fmu.fem.reduced.residuals import at_once, bound_errors, inertia_agrees
from fmu.fem.reduced.shared import SharedResiduals
from fmu.fem.reduced.space import Space
from fmu.types import BoolArray, FloatArray, IntArray

# A step of Davidson's method leaves about this fraction of an error; smaller corrections need not be added.
_STEP = 0.05
# Fractions of a tolerance: the space grows where an error exceeds GROWN, and an error of SHARE is accepted before
# the space is truncated.
GROWN, SHARE = 0.25, 0.45
# Fraction of the tolerance: a smaller energy outside the truncated space does not change a frequency noticeably.
_NEGLIGIBLE = 0.02
# Number of points for which the size of the truncated space is chosen first; all others are then checked.
_TUNED = 24
# A mode with λ up to this multiple of that of the highest needed mode may swap order with it at nearby points.
_CLOSE = 1.05
# Number of decompositions, each weighted by the remainders of the previous one, and the fourth power of the
# smallest factor of a weight. More decompositions save a few vectors, but cost digits of the gradient: the errors
# at all points then become as large as at the worst point.
_WEIGHED, _LEAST = 2, 1e-4
# Directions with a smaller fraction of the energy of the strongest direction are rounding errors.
_ROUNDING = 1e-13


class Learner:
    """The growing trial space of one block, and the points visited in training.

    Raise SingularAnchorError if `Anchors` does.

    Parameters
    ----------
    block : FullBlock
    lower, upper : ndarray, shape (n_parameters,)
        Bounds of the box.
    count : int
        Number of modes that may be needed.
    largest : int
        Largest number of vectors in the space.

    Attributes
    ----------
    space : Space
    anchors : Anchors
    shared : SharedResiduals or None
        Residuals of the space, or None if each residual needs its own solve.
    theta : ndarray, shape (n, n_parameters)
        Points visited so far.
    share : ndarray, shape (n,)
        Allowed error at each point, as a fraction of the tolerance.
    """

    def __init__(self, block: FullBlock, lower: FloatArray, upper: FloatArray, count: int, largest: int) -> None:
        self.block, self.count, self.largest = block, count, largest
        self.dofs, self.n_modes = block.dofs, block.n_modes
        self.anchors = Anchors(block, lower, upper)
        self.space = self.anchors.modes(count)
        self.shared = SharedResiduals.of(block) if len(self.anchors.theta) == 1 else None
        self._share(self.space.V)
        self.theta, self.share = np.empty((0, len(lower))), np.empty(0)
        self._solved: tuple[Space, FloatArray, FloatArray] | None = None

    @property
    def is_whole(self) -> bool:
        """Whether the space has as many vectors as the block has degrees of freedom."""
        return self.space.size >= self.block.size

    @property
    def is_full(self) -> bool:
        """Whether the space has reached its largest allowed size."""
        return self.space.size >= self.largest

    @property
    def is_stuck(self) -> bool:
        """Whether the space has reached its largest allowed size but has fewer vectors than degrees of freedom."""
        return self.is_full and not self.is_whole

    def visit(self, theta: FloatArray, allowed: FloatArray, share: float = 1.0) -> BoolArray:
        """Grow the space at theta (n, p) where needed; return a mask (n,) of the points with small enough errors.

        The errors at a point are small enough if, before the space grows there, the errors of the lowest m modes
        are at most `SHARE` times `share` times `allowed` (m,). If the space `is_whole`, all errors count as zero.
        The mask is False where the solver fails. If an error exceeds `GROWN` times `share` times `allowed`, that
        mode's correction is added to the space, unless the space is full. All points count as visited.
        """
        allowed = share * allowed
        good = np.empty(len(theta), dtype=bool)
        step = at_once(self.block, len(allowed))
        for first in range(0, len(theta), step):
            rows = slice(first, first + step)
            found = bound_errors(self.space, self.anchors, theta[rows], len(allowed), self.shared)
            self._look(theta[rows], share)
            solved = np.isfinite(found.eigenvalues)
            error = np.where(solved & self.is_whole, 0.0, found.error)
            good[rows] = np.all(error <= SHARE * allowed, axis=1)
            wrong = solved & ~(error <= GROWN * allowed)
            if wrong.any() and not self.is_full:
                target = np.broadcast_to(GROWN * allowed, wrong.shape)
                self._correct(found.corrections(wrong), target[wrong])
        return good

    def largest_miss(self, cut: Space, theta: FloatArray, needed: int, allowed: float) -> float:
        """Return the largest relative difference between frequencies in `cut` and in the full trial space.

        Only the `needed` lowest modes are compared. Points in theta (n, p) where the difference exceeds `allowed`
        are added to the visited points. The difference is infinite where only the solve in `cut` fails, and 0
        where the solve in the full space fails.
        """
        lam = self.space.modes(theta, needed)[0]
        off = np.max(apart(cut.modes(theta, needed)[0], lam), axis=1)
        off = np.where(np.isfinite(lam).all(axis=1), np.where(np.isnan(off), np.inf, off), 0.0)
        self._look(theta[off > allowed], 1.0)
        return float(np.max(off, initial=0.0))

    def _look(self, theta: FloatArray, share: float) -> None:
        self.theta = np.concatenate([self.theta, theta])
        self.share = np.concatenate([self.share, np.full(len(theta), share)])

    def solve_visited(self) -> tuple[FloatArray, FloatArray]:
        """Return eigenvalues λ (n, count) and shapes (n, r, count) in the basis V at all visited points.

        Both are NaN where the solver fails.
        """
        lam, y = np.empty((0, self.count)), np.empty((0, self.space.size, self.count))
        if self._solved is not None and self._solved[0] is self.space:
            _, lam, y = self._solved
        if len(lam) < len(self.theta):
            more = self.space.modes(self.theta[len(lam) :], self.count)
            lam, y = np.concatenate([lam, more[0]]), np.concatenate([y, more[1]])
            self._solved = (self.space, lam, y)
        return lam, y

    def observe(self, rows: sp.csr_array, reference: FloatArray) -> Observation:
        """Return the same as `Block.observe`, but with rows for the coefficients of the trial vectors V."""
        return compress_rows(rows @ self.space.V, reference)

    def add(self, X: FloatArray) -> None:
        """Add vectors X (n_dof, m) to the space, such as modes of the full model."""
        known = self.space.size
        self.space = self.space.grown(X, self.anchors.first)
        self._share(self.space.V[:, known:])

    def share_with(self, basis: FloatArray) -> SharedResiduals | None:
        """Return the shared residuals for a basis (n_dof, q) within the space, or None if `shared` is None."""
        return None if self.shared is None else self.shared.restrict(self.space.V.T @ (self.anchors.first @ basis))

    def _share(self, X: FloatArray) -> None:
        if self.shared is not None:
            self.shared = self.shared.grown(X, partial(self.anchors.solve, 0))

    def _correct(self, C: FloatArray, target: FloatArray) -> None:
        """Add the fewest principal directions of the corrections C (n_dof, m) that reduce the errors enough.

        The remaining energy of each correction is then at most the larger of its `target` (m,) and the fraction
        `_STEP` of its own energy, unless the space reaches its largest size first.
        """
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
        """Return False if the full model and the space have different numbers of low modes at any theta (n, p).

        The modes below a gap, which lies above the `needed` lowest modes, are counted by Sylvester's law of
        inertia. Points where they cannot be counted are skipped.
        """
        lam = self.space.modes(theta, min(self.count, self.space.size))[0]
        for values, (K, M) in zip(lam, self.block._matrices(theta), strict=True):
            # σ lies between two modes that are far apart, above all needed modes
            is_known = len(values) > needed and np.isfinite(values).all()
            if is_known and inertia_agrees(K, M, values, needed - 1) is False:
                return False
        return True

    def cut(self, needed: int, tolerance: float, smallest: int, largest: int) -> tuple[Space, FloatArray]:
        """Return a small space that reproduces the frequencies at the visited points, and a rotation (q, q).

        The frequencies agree within `tolerance` times each point's `share`, unless more than `largest` vectors
        would be needed. The space has at least `smallest` vectors, unless all further directions are negligible.

        The rotation's columns are the space's principal directions, in descending order of energy.

        The modes are compressed by proper orthogonal decomposition in the inner product of Ā, in which the energy
        of an error is the relative error of λ. The points with the largest errors determine the number of vectors.
        Weights reduce the largest errors (`balance_directions`), and modes have a larger weight where the allowed
        error is smaller. A mode just above the highest needed mode counts as needed, because the two may swap
        order at nearby points.
        """
        space, theta = self.space, self.theta
        lam, y = self.solve_visited()
        solved = np.isfinite(lam).all(axis=1)
        theta, lam, y, share = theta[solved], lam[solved], y[solved], self.share[solved]
        sigma = np.maximum(lam + space.shift, RIGID * lam[:, needed - 1 : needed])
        kept = np.broadcast_to(np.arange(lam.shape[1]) < needed, lam.shape).copy()
        if lam.shape[1] > needed:
            kept[:, needed] = sigma[:, needed] <= _CLOSE * sigma[:, needed - 1]
        count = needed + bool(kept[:, needed:].any())
        lam, kept = lam[:, :count], kept[:, :count]
        Z = (y / np.sqrt(sigma * share[:, None])[:, None, :])[:, :, :count].transpose(1, 0, 2)
        Z = np.where(kept, Z, 0.0).reshape(space.size, -1)
        Q, left = balance_directions(Z, tolerance, max(needed, 1), max(largest, needed))
        left = left.reshape(len(left), len(theta), count)
        left, total = np.max(left, axis=2), np.sum(left, axis=2)
        rotated = space.restrict(Q)

        def worst(size: int, rows: IntArray) -> FloatArray:
            reduced = rotated.truncate(size).modes(theta[rows], min(count, size))[0]
            off = np.full((len(reduced), count), np.inf)
            off[:, : reduced.shape[1]] = apart(reduced, lam[rows, : reduced.shape[1]])
            return np.asarray(np.max(off, axis=1, where=kept[rows], initial=0.0) / share[rows])

        def is_enough(size: int, rows: IntArray) -> bool:
            return bool(np.all(worst(size, rows) <= tolerance))

        low, high = max(smallest, needed) - 1, rotated.size
        guess = min(max(low + 1, int(np.sum(np.max(left, axis=1) > 2.0 * tolerance))), high)
        tuned = np.argsort(left[guess - 1])[::-1][:_TUNED]
        stretch = self.anchors.stretch(theta)
        while True:
            top = _fewest(partial(is_enough, rows=tuned), low, high, guess)
            # the error of λ is at most the remaining energy of all these modes in K, and K ≤ `stretch` times Ā
            with np.errstate(invalid="ignore"):  # with an infinite stretch there is no bound, even for zero energy
                bounded = stretch * total[top - 1] <= 2.0 * tolerance
            others = np.setdiff1d(np.flatnonzero(~bounded), tuned)
            bad = others[~(worst(top, others) <= tolerance)] if len(others) else others
            if not len(bad) or top == high:
                # the weights change the order of the directions: once sorted, the leading ones are a coarser basis
                energy = Q[:, :top].T @ Z
                return rotated.truncate(top), np.linalg.eigh(energy @ energy.T)[1][:, ::-1]
            low, guess, tuned = top, top + 1, np.concatenate([tuned, bad])


def count_needed(
    full: tuple[FullBlock, ...], rule: IndexPairing | ShapePairing, learners: Mapping[int, Learner]
) -> tuple[RankPairing | None, dict[int, int]]:
    """Return the pairing as fixed ranks, or None if the ranks vary, and the number of modes each block needs.

    Both follow from the solves at the initial points that all learners have in common.
    """
    # after a truncation, blocks may have visited different points: only the common earlier points are used
    visited = [learner.theta for learner in learners.values()]
    n = min(map(len, visited))
    alike = np.all([np.all(theta[:n] == visited[0][:n], axis=1) for theta in visited], axis=0)
    n = n if alike.all() else int(np.argmin(alike))
    found = {b: tuple(of[:n] for of in learner.solve_visited()) for b, learner in learners.items()}
    known = np.all([np.isfinite(lam).all(axis=1) for lam, _ in found.values()], axis=0)
    found = {b: (lam[known], y[known]) for b, (lam, y) in found.items()}
    seen = tuple(learners[b] if b in found else block for b, block in enumerate(full))
    eigenvalues, shapes = ({b: of[i] for b, of in found.items()} for i in (0, 1))
    return rule.find_needed(seen, eigenvalues, shapes)  # type: ignore[arg-type]


def balance_directions(
    Z: FloatArray, tolerance: float, smallest: int, largest: int
) -> tuple[FloatArray, FloatArray]:
    """Return orthonormal directions for the columns of Z (r, n_columns), strongest first, and remaining energies.

    Proper orthogonal decomposition minimises the mean remaining energy. Here, columns with a large remainder get a
    larger weight in the next decomposition, which reduces the largest remainder. Lawson's algorithm does this for
    polynomials (Lawson 1961, *Contributions to the theory of linear least maximum approximation*).

    There are at most `largest` directions, and no more than the larger of `smallest` and the number after which
    every remainder is negligible compared with `tolerance`.

    Returns
    -------
    Q : ndarray, shape (r, q)
        The directions.
    left : ndarray, shape (q, n_columns)
        Remaining energy of each column after the first 1, 2, … directions are removed.
    """
    energy, weight = np.sum(Z**2, axis=0), np.ones(Z.shape[1])
    best: tuple[FloatArray, FloatArray] | None = None
    fewest = largest + 1
    for _ in range(_WEIGHED):
        weighted = Z * weight
        Q = np.linalg.eigh(weighted @ weighted.T)[1][:, ::-1][:, :largest]
        left = energy - np.cumsum((Q.T @ Z) ** 2, axis=0)
        size = int(np.sum(np.max(left, axis=1) > 2.0 * tolerance)) + 1
        if best is None or size < fewest:
            # more vectors than this are not worth the cost of their projection
            enough = max(smallest, int(np.sum(np.max(left, axis=1) > _NEGLIGIBLE * tolerance)) + 1)
            best, fewest = (Q[:, :enough], left[:enough]), size
        # the remainders for the largest size that was not sufficient
        rest = np.maximum(left[max(min(size, len(left)) - 2, 0)], 0.0)
        if not rest.any():
            break
        weight *= np.maximum(rest / rest.max(), _LEAST) ** 0.25
    assert best is not None  # narrowed for the type checker: there is a first decomposition
    return best


def snapshot_basis(
    block: FullBlock, anchors: Anchors, theta: FloatArray, count: int, size: int, tolerance: float
) -> FloatArray:
    """Return principal directions (n_dof, q) of the lowest modes at theta (n, n_parameters), as a basis.

    It is meant for a box so wide that no basis is accurate everywhere. The modes are compressed by proper
    orthogonal decomposition in the inner product of Ā = K + s M at the first anchor point. In this inner product
    the energy of an error is the relative error of an eigenvalue (Quarteroni, Manzoni & Negri 2016, *Reduced Basis
    Methods for Partial Differential Equations*, chapter 6). The basis is accurate near theta; elsewhere its error
    is unknown.

    Parameters
    ----------
    block : FullBlock
    anchors : Anchors
    theta : ndarray, shape (n, n_parameters)
        Points where a solve fails are skipped.
    count : int
        Number of modes at each point.
    size : int
        Largest number q of basis vectors.
    tolerance : float
        Relative error of an eigenvalue below which a mode needs no further directions.

    Raises
    ------
    NoModesError
        If the solves fail at all points.
    """
    lam, phi = block.modes(theta, count)
    known = np.isfinite(lam).all(axis=1)
    if not known.any():
        raise NoModesError(theta[0])
    sigma = np.maximum(lam[known] + anchors.shift, np.finfo(float).tiny)
    modes = (phi[known] / np.sqrt(sigma)[:, None]).transpose(1, 0, 2).reshape(block.size, -1)
    energy, U = np.linalg.eigh(modes.T @ (anchors.first @ modes))
    kept = energy > _ROUNDING * energy[-1]
    root, U = np.sqrt(energy[kept]), U[:, kept]
    Q, _ = balance_directions(root[:, None] * U.T, tolerance, size, size)
    return np.asarray((modes @ (U / root)) @ Q)


def _fewest(is_enough: Callable[[int], bool], low: int, high: int, guess: int) -> int:
    """Return the smallest size with low < size ≤ high for which `is_enough` is True, searching from a guess.

    `high` is assumed to be enough.
    """
    step = 1 + guess // 64
    size = guess
    while low < size < high and not is_enough(size):
        low, size, step = size, size + step, 2 * step
    high = min(high, max(size, low + 1))
    size = high - step
    while low < size:
        if not is_enough(size):
            low = size
            break
        high, step = size, 2 * step
        size = high - step
    while high - low > 1:
        middle = (low + high) // 2
        if is_enough(middle):
            high = middle
        else:
            low = middle
    return high


def apart(reduced: FloatArray, lam: FloatArray) -> FloatArray:
    """Return the relative frequency differences (n, m) between two arrays of λ, with 0 for rigid-body modes."""
    rigid = (lam <= RIGID * lam[:, -1:]) & (reduced <= 10.0 * RIGID * lam[:, -1:])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(rigid, 0.0, np.abs(np.sqrt(reduced / lam) - 1.0))
