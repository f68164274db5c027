"""What a sampler learns before its draws count, and forgets to go on learning: schedule, step size, moments.

Adaptation is pooled over the chains of a task, frozen at the end of warm-up, and no draw of it is kept: the draws
that follow come from one fixed, valid kernel.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fmu.types import BoolArray, FloatArray

LAG = 10.0
"""A log-density that falls short of most chains' by this much, and one a coordinate, is not in their place."""
WINDOW_LAG = 3.0
"""The same for the mean over a window, and half of one a coordinate: it scatters less than a single draw."""
STUCK = 0.3
"""A chain that accepts less than this fraction of what the median chain accepts does not fit their settings."""
SHRINKAGE = 5.0
"""Draws that the diagonal of a covariance counts for."""


@dataclass(frozen=True)
class Schedule:
    """Warm-up in three parts, as in Stan (Carpenter et al. 2017, reference manual, "HMC algorithm parameters").

    The first finds the bulk of the distribution; the second learns the shape, in windows; the last settles the
    scale under the final shape.

    Attributes
    ----------
    steps, first, last : int
        Steps in all, in the first part, and in the last.
    windows : tuple of (int, int)
        First step (from 0) of each window and the step before which it closes: what is learnt there comes from
        these steps alone.
    """

    steps: int
    first: int
    last: int
    windows: tuple[tuple[int, int], ...]

    @classmethod
    def doubling(cls, steps: int) -> Schedule:
        """Return windows one after the other, each twice as long as the one before; none in a short warm-up.

        For a sampler that must settle anew in every window.
        """
        first = last = int(0.15 * steps)
        windows: list[tuple[int, int]] = []
        start, size, stop = first, 25, steps - last
        while stop - start >= size:
            # the last window takes what a further doubling would not leave enough of
            end = start + size if stop - (start + size) >= 2 * size else stop
            windows.append((start, end))
            start, size = end, 2 * size
        return cls(steps, first, last, tuple(windows))

    @classmethod
    def sliding(cls, steps: int) -> Schedule:
        """Return windows of the later half of all steps so far, closing ever 10 % later; none in a short warm-up.

        For a sampler that mixes slowly until it knows the shape: each window is drawn with a better one.
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
    """Nesterov's dual averaging of a logarithm towards an acceptance rate (Hoffman & Gelman 2014, section 3.2).

    Works on an array: one entry for pooled chains, or one a chain. The logarithm is kept within `lowest` and
    `highest`, where nothing is ever accepted or always everything.
    """

    log_value: FloatArray
    target: float
    gamma: float = 0.05
    t0: float = 10.0
    kappa: float = 0.75
    lowest: float = -25.0
    highest: float = 25.0
    _count: int = 0
    _error: FloatArray = field(init=False)
    _centre: FloatArray = field(init=False)
    _average: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self._error = np.zeros_like(self.log_value)
        self._centre = self.log_value + np.log(10.0)
        self._average = np.zeros_like(self.log_value)

    def update(self, acceptance: FloatArray) -> None:
        """Take one observed acceptance probability into account."""
        self._count += 1
        t = self._count
        weight = 1.0 / (t + self.t0)
        self._error = (1.0 - weight) * self._error + weight * (self.target - acceptance)
        self.log_value = np.clip(self._centre - np.sqrt(t) / self.gamma * self._error, self.lowest, self.highest)
        decay = t**-self.kappa
        self._average = decay * self.log_value + (1.0 - decay) * self._average

    @property
    def averaged(self) -> FloatArray:
        """The smoothed logarithm, to be frozen."""
        return self._average if self._count else self.log_value


class PooledMoments:
    """Covariance of the draws of all chains in a window, but for what is no draw from where most chains are.

    Left out are chains that lag behind, are trapped or stand still on the average of the window, and single draws
    on the way. What is left of a sampler's target is all but its far tails.
    """

    def __init__(self) -> None:
        self._positions: list[FloatArray] = []
        self._log_probs: list[FloatArray] = []
        self._acceptance: list[FloatArray] = []

    def add(self, position: FloatArray, log_prob: FloatArray, acceptance: FloatArray) -> None:
        """Take one step of all chains into account: (chains, ndim), (chains,), (chains,)."""
        self._positions.append(position)
        self._log_probs.append(log_prob)
        self._acceptance.append(acceptance)

    def covariance(self, first: int = 0) -> FloatArray | None:
        """Return the regularised covariance (ndim, ndim) of the steps from `first` on.

        None where the draws are too few or never moved. Shrunk towards its own diagonal with the weight of five
        draws, so that the parameters' units do not matter (Stan shrinks towards a fixed size, which would blur a
        posterior that is narrow in the prior's units).
        """
        if len(self._positions) <= first:
            return None
        log_prob, ndim = np.array(self._log_probs[first:]), self._positions[0].shape[1]
        mean = log_prob.mean(axis=0)
        included = keeping_up(mean, WINDOW_LAG + 0.5 * ndim, np.mean(self._acceptance[first:], axis=0))
        near = log_prob >= _level(mean) - (LAG + ndim)
        draws = np.array(self._positions[first:])[included & near]
        if len(draws) <= 2 * ndim:
            return None
        covariance = np.cov(draws, rowvar=False).reshape(ndim, ndim)
        spread = np.diag(covariance)
        if not np.all(spread > 0):
            return None
        n = len(draws)
        covariance = (n * covariance + SHRINKAGE * np.diag(spread)) / (n + SHRINKAGE)
        correlation = covariance / np.sqrt(np.outer(spread, spread))
        return covariance if np.all(np.linalg.eigvalsh(correlation) > 0) else None


def keeping_up(log_prob: FloatArray, allowance: float, acceptance: FloatArray | None = None) -> BoolArray:
    """Return which chains are where most of them are, shape (chains,).

    By their (average) log-density, which within one mode scatters by √(ndim/2) only: a chain far below is on its
    way or trapped; one far above has found a spike, or a mode that the others have yet to find. Either way the
    others cannot use what it learns. And by how much they accept, if that is given.
    """
    near = np.abs(log_prob - _level(log_prob)) <= allowance
    if acceptance is None:
        return near
    moving = near & (acceptance >= STUCK * np.median(acceptance))
    return moving if moving.any() else near


def _level(log_prob: FloatArray) -> float:
    """Return the log-density that half of the chains reach: of one or two the best."""
    return float(np.sort(log_prob)[::-1][(len(log_prob) + 1) // 2 - 1])
