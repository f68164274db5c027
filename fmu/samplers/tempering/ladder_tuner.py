"""How parallel tempering learns its ladder, and the settings of the kernel at every rung."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.samplers.kernel import Info, LogDensity, State
from fmu.samplers.tempering.ladder import adapted, rejections, stages
from fmu.samplers.tempering.replicas import TemperedInfo, TemperedState
from fmu.types import FloatArray

if TYPE_CHECKING:
    from fmu.samplers.tempering.tempering import Tempering, TemperingKernel


class LadderTuner:
    """Learns the ladder, stage by stage of warm-up, and in every stage anew the kernel's settings at each rung.

    Each rung above the prior has a tuner of its own, which sees the chains at that rung. The last stage, half of
    the warm-up, is on the ladder that the draws are made with.
    """

    def __init__(self, sampler: Tempering, density: LogDensity, chains: int, steps: int) -> None:
        self.sampler, self.density, self.chains = sampler, density, chains
        self.lengths = [steps] if sampler.temperatures is not None else stages(steps)
        self.bound = replace(sampler.bind(density), records=False)
        self._begin(self.bound.temperatures)

    def update(self, state: State, info: Info) -> None:
        """Learn from one step; ValueError unless it is one of tempering."""
        if not (isinstance(state, TemperedState) and isinstance(info, TemperedInfo)):
            raise ValueError(f"state: must be one of tempering (got {type(state).__name__})")
        self.log_likelihood.append(state.replicas.log_likelihood.T)
        self._tell_the_tuners(state, info)
        if len(self.log_likelihood) == self.lengths[0] and len(self.lengths) > 1:
            del self.lengths[0]
            settled = np.array(self.log_likelihood[len(self.log_likelihood) // 2 :]).swapaxes(0, 1)
            rejection = rejections(settled, self.temperatures).mean(axis=0)
            self._begin(adapted(self.temperatures, rejection, self.sampler.rungs))
        elif self.tuners:
            self._use([tuner.kernel for tuner in self.tuners])

    def finished(self) -> Tempering:
        """Return the settings learnt."""
        kernel = tuple(tuner.finished() for tuner in self.tuners) or self.sampler.kernel
        return replace(self.sampler, kernel=kernel, temperatures=self.temperatures, rungs=len(self.temperatures))

    def _begin(self, temperatures: FloatArray) -> None:
        """Begin a stage on a ladder."""
        self.temperatures = temperatures
        self.log_likelihood: list[FloatArray] = []
        above = len(temperatures) - 1
        settings, steps = self.sampler.kernel, self.lengths[0]
        tuners = [settings.tuner(self.density, self.chains, steps) for _ in range(above)]
        self.tuners = [tuner for tuner in tuners if tuner is not None]
        self._use([tuner.kernel for tuner in self.tuners] or [self.bound.kernels[0]] * above)

    def _use(self, kernels: Sequence[Any]) -> None:
        self.kernel: TemperingKernel = replace(self.bound, temperatures=self.temperatures, kernels=tuple(kernels))

    def _tell_the_tuners(self, state: TemperedState, info: TemperedInfo) -> None:
        t = self.temperatures[1:, None]
        above = state.replicas.each(lambda a: a[1:])
        log_prob, gradient = above.log_prob(t), above.gradient(t)
        for k, tuner in enumerate(self.tuners):
            own = slice(k * self.chains, (k + 1) * self.chains)
            slope = None if gradient is None else gradient[k]
            tuner.update(State(above.position[k], log_prob[k], slope), _part(info.of_rungs, own))


def _part(info: Info, chains: slice) -> Info:
    """Return the info of some of the replicas."""
    return Info(
        info.accepted[chains],
        info.log_prob[chains],
        info.n_solves[chains],
        info.n_gradients[chains],
        {name: value[chains] for name, value in info.extra.items()},
    )
