"""How each of the samplers learns during warm-up."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .kernel import FloatArray, Info, LogDensity, State
from .metric import Metric
from .proposals import RandomWalk
from .warmup import LAG, DualAveraging, PooledMoments, Schedule, keeping_up

if TYPE_CHECKING:
    from .hamiltonian import HamiltonianKernel, HamiltonianMonteCarlo
    from .metropolis import MetropolisHastings
    from .slice import Slice

START_SCALE = 0.01
"""Standard deviation of a random walk before anything is learnt, in scaled units."""
START_WIDTH = 0.5
"""Interval of a slice before anything is learnt, in scaled units."""

_MOST_STEPS = 128
_MEMORY = 0.9
_MOST_LOG = 25.0


class _Learner:
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


class HamiltonianTuner:
    """Step size by dual averaging, inverse mass by the covariance of the windows, trajectory length from both.

    In the first part every chain has a step size of its own: a chain that is far out needs a small one, and must
    not impose it on the others. Then one step size serves all; chains that lag behind have no say in it.
    """

    def __init__(self, sampler: HamiltonianMonteCarlo, density: LogDensity, chains: int, steps: int) -> None:
        self.sampler = sampler
        self.learner = _Learner(Schedule.doubling(steps), density.ndim)
        self.kernel: HamiltonianKernel = sampler.bind(density)
        self.kernel = replace(self.kernel, step_size=np.full(chains, float(self.kernel.step_size)))
        self.averaging = DualAveraging(np.log(self.kernel.step_size), sampler.target_accept)

    def update(self, state: State, info: Info) -> None:
        """Learn from one step."""
        window_closed = self.learner.learn(state, info)
        acceptance = info.extra["acceptance_rate"]
        pooling = self.averaging.log_value.ndim == 0
        self.averaging.update(self.learner.pooled(acceptance) if pooling else acceptance)
        if not pooling and not self.learner.searching:
            # from here on one step size for all: the smallest that a chain in the bulk came to
            self.averaging = self._restarted(self.learner.pooled(self.averaging.averaged))
        if window_closed and self.sampler.inverse_mass is None:
            self.kernel = replace(self.kernel, metric=Metric(self.learner.covariance, state.position.shape[1]))
            self.averaging = self._restarted(np.log(0.5))
        step_size = np.exp(self.averaging.log_value)
        self.kernel = replace(self.kernel, step_size=step_size, n_steps=self._n_steps(step_size))

    def finished(self) -> HamiltonianMonteCarlo:
        """Return the settings learnt."""
        step_size = float(np.exp(np.mean(self.averaging.averaged)))
        inverse_mass = self.sampler.inverse_mass if self.learner.covariance is None else self.kernel.metric.inverse
        return replace(
            self.sampler, step_size=step_size, n_steps=self._n_steps(step_size), inverse_mass=inverse_mass
        )

    def _restarted(self, log_step_size: Any) -> DualAveraging:
        return DualAveraging(np.asarray(log_step_size, dtype=float), self.sampler.target_accept)

    def _n_steps(self, step_size: Any) -> int:
        """Return the steps that make a trajectory as long as wanted, once the metric tells what that is."""
        if self.sampler.n_steps is not None or (
            self.learner.covariance is None and self.sampler.inverse_mass is None
        ):
            return self.kernel.n_steps
        return int(np.clip(np.round(self.sampler.length / float(np.max(step_size))), 1, _MOST_STEPS))


class MetropolisTuner:
    """Covariance of a Gaussian random walk (Haario, Saksman & Tamminen 2001), its scale by the acceptance rate.

    The scale s of s²·S follows the acceptance rate of all chains that keep up towards its optimum, 0.44 in one
    dimension and 0.234 in many (Gelman, Roberts & Gilks 1996), by a Robbins–Monro recursion (Andrieu & Thoms 2008,
    algorithm 4); S is the covariance of each window in turn.
    """

    def __init__(self, sampler: MetropolisHastings, density: LogDensity, chains: int, steps: int) -> None:
        self.sampler, self.density = sampler, density
        self.learner = _Learner(Schedule.sliding(steps), density.ndim)
        self.target = 0.234 + (0.44 - 0.234) / density.ndim
        self.shape = START_SCALE**2 * np.eye(density.ndim)
        self.log_scale, self.count, self.sum = 0.0, 0, 0.0
        self.kernel = self._settings(0.0).bind(density)

    def update(self, state: State, info: Info) -> None:
        """Learn from one step."""
        window_closed = self.learner.learn(state, info)
        self.count += 1
        rate = float(self.learner.pooled(info.extra["acceptance_rate"]))
        gain = 3.0 / (self.count + 10) ** 0.6
        self.log_scale = float(np.clip(self.log_scale + gain * (rate - self.target), -_MOST_LOG, _MOST_LOG))
        if self.count > 20:
            self.sum += self.log_scale
        if window_closed:
            self.shape = np.asarray(self.learner.covariance)
            self.log_scale, self.count, self.sum = float(np.log(2.38 / np.sqrt(self.density.ndim))), 0, 0.0
        self.kernel = self._settings(self.log_scale).bind(self.density)

    def finished(self) -> MetropolisHastings:
        """Return the settings learnt, the scale averaged over the last steps."""
        averaged = self.sum / (self.count - 20) if self.count > 40 else self.log_scale
        return self._settings(averaged)

    def _settings(self, log_scale: float) -> MetropolisHastings:
        return replace(self.sampler, proposal=RandomWalk(np.exp(2.0 * log_scale) * self.shape))


class SliceTuner:
    """Axes along the principal directions of the covariance, intervals of a few standard deviations there.

    Tibbits, Groendyke, Haran & Liechty (2014), "Automated factor slice sampling".
    """

    def __init__(self, sampler: Slice, density: LogDensity, chains: int, steps: int) -> None:
        self.sampler, self.density = sampler, density
        self.learner = _Learner(Schedule.sliding(steps), density.ndim)
        self.kernel = sampler.bind(density)
        self.settings = replace(sampler, width=START_WIDTH)

    def update(self, state: State, info: Info) -> None:
        """Learn from one step."""
        if self.learner.learn(state, info) and self.learner.covariance is not None:
            variance, axes = np.linalg.eigh(self.learner.covariance)
            width = self.sampler.spread * np.sqrt(variance)
            self.settings = replace(self.sampler, width=width, axes=axes)
            self.kernel = self.settings.bind(self.density)

    def finished(self) -> Slice:
        """Return the settings learnt."""
        return self.settings
