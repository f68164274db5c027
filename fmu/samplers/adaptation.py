"""Code that the tuners share: the warm-up schedule, dual averaging of a step size, and moments of the draws.

Adaptation uses the draws of all chains in a group and stops at the end of warm-up. All retained draws therefore
come from one fixed, valid kernel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from fmu.samplers.kernel import Info, State, Tree
from fmu.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from fmu.samplers.mixture.warp import Warp

LAG = 10.0
"""Largest difference between the log-density of a chain in the bulk and the value that at least half of the
chains reach; one more is allowed per coordinate."""
WINDOW_LAG = 3.0
"""The same difference for means over a window, which scatter less than single draws; one half more is allowed per
coordinate."""
STUCK = 0.3
"""Smallest acceptance rate of a chain that is not stuck, relative to the median over the chains."""
SHRINKAGE = 5.0
"""Weight of the diagonal in a regularised covariance, as a number of draws."""
_HISTORY = ("position", "log_prob", "acceptance")
_MEMORY = 0.9  # weight of the past in the smoothed log-density of a chain


@dataclass(frozen=True)
class Schedule:
    """Schedule of a warm-up with three parts, as in Stan (Carpenter et al. 2017).

    The first part finds the bulk of the distribution, the second learns the covariance in windows, and the last
    adapts the step size under the final covariance. See the Stan reference manual, "HMC algorithm parameters".

    Attributes
    ----------
    steps, first, last : int
        Numbers of steps in total, in the first part, and in the last part.
    windows : tuple of (int, int)
        For each window, the index (from 0) of its first step, and the index of the first step after the window.
        Each covariance is estimated from the steps of a single window.
    """

    steps: int
    first: int
    last: int
    windows: tuple[tuple[int, int], ...]

    @classmethod
    def doubling(cls, steps: int) -> Schedule:
        """Return a schedule in which each window is twice as long as the previous one, but the last may be longer.

        A warm-up of fewer than about 35 steps has no windows. This schedule suits a sampler that must adapt its
        step size again in every window.
        """
        first = last = int(0.15 * steps)
        windows: list[tuple[int, int]] = []
        start, size, stop = first, 25, steps - last
        while stop - start >= size:
            # the last window takes all remaining steps if a further window would not fit
            end = start + size if stop - (start + size) >= 2 * size else stop
            windows.append((start, end))
            start, size = end, 2 * size
        return cls(steps, first, last, tuple(windows))

    @classmethod
    def sliding(cls, steps: int) -> Schedule:
        """Return a schedule in which each window covers the later half of all steps so far.

        Each window closes 10 % (at least 10 steps) later than the previous one. The last window closes with the
        second part. In a warm-up of more than 100 steps, the first windows close during the first part. A warm-up
        of fewer than 30 steps has no windows. This schedule suits a sampler that mixes slowly until it knows the
        target's covariance: the estimate improves from window to window.
        """
        first, last = int(0.25 * steps), int(0.15 * steps)
        windows: list[tuple[int, int]] = []
        end, stop = 25, steps - last
        while end < stop:
            windows.append((end // 2, end))
            end = max(end + 10, int(1.1 * end))
        if windows:
            windows.append((stop // 2, stop))
        return cls(steps, first, last, tuple(windows))


@dataclass
class DualAveraging:
    """Nesterov's dual averaging, which adapts the logarithm x of a step size to reach an acceptance rate δ.

    Hoffman & Gelman (2014), JMLR 15, 1593-1623, equation (6), with their constants. The arrays have one entry for
    pooled chains, or one entry per chain. x stays between `lowest` and `highest`, because on some densities the
    step size does not affect the acceptance rate.

    Parameters
    ----------
    log_value : ndarray, shape () or (chains,)
        The logarithm x of the next step size.
    target : float
        The acceptance rate δ.
    count, error, centre, average
        t, H̄_t, μ and x̄_t, the state of the recursion. The defaults start a new recursion with μ = x + log 10.
    """

    log_value: FloatArray
    target: float
    count: int = 0
    error: FloatArray = field(default_factory=lambda: np.zeros(()))
    centre: FloatArray | None = None
    average: FloatArray = field(default_factory=lambda: np.zeros(()))

    gamma: ClassVar[float] = 0.05
    t0: ClassVar[float] = 10.0
    kappa: ClassVar[float] = 0.75
    lowest: ClassVar[float] = -25.0
    highest: ClassVar[float] = 25.0

    def __post_init__(self) -> None:
        if self.centre is None:
            # μ = log(10 ε₀): too large a step costs less than too small a step
            self.centre = self.log_value + np.log(10.0)

    def update(self, acceptance: FloatArray) -> None:
        """Update x with one observed acceptance probability α_t, shape () or (chains,)."""
        self.count += 1
        t = self.count
        # H̄_t = (1 − 1/(t + t₀)) H̄_{t−1} + (δ − α_t)/(t + t₀) is the mean error so far; t₀ damps the first steps
        weight = 1.0 / (t + self.t0)
        self.error = (1.0 - weight) * self.error + weight * (self.target - acceptance)
        # x_{t+1} = μ − √t/γ H̄_t: too many rejections (H̄ > 0) shorten the step
        self.log_value = np.clip(self.centre - np.sqrt(t) / self.gamma * self.error, self.lowest, self.highest)
        # x̄_{t+1} = t^−κ x_{t+1} + (1 − t^−κ) x̄_t: x continues to scatter, but its average converges
        decay = t**-self.kappa
        self.average = decay * self.log_value + (1.0 - decay) * self.average

    @property
    def averaged(self) -> FloatArray:
        """The averaged logarithm x̄, which is used after warm-up, shape () or (chains,).

        Before the first update it is x.
        """
        smoothed: FloatArray = self.average if self.count else self.log_value
        return smoothed


class Learner:
    """Learns the target's covariance from warm-up steps, and which chains have reached the bulk of the target.

    Attributes
    ----------
    covariance : ndarray, shape (ndim, ndim), or None
        The latest estimate of the covariance, which a window leaves unchanged if its draws allow no estimate. It
        is None before the first estimate.
    warp : Warp or None
        Coordinates in which the covariance was estimated; None if these are the coordinates of the draws.

    Parameters
    ----------
    schedule : Schedule
    ndim : int
    choose_warp : callable, optional
        Returns the warp for the draws (n, ndim) of a window. By default no warp is used.
    """

    def __init__(
        self, schedule: Schedule, ndim: int, choose_warp: Callable[[FloatArray], Warp] | None = None
    ) -> None:
        self.schedule, self.ndim, self.choose_warp = schedule, ndim, choose_warp
        self.warp: Warp | None = None
        self.step = 0
        self.covariance: FloatArray | None = None
        self._log_prob: FloatArray | None = None  # smoothed log-density of every chain
        self._history: list[tuple[FloatArray, ...]] = []  # one tuple per step; _HISTORY names the arrays

    def learn(self, state: State, info: Info) -> bool:
        """Record one step; return True if it closed a window and gave a new covariance.

        After the last window, only the chains' log-densities are followed.
        """
        smoothed = state.log_prob if self._log_prob is None else self._log_prob
        self._log_prob = _MEMORY * smoothed + (1.0 - _MEMORY) * state.log_prob
        self.step += 1
        windows = self.schedule.windows
        if not windows or self.step > windows[-1][1]:
            return False
        acceptance = info.extra.get("acceptance_rate", info.accepted)
        self._history.append((state.position, state.log_prob, acceptance))
        closed = [first for first, end in windows if end == self.step]
        draws = draws_in_bulk(*self._arrays(closed[0])) if closed else None
        if self.step == windows[-1][1]:
            self._history = []  # there are no more windows
        if draws is None:
            return False
        warp = None if self.choose_warp is None else self.choose_warp(draws)
        learnt = regularised_covariance(draws if warp is None else warp.to_x(draws))
        if learnt is None:
            return False
        self.covariance, self.warp = learnt, warp
        return True

    @property
    def searching(self) -> bool:
        """Whether warm-up is still in its first part."""
        return self.step < self.schedule.first

    def average_arrived(self, value: FloatArray) -> FloatArray:
        """Return the mean of `value` (chains,) over the chains that have reached the bulk, shape ()."""
        assert self._log_prob is not None  # learn() comes first
        return np.asarray(np.mean(value[find_arrived(self._log_prob, LAG + self.ndim)]))

    def state(self) -> Tree:
        """Return the learner's state as plain data, without the warp."""
        return {
            "step": self.step,
            "covariance": self.covariance,
            "log_prob": self._log_prob,
            "history": dict(zip(_HISTORY, self._arrays(), strict=False)),
        }

    def restore(self, state: Tree) -> None:
        """Restore the state that another learner's `state` returned. The warp must be restored separately."""
        self.step, self.covariance, self._log_prob = state["step"], state["covariance"], state["log_prob"]
        history = state["history"]
        self._history = list(zip(*(history[name] for name in _HISTORY if name in history), strict=True))

    def _arrays(self, first: int = 0) -> list[FloatArray]:
        """Return the recorded arrays from step `first` onwards, each with leading axes (steps, chains)."""
        return [np.array(values) for values in zip(*self._history[first:], strict=True)]


