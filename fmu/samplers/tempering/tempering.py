"""Parallel tempering: chains between prior and posterior that swap places, so that no mode holds one for long."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fmu.samplers.hmc.hmc import HamiltonianMonteCarlo
from fmu.samplers.kernel import Info, Kernel, LogDensity, State
from fmu.samplers.loop.settings import whole_number
from fmu.samplers.metropolis import MetropolisHastings
from fmu.samplers.slice import Slice
from fmu.samplers.tempering.density import Points, PriorAndLikelihood, TemperedDensity, stacked
from fmu.samplers.tempering.ladder import first_ladder, ladder
from fmu.samplers.tempering.ladder_tuner import LadderTuner
from fmu.samplers.tempering.replicas import TemperedInfo, TemperedState
from fmu.samplers.tempering.rungs import on_density, side_by_side
from fmu.types import FloatArray, IntArray

LOG_LIKELIHOOD = "rung_log_likelihood"
"""Statistic of a run: the log-likelihood at every rung, from the prior to the posterior."""
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


@dataclass(frozen=True)
class TemperingKernel:
    """Parallel tempering bound to a density; `kernels` are those of the rungs above the prior."""

    parts: PriorAndLikelihood
    temperatures: FloatArray
    kernels: tuple[Any, ...]
    swap_every: int
    records: bool = True
    _joined: dict[int, Kernel] = field(default_factory=dict, init=False, repr=False, compare=False)

    def init(self, positions: FloatArray) -> tuple[State, Info]:
        """Put all replicas of a chain at its start, one solve a chain."""
        points, rungs, chains = self.parts.points(positions), len(self.temperatures), len(positions)
        gradient = points.gradient(np.ones(chains))
        log_prob = points.log_prob(np.ones(chains))
        bad = np.isfinite(log_prob) & (False if gradient is None else ~np.all(np.isfinite(gradient), axis=1))
        if bad.any():
            raise ValueError(f"init: the gradient must be finite at the start (chain {np.flatnonzero(bad)[0]})")
        replicas = points.each(lambda a: np.repeat(a[None], rungs, axis=0))
        state = self._state(replicas, np.zeros((rungs, chains), dtype=np.int64), 0)
        solves = np.full(chains, self.parts.solves_each)
        gradients = np.full(chains, int(self.parts.with_gradients))
        return state, Info(np.zeros(chains, dtype=bool), log_prob, solves, gradients)

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Draw from the prior, move the replicas above it, and swap."""
        if not isinstance(state, TemperedState):
            raise ValueError(f"state: must be one of tempering (got {type(state).__name__})")
        old, heading = self._on_ladder(state)
        chains = len(state.position)
        prior = self.parts.points(self.parts.sample_prior(rng, chains))
        moved, local = self._move(rng, old.each(lambda a: a[1:]))
        replicas = stacked([prior.each(lambda a: a[None]), moved])
        n_steps = state.n_steps + 1
        if n_steps % self.swap_every == 0:
            order = self._order_after_swaps(rng, replicas.log_likelihood, n_steps // self.swap_every % 2)
            replicas, heading = replicas.each(lambda a: _taken(a, order)), _taken(heading, order)
        heading, round_trips = _turned(heading)
        new = self._state(replicas, heading, n_steps)

        def total(of_replicas: NDArray[Any]) -> NDArray[Any]:
            return np.sum(of_replicas.reshape(-1, chains), axis=0)

        extra = {"n_nonfinite": total(local.extra["n_nonfinite"]), "round_trips": round_trips}
        if "diverging" in local.extra:
            extra["diverging"] = local.extra["diverging"].reshape(-1, chains)[-1]
        if self.records:
            extra[LOG_LIKELIHOOD] = replicas.log_likelihood.T
        n_solves = total(local.n_solves) + self.parts.solves_each
        n_gradients = total(local.n_gradients) + int(self.parts.with_gradients)
        accepted = np.any(new.position != state.position, axis=1)
        return new, TemperedInfo(accepted, new.log_prob, n_solves, n_gradients, extra, of_rungs=local)

    def _state(self, replicas: Points, heading: IntArray, n_steps: int) -> TemperedState:
        cold = replicas.each(lambda a: a[-1])
        return TemperedState(
            cold.position,
            cold.log_prob(np.ones(len(cold.log_prior))),
            replicas=replicas,
            temperatures=self.temperatures,
            heading=heading,
            n_steps=n_steps,
        )

    def _on_ladder(self, state: TemperedState) -> tuple[Points, IntArray]:
        """Return replicas and headings, on another ladder those whose rung was nearest in rank."""
        old, new = len(state.temperatures), len(self.temperatures)
        if old == new:
            return state.replicas, state.heading
        nearest = np.round(np.linspace(0, old - 1, new)).astype(np.int64)
        return state.replicas.each(lambda a: a[nearest]), np.zeros((new, state.heading.shape[1]), dtype=np.int64)

    def _move(self, rng: np.random.Generator, points: Points) -> tuple[Points, Info]:
        """Advance the replicas above the prior by one step of their kernels, as one array."""
        rungs, chains = points.log_prior.shape
        t = np.repeat(self.temperatures[1:], chains)
        start = points.each(lambda a: a.reshape(rungs * chains, *a.shape[2:]))
        density = TemperedDensity(self.parts, t, start)
        if chains not in self._joined:
            self._joined[chains] = side_by_side(self.kernels, chains)
        kernel = on_density(self._joined[chains], density)
        state, info = kernel.step(rng, State(start.position, start.log_prob(t), start.gradient(t)))
        end, n_solves = density.at(state.position)
        info = replace(info, n_solves=info.n_solves + n_solves)
        return end.each(lambda a: a.reshape(rungs, chains, *a.shape[1:])), info

    def _order_after_swaps(self, rng: np.random.Generator, log_likelihood: FloatArray, first: int) -> IntArray:
        """Return which rung's replica each rung holds after the swaps of the even or odd pairs, (rungs, chains).

        A swap of rungs k and k + 1 is accepted with probability min(1, exp((t_{k+1} − t_k)(l_k − l_{k+1}))).
        """
        rungs, chains = log_likelihood.shape
        lower = np.arange(first, rungs - 1, 2)
        order = np.repeat(np.arange(rungs)[:, None], chains, axis=1)
        gain = np.diff(self.temperatures)[lower, None] * (log_likelihood[lower] - log_likelihood[lower + 1])
        swapped = -rng.standard_exponential(gain.shape) <= gain
        order[lower] += swapped
        order[lower + 1] -= swapped
        return order


def _taken(values: Any, order: IntArray) -> Any:
    """Return values (rungs, chains, ...) in the given order of rungs, which differs from chain to chain."""
    return values[order, np.arange(order.shape[1])]


def _turned(heading: IntArray) -> tuple[IntArray, IntArray]:
    """Turn the replicas round at the ends of the ladder; return how many of each chain completed a round trip."""
    heading = heading.copy()
    heading[0] = np.where(heading[0] == 1, 2, heading[0])
    round_trips = (heading[-1] == 2).astype(np.int64)
    heading[-1] = 1
    return heading, round_trips
