"""How each of the samplers learns during warm-up."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.samplers.adaptation.schedule import LAG, DualAveraging, PooledMoments, Schedule, keeping_up
from fmu.samplers.hmc.metric import Metric
from fmu.samplers.kernel import Info, Kernel, LogDensity, State
from fmu.samplers.proposals import RandomWalk
from fmu.types import FloatArray

if TYPE_CHECKING:
    from fmu.samplers.hmc.hmc import HamiltonianKernel, HamiltonianMonteCarlo
    from fmu.samplers.metropolis import MetropolisHastings
    from fmu.samplers.slice import Slice, SliceKernel

START_SCALE = 0.01
"""Standard deviation of a random walk before anything is learnt, in scaled units."""
START_WIDTH = 0.5
"""Interval of a slice before anything is learnt, in scaled units."""

_MOST_STEPS = 32  # of a trajectory: a metric that fits needs 2 to 8; one that does not must not cost without end
_MEMORY = 0.9  # weight of the past in the smoothed log-density of a chain
_SETTLING = 20  # steps that the scale of a random walk takes to settle


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
        inverse_mass = self.sampler.inverse_mass
        if inverse_mass is None and self.learner.covariance is not None:
            inverse_mass = self.learner.covariance
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


class SliceTuner:
    """Axes along the principal directions of the covariance, intervals of a few standard deviations there.

    Tibbits, Groendyke, Haran & Liechty (2014), "Automated factor slice sampling".
    """

    def __init__(self, sampler: Slice, density: LogDensity, steps: int) -> None:
        self.sampler, self.density = sampler, density
        self.learner = _Learner(Schedule.sliding(steps), density.ndim)
        self.kernel: SliceKernel = sampler.bind(density)
        self.settings = replace(sampler, width=START_WIDTH)
        self.window_closed = False

    def update(self, state: State, info: Info) -> None:
        """Learn from one step."""
        self.window_closed = self.learner.learn(state, info)
        if self.window_closed:
            variance, axes = np.linalg.eigh(np.asarray(self.learner.covariance))
            width = self.sampler.spread * np.sqrt(variance)
            self.settings = replace(self.sampler, width=width, axes=axes)
            self.kernel = self.settings.bind(self.density)

    def finished(self) -> Slice:
        """Return the settings learnt."""
        return self.settings


@dataclass(frozen=True)
class Search:
    """Steps of a slice sampler that are recorded as those of a Metropolis sampler are."""

    kernel: SliceKernel

    def init(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate the start."""
        return self.kernel.init(positions)

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Draw from the slice: never rejected."""
        state, info = self.kernel.step(rng, state)
        extra = {"acceptance_rate": info.accepted.astype(float), "n_nonfinite": info.extra["n_nonfinite"]}
        return state, replace(info, extra=extra)


class MetropolisTuner:
    """Covariance of a Gaussian random walk (Haario, Saksman & Tamminen 2001), its scale by the acceptance rate.

    A random walk of unknown shape and size takes long to reach the bulk, and may learn on the way what fits the
    way alone. The first part of the warm-up is therefore done by slice sampling, which finds its own scale in
    every step; the covariance it has learnt by then is where the random walk begins, and each window improves it.

    The scale s of s²·S follows the acceptance rate of all chains that keep up towards its optimum, 0.44 in one
    dimension and 0.234 in many (Gelman, Roberts & Gilks 1996), by a Robbins–Monro recursion (Andrieu & Thoms 2008,
    algorithm 4); S is the covariance of each window in turn.
    """

    def __init__(self, sampler: MetropolisHastings, density: LogDensity, search: SliceTuner) -> None:
        self.sampler, self.density, self.search = sampler, density, search
        self.target = 0.234 + (0.44 - 0.234) / density.ndim
        self.shape = START_SCALE**2 * np.eye(density.ndim)
        self._restart(0.0)
        self.kernel: Kernel = Search(search.kernel)

    def update(self, state: State, info: Info) -> None:
        """Learn from one step."""
        searching = self.search.learner.searching
        self.search.update(state, info)
        if not searching:
            self.count += 1
            rate = float(self.search.learner.pooled(info.extra["acceptance_rate"]))
            self.log_scale += 3.0 / (self.count + 10) ** 0.6 * (rate - self.target)
            if self.count > _SETTLING:
                self.sum += self.log_scale
        if self.search.window_closed:
            self.shape = np.asarray(self.search.learner.covariance)
            self._restart(float(np.log(2.38 / np.sqrt(self.density.ndim))))
        if self.search.learner.searching:
            self.kernel = Search(self.search.kernel)
        else:
            self.kernel = self._settings(self.log_scale).bind(self.density)

    def finished(self) -> MetropolisHastings:
        """Return the settings learnt, the scale averaged over the last steps."""
        averaged = self.sum / (self.count - _SETTLING) if self.count > 2 * _SETTLING else self.log_scale
        return self._settings(averaged)

    def _restart(self, log_scale: float) -> None:
        self.log_scale, self.count, self.sum = log_scale, 0, 0.0

    def _settings(self, log_scale: float) -> MetropolisHastings:
        return replace(self.sampler, proposal=RandomWalk(np.exp(2.0 * log_scale) * self.shape))
