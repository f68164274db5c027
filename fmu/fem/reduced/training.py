"""How a reduced basis is trained: sample, compress, verify on fresh points, grow."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from fmu.engines.base import Engine, InProcess
from fmu.fem.modes.eigensolver import DENSE_LIMIT
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.modal import RIGID, BlockModel, frequency_hz, is_rigid
from fmu.fem.modes.separable import coefficients, weighted_sum
from fmu.fem.pairing.prediction import joined
from fmu.fem.pairing.rules import AT_ONCE, IndexPairing, RankPairing, ShapePairing
from fmu.fem.reduced.basis import ReducedBlock
from fmu.progress.phases import phase, solved
from fmu.types import FloatArray, IntArray

# Directions with less energy than this share of the strongest are rounding: the Gram matrix squares the shapes.
_SNAPSHOT_RANK = 1e-14
# More shapes than the first, of more degrees of freedom than the second, are compressed in batches.
MANY_SHAPES, LARGE = 4096, 2000
# Below this size a block is kept whole, in a basis that only makes its mass matrix the unit matrix.
EXACT_LIMIT = 20
# The lowest λ of a basis that is kept whole is at least this share of the highest: a solver then keeps nine
# digits.
_HIGHEST = 1e-7
_ROUNDS = 12
# From this round on the tolerance at the known points is halved: with many parameters, fresh points always lie a
# little further out, and the same small miss would recur in every round.
_CAREFUL_ROUND = 3
_MOST_VECTORS = 1000
# Points per task: few enough to keep many workers busy. Results must not depend on the number of workers.
_CHUNK = 4


def affordable(n_dof: int) -> int:
    """Return the largest useful number of basis vectors for a block of `n_dof` degrees of freedom.

    A reduced solve takes about 60 ns · r², more from r = 1000 on, and a sparse full one about 30 µs a degree of
    freedom (results/scale.md): at 12 √n the first is a third of the second. Dense blocks, up to
    `fmu.fem.modes.eigensolver.DENSE_LIMIT`, are solved a theta at a time, which is never faster.
    """
    return n_dof if n_dof <= DENSE_LIMIT else min(int(12.0 * np.sqrt(n_dof)), _MOST_VECTORS)


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

    def lowest(self, count: int) -> Snapshots:
        """Return only the snapshots of the lowest `count` modes."""
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
        """Return |f_reduced − f| / f, shape (n, m).

        For a rigid-body mode 0 if it is one in the reduced model too, else infinity.
        """
        exact, reduced = self.eigenvalues, block.eigenvalues(self.theta, self.eigenvalues.shape[1])
        top = exact[:, -1:]
        rigid = is_rigid(exact)
        error = np.where(reduced <= 10.0 * RIGID * top, 0.0, np.inf)
        f, f_reduced = frequency_hz(exact), frequency_hz(reduced)
        return np.divide(np.abs(f_reduced - f), f, out=error, where=~rigid)


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
    """

    model: BlockModel
    pairing: IndexPairing | ShapePairing | RankPairing
    lower: FloatArray
    upper: FloatArray
    confirmed: bool = True


