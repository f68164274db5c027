"""The Metropolis-Hastings sampler with a general proposal (PAPER section 4.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from fmu.samplers.evaluation import evaluate
from fmu.samplers.kernel import Info, Kernel, State
from fmu.samplers.proposals import Proposal, RandomWalk
from fmu.samplers.slice import Slice, SliceKernel, SliceTuner
from fmu.types import FloatArray, LogDensity

START_SCALE = 0.01
"""Standard deviation of a random walk before anything is learnt, in scaled units."""
_SETTLING = 20  # steps that the scale of a random walk takes to settle


@dataclass(frozen=True)
class MetropolisHastings:
    """Metropolis-Hastings: accept a candidate with probability min(1, P(E*) q(E | E*) / (P(E) q(E* | E))).

    Parameters
    ----------
    proposal : Proposal, optional
        The density q, its settings in scaled units. Without it, a Gaussian random walk whose covariance warm-up
        learns; its first quarter is slice sampling.

    References
    ----------
    Section 4.1 of the paper; Hastings (1970), Biometrika 57, 97-109.
    """

    proposal: Proposal | None = None

    name: ClassVar[str] = "mh"

    @property
    def walkers(self) -> int:
        """A chain is a single point."""
        return 1

    def bind(self, density: LogDensity) -> MetropolisKernel:
        """Return the kernel that samples `density`."""
        return MetropolisKernel(density, self.proposal or RandomWalk(START_SCALE))

    def tuner(self, density: LogDensity, chains: int, steps: int) -> MetropolisTuner | None:
        """Return what learns the random walk in `steps` steps of warm-up, None if nothing is to be learnt."""
        if self.proposal is not None:
            return None
        return MetropolisTuner(self, density, SliceTuner(Slice(), density, steps))


@dataclass(frozen=True)
class MetropolisKernel:
    """Metropolis-Hastings bound to a density."""

    density: LogDensity
    proposal: Proposal

    def init(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate the start, one solve a chain."""
        first = evaluate(self.density, positions)
        nothing = np.zeros(len(positions), dtype=np.int64)
        info = Info(nothing.astype(bool), first.log_prob, first.n_solves, nothing)
        return State(positions, first.log_prob), info

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Propose, and accept or reject.

        A candidate outside the box has probability zero: it is rejected without an evaluation.
        """
        candidate = self.proposal.sample(rng, state.position)
        new = evaluate(self.density, candidate)
        log_ratio = np.full(len(candidate), -np.inf)
        alive = np.isfinite(new.log_prob)
        log_ratio[alive] = (
            new.log_prob[alive]
            - state.log_prob[alive]
            + self.proposal.log_ratio(candidate[alive], state.position[alive])
        )
        log_u = -rng.standard_exponential(len(candidate))
        accepted = log_u <= log_ratio
        position = np.where(accepted[:, None], candidate, state.position)
        log_prob = np.where(accepted, new.log_prob, state.log_prob)
        extra = {"acceptance_rate": np.exp(np.minimum(0.0, log_ratio)), "n_nonfinite": new.n_nonfinite}
        info = Info(accepted, log_prob, new.n_solves, np.zeros_like(new.n_solves), extra)
        return State(position, log_prob), info


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