def draws_in_bulk(position: FloatArray, log_prob: FloatArray, acceptance: FloatArray) -> FloatArray | None:
    """Return the draws of all chains that are in the bulk of the target, shape (n, ndim).

    Chains that have not reached the bulk (see `find_arrived`) or hardly move are excluded. So are single draws
    with a far lower log-density; this loses only the far tails of the target.

    Parameters
    ----------
    position : ndarray, shape (steps, chains, ndim)
    log_prob, acceptance : ndarray, shape (steps, chains)

    Returns
    -------
    ndarray or None
        None if there are at most ``2 ndim`` draws, or a coordinate never changed.
    """
    if not len(position):
        return None
    ndim = position.shape[-1]
    mean = log_prob.mean(axis=0)
    included = find_arrived(mean, WINDOW_LAG + 0.5 * ndim, np.mean(acceptance, axis=0))
    near = log_prob >= _level(mean) - (LAG + ndim)
    draws = position[included & near]
    return draws if len(draws) > 2 * ndim and np.all(np.ptp(draws, axis=0) > 0) else None


def regularised_covariance(draws: FloatArray) -> FloatArray | None:
    """Return the covariance of draws (n, ndim), shape (ndim, ndim), or None if it is singular.

    It is shrunk towards its own diagonal with the weight of five draws, so the units of the parameters do not
    matter. (Stan shrinks towards a fixed size, which would distort the covariance of a posterior much narrower
    than the prior.)
    """
    n, ndim = draws.shape
    covariance = np.cov(draws, rowvar=False).reshape(ndim, ndim)
    spread = np.diag(covariance)
    if not np.all(spread > 0):
        return None
    covariance = (n * covariance + SHRINKAGE * np.diag(spread)) / (n + SHRINKAGE)
    # definiteness is checked on the correlations, as variances may differ too much for the rounding errors
    correlation = covariance / np.sqrt(np.outer(spread, spread))
    return covariance if np.all(np.linalg.eigvalsh(correlation) > 0) else None


def find_arrived(log_prob: FloatArray, allowance: float, acceptance: FloatArray | None = None) -> BoolArray:
    """Return a mask (chains,) of the chains that have reached the bulk, the region where most chains are.

    The criterion is each chain's (average) log-density, which scatters by only √(ndim/2) within one mode. It may
    differ by at most `allowance` from the value that at least half of the chains reach. A chain with a far lower
    value is still approaching the bulk or trapped. One with a far higher value has found a spike, or a mode that
    the other chains have not found yet. In either case its draws are of no use to the other chains.

    If `acceptance` is given, a chain must also accept at least `STUCK` times as often as the median chain, unless
    none of the chains in the bulk does.
    """
    near = np.abs(log_prob - _level(log_prob)) <= allowance
    if acceptance is None:
        return near
    moving = near & (acceptance >= STUCK * np.median(acceptance))
    return moving if moving.any() else near


def _level(log_prob: FloatArray) -> float:
    """Return the log-density that at least half of the chains reach.

    With one or two chains, this is the highest log-density.
    """
    return float(np.sort(log_prob)[::-1][(len(log_prob) + 1) // 2 - 1])
