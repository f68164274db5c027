"""Training of a reduced basis: points in the box are visited, and the space is grown, truncated and verified.

K + s M is factorised at one or a few anchor points in the box (`fmu.fem.reduced.anchors`). At every visited point
the reduced problem is solved. The residuals of its modes give error bounds (`fmu.fem.reduced.residuals`) and the
vectors that the space lacks (`fmu.fem.reduced.learning`). Once the errors at a set of fresh points, including
corners and faces, are within the tolerance, the space is truncated to the final basis. Full solves at a few
further points verify the basis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from fmu.fem.modes.eigensolver import DENSE_LIMIT
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.pairing.rules import IndexPairing, RankPairing, ShapePairing
from fmu.fem.reduced.anchors import Anchors, Far
from fmu.fem.reduced.basis import ReducedBlock
from fmu.fem.reduced.confirming import confirm_blocks
from fmu.fem.reduced.cost import Cost
from fmu.fem.reduced.learning import SHARE, Learner, apart, count_needed, snapshot_basis
from fmu.fem.reduced.points import (
    Trained,
    affordable,
    box_points,
    mass_orthonormal,
    most_trial_vectors,
    points_near_zero,
)
from fmu.fem.reduced.shared import SharedResiduals
from fmu.fem.reduced.space import Space
from fmu.progress.phases import count_solves, phase
from fmu.types import BoolArray, FloatArray

# A block of up to this size is kept whole, in a basis that only makes its mass matrix the identity.
EXACT_LIMIT = 20
# A basis is kept whole only if its lowest λ is at least this fraction of the highest: a solver then keeps nine
# digits.
_HIGHEST = 1e-7
BUDGET = 400
"""Largest cost of the visits in training, in units of full-model solves (`fmu.fem.reduced.cost`)."""
CHEAP = 0.01
"""Cost of a full solve up to which the full model is used if the reduced model is inaccurate."""
# Largest relative error of frequencies while the needed modes are selected from the candidates; only the needed
# modes are then improved.
LOOSE = 1e-3
# Number of points that are visited together, of consecutive good points required, and largest number of points.
_TOGETHER, _ENOUGH, _MOST_POINTS = 16, 48, 2048
# Number of points of the Sobol sequence, besides corners and faces, in a set of fresh points.
_SOBOL = 32
# Number of fresh points with full solves; largest numbers of rounds of training, in the box and in a region.
_CHECKED, _ROUNDS, _MOST_ROUNDS = 4, 4, 20
# The truncation may use the fraction _CUT of the remaining tolerance at the points that determine its size, and
# all of it at fresh points, up to _FRESH of each kind.
_CUT, _FRESH = 0.85, 48
_CHECKS, _CUTS = 1000, 2000  # first seeds of the points of the checks and of the truncations


@dataclass(eq=False, repr=False)
class Training:
    """Training of a parametric reduced basis, with its current state.

    Raise TypeError if a block in `full` is reduced. Within `FullBlock.spread_over`, long solves run in an engine's
    workers. The result does not depend on the engine.

    Parameters
    ----------
    full : tuple of FullBlock
        The structure's blocks before reduction.
    rule : IndexPairing or ShapePairing
        Pairing rule, which determines how many modes each block needs.
    lower, upper : ndarray, shape (n_parameters,)
        Bounds of the box.
    tolerance : float
        Largest relative error allowed in a needed frequency at the visited points.
    """

    full: tuple[FullBlock, ...]
    rule: IndexPairing | ShapePairing
    lower: FloatArray
    upper: FloatArray
    tolerance: float

    def __post_init__(self) -> None:
        for b, block in enumerate(self.full):
            if block.is_reduced:
                raise TypeError(f"block {b}: training needs the full model (got {type(block).__name__})")
        self.learners: dict[int, Learner] = {}
        self.fixed: RankPairing | None = None
        self.reduced: dict[int, ReducedBlock] = {}
        self.shared: dict[int, SharedResiduals | None] = {}
        self.n_trained: dict[int, int] = {}
        self.confirmed = True
        self.share = 1.0
        self.is_narrow = False
        self.far: Far | None = None
        self.costs: dict[int, Cost] = {}
        self.spent = 0.0
        self._cuts: dict[int, Space] = {}
        self._seed, self._cut_seed, self._cut_share = 0, _CUTS, _CUT

    def run(self) -> Trained:
        """Train until the errors at fresh points, including corners and faces, are small and full solves agree.

        Training ends without success (`confirmed` is False) if the errors do not become small, full solves
        still disagree after the last round, the cost exceeds `BUDGET` full solves, or a basis reaches its largest
        useful size (`is_cut`), to which it is truncated. Raise SingularAnchorError if `Anchors` does.
        """
        counts = self.rule.counts(self.full)
        with phase("training"):
            for b, count in counts.items():
                block = self.full[b]
                self.learners[b] = Learner(block, self.lower, self.upper, count, most_trial_vectors(block.size))
                cost = Cost.of(block, self.learners[b].anchors.factor(0))
                if cost is not None:
                    self.costs[b] = cost
                    self.learners[b].largest = min(self.learners[b].largest, 2 * self._affordable(b))
        self.n_trained = dict.fromkeys(counts, 0)
        self._visit(2 * _TOGETHER)
        self.fixed, self.n_trained = count_needed(self.full, self.rule, self.learners)
        near_zero = points_near_zero(self.lower, self.upper, _SOBOL)
        for round_ in range(_ROUNDS):
            for b in self.learners:
                self._look(b, near_zero)
            self.confirmed = self._visit(_ENOUGH)
            fixed, needed = count_needed(self.full, self.rule, self.learners)
            if fixed != self.fixed or any(n > self.n_trained.get(b, 0) for b, n in needed.items()):
                self.fixed, self.n_trained = fixed, needed
                self.confirmed = self._visit(_ENOUGH)
            self._cut()
            if not self.is_accurate or self._verify(round_):
                break
            self._cut_share *= 0.5
        else:
            self.confirmed = False
        self.confirmed &= self.is_accurate
        points = np.concatenate([box_points(self.lower, self.upper, _SOBOL, _CHECKS + _ROUNDS), near_zero])
        self.far = self.current().bound(self.full).find_far(points, self.n_trained, self.tolerance)
        return self.current()

    def refine(self, theta: FloatArray, times: float = 3.0) -> Trained:
        """Continue training at points theta (n, n_parameters), where errors must decrease by the factor `times`.

        Errors at other points in the box may stay as they are.
        """
        off = [
            self.learners[b].largest_miss(cut, theta, self.n_trained[b], np.inf) for b, cut in self._cuts.items()
        ]
        found = max(off, default=0.0) / ((1.0 - SHARE) * self.tolerance)
        self.share = min(self.share, found if found > 0.0 else 1.0) / times
        with phase("training"):
            for b, learner in self.learners.items():
                learner.share = np.where(learner.share < 1.0, self.share, learner.share)
                left = theta
                for _ in range(_ROUNDS):
                    left = left[~self._look(b, left, self.share)]
                    if not len(left) or self.is_spent:
                        break
            self._cut()
        return self.current()

    def narrow(self, tolerance: float, region: Callable[[], FloatArray]) -> Iterator[Trained]:
        """Continue training to a smaller `tolerance` in a region of the box, yielding the model before each round.

        In each round, `region` is called for fresh points (n, n_parameters). When the errors at all these points
        are small enough, training yields the final model and ends. It ends without success (`confirmed` is False)
        if a basis reaches its largest useful size, if the budget is spent, or after the last round.
        """
        self.share, self.is_narrow = tolerance / self.tolerance, True
        for _ in range(_MOST_ROUNDS):
            yield self.current()
            theta = region()
            good = [self._look(b, theta, self.share) for b in self.learners]
            self._cut()
            if not self.is_accurate:
                break
            if np.all(good):
                yield self.current()
                return
        self.confirmed = False

    def at(self, theta: FloatArray) -> Trained:
        """Return a model with bases that are built from full modes at theta (n, n_parameters).

        Only blocks of more than `DENSE_LIMIT` degrees of freedom have such a basis. It has at most the largest
        useful size. Its accuracy away from these points is not checked. Raise NoModesError if no solve succeeds,
        or SingularAnchorError if `Anchors` does.
        """
        centre = 0.5 * (self.lower + self.upper)
        for b, count in self.rule.counts(self.full).items():
            block = self.full[b]
            anchors = Anchors(block, self.lower, self.upper)
            cost = Cost.of(block, anchors.factor(0))
            if cost is not None:
                self.costs[b], self.n_trained[b] = cost, count
                V = snapshot_basis(block, anchors, theta, count, self._affordable(b), self.tolerance)
                self.reduced[b] = ReducedBlock(block, mass_orthonormal(block, V, centre), count)
        return self.current()

    def current(self) -> Trained:
        """Return the outcome of training so far."""
        blocks = tuple(self.reduced.get(b, full) for b, full in enumerate(self.full))
        anchors = {b: learner.anchors for b, learner in self.learners.items()}
        found = self.confirmed, anchors, self.tolerance if self.is_narrow else None, self.shared
        return Trained(blocks, self.fixed or self.rule, self.lower, self.upper, *found)

    def state(self) -> dict[str, FloatArray]:
        """Return the arrays from which `restore` rebuilds the trained model, keyed by name.

        ``elsewhere`` is the tolerance outside the region, if any; ``far`` has all fields of `Far` except theta.
        """
        state: dict[str, FloatArray] = {"lower": self.lower, "upper": self.upper}
        if self.is_narrow:
            state["elsewhere"] = np.array(self.tolerance)
        if self.far is not None:
            state["far"] = np.array(self.far[1:], dtype=float)
        if self.fixed is not None:
            state["pairing"] = np.array([self.fixed.block, self.fixed.rank], dtype=float)
        for b, reduced in self.reduced.items():
            state[f"basis{b}"] = reduced.basis
            state[f"n_trained{b}"] = np.array(float(reduced.n_trained))
            if (shared := self.shared.get(b)) is not None:
                state[f"energy{b}"], state[f"mass{b}"] = shared.energy, shared.mass
        return state

    @classmethod
    def restore(
        cls, full: tuple[FullBlock, ...], rule: IndexPairing | ShapePairing, state: dict[str, FloatArray]
    ) -> Trained:
        """Rebuild the trained model from the arrays that `state` returned."""
        training = cls(full, rule, state["lower"], state["upper"], tolerance=0.0)
        if "elsewhere" in state:
            training.tolerance, training.is_narrow = float(state["elsewhere"]), True
        if "pairing" in state:
            block, rank = state["pairing"].astype(int).tolist()
            training.fixed = RankPairing(tuple(block), tuple(rank))
        for b in range(len(full)):
            if f"basis{b}" in state:
                n_trained = int(state[f"n_trained{b}"])
                training.reduced[b] = ReducedBlock(full[b], state[f"basis{b}"], n_trained)
            if f"energy{b}" in state:
                training.shared[b] = SharedResiduals(full[b], state[f"energy{b}"], state[f"mass{b}"])
        return training.current()

    def _visit(self, enough: int) -> bool:
        """Visit fresh points until the errors at `enough` consecutive points are small; return True on success.

        Return False after `_MOST_POINTS` points, if the budget is spent or a space is full, or if no space grows.
        """
        good = visited = 0
        with phase("training") as under_way:
            while good < enough and visited < _MOST_POINTS:
                points = self._shuffled_points(self._seed, self._seed)
                self._seed += 1
                size = self._size()
                for first in range(0, len(points), _TOGETHER):
                    part = points[first : first + _TOGETHER]
                    under_way.expect(len(part))
                    was_good = np.all([self._look(b, part) for b in self.learners])
                    under_way.said["basis"] = self._size()
                    under_way.advance(len(part))
                    visited += len(part)
                    good = good + len(part) if was_good else 0
                    if good >= enough:
                        return True
                    if not was_good and (self.is_spent or any(of.is_stuck for of in self.learners.values())):
                        return False
                if good < len(points) and self._size() == size:  # no solve succeeds, or only rounding remains
                    return False
        return good >= enough

    def _fresh(self) -> FloatArray:
        """Return fresh points (m, n_parameters) for checking a truncation.

        Some of them are near zero in parameters whose lower bound is zero.
        """
        self._cut_seed += 1
        points = self._shuffled_points(self._cut_seed, self._cut_seed)
        near_zero = points_near_zero(self.lower, self.upper, _SOBOL, self._cut_seed)
        return np.concatenate([points[:_FRESH], near_zero[:_FRESH]])

    def _shuffled_points(self, seed: int, order: int) -> FloatArray:
        """Return `box_points` (m, n_parameters) for `seed`, shuffled with the seed `order`."""
        points = box_points(self.lower, self.upper, _SOBOL, seed)
        return points[np.random.default_rng(order).permutation(len(points))]

    def _size(self) -> int:
        return sum(learner.space.size for learner in self.learners.values())

    def _allowed_errors(self, b: int) -> FloatArray:
        """Return the errors (m,) allowed in the needed modes of `b` or, until they are known, all candidates."""
        n = self.n_trained.get(b, 0)
        return np.full(n, self.tolerance) if n else np.full(self.learners[b].count, max(LOOSE, self.tolerance))

    def _cut(self) -> None:
        """Truncate the spaces to small bases that, size permitting, meet the tolerance at all visited points."""
        for b, needed in self.n_trained.items():
            self.reduced[b] = ReducedBlock(self.full[b], self._choose_cut(b, needed), needed)
            self.shared[b] = self.learners[b].share_with(self.reduced[b].basis)

    def is_cut(self) -> bool:
        """Return True if the basis of a large block has its largest useful size: more points cannot improve it."""
        return any(
            len(of.basis) > DENSE_LIMIT and of.size >= self._affordable(b) for b, of in self.reduced.items()
        )

    @property
    def is_spent(self) -> bool:
        """Whether training has cost as much as `BUDGET` solves of the full model."""
        return self.spent > BUDGET * sum(cost.full for cost in self.costs.values()) > 0.0

    @property
    def is_accurate(self) -> bool:
        """Whether neither the largest basis size nor the budget has limited training."""
        return not (self.is_cut() or self.is_spent)

    def prefers_full(self) -> bool:
        """Return True if the full model should be used, because the reduced model is inaccurate and saves little.

        It saves little if the structure has large blocks and their full solves cost no more than reduced ones, or
        at most `CHEAP`. A run of 20 000 full solves then takes minutes.
        """
        full = sum(cost.full for cost in self.costs.values())
        reduced = sum(self.costs[b].of_reduced(of.size) for b, of in self.reduced.items() if b in self.costs)
        return not self.is_accurate and bool(self.costs) and (full <= CHEAP or full <= reduced)

    def _look(self, b: int, theta: FloatArray, share: float = 1.0) -> BoolArray:
        """Visit theta (n, p) in block `b`, add the cost to `spent`, and return the mask (n,) of good points."""
        allowed = self._allowed_errors(b)
        if b in self.costs:
            self.spent += len(theta) * self.costs[b].visit(self.learners[b].space.size, len(allowed))
        return self.learners[b].visit(theta, allowed, share)

    def _affordable(self, b: int) -> int:
        """Return the largest useful basis size for block `b`.

        If the block is large, a reduced solve costs at most a third of a full solve.
        """
        most = affordable(self.full[b].size)
        return min(most, self.costs[b].most_vectors()) if b in self.costs else most

    def _choose_cut(self, b: int, needed: int) -> FloatArray:
        block = self.full[b]
        centre = 0.5 * (self.lower + self.upper)
        if block.n_modes == block.size <= EXACT_LIMIT:
            lam, shapes = block.modes(centre[None], block.size)
            # all modes of the block, unless the highest are so high that the low ones would lose their digits
            if not lam[0, -1] * _HIGHEST > lam[0, lam[0] > 0.0].min(initial=np.inf):
                return shapes[0]
        smallest = self.reduced[b].size if b in self.reduced else 1
        largest = max(self._affordable(b), needed)
        learner, left, share = self.learners[b], (1.0 - SHARE) * self.tolerance, self._cut_share
        for _ in range(_ROUNDS):
            cut, order = learner.cut(needed, share * left, smallest, largest)
            # with smaller errors required at some points, fresh points of the box need no check
            if cut.size == largest or self.share < 1.0:
                break
            off = learner.largest_miss(cut, self._fresh(), needed, left)
            if off <= left:
                break
            share *= _CUT * left / off
        self._cuts[b] = cut
        return mass_orthonormal(block, cut.V @ order, centre)

    def _verify(self, round_: int) -> bool:
        """Return True if full solves at fresh points confirm the frequencies, pairing and number of low modes.

        Where frequencies differ by more than the tolerance, the full model's modes are added to the space.
        """
        points = self._shuffled_points(_CHECKS + round_, round_)[: 2 * _CHECKED]
        counts = self.rule.counts(self.full)
        # if full solves are expensive, they start from the modes of the basis
        full = confirm_blocks(self.current().bound(self.full))
        exact: dict[int, tuple[FloatArray, FloatArray]] = {}
        with phase("training", len(counts)) as under_way:
            for b, count in counts.items():
                exact[b] = full[b].modes(points[:_CHECKED], count)
                under_way.advance()
            count_solves(_CHECKED)
        agreed = True
        eigenvalues, shapes = ({b: of[i] for b, of in exact.items()} for i in (0, 1))
        fixed, needed = self.rule.find_needed(self.full, eigenvalues, shapes)
        agreed &= self.fixed is None or fixed == self.fixed
        agreed &= all(needed[b] <= n or self.fixed is None for b, n in self.n_trained.items())
        for b, n in self.n_trained.items():
            learner, lam = self.learners[b], eigenvalues[b][:, :n]
            if learner.is_whole:
                continue
            found = self.reduced[b].eigenvalues(points[:_CHECKED], n)
            known = np.isfinite(lam).all(axis=1)
            bad = known & ~np.all(apart(found, lam) <= self.tolerance, axis=1)
            # if the block's solves started from the modes of the basis, its eigenvalues have already been counted
            is_counted = full[b] is not self.full[b]
            agreed &= not bad.any() and (is_counted or learner.counts_the_same(points[_CHECKED:], n))
            for row in np.flatnonzero(bad):
                learner.add(shapes[b][row])
        return agreed
