"""The Metropolis-Hastings sampler with a general proposal (PAPER section 4.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fmu.samplers.adaptation.tuners import START_SCALE, MetropolisTuner, SliceTuner
from fmu.samplers.evaluation import evaluate
from fmu.samplers.kernel import Info, LogDensity, State
from fmu.samplers.proposals import Proposal, RandomWalk
from fmu.samplers.slice import Slice
from fmu.types import FloatArray


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
