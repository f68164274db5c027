"""Parallel tempering: chains between prior and posterior that swap places, so that no mode holds one for long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from fmu.samplers.hmc.hmc import HamiltonianMonteCarlo
from fmu.samplers.kernel import Info, State
from fmu.samplers.loop.settings import whole_number
from fmu.samplers.metropolis import MetropolisHastings
from fmu.samplers.slice import Slice
from fmu.samplers.tempering.density import PriorAndLikelihood
from fmu.samplers.tempering.kernel import TemperingKernel
from fmu.samplers.tempering.ladder import adapted, first_ladder, ladder, rejections, stages
from fmu.samplers.tempering.replicas import TemperedInfo, TemperedState
from fmu.types import FloatArray, LogDensity

_KERNELS = {kind.name: kind for kind in (Slice, MetropolisHastings, HamiltonianMonteCarlo)}


@dataclass(frozen=True)
class Tempering:
    """Parallel tempering over one of the other samplers.

    A chain is a ladder of replicas, of which replica k samples prior · likelihood^t_k, with t from 0 (the prior,
    drawn from independently) to 1 (the posterior, whose draws are the chain's). After a step neighbours propose to
    swap, the even and the odd pairs in turn: a replica that finds another mode near the prior carries it to the
    posterior. In warm-up the ladder is learnt for equal rejection of all swaps, and then the kernel's settings,
    for every rung its own. The log-likelihoods at all rungs give the evidence, see `fmu.evidence`.

    Parameters
    ----------
    kernel : {"slice", "mh", "hmc"}, Slice, MetropolisHastings or HamiltonianMonteCarlo
        What moves the replicas at t > 0; after warm-up a tuple of settings, one for each of these rungs.
    temperatures : array_like, shape (rungs,), optional
        Inverse temperatures from 0 to 1, which are then not learnt.
    rungs : int, optional
        Length of the ladder that is learnt. If not given it is about 2Λ + 1, Λ being the communication barrier
        that warm-up finds: half of all swaps then succeed, which makes most of the cost (Syed et al. 2022,
        section 4.3). At least 8, at most 64, and 12 to begin with.
    swap_every : int
        Steps from one round of swaps to the next.

    Raises
    ------
    ValueError
        If a setting is out of range or does not fit the others.

    References
    ----------
    Geyer (1991), Computing Science and Statistics 23, 156-163; Syed, Bouchard-Côté, Deligiannidis & Doucet (2022),
    JRSS B 84, 321-350, algorithms 1 (swaps) and 4 (ladder).
    """

    kernel: Any = "slice"
    temperatures: Any = None
    rungs: int | None = None
    swap_every: int = 1

    name: ClassVar[str] = "tempering"

    def __post_init__(self) -> None:
        if isinstance(self.kernel, str) and self.kernel in _KERNELS:
            object.__setattr__(self, "kernel", _KERNELS[self.kernel]())
        if self.temperatures is not None:
            object.__setattr__(self, "temperatures", ladder("temperatures", self.temperatures))
        if self.rungs is not None:
            whole_number("rungs", self.rungs, 2)
            if self.temperatures is not None and len(self.temperatures) != self.rungs:
                raise ValueError(f"rungs: must be the number of temperatures if both are given (got {self.rungs})")
        whole_number("swap_every", self.swap_every, 1)
        several = isinstance(self.kernel, tuple)
        if several and (self.temperatures is None or len(self.kernel) != len(self.temperatures) - 1):
            raise ValueError(f"kernel: must be one a temperature above 0 (got {len(self.kernel)})")
        kinds = {type(kernel) for kernel in self._kernels(1)}
        if len(kinds) != 1 or not kinds <= set(_KERNELS.values()):
            raise ValueError(
                f"kernel: must be one of {', '.join(_KERNELS)}, or settings of one (got {self.kernel!r})"
            )
        if any(getattr(kernel, "gradient", "exact") != "exact" for kernel in self._kernels(1)):
            raise ValueError("kernel.gradient: must be exact under tempering (got central-difference)")

    @property
    def walkers(self) -> int:
        """A chain is a single point: that of its posterior."""
        return 1

    def bind(self, density: LogDensity) -> TemperingKernel:
        """Return the kernel that samples `density`.

        Raises
        ------
        ValueError
            If the density is not made of a likelihood and a prior that can be drawn from, or a setting of the
            kernel does not fit it.
        """
        t = first_ladder(self.rungs) if self.temperatures is None else np.asarray(self.temperatures)
        kernels = {id(kernel): kernel.bind(density) for kernel in self._kernels(1)}
        bound = tuple(kernels[id(kernel)] for kernel in self._kernels(len(t) - 1))
        with_gradients = isinstance(self._kernels(1)[0], HamiltonianMonteCarlo)
        return TemperingKernel(PriorAndLikelihood(density, with_gradients), t, bound, self.swap_every)

    def tuner(self, density: LogDensity, chains: int, steps: int) -> LadderTuner | None:
        """Return what learns ladder and kernels in `steps` steps of warm-up, None if nothing is to be learnt."""
        learns = not isinstance(self.kernel, tuple) and self.kernel.tuner(density, chains, steps) is not None
        return LadderTuner(self, density, chains, steps) if learns or self.temperatures is None else None

    def _kernels(self, rungs: int) -> tuple[Any, ...]:
        """Return the settings at the rungs above the prior."""
        return self.kernel if isinstance(self.kernel, tuple) else (self.kernel,) * rungs


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
