"""A group of chains, the unit of work that a run is divided into, and how a part of that work is done.

The chains of a group advance in lockstep with one generator, and learn together. Groups know nothing of each
other, and between two parts of its work a group is plain data: it does not matter where, in which order and in how
many parts the work is done.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, is_dataclass, replace
from typing import Any

import numpy as np

from fmu.interruption import is_asked
from fmu.posterior.scaled import ScaledDensity
from fmu.progress import Report
from fmu.samplers.kernel import Info, Kernel, Sampler, State, Tuner
from fmu.samplers.loop.record import Record, Steps
from fmu.samplers.loop.settings import describe
from fmu.samplers.loop.snapshot import Snapshot, restored, taken
from fmu.samplers.loop.starts import check_finite
from fmu.types import FloatArray, LogDensity

WARMUP, DRAWS = "warmup", "draws"


class RunContext:
    """What all groups of a run share.

    Parameters
    ----------
    density : LogDensity
    sampler : Sampler
    warmup : int
        Steps.
    """

    def __init__(self, density: LogDensity, sampler: Sampler, warmup: int) -> None:
        self.density, self.sampler, self.warmup = density, sampler, warmup
        self.scaled = ScaledDensity(density)

    def given(self) -> dict[str, Any]:
        """Return what a snapshot of a group names instead of copying it."""
        return {"scaled": self.scaled, "density": self.density} | dict(_settings("sampler", self.sampler))


@dataclass(frozen=True)
class Chunk:
    """A part of a group's work.

    Attributes
    ----------
    group : Snapshot
        As it is now.
    phase : {"warmup", "draws"}
    steps, seconds : int, float
        It ends when either is used up, or a stop is asked for, after one step at the earliest.
    total : int
        Steps of the phase, for who reads the progress.
    label : str
        What tells the group from others there; empty if there are none.
    """

    group: Snapshot
    phase: str
    steps: int
    seconds: float
    total: int
    label: str = ""


@dataclass(frozen=True)
class GroupState:
    """Where a group stands.

    Attributes
    ----------
    group : Snapshot
    done : mapping of str to int
        Steps taken in each phase.
    learnt : dict
        The settings that draws are made with, as JSON-able data; {} if nothing was learnt, or not yet.
    """

    group: Snapshot
    done: Mapping[str, int]
    learnt: dict[str, Any]


@dataclass(frozen=True)
class ChunkResult:
    """What came of a chunk.

    Attributes
    ----------
    steps : Steps
    group_state : GroupState
    failures : list
        What `take_failures` of the density gave: points without a finite log-density, and why.
    """

    steps: Steps
    group_state: GroupState
    failures: list[Any]


def first_snapshot(
    context: RunContext, rng: np.random.Generator, position: FloatArray, first_chain: int
) -> Snapshot:
    """Return a group that has not begun.

    Parameters
    ----------
    context : RunContext
    rng : Generator
    position : ndarray, shape (chains, ndim) or (chains, walkers, ndim)
        Where its chains start, scaled.
    first_chain : int
        Number of its first chain in the run.
    """
    return _GroupRunner(context, rng, {"position": position, "first_chain": first_chain}).snapshot()


def advance(context: RunContext, chunk: Chunk, report: Report | None = None) -> ChunkResult:
    """Do a part of a group's work.

    Raises
    ------
    ValueError
        If a chain would start where the log-density is not finite.
    """
    group = _GroupRunner.of_snapshot(chunk.group, context)
    began = time.perf_counter()
    record = Record(group.chains, context.sampler.walkers, context.scaled.ndim)
    record.reserve(chunk.steps)
    done, pace = 0, _Pace()
    while done == 0 or (done < chunk.steps and time.perf_counter() - began < chunk.seconds and not is_asked()):
        info = group.step(chunk.phase)
        record.write(done, 0, group.as_steps(info))
        done += 1
        if report is not None:
            words = pace.words(info) | {"solves": group.solves}
            if chunk.label:
                words["group"] = chunk.label
            report(chunk.phase, group.done[chunk.phase], chunk.total, words)
    take = getattr(context.density, "take_failures", list)
    return ChunkResult(record.steps(0, done), group.group_state(), list(take()))


def evaluated_again(context: RunContext, group: Snapshot) -> tuple[FloatArray, FloatArray]:
    """Return the log-density where the chains of a group are: as the group has it, and evaluated anew."""
    held = _GroupRunner.of_snapshot(group, context)
    return held.state.log_prob, held.kernel.init(held.state.position)[0].log_prob


class _GroupRunner:
    """A group in the middle of its work.

    Parameters
    ----------
    context : RunContext
    rng : Generator
    held : dict
        What a snapshot holds beside the generator: ``position`` and ``first_chain`` of a group that has not begun;
        else ``done``, ``solves``, ``settings``, ``state`` and ``tuner``.
    """

    def __init__(self, context: RunContext, rng: np.random.Generator, held: dict[str, Any]) -> None:
        self.context, self.rng = context, rng
        self.first_chain: int = held["first_chain"]
        self.position: FloatArray | None = held.get("position")
        self.done: dict[str, int] = held.get("done", {WARMUP: 0, DRAWS: 0})
        self.solves: int = held.get("solves", 0)
        self.settings: Sampler | None = held.get("settings")
        self._state: State | None = held.get("state")
        self.start: Info | None = None  # what it cost, until a step has booked it
        self.tuner: Tuner | None = held.get("tuner")
        self.kernel: Kernel = (self.settings or context.sampler).bind(context.scaled)

    @property
    def state(self) -> State:
        """Where the chains are; the start is evaluated when this is first asked for."""
        if self._state is None:
            self._begin()
        assert self._state is not None
        return self._state

    @property
    def chains(self) -> int:
        """How many they are."""
        return len(self.state.position)

    def step(self, phase: str) -> Info:
        """Advance one step, and learn from it in warm-up; the first one carries the cost of the start too."""
        state = self.state
        kernel = self.kernel if self.tuner is None else self.tuner.kernel
        self._state, info = kernel.step(self.rng, state)
        if self.start is not None:
            solves = info.n_solves + self.start.n_solves
            gradients = info.n_gradients + self.start.n_gradients
            info, self.start = replace(info, n_solves=solves, n_gradients=gradients), None
        self.done[phase] += 1
        self.solves += int(info.n_solves.sum())
        if self.tuner is not None:
            self.tuner.update(self._state, info)
            if self.done[WARMUP] == self.context.warmup:
                self._freeze(self.tuner)
        return info

    def as_steps(self, info: Info) -> Steps:
        """Return the step that has just been taken."""
        named = {
            "lp": info.log_prob,
            "accepted": info.accepted,
            "n_solves": info.n_solves,
            "n_gradients": info.n_gradients,
            **info.extra,
        }
        chains, walkers = self.chains, self.context.sampler.walkers
        theta = self.context.scaled.to_theta(self.state.position)
        lead = info.log_prob.ndim  # behind it, a statistic may be a vector
        return Steps(
            theta.reshape(chains, 1, walkers, -1),
            {name: value.reshape(chains, 1, walkers, *value.shape[lead:]) for name, value in named.items()},
        )

    def group_state(self) -> GroupState:
        """Return where the group stands."""
        learnt = {} if self.settings is None else describe(self.settings)
        return GroupState(self.snapshot(), dict(self.done), learnt)

    def snapshot(self) -> Snapshot:
        """Return the group as plain data."""
        held: dict[str, Any] = {"first_chain": self.first_chain, "generator": self.rng.bit_generator.state}
        if self._state is None:
            held["position"] = self.position
        else:
            held |= {"done": self.done, "solves": self.solves, "settings": self.settings}
            held |= {"state": self._state, "tuner": self.tuner}
        return taken(held, self.context.given())

    @classmethod
    def of_snapshot(cls, snapshot: Snapshot, context: RunContext) -> _GroupRunner:
        """Return the group that a snapshot was taken of."""
        held = restored(snapshot, context.given())
        rng = np.random.default_rng(0)
        rng.bit_generator.state = held["generator"]
        return cls(context, rng, held)

    def _begin(self) -> None:
        """Evaluate the start."""
        assert self.position is not None
        context = self.context
        self._state, self.start = self.kernel.init(self.position)
        check_finite(context.scaled, self.position, self.start.log_prob, self.first_chain)
        if context.warmup:
            self.tuner = context.sampler.tuner(context.scaled, len(self.position), context.warmup)

    def _freeze(self, tuner: Tuner) -> None:
        """End the adaptation."""
        self.settings, self.tuner = tuner.finished(), None
        self.kernel = self.settings.bind(self.context.scaled)


def _settings(name: str, thing: Any) -> Iterator[tuple[str, Any]]:
    """Yield settings and those within them, such as a proposal of the user's own, by name."""
    yield name, thing
    for key, value in getattr(thing, "__dict__", {}).items():
        if is_dataclass(value) and not isinstance(value, type):
            yield from _settings(f"{name}.{key}", value)


class _Pace:
    """What a line of progress shows of the steps of a part taken so far."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self._accepted = self._moves = self._solves = 0

    def words(self, info: Info) -> dict[str, str | int | float]:
        self._accepted += int(np.sum(info.accepted))
        self._moves += info.accepted.size
        self._solves += int(np.sum(info.n_solves))
        seconds = max(time.perf_counter() - self._began, 1e-9)
        return {
            "lp": float(np.mean(info.log_prob)),
            "accept": self._accepted / self._moves,
            "solves_per_s": self._solves / seconds,
        }
