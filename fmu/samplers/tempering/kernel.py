"""The parallel-tempering kernel: draws from the prior, moves at every rung, and swaps between rungs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fmu.samplers.kernel import Info, State
from fmu.samplers.local import LocalKernel, accept
from fmu.samplers.tempering.density import Points, PriorAndLikelihood, TemperedTarget
from fmu.samplers.trajectory import require_finite_gradient
from fmu.types import AnyArray, FloatArray, IntArray

LOG_LIKELIHOOD = "rung_log_likelihood"
"""Statistic of a run: the log-likelihood at every rung, from the prior to the posterior."""


@dataclass(frozen=True)
class TemperingKernel:
    """Parallel-tempering kernel bound to a density. `kernels` has one kernel for each rung above the prior.

    The extra arrays of the State are:

    - the fields of `Points` for all replicas, with leading axes (rungs, chains), named ``rung_position`` etc.;
    - ``heading``, (rungs, chains): 1 for a replica that was last at the posterior, 2 for a replica that has been
      at the prior since then, otherwise 0;
    - ``n_steps``, (): the number of steps taken.

    The extra statistics in the Info of a step are:

    - ``n_nonfinite`` and ``round_trips``, (chains,);
    - ``diverging``, (chains,), for the posterior's rung, if the kernels report divergences;
    - ``rung_log_likelihood``, (chains, rungs), if `records` is True.

    `Info.parts` contains the diagnostics of the replicas' steps, in arrays whose leading axis has length
    (rungs − 1) · chains. The replicas are in the order of the rungs above the prior.
    """

    parts: PriorAndLikelihood
    temperatures: FloatArray
    kernels: tuple[LocalKernel, ...]
    swap_every: int
    records: bool = True
    _joined: dict[int, LocalKernel] = field(default_factory=dict, init=False, repr=False, compare=False)

    def init(self, positions: FloatArray) -> tuple[State, Info]:
        """Place all replicas of a chain at its starting point, at one evaluation per chain.

        Raise ValueError if a gradient that the kernels need is not finite.
        """
        points, rungs, chains = self.parts.points(positions), len(self.temperatures), len(positions)
        gradient = points.gradient(np.ones(chains))
        log_prob = points.log_prob(np.ones(chains))
        if gradient is not None:
            require_finite_gradient(log_prob, np.all(np.isfinite(gradient), axis=1))
        replicas = points.each(lambda a: np.repeat(a[None], rungs, axis=0))
        state = self._state(replicas, np.zeros((rungs, chains), dtype=np.int64), 0)
        solves = np.full(chains, self.parts.solves_each)
        gradients = np.full(chains, int(self.parts.with_gradients))
        return state, Info(np.zeros(chains, dtype=bool), log_prob, solves, gradients)

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Draw from the prior, move the replicas at the other rungs, and swap replicas every `swap_every` steps.

        If the number of rungs has changed, each rung first takes the replica whose relative rank is nearest, and
        all headings become 0.
        """
        old, heading, n_steps = replicas_of(state), state.extra["heading"], int(state.extra["n_steps"]) + 1
        rungs = len(self.temperatures)
        if len(heading) != rungs:  # the ladder has changed: a rung takes the replica whose rank is nearest
            nearest = np.round(np.linspace(0, len(heading) - 1, rungs)).astype(np.int64)
            old, heading = old.each(lambda a: a[nearest]), np.zeros((rungs, heading.shape[1]), dtype=np.int64)
        chains = len(state.position)
        prior = self.parts.points(self.parts.sample_prior(rng, chains))
        moved, local = self._move(rng, old.each(lambda a: a[1:]))
        replicas = prior.each(lambda at_prior, above: np.concatenate([at_prior[None], above]), moved)
        if n_steps % self.swap_every == 0:
            order = self._order_after_swaps(rng, replicas.log_likelihood, n_steps // self.swap_every % 2)
            replicas, heading = replicas.each(lambda a: _take_in_order(a, order)), _take_in_order(heading, order)
        heading, round_trips = _update_headings(heading)
        new = self._state(replicas, heading, n_steps)

        def total(of_replicas: AnyArray) -> AnyArray:
            return np.sum(of_replicas.reshape(-1, chains), axis=0)

        extra = {"n_nonfinite": total(local.extra["n_nonfinite"]), "round_trips": round_trips}
        if "diverging" in local.extra:
            extra["diverging"] = local.extra["diverging"].reshape(-1, chains)[-1]
        if self.records:
            extra[LOG_LIKELIHOOD] = replicas.log_likelihood.T
        n_solves = total(local.n_solves) + self.parts.solves_each
        n_gradients = total(local.n_gradients) + int(self.parts.with_gradients)
        accepted = np.any(new.position != state.position, axis=1)
        return new, Info(accepted, new.log_prob, n_solves, n_gradients, extra, parts=local)

    def _state(self, replicas: Points, heading: IntArray, n_steps: int) -> State:
        cold = replicas.each(lambda a: a[-1])
        known = {f"rung_{name}": array for name, array in replicas._asdict().items() if array is not None}
        extra = {**known, "heading": heading, "n_steps": np.asarray(n_steps)}
        return State(cold.position, cold.log_prob(np.ones(len(cold.log_prior))), extra=extra)

    def _move(self, rng: np.random.Generator, points: Points) -> tuple[Points, Info]:
        """Move the replicas above the prior by one step of their kernels; return them and the diagnostics."""
        rungs, chains = points.log_prior.shape
        t = np.repeat(self.temperatures[1:], chains)
        start = points.each(lambda a: a.reshape(rungs * chains, *a.shape[2:]))
        target = TemperedTarget(self.parts, t, start)
        if chains not in self._joined:
            self._joined[chains] = side_by_side(self.kernels, chains)
        kernel = replace(self._joined[chains], target=target)
        state, info = kernel.step(rng, State(start.position, start.log_prob(t), start.gradient(t)))
        end, n_solves = target.at(state.position)
        info = replace(info, n_solves=info.n_solves + n_solves)
        return end.each(lambda a: a.reshape(rungs, chains, *a.shape[1:])), info

    def _order_after_swaps(self, rng: np.random.Generator, log_likelihood: FloatArray, first: int) -> IntArray:
        """Swap even or odd pairs of rungs; return the rung from which each rung's replica comes, (rungs, chains).

        A swap of rungs k and k + 1 is accepted with probability min(1, exp((t_{k+1} − t_k)(l_k − l_{k+1}))), where
        l is the log-likelihood: the priors cancel in the ratio of the joint densities after and before the swap.
        """
        rungs, chains = log_likelihood.shape
        lower = np.arange(first, rungs - 1, 2)
        order = np.repeat(np.arange(rungs)[:, None], chains, axis=1)
        gain = np.diff(self.temperatures)[lower, None] * (log_likelihood[lower] - log_likelihood[lower + 1])
        swapped = accept(rng, gain)
        # the pairs (first, first + 1), (first + 2, …) share no rung, so that all pairs can swap at once
        order[lower] += swapped
        order[lower + 1] -= swapped
        return order


def _take_in_order(values: AnyArray, order: IntArray) -> AnyArray:
    """Reorder values (rungs, chains, ...) along the rungs according to `order` (rungs, chains)."""
    return values[order, np.arange(order.shape[1])]


def _update_headings(heading: IntArray) -> tuple[IntArray, IntArray]:
    """Update the headings of the replicas at both ends of the ladder.

    Return the headings, (rungs, chains), and the numbers of completed round trips, (chains,).
    """
    heading = heading.copy()
    heading[0] = np.where(heading[0] == 1, 2, heading[0])
    round_trips = (heading[-1] == 2).astype(np.int64)
    heading[-1] = 1
    return heading, round_trips


def replicas_of(state: State) -> Points:
    """Return the replicas in a state of `TemperingKernel`, with leading axes (rungs, chains)."""
    return Points(*(state.extra.get(f"rung_{name}") for name in Points._fields))  # type: ignore[arg-type]


def side_by_side(kernels: Sequence[LocalKernel], chains: int) -> LocalKernel:
    """Return the kernel that moves the replicas of all rungs as one array, ordered by rung.

    Parameters
    ----------
    kernels : sequence of LocalKernel
        One kernel per rung, all of the same class.
    chains : int
        Number of replicas at each rung.
    """
    first = kernels[0]
    return first if all(kernel is first for kernel in kernels) else first.join(kernels, chains)
