"""The mixture sampler's kernel, which alternates between local steps and jumps to independent candidates."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fmu.samplers.kernel import Info, State, Target
from fmu.samplers.local import LocalKernel, accept_or_reject
from fmu.samplers.mixture.curved import CurvedMixture
from fmu.samplers.mixture.proposal import Mixture
from fmu.types import AnyArray, FloatArray

BLOCK = 25
"""Number of candidates per chain that are evaluated in one batch, since they do not depend on the position of the
chain."""
LOG_WEIGHT, CANDIDATE = "log_weight", "candidate_log_weight"
"""Names of two statistics of a run: log P − log q after each step, and at the step's candidate (NaN without a
candidate)."""
_FAR = 50.0
_OF_BLOCK = ("position", "log_prob", "log_weight")
_LOCAL, _OF_CONSECUTIVE_STEPS = "local_", "energy"


@dataclass(frozen=True)
class MixtureKernel:
    """Kernel that alternates between local steps and jumps to candidates drawn from a mixture.

    A candidate with weight w* = P/q is accepted with probability min(1, w*/w), where w is the weight at the
    chain's current position. The `State` carries these extra arrays:

    - ``step`` (): number of steps taken;
    - ``block_position`` (BLOCK, chains, ndim), ``block_log_prob`` and ``block_log_weight`` (BLOCK, chains): the
      current block of candidates, which is evaluated in one batch;
    - ``next`` (): index of the next candidate in the block;
    - ``log_weight`` (chains,): log w at the positions; NaN before the first fit;
    - ``fit`` (): number of the mixture fit from which the block and the weights come; -1 before the first step;
    - ``local_...``: the statistics of the last local step, except ``energy``.

    Attributes
    ----------
    proposal : Mixture, CurvedMixture or None
        The mixture. If it is None, every step is a local step.
    local : LocalKernel
    local_steps, jumps : int
        Numbers of local steps and of jumps per cycle.
    fit : int
        Number of the current mixture fit; candidates and weights from an earlier fit are not used.
    gathers : bool
        Used in warm-up only. If True, a chain far out in the tail accepts every candidate that is not below the
        candidates' median log-density. Without this it might never move: local steps fail there, and its weight is
        infinite. "Far out" is more than `_FAR` plus one per coordinate below that median.
    """

    target: Target
    proposal: Mixture | CurvedMixture | None
    local: LocalKernel
    local_steps: int
    jumps: int
    fit: int = 0
    gathers: bool = False

    def init(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate the starting points with the local kernel; return the state, and an `Info` with the cost."""
        state, info = self.local.init(positions)
        chains, ndim = positions.shape
        extra = {
            "step": np.array(0),
            "fit": np.array(-1),
            "next": np.array(BLOCK),
            "block_position": np.zeros((BLOCK, chains, ndim)),
            "block_log_prob": np.zeros((BLOCK, chains)),
            "block_log_weight": np.zeros((BLOCK, chains)),
            LOG_WEIGHT: np.full(chains, np.nan),
        }
        return replace(state, extra=extra), info

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Take one local step or one jump, whichever is next in the cycle; return the new state and its `Info`."""
        number = int(state.extra["step"])
        state = replace(state, extra={**state.extra, "step": np.array(number + 1)})
        if self.proposal is None or number % (self.local_steps + self.jumps) < self.local_steps:
            return self._local(rng, state)
        return self._jump(rng, state, self.proposal)

    def _local(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        start, cost = self.local.target.complete(State(state.position, state.log_prob, state.gradient))
        end, info = self.local.step(rng, start)
        n_solves, n_gradients = info.n_solves, info.n_gradients
        if cost is not None:  # the state has no gradient after a jump
            n_solves, n_gradients = n_solves + cost.n_solves, n_gradients + cost.n_gradients
        log_weight = state.extra[LOG_WEIGHT]
        if self.proposal is not None:
            at_end = end.log_prob - self.proposal.log_density(end.position)
            log_weight = np.where(info.accepted | (state.extra["fit"] != self.fit), at_end, log_weight)
        of_step = {name: value for name, value in info.extra.items() if name != _OF_CONSECUTIVE_STEPS}
        kept = {_LOCAL + name: value for name, value in of_step.items()}
        extra = {**state.extra, LOG_WEIGHT: log_weight, "fit": np.array(self.fit), **kept}
        if state.extra["fit"] != self.fit:
            extra["next"] = np.array(BLOCK)
        stats = {
            "acceptance_rate": info.accepted.astype(float),
            **of_step,
            LOG_WEIGHT: log_weight,
            CANDIDATE: np.full(len(log_weight), np.nan),
        }
        return replace(end, extra=extra), Info(info.accepted, end.log_prob, n_solves, n_gradients, stats, info)

    def _jump(
        self, rng: np.random.Generator, state: State, proposal: Mixture | CurvedMixture
    ) -> tuple[State, Info]:
        extra = dict(state.extra)
        chains, ndim = state.position.shape
        n_solves, n_nonfinite = (np.zeros(chains, dtype=np.int64) for _ in range(2))
        if extra["fit"] != self.fit:
            extra |= {"fit": np.array(self.fit), "next": np.array(BLOCK)}
            extra[LOG_WEIGHT] = state.log_prob - proposal.log_density(state.position)
        if extra["next"] == BLOCK:
            u = proposal.draw(rng, BLOCK * chains)
            found = self.target.evaluate(u)
            log_weight = found.log_prob - proposal.log_density(u)
            n_solves = found.n_solves.reshape(BLOCK, chains).sum(axis=0)
            n_nonfinite = found.n_nonfinite.reshape(BLOCK, chains).sum(axis=0)
            extra |= {
                "next": np.array(0),
                "block_position": u.reshape(BLOCK, chains, ndim),
                "block_log_prob": found.log_prob.reshape(BLOCK, chains),
                "block_log_weight": log_weight.reshape(BLOCK, chains),
            }
        k = int(extra["next"])
        candidate, value, weight = (extra[f"block_{name}"][k] for name in _OF_BLOCK)
        log_ratio = np.where(np.isfinite(value), weight - extra[LOG_WEIGHT], -np.inf)
        if self.gathers:
            usual = np.median(extra["block_log_prob"])
            is_far = state.log_prob < usual - _FAR - ndim
            log_ratio = np.where(is_far & (value >= usual), np.inf, log_ratio)
        end, accepted = accept_or_reject(rng, state, State(candidate, value), log_ratio)
        extra |= {"next": np.array(k + 1), LOG_WEIGHT: np.where(accepted, weight, extra[LOG_WEIGHT])}
        stats: dict[str, AnyArray] = {
            name.removeprefix(_LOCAL): _nothing(value) for name, value in extra.items() if name.startswith(_LOCAL)
        }
        stats |= {
            "acceptance_rate": np.exp(np.minimum(0.0, log_ratio)),
            "n_nonfinite": n_nonfinite,
            LOG_WEIGHT: extra[LOG_WEIGHT],
            CANDIDATE: weight,
        }
        info = Info(accepted, end.log_prob, n_solves, np.zeros_like(n_solves), stats)
        return replace(end, extra=extra), info


def _nothing(value: AnyArray) -> AnyArray:
    """Return a placeholder for a local-step statistic in a jump: NaN, 0 or False, depending on its type."""
    return np.full_like(value, np.nan if value.dtype.kind == "f" else 0)
