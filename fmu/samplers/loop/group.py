"""Groups of chains, into which a run's work is divided, and the function that does a chunk of a group's work.

The chains of a group advance in lockstep with one random generator, and are tuned together. Groups are independent
of each other. Between two chunks of work a group is plain data. The result therefore depends neither on the number
of workers nor on which worker does a chunk, or when.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from fmu.interruption import is_asked
from fmu.posterior.failures import Failure
from fmu.posterior.scaled import ScaledDensity
from fmu.progress import Report
from fmu.samplers.kernel import Info, Kernel, Sampler, State, Tree, Tuner
from fmu.samplers.loop.record import Record, Steps
from fmu.samplers.loop.starts import check_finite
from fmu.samplers.settings import describe
from fmu.types import FloatArray, LogDensity

WARMUP, DRAWS = "warmup", "draws"
_AT_ONCE = 64
"""Largest number of steps that are recorded together, which takes a tenth of the time of recording each alone."""
_STATS = {"lp": "log_prob", "accepted": "accepted", "n_solves": "n_solves", "n_gradients": "n_gradients"}
"""Statistics of every sampler, and the attributes of `Info` that have them."""


class RunContext:
    """Density, sampler and warm-up length, common to all groups of a run.

    Parameters
    ----------
    density : LogDensity
    sampler : Sampler
    warmup : int
        Number of warm-up steps.
    """

    def __init__(self, density: LogDensity, sampler: Sampler, warmup: int) -> None:
        self.density, self.sampler, self.warmup = density, sampler, warmup
        self.scaled = ScaledDensity(density)


@dataclass(frozen=True)
class GroupState:
    """A group of chains between two chunks of its work, as plain data.

    Attributes
    ----------
    first_chain : int
        Index of the group's first chain in the run.
    generator : dict
        State of the bit generator.
    start : ndarray, shape (chains, ndim) or (chains, walkers, ndim), or None
        Starting points of the chains, in scaled units; None once the chains have begun.
    done : mapping of str to int
        Number of steps taken in each phase.
    solves : int
        Number of solves so far.
    state : State or None
        None if the chains have not begun.
    tuner : Tree or None
        `Tuner.state` of the tuner; None if the chains have not begun, or there is nothing to learn.
    learnt : dict
        Learnt settings with which the draws are made, as JSON-able data; {} if nothing has been learnt.
    """

    first_chain: int
    generator: Mapping[str, object]
    start: FloatArray | None
    done: Mapping[str, int]
    solves: int = 0
    state: State | None = None
    tuner: Tree | None = None
    learnt: dict[str, object] = field(default_factory=dict)

    @classmethod
    def at(cls, start: FloatArray, rng: np.random.Generator, first_chain: int = 0) -> GroupState:
        """Return a group whose chains have yet to take their first step from `start`."""
        return cls(first_chain, rng.bit_generator.state, start, {WARMUP: 0, DRAWS: 0})

    @classmethod
    def of_tree(cls, tree: Tree) -> GroupState:
        """Return the group that `tree` describes."""
        state = tree["state"]
        return cls(**{**tree, "state": None if state is None else State(**state)})

    def tree(self) -> Tree:
        """Return the group as a tree of arrays, numbers and strings."""
        return {**vars(self), "state": None if self.state is None else vars(self.state)}


@dataclass(frozen=True)
class Chunk:
    """A chunk of a group's work.

    Attributes
    ----------
    group : GroupState
        The group before the chunk.
    phase : {"warmup", "draws"}
    steps, seconds : int, float
        The chunk ends after `steps` steps or `seconds` seconds, or when a stop is requested, but not before one
        step.
    total : int
        Planned number of steps of the phase, for progress reports.
    label : str
        Name of the group, for progress reports; empty if there is only one group.
    """

    group: GroupState
    phase: str
    steps: int
    seconds: float
    total: int
    label: str = ""


@dataclass(frozen=True)
class ChunkResult:
    """The result of a chunk.

    Attributes
    ----------
    steps : Steps
    group : GroupState
        The group after the chunk.
    failures : list
        Points without a finite log-density, with the reasons (the density's `take_failures`); empty for a density
        without this method.
    """

    steps: Steps
    group: GroupState
    failures: list[Failure]


def advance(context: RunContext, chunk: Chunk, report: Report | None = None) -> ChunkResult:
    """Do a chunk of a group's work and return the result.

    Raises
    ------
    ValueError
        If the log-density, or a gradient that the sampler needs, is not finite at a chain's starting point, if the
        walkers of an emcee ensemble do not span the space, or if a setting does not fit the density.
    """
    group = _GroupRunner(context, chunk.group)
    began = time.perf_counter()
    record = Record(group.chains, context.sampler.walkers, context.scaled.ndim)
    record.reserve(chunk.steps)
    done, pace, taken = 0, _Pace(), list[tuple[FloatArray, Info]]()

    def write() -> None:
        record.write(done - len(taken), 0, group.as_steps(taken))
        taken.clear()

    while done == 0 or (done < chunk.steps and time.perf_counter() - began < chunk.seconds and not is_asked()):
        info = group.step(chunk.phase)
        if len(taken) == _AT_ONCE or (taken and info.extra.keys() != taken[0][1].extra.keys()):
            write()
        taken.append((group.state.position, info))
        done += 1
        if report is not None:
            words = pace.words(info) | {"solves": group.solves}
            if chunk.label:
                words["group"] = chunk.label
            report(chunk.phase, group.done[chunk.phase], chunk.total, words)
    write()
    take = getattr(context.density, "take_failures", list)
    return ChunkResult(record.steps(0, done), group.group_state(), list(take()))


def evaluate_again(context: RunContext, group: GroupState) -> tuple[FloatArray, FloatArray]:
    """Return the log-densities at a group's positions, both as stored and as recomputed.

    Both have shape (chains,), or (chains, walkers) for an ensemble.
    """
    held = _GroupRunner(context, group)
    return held.state.log_prob, held.kernel.init(held.state.position)[0].log_prob


class _GroupRunner:
    """Runs a group of chains for one chunk of its work.

    Parameters
    ----------
    context : RunContext
    group : GroupState
        If the chains have not begun, their starting points are evaluated.
    """

    def __init__(self, context: RunContext, group: GroupState) -> None:
        self.context, self.first_chain = context, group.first_chain
        self.rng = np.random.default_rng(0)
        self.rng.bit_generator.state = group.generator
        self.done, self.solves = dict(group.done), group.solves
        self.kernel: Kernel = context.sampler.bind(context.scaled)
        self.start: Info | None = None  # cost of the start, until it is counted for a step
        if group.state is not None:
            self.state = group.state
        else:
            assert group.start is not None
            self.state, self.start = self.kernel.init(group.start)
            check_finite(context.scaled, group.start, self.start.log_prob, self.first_chain)
        self.tuner: Tuner | None = None
        self.learnt: Sampler | None = None
        if context.warmup and (group.state is None or group.tuner is not None):
            self.tuner = context.sampler.tuner(context.scaled, self.chains, context.warmup)
            if self.tuner is not None and group.tuner is not None:
                self.tuner.restore(group.tuner)
            self._take_kernel()

    @property
    def chains(self) -> int:
        """Number of chains."""
        return len(self.state.position)

    def step(self, phase: str) -> Info:
        """Take one step and, in warm-up, let the tuner learn from it; return the step's diagnostics.

        They include the tuner's own solves and, in the first step, the cost of evaluating the starting points.
        """
        self.state, info = self.kernel.step(self.rng, self.state)
        if self.start is not None:
            solves = info.n_solves + self.start.n_solves
            gradients = info.n_gradients + self.start.n_gradients
            info, self.start = replace(info, n_solves=solves, n_gradients=gradients), None
        self.done[phase] += 1
        if self.tuner is not None and self.learnt is None:
            spent = self.tuner.update(self.state, info)
            if spent is not None:
                info = replace(info, n_solves=info.n_solves + spent)
            self._take_kernel()
        self.solves += int(info.n_solves.sum())
        return info

    def as_steps(self, taken: list[tuple[FloatArray, Info]]) -> Steps:
        """Return consecutive steps as `Steps`; `taken` has the scaled positions and the `Info` after each step."""
        positions, infos = zip(*taken, strict=True)
        named = {name: [getattr(info, attribute) for info in infos] for name, attribute in _STATS.items()}
        named |= {name: [info.extra[name] for info in infos] for name in infos[0].extra}
        chains, walkers = self.chains, self.context.sampler.walkers
        lead = infos[0].log_prob.ndim  # a statistic may have further dimensions
        theta = self.context.scaled.to_theta(np.stack(positions, axis=1))
        return Steps(
            theta.reshape(chains, len(taken), walkers, -1),
            {
                name: np.stack(values, axis=1).reshape(chains, len(taken), walkers, *values[0].shape[lead:])
                for name, values in named.items()
            },
        )

    def group_state(self) -> GroupState:
        """Return the group as plain data."""
        return GroupState(
            first_chain=self.first_chain,
            generator=self.rng.bit_generator.state,
            start=None,
            done=dict(self.done),
            solves=self.solves,
            state=self.state,
            tuner=None if self.tuner is None else self.tuner.state(),
            learnt={} if self.learnt is None else describe(self.learnt),
        )

    def _take_kernel(self) -> None:
        """Select the tuner's kernel in warm-up, and the kernel with the learnt settings afterwards."""
        if self.tuner is None:
            return
        if self.done[WARMUP] < self.context.warmup:
            self.kernel = self.tuner.kernel
        else:
            self.learnt = self.tuner.finish_learning()
            self.kernel = self.learnt.bind(self.context.scaled)


class _Pace:
    """Statistics of a chunk's steps so far, for progress reports."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self._accepted = self._moves = self._solves = 0

    def words(self, info: Info) -> dict[str, str | int | float]:
        self._accepted += int(np.count_nonzero(info.accepted))
        self._moves += info.accepted.size
        self._solves += int(info.n_solves.sum())
        seconds = max(time.perf_counter() - self._began, 1e-9)
        return {
            "lp": float(info.log_prob.mean()),
            "accept": self._accepted / self._moves,
            "solves_per_s": self._solves / seconds,
        }
