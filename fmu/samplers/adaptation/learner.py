"""What all tuners have in common: the schedule of the warm-up, and moments of the chains that keep up."""

from __future__ import annotations

import numpy as np

from fmu.samplers.adaptation.schedule import LAG, PooledMoments, Schedule, keeping_up
from fmu.samplers.kernel import Info, State
from fmu.types import FloatArray

_MEMORY = 0.9  # weight of the past in the smoothed log-density of a chain


class Learner:
    """The part that all tuners share: where in the schedule, which chains keep up, the moments of the window."""

    def __init__(self, schedule: Schedule, ndim: int) -> None:
        self.schedule, self.ndim = schedule, ndim
        self.step = 0
        self.moments = PooledMoments()
        self.covariance: FloatArray | None = None
        self._log_prob: FloatArray | None = None

    def learn(self, state: State, info: Info) -> bool:
        """Take one step into account; True where a window has just closed with a new covariance."""
        smoothed = state.log_prob if self._log_prob is None else self._log_prob
        self._log_prob = _MEMORY * smoothed + (1.0 - _MEMORY) * state.log_prob
        self.moments.add(state.position, state.log_prob, info.extra.get("acceptance_rate", info.accepted))
        self.step += 1
        closed = [first for first, end in self.schedule.windows if end == self.step]
        learnt = self.moments.covariance(closed[0]) if closed else None
        if learnt is None:
            return False
        self.covariance = learnt
        return True

    @property
    def searching(self) -> bool:
        """Whether the first part of the warm-up still runs."""
        return self.step < self.schedule.first

    def pooled(self, value: FloatArray) -> FloatArray:
        """Return the mean over the chains that keep up."""
        assert self._log_prob is not None  # learn() comes first
        return np.asarray(np.mean(value[keeping_up(self._log_prob, LAG + self.ndim)]))
