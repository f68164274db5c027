"""Parallel tempering, in which replicas of a chain at several temperatures swap positions to leave modes.

Replica k samples prior · likelihood^t_k. The inverse temperatures t_k form a ladder of rungs, from 0 (the prior)
to 1 (the posterior). A swap between neighbouring rungs k and k+1 is rejected with probability r_k. The sum Λ of
all r_k is the communication barrier between prior and posterior; with many rungs it hardly depends on their
positions. Replicas travel fastest if all r_k are equal and there are about 2Λ rungs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fmu.arguments import check_arguments
from fmu.samplers.kernel import Info, Sampler, State, Tree
from fmu.samplers.local import LocalKernel, LocalSampler
from fmu.samplers.registry import SAMPLERS, local_samplers, make_sampler
from fmu.samplers.settings import vector, whole_number
from fmu.samplers.tempering.density import PriorAndLikelihood
from fmu.samplers.tempering.kernel import TemperingKernel, replicas_of
from fmu.types import FloatArray, LogDensity

FEWEST, MOST = 8, 64
"""Smallest and largest default number of rungs of a learnt ladder; fewer rungs give inaccurate evidences."""
FIRST = 12
"""Number of rungs before the ladder is learnt."""
_POWER = 5.0
"""Exponent of the initial ladder, with rungs at (k/K)⁵, because posteriors are far narrower than priors (Friel &
Pettitt 2008)."""
_SHORTEST = 20  # fewest steps of a stage of the warm-up
_LEAST = 1e-3  # smallest rejection probability that the interpolation uses, so that the barrier increases


@check_arguments
@dataclass(frozen=True)
class Tempering(Sampler):
    """Parallel tempering, with the replicas moved by one of the local samplers.

    Each chain is a ladder of replicas. Replica k samples prior · likelihood^t_k, with t_k from 0 (independent
    draws from the prior) to 1 (the posterior; its draws are the draws of the chain). After every `swap_every`
    steps, swaps between neighbouring replicas are proposed, for even and odd pairs in turn. A replica that finds
    another mode near the prior thus carries it to the posterior. Warm-up learns the ladder on which all swaps are
    rejected equally often, and the kernel settings for every rung, unless they are given. The log-likelihoods at
    all rungs give the evidence; see `fmu.evidence`.

    Parameters
    ----------
    kernel : str, LocalSampler or tuple of LocalSampler
        Sampler that moves the replicas at t > 0: a name such as "slice", "mh" or "hmc", or its settings. A tuple
        has one entry for each temperature above 0, and requires `temperatures`. If warm-up learns the settings, it
        replaces them by such a tuple.
    temperatures : array_like, shape (rungs,), optional
        Inverse temperatures from 0 to 1; learnt in warm-up by default.
    rungs : int, optional
        Number of rungs of the learnt ladder. The default is about 2Λ + 1, where Λ is the communication barrier
        found in warm-up. Half of all swaps then succeed, which is the best use of the solves (Syed et al. 2022,
        section 4.3). By default there are 8 to 64 rungs, and 12 when warm-up begins.
    swap_every : int
        Number of steps between two rounds of swaps.

    Raises
    ------
    ValueError
        If a setting is out of range or does not fit the other settings, if `temperatures` are not distinct numbers
        from 0 to 1 that include both ends, or if `kernel` is not a local sampler, takes central differences or has
        `bent`.

    References
    ----------
    Geyer (1991), Computing Science and Statistics 23, 156-163; Syed, Bouchard-Côté, Deligiannidis & Doucet (2022),
    JRSS B 84, 321-350, algorithms 1 (swaps) and 4 (ladder).
    """

    kernel: Any = "slice"
    temperatures: ArrayLike | None = None
    rungs: int | None = None
    swap_every: int = 1

    name: ClassVar[str] = "tempering"
    title: ClassVar[str] = "Parallel tempering"
    colour: ClassVar[str] = "#56B4E9"
    cost: ClassVar[tuple[float, float, float]] = (50.0, 35.0, 1.0)
    learns_together: ClassVar[bool] = True

    def __post_init__(self) -> None:
        given = self.kernel
        if isinstance(given, str) and given in SAMPLERS:
            object.__setattr__(self, "kernel", make_sampler(given))
        if self.temperatures is not None:
            object.__setattr__(self, "temperatures", ladder("temperatures", self.temperatures))
        if self.rungs is not None:
            whole_number("rungs", self.rungs, 2)
            if self.temperatures is not None and np.size(self.temperatures) != self.rungs:
                raise ValueError(f"rungs: must be the number of temperatures if both are given (got {self.rungs})")
        whole_number("swap_every", self.swap_every, 1)
        if self._is_by_rung and (self.temperatures is None or len(self.kernel) != np.size(self.temperatures) - 1):
            raise ValueError(f"kernel: must be one per temperature above 0 (got {len(self.kernel)})")
        kinds = {type(kernel) for kernel in self._kernels(1)}
        if len(kinds) != 1 or not issubclass(kinds.pop(), LocalSampler):
            raise ValueError(
                f"kernel: must be one of {', '.join(local_samplers())}, or settings of one (got {given!r})"
            )
        if any(kernel.gradient == "central-difference" for kernel in self._kernels(1)):
            raise ValueError("kernel.gradient: must be exact under tempering (got central-difference)")
        if any(kernel.is_bent for kernel in self._kernels(1)):
            raise ValueError("kernel.bent: must not be given under tempering, which transforms no coordinates")

    def bind(self, density: LogDensity) -> TemperingKernel:
        """Return the kernel that samples `density`.

        Raises
        ------
        ValueError
            If the density lacks the methods that `PriorAndLikelihood` needs, or a setting of the kernel does not
            fit the density.
        """
        t = first_ladder(self.rungs) if self.temperatures is None else np.asarray(self.temperatures)
        kernels = {id(kernel): kernel.bind(density) for kernel in self._kernels(1)}
        bound = tuple(kernels[id(kernel)] for kernel in self._kernels(len(t) - 1))
        parts = PriorAndLikelihood(density, self._kernels(1)[0].takes_gradients)
        return TemperingKernel(parts, t, bound, self.swap_every)

    def tuner(self, density: LogDensity, chains: int, steps: int) -> LadderTuner | None:
        """Return a tuner that learns the ladder and the kernels' settings in `steps` warm-up steps.

        Return None if the ladder is given and the kernel has nothing to learn.
        """
        learns = not self._is_by_rung and self.kernel.rung_tuner(density, chains, steps) is not None
        return LadderTuner(self, density, chains, steps) if learns or self.temperatures is None else None

    @property
    def _is_by_rung(self) -> bool:
        """Whether each rung has its own kernel settings."""
        return isinstance(self.kernel, tuple)

    def _kernels(self, rungs: int) -> tuple[LocalSampler, ...]:
        """Return the kernel settings at the `rungs` rungs above the prior."""
        return self.kernel if self._is_by_rung else (self.kernel,) * rungs


class LadderTuner:
    """Tuner of the ladder, unless it is given, and of the kernel at each rung, if the kernel learns anything.

    The ladder changes between the stages of warm-up. Each rung above the prior has its own tuner, which learns
    from the replicas at that rung and is restarted in every stage. The last stage, half of warm-up, already uses
    the final ladder.
    """

    def __init__(self, sampler: Tempering, density: LogDensity, chains: int, steps: int) -> None:
        self.sampler, self.density, self.chains = sampler, density, chains
        self.lengths = [steps] if sampler.temperatures is not None else stages(steps)
        self.bound = replace(sampler.bind(density), records=False)
        self.log_likelihood: list[FloatArray] = []  # (chains, rungs), of each step; not in the last stage
        self._begin(self.bound.temperatures)

    def update(self, state: State, info: Info) -> None:
        """Adapt the settings to one more warm-up step."""
        self._tell_the_tuners(state, info)
        if len(self.lengths) > 1:
            self.log_likelihood.append(replicas_of(state).log_likelihood.T)
        if len(self.log_likelihood) == self.lengths[0] and len(self.lengths) > 1:
            del self.lengths[0]
            settled = np.array(self.log_likelihood[len(self.log_likelihood) // 2 :]).swapaxes(0, 1)
            rejection = rejections(settled, self.temperatures).mean(axis=0)
            self._begin(adapt_ladder(self.temperatures, rejection, self.sampler.rungs))
        elif self.tuners:
            self._take_kernels([tuner.kernel for tuner in self.tuners])

    def finish_learning(self) -> Tempering:
        """Return the settings with the learnt ladder and kernels."""
        kernel = tuple(tuner.finish_learning() for tuner in self.tuners) or self.sampler.kernel
        return replace(self.sampler, kernel=kernel, temperatures=self.temperatures, rungs=len(self.temperatures))

    def state(self) -> Tree:
        """Return the tuner's state as plain data."""
        return {
            "lengths": self.lengths,
            "temperatures": self.temperatures,
            "log_likelihood": np.array(self.log_likelihood),
            "tuners": {str(k): tuner.state() for k, tuner in enumerate(self.tuners)},
        }

    def restore(self, state: Tree) -> None:
        """Restore the state that another tuner's `state` returned."""
        self.lengths = list(state["lengths"])
        self._begin(state["temperatures"])
        self.log_likelihood = list(state["log_likelihood"])
        for k, tuner in enumerate(self.tuners):
            tuner.restore(state["tuners"][str(k)])
        if self.tuners:
            self._take_kernels([tuner.kernel for tuner in self.tuners])

    def _begin(self, temperatures: FloatArray) -> None:
        """Begin a stage of warm-up with the given inverse temperatures."""
        self.temperatures = temperatures
        self.log_likelihood = []
        above = len(temperatures) - 1
        settings, steps = self.sampler.kernel, self.lengths[0]
        tuners = [settings.rung_tuner(self.density, self.chains, steps) for _ in range(above)]
        self.tuners = [tuner for tuner in tuners if tuner is not None]
        self._take_kernels([tuner.kernel for tuner in self.tuners] or [self.bound.kernels[0]] * above)

    def _take_kernels(self, kernels: Sequence[LocalKernel]) -> None:
        self.kernel: TemperingKernel = replace(self.bound, temperatures=self.temperatures, kernels=tuple(kernels))

    def _tell_the_tuners(self, state: State, info: Info) -> None:
        """Update each rung's tuner with the replicas at the rung and their tempered log-densities."""
        parts, t = info.parts, self.temperatures[1:, None]
        assert parts is not None  # TemperingKernel returns them
        above = replicas_of(state).each(lambda a: a[1:])
        log_prob, gradient = above.log_prob(t), above.gradient(t)
        for k, tuner in enumerate(self.tuners):
            own = slice(k * self.chains, (k + 1) * self.chains)
            local = Info(
                parts.accepted[own],
                parts.log_prob[own],
                parts.n_solves[own],
                parts.n_gradients[own],
                {name: value[own] for name, value in parts.extra.items()},
            )
            tuner.update(State(above.position[k], log_prob[k], None if gradient is None else gradient[k]), local)


