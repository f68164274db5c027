"""Slice sampling (Neal 2003): the hyperrectangle method and the coordinate-wise one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from .evaluation import evaluate
from .kernel import BoolArray, FloatArray, Info, IntArray, LogDensity, State
from .settings import fits, one_of, positive_scale, whole_number

SCHEMES = ("hyperrectangle", "coordinate")


@dataclass(frozen=True)
class Slice:
    """Slice sampling: draw a level Y under the density, then a point from the slice {E : P(E) ≥ Y}.

    Parameters
    ----------
    scheme : {"hyperrectangle", "coordinate"}
        "hyperrectangle" moves all coordinates at once, as section 4.2 of the paper lists; "coordinate" takes
        them in turn with stepping-out, as its section 5 describes. One draw is one full sweep.
    width : float or vector (ndim,)
        The initial interval, in scaled units.
    max_steps_out : int
        Most expansions of one interval by `width` ("coordinate" only): Neal's m is ``max_steps_out + 1``.
    max_shrinks : int
        Most candidates for one interval. A chain that reaches it stays where it is, which leaves the target
        invariant; it happens only where rounding hides the slice.

    Notes
    -----
    The test of section 4.2, step 3, reads Y ≤ P(E_0) in print; it must be on the candidate E_1. A new level and
    a new interval are drawn for every sample.

    References
    ----------
    Neal (2003), Annals of Statistics 31, 705-767: figure 8 (hyperrectangle), figures 3 and 5 (coordinate).
    """

    scheme: str = "hyperrectangle"
    width: Any = 0.5
    max_steps_out: int = 10
    max_shrinks: int = 1000

    name: ClassVar[str] = "slice"

    def __post_init__(self) -> None:
        one_of("scheme", self.scheme, SCHEMES)
        object.__setattr__(self, "width", positive_scale("width", self.width, matrix=False))
        whole_number("max_steps_out", self.max_steps_out, 0)
        whole_number("max_shrinks", self.max_shrinks, 1)

    @property
    def walkers(self) -> int:
        """A chain is a single point."""
        return 1

    def bind(self, density: LogDensity) -> SliceKernel:
        """Return the kernel that samples `density`; ValueError if `width` does not fit its coordinates."""
        width = np.broadcast_to(fits("width", self.width, density.ndim), density.ndim)
        return SliceKernel(density, self, width)


@dataclass
class _Account:
    """What one step has cost so far, per chain."""

    n_solves: IntArray
    n_nonfinite: IntArray
    n_steps_out: IntArray
    n_shrinks: IntArray


@dataclass(frozen=True)
class SliceKernel:
    """Slice sampling bound to a density; `width` has one entry a coordinate."""

    density: LogDensity
    settings: Slice
    width: FloatArray

    def init(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate the start, one solve a chain."""
        first = evaluate(self.density, positions)
        nothing = np.zeros(len(positions), dtype=np.int64)
        info = Info(nothing.astype(bool), first.log_prob, first.n_solves, nothing)
        return State(positions, first.log_prob), info

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Draw from the slice: once for all coordinates, or a full sweep of coordinates."""
        chains, ndim = state.position.shape
        account = _Account(*(np.zeros(chains, dtype=np.int64) for _ in range(4)))
        x, log_prob = state.position, state.log_prob
        if self.settings.scheme == "hyperrectangle":
            level = log_prob - rng.standard_exponential(chains)
            ends = self._place(rng, x, slice(None))
            x, log_prob = self._shrink(rng, x, log_prob, level, ends, slice(None), account)
        else:
            for i in range(ndim):
                axis = slice(i, i + 1)
                level = log_prob - rng.standard_exponential(chains)
                ends = self._step_out(rng, x, level, i, self._place(rng, x, axis), account)
                x, log_prob = self._shrink(rng, x, log_prob, level, ends, axis, account)
        extra = {
            "n_nonfinite": account.n_nonfinite,
            "n_steps_out": account.n_steps_out,
            "n_shrinks": account.n_shrinks,
        }
        moved = np.any(x != state.position, axis=1)
        info = Info(moved, log_prob, account.n_solves, np.zeros_like(account.n_solves), extra)
        return State(x, log_prob), info

    def _place(self, rng: np.random.Generator, x: FloatArray, axes: slice) -> FloatArray:
        """Return the initial interval around `x`, placed at random: (left and right, chains, axes)."""
        width = self.width[axes]
        left = x[:, axes] - width * rng.random(x[:, axes].shape)
        return np.stack([left, left + width])

    def _step_out(
        self,
        rng: np.random.Generator,
        x: FloatArray,
        level: FloatArray,
        i: int,
        interval: FloatArray,
        account: _Account,
    ) -> FloatArray:
        """Widen the intervals of coordinate `i` until both ends are off the slice (Neal 2003, figure 3).

        The two ends and all chains advance together, for the split of the budget between left and right is drawn
        beforehand. An end beyond the bounds is off the slice, at no cost.
        """
        ends = interval[:, :, 0]
        outward = np.array([-self.width[i], self.width[i]])
        budget = self.settings.max_steps_out
        to_left = np.floor((budget + 1) * rng.random(len(x))).astype(np.int64)
        left_over = np.stack([to_left, budget - to_left])
        while True:
            growing = (left_over > 0) & (ends >= self.density.lower[i]) & (ends <= self.density.upper[i])
            side, chain = np.nonzero(growing)
            if not side.size:
                return ends[:, :, None]
            points = x[chain]
            points[:, i] = ends[side, chain]
            on_slice = self._evaluate(points, chain, account) > level[chain]
            left_over[side, chain] -= 1
            left_over[side[~on_slice], chain[~on_slice]] = 0
            side, chain = side[on_slice], chain[on_slice]
            ends[side, chain] += outward[side]
            np.add.at(account.n_steps_out, chain, 1)

    def _shrink(
        self,
        rng: np.random.Generator,
        x: FloatArray,
        log_prob: FloatArray,
        level: FloatArray,
        ends: FloatArray,
        axes: slice,
        account: _Account,
    ) -> tuple[FloatArray, FloatArray]:
        """Draw from the intervals, shrinking them towards `x` at every miss (Neal 2003, figures 5 and 8).

        The intervals are cut at the bounds first: beyond them every candidate would miss. Chains that have hit
        the slice wait and are not evaluated again.
        """
        left = np.maximum(ends[0], self.density.lower[axes])
        right = np.minimum(ends[1], self.density.upper[axes])
        new, new_log_prob = x.copy(), log_prob.copy()
        waiting: IntArray = np.arange(len(x))
        for _ in range(self.settings.max_shrinks):
            candidate = x[waiting]
            u = rng.random(candidate[:, axes].shape)
            candidate[:, axes] = left[waiting] + u * (right[waiting] - left[waiting])
            value = self._evaluate(candidate, waiting, account)
            hit: BoolArray = value >= level[waiting]
            new[waiting[hit]], new_log_prob[waiting[hit]] = candidate[hit], value[hit]
            waiting, candidate = waiting[~hit], candidate[~hit]
            if not waiting.size:
                break
            below = candidate[:, axes] < x[waiting, axes]
            left[waiting] = np.where(below, candidate[:, axes], left[waiting])
            right[waiting] = np.where(below, right[waiting], candidate[:, axes])
            account.n_shrinks[waiting] += 1
        return new, new_log_prob

    def _evaluate(self, points: FloatArray, chain: IntArray, account: _Account) -> FloatArray:
        found = evaluate(self.density, points)
        np.add.at(account.n_solves, chain, found.n_solves)
        np.add.at(account.n_nonfinite, chain, found.n_nonfinite)
        return found.log_prob