class Training:
    """Offline stage of the parametric reduced basis.

    Parameters
    ----------
    full : BlockModel
    rule : IndexPairing or ShapePairing
        Decides which modes of which blocks are needed.
    lower, upper : ndarray, shape (n_parameters,)
        The box.
    tolerance : float
        Largest relative error of a needed frequency at the sampled and at the fresh points.
    n_sobol : int
        Points of the Sobol sequence, beside corners and faces; fresh sets are half as large.
    engine : Engine, optional
        Solves the full model at several points at once. The result does not depend on it.
    """

    def __init__(
        self,
        full: BlockModel,
        rule: IndexPairing | ShapePairing,
        lower: FloatArray,
        upper: FloatArray,
        tolerance: float,
        n_sobol: int = 64,
        engine: Engine | None = None,
    ) -> None:
        self.full, self.rule = full, rule
        self.lower, self.upper = lower, upper
        self.tolerance = tolerance
        self.n_sobol = n_sobol
        self._engine = engine or InProcess()
        self.snapshots: dict[int, Snapshots] = {}
        self.fixed: RankPairing | None = None
        self.basis: dict[int, FloatArray] = {}
        self.n_trained: dict[int, int] = {}
        self.confirmed = True

    def run(self) -> Trained:
        """Train until a fresh set of points, corners and faces among them, is within the tolerance.

        Fresh points outside the tolerance join the snapshots before the next round; so do the others while the
        snapshots are few. Training ends without success after the last round, or when the basis would be larger
        than `affordable`; it is then cut to that size.
        """
        self.snapshots = self._solved(box_points(self.lower, self.upper, self.n_sobol, seed=0))
        self.confirmed = False
        for round_ in range(1, _ROUNDS):
            self._compress(0.5 if round_ >= _CAREFUL_ROUND else 1.0)
            if self.is_cut():
                return self._trained()
            fresh = self._solved(box_points(self.lower, self.upper, self.n_sobol // 2, seed=round_))
            self.confirmed = self._good_for(fresh)
            if self.confirmed:
                return self._trained()
            self._add(self._worth_adding(fresh))
        self._compress()
        return self._trained()

    def refined(self, theta: FloatArray) -> Trained:
        """Continue with more points (n, n_parameters) and a third of the tolerance."""
        self._add(self._solved(theta))
        self.tolerance /= 3.0
        self._compress()
        return self._trained()

    def state(self) -> dict[str, FloatArray]:
        """Return the outcome as arrays."""
        state: dict[str, FloatArray] = {"lower": self.lower, "upper": self.upper}
        if self.fixed is not None:
            state["pairing"] = np.array([self.fixed.block, self.fixed.rank], dtype=float)
        for b, basis in self.basis.items():
            state[f"basis{b}"] = basis
            state[f"n_trained{b}"] = np.array(float(self.n_trained[b]))
        return state

    @classmethod
    def restored(
        cls, full: BlockModel, rule: IndexPairing | ShapePairing, state: dict[str, FloatArray]
    ) -> Trained:
        """Return the outcome that `state` described."""
        training = cls(full, rule, state["lower"], state["upper"], tolerance=0.0)
        if "pairing" in state:
            block, rank = state["pairing"].astype(int).tolist()
            training.fixed = RankPairing(tuple(block), tuple(rank))
        for b in range(len(full.blocks)):
            if f"basis{b}" in state:
                training.basis[b] = state[f"basis{b}"]
                training.n_trained[b] = int(state[f"n_trained{b}"])
        return training._trained()

    def _trained(self) -> Trained:
        blocks = (self._reduced(b) if b in self.basis else full for b, full in enumerate(self.full.blocks))
        model = BlockModel(tuple(blocks), self.full.n_parameters)
        return Trained(model, self.fixed or self.rule, self.lower, self.upper, self.confirmed)

    def _solved(self, theta: FloatArray) -> dict[int, Snapshots]:
        """Solve the blocks that the rule looks at, for all modes that might be needed."""
        counts = self.rule.counts(self.full)
        parts = [theta[first : first + _CHUNK] for first in range(0, len(theta), _CHUNK)]
        tasks = [(b, part, count) for b, count in counts.items() for part in parts]
        with phase("training", len(tasks)) as under_way:
            outcome = iter(self._engine.run_tasks(_solve_there, self.full, tasks, lambda *_: under_way.advance()))
            solved(len(theta))
        return {b: joined(list(islice(outcome, len(parts)))) for b in counts}

    def _needed(self, snapshots: dict[int, Snapshots]) -> tuple[RankPairing | None, dict[int, int]]:
        """Return the pairing as fixed ranks where that is exact, and how many modes of each block are needed."""
        eigenvalues = {b: s.eigenvalues for b, s in snapshots.items()}
        return self.rule.needed(self.full, eigenvalues, {b: s.shapes for b, s in snapshots.items()})

    def _compress(self, share: float = 1.0) -> None:
        """Find the smallest basis with errors within `share` of the tolerance at all known points."""
        self.fixed, self.n_trained = self._needed(self.snapshots)
        tolerance = share * self.tolerance
        self.basis = {b: self._compressed(b, needed, tolerance) for b, needed in self.n_trained.items()}

    def is_cut(self) -> bool:
        """Say whether a basis has reached its largest useful size: more points cannot improve it."""
        return any(len(v) > DENSE_LIMIT and v.shape[1] >= affordable(len(v)) for v in self.basis.values())

    def _compressed(self, b: int, needed: int, tolerance: float) -> FloatArray:
        block = self._block(b)
        centre = 0.5 * (self.lower + self.upper)
        if block.n_modes == block.size <= EXACT_LIMIT:
            lam, shapes = block.modes(centre[None], block.size)
            # all modes of the block, unless the highest are so high that the low ones would lose their digits
            if not lam[0, -1] * _HIGHEST > lam[0, lam[0] > 0.0].min(initial=np.inf):
                return shapes[0]
        wanted = self.snapshots[b].lowest(needed)
        basis = proper_orthogonal_basis(block, wanted, centre)

        def acceptable(candidate: ReducedBlock) -> bool:
            return all(np.max(part.frequency_error(candidate)) <= tolerance for part in wanted.parts(AT_ONCE))

        smallest = self.basis[b].shape[1] if b in self.basis else 1
        largest = basis[:, : max(affordable(block.size), needed)]
        return smallest_basis(ReducedBlock(block, largest, needed), acceptable, smallest).basis

    def _good_for(self, fresh: dict[int, Snapshots]) -> bool:
        fixed, needed = self._needed(fresh)
        if (self.fixed is not None and fixed != self.fixed) or self._needs_more(needed):
            return False
        return bool(np.max(self._errors(fresh)) <= self.tolerance)

    def _needs_more(self, needed: dict[int, int]) -> bool:
        """Say whether a block needs more modes than its basis was trained for."""
        return any(needed[b] > n_trained for b, n_trained in self.n_trained.items())

    def _errors(self, fresh: dict[int, Snapshots]) -> FloatArray:
        """Return the largest relative error of a frequency at each of the fresh points, shape (n,)."""
        errors = [fresh[b].lowest(n).largest_error(self._reduced(b)) for b, n in self.n_trained.items()]
        return np.asarray(np.max(errors, axis=0))

    def _worth_adding(self, fresh: dict[int, Snapshots]) -> dict[int, Snapshots]:
        """Return the points of `fresh` that are to join the others: where these are many, the bad ones alone."""
        many = any(
            s.eigenvalues.shape[0] * self.n_trained[b] > MANY_SHAPES and self._block(b).size > LARGE
            for b, s in self.snapshots.items()
        )
        fixed, needed = self._needed(fresh)
        if not many or fixed != self.fixed or self._needs_more(needed):
            return fresh
        bad = ~(self._errors(fresh) <= 0.5 * self.tolerance)
        return {b: s.rows(bad) for b, s in fresh.items()}

    def _add(self, fresh: dict[int, Snapshots]) -> None:
        self.snapshots = {b: joined([s, fresh[b]]) for b, s in self.snapshots.items()}

    def _reduced(self, b: int) -> ReducedBlock:
        return ReducedBlock(self._block(b), self.basis[b], self.n_trained[b])

    def _block(self, b: int) -> FullBlock:
        block: Any = self.full.blocks[b]
        if block.is_reduced:
            raise TypeError(f"block {b}: training needs the full model (got {type(block).__name__})")
        return block


def _solve_there(full: BlockModel, task: tuple[int, FloatArray, int], _: object) -> Snapshots:
    b, theta, count = task
    block: Any = full.blocks[b]
    return Snapshots.solve(block, theta, count)


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


def proper_orthogonal_basis(block: FullBlock, snapshots: Snapshots, centre: FloatArray) -> FloatArray:
    """Return the POD of mode shapes, shape (size, r_max), strongest direction first.

    Orthonormal in the block's mass matrix at `centre` (n_parameters,); where degrees of freedom have no mass, in
    M + K/λ with the highest λ of the snapshots, as M does not see how they follow.

    Notes
    -----
    Each shape is weighted by 1/ω. The error e of a truncated basis consists of high modes, of some frequency Ω,
    and raises an eigenvalue by the relative amount Ω²‖e‖²/ω². With the weight, errors of the same size have the
    same effect on every relative frequency.
    """
    M = weighted_sum(block.M_terms, coefficients(block.M_terms, centre[None])[0])
    lam = snapshots.eigenvalues
    if block.n_modes < block.size:
        M = M + weighted_sum(block.K_terms, coefficients(block.K_terms, centre[None])[0]) / np.max(lam)
    floor = 1e-6 * lam[:, -1:]
    # without any stiffness every vector is a mode, and none is worth a place in the basis
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
    """Return fewer columns with the same POD, up to directions weaker than `_SNAPSHOT_RANK`.

    Each batch of shapes is compressed together with the scaled directions of those before it (Himpel, Leibner &
    Rave 2018, *Hierarchical approximate proper orthogonal decomposition*, SIAM J. Sci. Comput. 40, A3267).
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
    """Return `reduced` truncated to the fewest leading basis vectors that are acceptable, or unchanged.

    By bisection: in nested spaces the reduced eigenvalues fall monotonically towards the exact ones (Courant and
    Fischer), so a basis that is acceptable remains acceptable when vectors are added.
    """
    low, high = max(smallest, reduced.n_trained) - 1, reduced.size
    while high - low > 1:
        middle = (low + high) // 2
        if acceptable(reduced.truncated(middle)):
            high = middle
        else:
            low = middle
    return reduced.truncated(high)