def ladder(name: str, value: ArrayLike) -> tuple[float, ...]:
    """Return inverse temperatures in ascending order.

    Raise ValueError unless they are distinct and run from 0 to 1, both included.
    """
    t = tuple(sorted(vector(name, value)))
    if len(t) < 2 or t[0] != 0.0 or t[-1] != 1.0 or len(set(t)) < len(t):
        raise ValueError(f"{name}: must be distinct inverse temperatures from 0 to 1, with both (got {value!r})")
    return t


def first_ladder(rungs: int | None) -> FloatArray:
    """Return the initial inverse temperatures, shape (rungs,); there are `FIRST` rungs if `rungs` is None."""
    return np.linspace(0.0, 1.0, rungs or FIRST) ** _POWER


def stages(steps: int) -> list[int]:
    """Return the lengths of the warm-up stages in steps. The ladder changes from stage to stage.

    Each stage but the first is about as long as all previous stages together. With fewer than 40 steps there is
    one stage, so the ladder does not change. With 0 steps the list is empty.
    """
    lengths = []
    while steps >= 2 * _SHORTEST:
        lengths.append(steps - steps // 2)
        steps //= 2
    return [*([steps] if steps else []), *reversed(lengths)]


def rejections(log_likelihood: FloatArray, temperatures: FloatArray) -> FloatArray:
    """Return the probability that a swap between neighbouring rungs is rejected, shape (..., rungs − 1).

    This is the mean over the draws of 1 − min(1, exp((t_{k+1} − t_k)(l_k − l_{k+1}))), where l_k is the
    log-likelihood at rung k.

    Parameters
    ----------
    log_likelihood : ndarray, shape (..., draws, rungs)
    temperatures : ndarray, shape (rungs,)
    """
    gain = np.diff(temperatures) * (log_likelihood[..., :-1] - log_likelihood[..., 1:])
    return np.mean(1.0 - np.exp(np.minimum(gain, 0.0)), axis=-2)


def adapt_ladder(temperatures: FloatArray, rejection: FloatArray, rungs: int | None) -> FloatArray:
    """Return the inverse temperatures at which all swaps are expected to be rejected equally often.

    The barrier from 0 to each rung, Λ(t_k) = r_0 + … + r_{k−1}, is interpolated monotonically and divided into
    equal parts (Syed et al. 2022).

    Parameters
    ----------
    temperatures : ndarray, shape (rungs,)
        The present inverse temperatures t_k.
    rejection : ndarray, shape (rungs − 1,)
        Probabilities r_k that a swap between the rungs k and k + 1 is rejected.
    rungs : int, optional
        Number of rungs of the new ladder. By default half of all swaps are expected to succeed, but there are at
        least `FEWEST` and at most `MOST` rungs.
    """
    from scipy.interpolate import PchipInterpolator

    barrier = np.concatenate([[0.0], np.cumsum(np.maximum(rejection, _LEAST))])
    if rungs is None:
        rungs = int(np.clip(np.ceil(2.0 * np.sum(rejection)) + 1, FEWEST, MOST))
    level = np.linspace(0.0, barrier[-1], rungs)
    t = PchipInterpolator(barrier, temperatures)(level)
    t[0], t[-1] = 0.0, 1.0
    return t if np.all(np.diff(t) > 0.0) else np.interp(level, barrier, temperatures)
