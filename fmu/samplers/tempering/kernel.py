"""Parallel tempering, a step at a time: draws from the prior, moves at every rung, swaps between rungs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmu.samplers.kernel import Info, Kernel, State
from fmu.samplers.tempering.density import Points, PriorAndLikelihood, TemperedDensity, stacked
from fmu.samplers.tempering.replicas import TemperedInfo, TemperedState
from fmu.samplers.tempering.rungs import on_density, side_by_side
from fmu.types import FloatArray, IntArray

LOG_LIKELIHOOD = "rung_log_likelihood"
"""Statistic of a run: the log-likelihood at every rung, from the prior to the posterior."""


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
