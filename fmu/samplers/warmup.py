"""What a sampler learns before its draws count, and forgets to go on learning: schedule, step size, moments.

Adaptation is pooled over the chains of a task, frozen at the end of warm-up, and no draw of it is kept: the draws
that follow come from one fixed, valid kernel.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .kernel import BoolArray, FloatArray, State

# A chain whose log-density is on average this far below the best one's is on its way, or trapped: the others must
# not learn from it. Within one mode the log-density scatters by √(ndim/2) only.
OUTLIER = 30.0


@dataclass(frozen=True)
class Schedule:
    """Warm-up in three parts, as in Stan (Carpenter et al. 2017, reference manual, "HMC algorithm parameters").

    The first finds the bulk of the distribution; the second learns the shape in windows that double, each from
    its own draws alone; the last settles the scale under the final shape.

    Attributes
    ----------
    steps, first, last : int
        Steps in all, in the first part, and in the last.
    ends : tuple of int
        Step (from 0) after which each window of the second part closes.
    """

    steps: int
    first: int
    last: int
    ends: tuple[int, ...]

    @classmethod
    def of(cls, steps: int) -> Schedule:
        """Return the schedule of a warm-up of that many steps; a short one has no windows."""
        first, last = int(0.15 * steps), int(0.15 * steps)
        ends: list[int] = []
        start, size = first, 25
        stop = steps - last
        while stop - start >= size:
            # the last window takes what a further doubling would not leave enough of
            end = start + size if stop - (start + size) >= 2 * size else stop
            ends.append(end - 1)
            start, size = end, 2 * size
        return cls(steps, first, last, tuple(ends))


@dataclass
class DualAveraging:
    """Nesterov's dual averaging of a logarithm towards an acceptance rate (Hoffman & Gelman 2014, section 3.2).

    Works on an array: one entry for pooled chains, or one a chain.
    """

    log_value: FloatArray
    target: float
    gamma: float = 0.05
    t0: float = 10.0
    kappa: float = 0.75
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
        self.log_value = self._centre - np.sqrt(t) / self.gamma * self._error
        decay = t**-self.kappa
        self._average = decay * self.log_value + (1.0 - decay) * self._average

    @property
    def averaged(self) -> FloatArray:
        """The smoothed logarithm, to be frozen."""
        return self._average if self._count else self.log_value


class PooledMoments:
    """Covariance of the draws of all chains of a window, those of chains that lag behind left out."""

    def __init__(self) -> None:
        self._positions: list[FloatArray] = []
        self._log_probs: list[FloatArray] = []

    def add(self, state: State) -> None:
        """Take one step of all chains into account."""
        self._positions.append(state.position)
        self._log_probs.append(state.log_prob)

    def covariance(self) -> FloatArray | None:
        """Return the regularised covariance (ndim, ndim), None where the draws are too few or never moved.

        Shrunk towards its own diagonal with the weight of five draws, so that the parameters' units do not matter
        (Stan shrinks towards a fixed size, which would blur a posterior that is narrow in the prior's units).
        """
        if not self._positions:
            return None
        included = keeping_up(np.mean(self._log_probs, axis=0))
        draws = np.concatenate([position[included] for position in self._positions])
        if len(draws) <= 2 * draws.shape[1]:
            return None
        covariance = np.cov(draws, rowvar=False).reshape(draws.shape[1], draws.shape[1])
        spread = np.diag(covariance)
        if not np.all(spread > 0):
            return None
        n = len(draws)
        covariance = (n * covariance + 5.0 * np.diag(spread)) / (n + 5.0)
        return covariance if np.all(np.linalg.eigvalsh(covariance) > 0) else None


def keeping_up(log_prob: FloatArray) -> BoolArray:
    """Return which chains, by their (average) log-density, are with the best one; shape (chains,)."""
    return log_prob >= np.max(log_prob) - OUTLIER
