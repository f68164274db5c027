"""Slice sampling (Neal 2003) with the hyperrectangle scheme or the coordinate-wise scheme."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from fmu.arguments import check_arguments
from fmu.samplers.adaptation import Learner, Schedule
from fmu.samplers.kernel import Info, State, Target, Tree
from fmu.samplers.local import LocalKernel, LocalSampler
from fmu.samplers.settings import fits, one_of, orthonormal, positive_number, positive_scale, whole_number
from fmu.types import BoolArray, FloatArray, IntArray, LogDensity

START_WIDTH = 0.5
"""Width of the initial interval, in scaled units, before anything is learnt."""
SCHEMES = ("hyperrectangle", "coordinate")
ACCOUNT = ("n_solves", "n_nonfinite", "n_steps_out", "n_shrinks")
"""Names of the quantities that a step counts for each chain."""


@check_arguments
@dataclass(frozen=True)
class Slice(LocalSampler):
    """Slice sampler: draws a level Y under the density P, then a point from the slice {E : P(E) ≥ Y}.

    Parameters
    ----------
    scheme : {"hyperrectangle", "coordinate"}
        "hyperrectangle" moves along all axes at once (Boulkaibet et al., section 4.2); "coordinate" moves along
        one axis after the other, with stepping-out (section 5 of the same paper). One draw is one full sweep over
        the axes.
    width : float or vector (ndim,), optional
        Width of the initial interval along each axis, in scaled units. By default, widths and axes are learnt in
        warm-up.
    axes : None or matrix (ndim, ndim)
        Directions of the intervals, as orthonormal columns; the coordinate axes if None. They are learnt in
        warm-up unless `width` is given.
    spread : float
        Width that adaptation gives to the interval on an axis, in standard deviations of the target along this
        axis.
    max_steps_out : int
        Largest number of expansions of one interval by `width` ("coordinate" only): Neal's m is
        ``max_steps_out + 1``.
    max_shrinks : int
        Largest number of candidates for one interval. A chain that misses the slice with all of them does not move
        along the axes of this interval, which leaves the target invariant. With the default number, this happens
        only if rounding errors make all candidates miss.

    Raises
    ------
    ValueError
        If `scheme` is unknown, `width` is not a positive finite number or vector, `spread` is not positive and
        finite, the columns of `axes` are not orthonormal, `max_steps_out` is negative or `max_shrinks` is less
        than 1.

    Notes
    -----
    Boulkaibet et al. print step 3 of section 4.2 with the test Y ≤ P(E_0); the candidate E_1 must be tested
    instead. A new level and a new interval are drawn for every sample.

    References
    ----------
    Boulkaibet, Marwala, Mthembu, Friswell & Adhikari, *Sampling Techniques in Bayesian Finite Element Model
    Updating*; Neal (2003), Annals of Statistics 31, 705-767: figure 8 (hyperrectangle), figures 3 and 5
    (coordinate).
    """

    scheme: str = "hyperrectangle"
    width: ArrayLike | None = None
    max_steps_out: int = 10
    max_shrinks: int = 1000
    axes: ArrayLike | None = None
    spread: float = 3.0

    name: ClassVar[str] = "slice"
    title: ClassVar[str] = "Slice sampling"
    colour: ClassVar[str] = "#009E73"
    cost: ClassVar[tuple[float, float, float]] = (3.0, 2.3, 1.0)

    def __post_init__(self) -> None:
        one_of("scheme", self.scheme, SCHEMES)
        if self.width is not None:
            object.__setattr__(self, "width", positive_scale("width", self.width, matrix=False))
        object.__setattr__(self, "spread", positive_number("spread", self.spread))
        if self.axes is not None:
            object.__setattr__(self, "axes", orthonormal("axes", self.axes))
        whole_number("max_steps_out", self.max_steps_out, 0)
        whole_number("max_shrinks", self.max_shrinks, 1)

    def bind(self, density: LogDensity) -> SliceKernel:
        """Return the kernel that samples `density`; raise ValueError if `width` or `axes` has the wrong size."""
        width = np.broadcast_to(fits("width", self.width or START_WIDTH, density.ndim), density.ndim)
        axes = np.eye(density.ndim) if self.axes is None else fits("axes", self.axes, density.ndim)
        return SliceKernel(Target(density), self, width, axes)

    def tuner(self, density: LogDensity, chains: int, steps: int) -> SliceTuner | None:
        """Return a tuner that learns widths and axes in `steps` warm-up steps, or None if `width` is given."""
        return SliceTuner(self, density, steps) if self.width is None else None

    def take_covariance(self, covariance: FloatArray) -> Slice:
        """Return a copy with intervals along the principal axes of a covariance, shape (ndim, ndim).

        Return `self` if `width` or `axes` is given.
        """
        if self.width is not None or self.axes is not None:
            return self
        variances, axes = np.linalg.eigh(covariance)
        return replace(self, axes=axes, width=self.spread * np.sqrt(np.maximum(variances, 1e-24)))


@dataclass(frozen=True)
class SliceKernel(LocalKernel):
    """Slice-sampling kernel bound to a density.

    `width` has one entry per axis, and the axes are the columns of `axes`. If each chain has its own widths and
    axes, the shapes are (chains, ndim) and (chains, ndim, ndim). Intervals are stored as offsets from the current
    position along the axes, so offset 0 is always inside.
    """

    settings: Slice
    width: FloatArray
    axes: FloatArray

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Draw a point from the slice for every chain, along all axes at once or along each axis in turn."""
        chains, ndim = state.position.shape
        account = {name: np.zeros(chains, dtype=np.int64) for name in ACCOUNT}
        x, log_prob = state.position, state.log_prob
        if self.settings.scheme == "hyperrectangle":
            level = log_prob - rng.standard_exponential(chains)
            ends = self._place(rng, chains, self.width)
            x, log_prob = self._shrink(rng, x, log_prob, level, ends, self.axes, account)
        else:
            for i in range(ndim):
                level = log_prob - rng.standard_exponential(chains)
                ends = self._place(rng, chains, self.width[..., i : i + 1])
                ends = self._step_out(rng, x, level, i, ends, account)
                x, log_prob = self._shrink(rng, x, log_prob, level, ends, self.axes[..., i : i + 1], account)
        moved, n_solves = np.any(x != state.position, axis=1), account.pop("n_solves")
        return State(x, log_prob), Info(moved, log_prob, n_solves, np.zeros_like(n_solves), account)

    def join(self, kernels: Sequence[Self], chains: int) -> Self:
        """Return one kernel for the chains of all `kernels`, with separate widths and axes for each chain."""
        width, axes = [kernel.width for kernel in kernels], [kernel.axes for kernel in kernels]
        return replace(self, width=np.repeat(width, chains, axis=0), axes=np.repeat(axes, chains, axis=0))

    def _place(self, rng: np.random.Generator, chains: int, width: FloatArray) -> FloatArray:
        """Place intervals of given widths at random around 0; return the left and right ends (2, chains, axes)."""
        left = -width * rng.random((chains, width.shape[-1]))
        return np.stack([left, left + width])

    def _step_out(
        self,
        rng: np.random.Generator,
        x: FloatArray,
        level: FloatArray,
        i: int,
        interval: FloatArray,
        account: dict[str, IntArray],
    ) -> FloatArray:
        """Step out along axis `i` (Neal 2003, figure 3); return the left and right interval ends, (2, chains, 1).

        Each end is moved outwards until it is off the slice or its budget is used up. The budget is split between
        left and right in advance, so both ends and all chains can advance together. An end outside the bounds
        counts as off the slice and takes no solve. Evaluations and expansions are added to `account`, and
        `interval` is overwritten.
        """
        ends = interval[:, :, 0]
        outward = np.multiply.outer([-1.0, 1.0], np.broadcast_to(self.width[..., i], len(x)))
        axis = np.broadcast_to(self.axes[..., i], x.shape)
        budget = self.settings.max_steps_out
        to_left = np.floor((budget + 1) * rng.random(len(x))).astype(np.int64)
        left_over = np.stack([to_left, budget - to_left])
        while True:
            side, chain = np.nonzero(left_over > 0)
            if not side.size:
                return ends[:, :, None]
            points = x[chain] + ends[side, chain, None] * axis[chain]
            on_slice = self._evaluate(points, chain, account) > level[chain]
            left_over[side, chain] -= 1
            left_over[side[~on_slice], chain[~on_slice]] = 0
            side, chain = side[on_slice], chain[on_slice]
            ends[side, chain] += outward[side, chain]
            np.add.at(account["n_steps_out"], chain, 1)

    def _shrink(
        self,
        rng: np.random.Generator,
        x: FloatArray,
        log_prob: FloatArray,
        level: FloatArray,
        ends: FloatArray,
        axes: FloatArray,
        account: dict[str, IntArray],
    ) -> tuple[FloatArray, FloatArray]:
        """Draw from the intervals, shrinking them towards offset 0 at every miss (Neal 2003, figures 5 and 8).

        Return the new positions, shape (chains, ndim), and their log-densities, shape (chains,). The intervals are
        first cut at the bounds where `_cut` can do so. Chains that have hit the slice wait for the other chains
        and are not evaluated again. A chain that misses `max_shrinks` times stays. Evaluations and misses are
        added to `account`.
        """
        left, right = self._cut(x, ends, axes)
        new, new_log_prob = x.copy(), log_prob.copy()
        waiting: IntArray = np.arange(len(x))
        for _ in range(self.settings.max_shrinks):
            offset = left[waiting] + rng.random((len(waiting), axes.shape[-1])) * (right[waiting] - left[waiting])
            candidate = x[waiting] + _along(axes, offset, waiting)
            value = self._evaluate(candidate, waiting, account)
            hit: BoolArray = value >= level[waiting]
            new[waiting[hit]], new_log_prob[waiting[hit]] = candidate[hit], value[hit]
            waiting, offset = waiting[~hit], offset[~hit]
            if not waiting.size:
                break
            below = offset < 0.0
            left[waiting] = np.where(below, offset, left[waiting])
            right[waiting] = np.where(below, right[waiting], offset)
            account["n_shrinks"][waiting] += 1
        return new, new_log_prob

    def _cut(self, x: FloatArray, ends: FloatArray, axes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Cut the intervals at the bounds of each coordinate that only one axis moves; return left and right ends.

        Both have shape (chains, axes). If each chain has its own axes, intervals on several axes are not cut.
        """
        left, right = ends[0].copy(), ends[1].copy()
        if axes.ndim == 3:  # each chain has its own, oblique axes: only a single axis can be cut
            return _cut_line(self.target, x, left, right, axes) if axes.shape[2] == 1 else (left, right)
        moves = axes != 0.0
        for i, k in np.argwhere(moves & (np.count_nonzero(moves, axis=1) == 1)[:, None]):
            walls = np.stack([self.target.lower[i] - x[:, i], self.target.upper[i] - x[:, i]]) / axes[i, k]
            left[:, k] = np.maximum(left[:, k], walls.min(axis=0))
            right[:, k] = np.minimum(right[:, k], walls.max(axis=0))
        return left, right

    def _evaluate(self, points: FloatArray, chain: IntArray, account: dict[str, IntArray]) -> FloatArray:
        found = self.target.evaluate(points, chain)
        np.add.at(account["n_solves"], chain, found.n_solves)
        np.add.at(account["n_nonfinite"], chain, found.n_nonfinite)
        return found.log_prob


class SliceTuner:
    """Tuner that aligns intervals with the principal axes of the target's covariance, and learns their widths.

    This is automated factor slice sampling (Tibbits, Groendyke, Haran & Liechty 2014).
    """

    def __init__(self, sampler: Slice, density: LogDensity, steps: int) -> None:
        self.sampler, self.density = sampler, density
        self.learner = Learner(Schedule.sliding(steps), density.ndim)
        self.kernel: SliceKernel = sampler.bind(density)
        self.settings = replace(sampler, width=START_WIDTH)
        self.window_closed = False

    def update(self, state: State, info: Info) -> None:
        """Adapt the settings to one more warm-up step."""
        self.window_closed = self.learner.learn(state, info)
        if self.window_closed:
            self._take_covariance()

    def finish_learning(self) -> Slice:
        """Return the learnt settings. If no covariance was learnt, the width is `START_WIDTH`."""
        return self.settings

    def state(self) -> Tree:
        """Return the tuner's state as plain data."""
        return self.learner.state()

    def restore(self, state: Tree) -> None:
        """Restore the state that another tuner's `state` returned."""
        self.learner.restore(state)
        if self.learner.covariance is not None:
            self._take_covariance()

    def _take_covariance(self) -> None:
        variance, axes = np.linalg.eigh(np.asarray(self.learner.covariance))
        width = self.sampler.spread * np.sqrt(variance)
        self.settings = replace(self.sampler, width=width, axes=axes)
        self.kernel = self.settings.bind(self.density)


def _along(axes: FloatArray, offset: FloatArray, chain: IntArray) -> FloatArray:
    """Return displacements (n, ndim) for offsets (n, k) along k axes, the columns of `axes`.

    `axes` has the shape (ndim, k) if all chains share the axes, otherwise (chains, ndim, k). `chain` (n,) contains
    the chain of each row.
    """
    return offset @ axes.T if axes.ndim == 2 else np.einsum("nij,nj->ni", axes[chain], offset)


def _cut_line(
    target: Target, x: FloatArray, left: FloatArray, right: FloatArray, axes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the ends (chains, 1) of intervals along one axis per chain (chains, ndim, 1), cut at the bounds."""
    slope = axes[:, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):  # a bound that is never reached
        walls = np.stack([target.lower - x, target.upper - x]) / slope
    walls = np.where(slope == 0.0, [[[-np.inf]], [[np.inf]]], walls)
    first, last = walls.min(axis=0).max(axis=1), walls.max(axis=0).min(axis=1)
    return np.maximum(left, first[:, None]), np.minimum(right, last[:, None])
