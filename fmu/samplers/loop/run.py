"""Run a sampler: groups of chains and their seeds, warm-up and draws, progress reports, and checkpoints."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike

from fmu.engines.base import Engine, InProcess
from fmu.interruption import shielded
from fmu.numbers import apart
from fmu.posterior.failures import Failure
from fmu.progress import Report
from fmu.samplers.kernel import Sampler
from fmu.samplers.loop.group import (
    DRAWS,
    WARMUP,
    Chunk,
    ChunkResult,
    GroupState,
    RunContext,
    advance,
    evaluate_again,
)
from fmu.samplers.loop.record import Draws, Record, RunResult, Steps
from fmu.samplers.loop.saving import Checkpointer, Interrupted, PendingGroup, TooManyFailuresError
from fmu.samplers.loop.starts import starting_points
from fmu.samplers.settings import describe, whole_number
from fmu.types import FloatArray, LogDensity

MOST_STEPS = 1000
"""Largest number of steps in a chunk of work."""
LIVE_S = 1.0
"""Time in s within which every group advances if the run reports progress, saves checkpoints, or can be
stopped."""
_ENOUGH = 20  # number of steps below which diagnostics are not reliable


class _RunningGroup:
    """A group of chains in a run: its state, and for each phase the index of the first unsaved step."""

    def __init__(self, index: int, chains: int, state: GroupState) -> None:
        self.index, self.state = index, state
        self.chains = slice(state.first_chain, state.first_chain + chains)
        self.pending = dict(state.done)
        self.failures: list[Failure] = []


class Run:
    """A sampling run that warms up once, when it is created, and can be extended any number of times.

    The same density, settings and seed give the same draws, bit for bit, whatever the number of chunks and
    workers, and however often the run is interrupted. Each group of chains has its own random generator, from
    ``SeedSequence(seed).spawn(groups)``.

    Parameters
    ----------
    density : LogDensity
        Density to sample. If it has attributes `offset` and `scale`, shape (ndim,), these define the scaled
        coordinates; see `ScaledDensity`.
    sampler : Sampler
        Settings of the sampler, in scaled units.
    warmup : int
        Number of steps before the draws. The settings learnt in these steps are then frozen.
    chains : int
        Number of chains, or of ensembles.
    seed : int
    init : "prior", "start" or array_like, shape (chains, ndim) or (chains, walkers, ndim)
        See `starting_points`.
    groups : int, optional
        Number of groups. The chains of a group advance in lockstep and are tuned together; different workers can
        advance different groups. The draws depend on this number. By default all chains form one group, but each
        ensemble forms a group of its own.
    progress : callable, optional
        Called as ``progress(phase, done, total, info)`` with the phase ("warmup" or "draws"), the number of steps
        done, the number of steps planned, and a mapping of names to numbers; with several groups,
        ``info["group"]`` names the group. It is called after every step in this process, and several times a
        second for steps in other workers.
    engine : Engine, optional
        Engine that does the work; by default, this process does it.
    checkpointer : Checkpointer, optional
        Saves draws and states. Saved steps are read back and not drawn again.
    stop : callable, optional
        Called between two chunks of work, at least once a second unless a step takes longer. The run stops if
        `stop` returns True.
    too_many_failed : callable, optional
        Called as ``too_many_failed(n_failed, n_solves, failures)``; returns a message if too many of the solves
        failed, otherwise None.
    live : callable, optional
        Returns diagnostics for progress reports, a mapping of names to numbers, from draws with shape (chains,
        steps, walkers, ndim). It is called with ``ended=True`` for the last report.

    Raises
    ------
    ValueError
        If a number or `init` is invalid, or a setting does not fit the density; if a starting point is outside the
        bounds, or its log-density or a gradient that the sampler needs is not finite; or if the checkpointer
        contains a run with another density.
    Interrupted
        If `stop` returned True before the end of warm-up or, with a checkpointer, if the user pressed Ctrl+C.
    TooManyFailuresError, RunFailedError
        If `too_many_failed` returns a message, workers die repeatedly or the connection to a cluster is lost.
    """

    def __init__(
        self,
        density: LogDensity,
        sampler: Sampler,
        *,
        warmup: int,
        chains: int,
        seed: int,
        init: str | ArrayLike,
        groups: int | None = None,
        progress: Report | None = None,
        engine: Engine | None = None,
        checkpointer: Checkpointer | None = None,
        stop: Callable[[], bool] | None = None,
        too_many_failed: Callable[[int, int, list[Failure]], str | None] | None = None,
        live: Callable[..., Mapping[str, float]] | None = None,
    ) -> None:
        self.sampler, self.chains = sampler, whole_number("chains", chains, 1)
        self.warmup, self.seed = whole_number("warmup", warmup, 0), whole_number("seed", seed, 0)
        self.init = init if isinstance(init, str) else "array"
        self.groups = n_groups(groups, self.chains, sampler)
        self._context = RunContext(density, sampler, self.warmup)
        self._engine, self._keeper, self._stop = engine or InProcess(), checkpointer, stop or (lambda: False)
        self._too_many_failed = too_many_failed or (lambda *_: None)
        self._n_failed = self._n_solves = 0
        self._hurried = progress is not None or checkpointer is not None or stop is not None
        self._watch = None if progress is None else _Watch(progress, live)
        walkers, ndim = sampler.walkers, self._context.scaled.ndim
        self._records = {phase: Record(self.chains, walkers, ndim) for phase in (WARMUP, DRAWS)}
        self._elapsed_s = {WARMUP: 0.0, DRAWS: 0.0}
        self._drawn = 0
        self._groups = self._begin_groups(init)
        if checkpointer is not None:
            for group in self._groups:
                self._restore(group, checkpointer)
        self._advance(WARMUP, self.warmup)

    def extend(self, draws: int) -> RunResult:
        """Take `draws` more steps, and return the result with all draws so far.

        Raises
        ------
        ValueError
            If `draws` is not a positive whole number or, without warm-up, a starting point or setting is invalid.
        Interrupted
            If the run was stopped on request.
        TooManyFailuresError, RunFailedError
            If `too_many_failed` returns a message, workers die repeatedly or the connection to a cluster is lost.
        """
        target = self._drawn + whole_number("draws", draws, 1)
        self._advance(DRAWS, target)
        self._drawn = target
        return self._result(target)

    @property
    def warmup_solves(self) -> int:
        """Number of solves in warm-up, summed over all chains."""
        return int(np.sum(self._records[WARMUP].draws(self.warmup).stats.get("n_solves", 0)))

    def report_end(self) -> None:
        """Send a last progress report for each group, with the diagnostics on which the verdict is based.

        Nothing is sent if there are fewer than 20 steps, or if `progress` or `live` is not given.
        """
        if self._watch is not None:
            self._watch.end(self._common(DRAWS))

    def _begin_groups(self, init: str | ArrayLike) -> list[_RunningGroup]:
        """Return all groups as they are before their first step."""
        context, walkers = self._context, self.sampler.walkers
        seeds = np.random.SeedSequence(self.seed).spawn(self.groups)
        generators = [np.random.default_rng(child) for child in seeds]
        positions = starting_points(context.scaled, init, generators, self.chains, walkers)
        each = self.chains // self.groups
        starts = enumerate(zip(positions, generators, strict=True))
        return [_RunningGroup(i, each, GroupState.at(*start, first_chain=i * each)) for i, start in starts]

    def _restore(self, group: _RunningGroup, checkpointer: Checkpointer) -> None:
        """Restore a group's last saved state, if there is one. Raise ValueError if the density has changed."""
        kept = checkpointer.kept(group.index)
        if kept is None:
            return
        _check_same(self._context, kept.group_state)
        for phase, record in self._records.items():
            record.reserve(kept.group_state.done[phase])
        for phase, first, steps in kept.steps:
            self._write(group, phase, first, steps)
        group.state, group.pending = kept.group_state, dict(kept.group_state.done)
        for phase, seconds in kept.elapsed_s.items():
            self._elapsed_s[phase] = max(self._elapsed_s[phase], seconds)

    def _advance(self, phase: str, target: int) -> None:
        """Advance all groups to `target` steps of a phase, or raise Interrupted or TooManyFailuresError."""
        behind = [group for group in self._groups if group.state.done[phase] < target]
        if not behind:
            return
        self._records[phase].reserve(target)
        began, before = time.perf_counter(), self._elapsed_s[phase]

        def follow(line: int, done: ChunkResult) -> Chunk | None:
            with shielded():
                self._elapsed_s[phase] = before + time.perf_counter() - began
                group = behind[line]
                self._write(group, phase, group.state.done[phase], done.steps)
                group.state = done.group
                group.failures += done.failures
                why = self._too_many_failed(self._n_failed, self._n_solves, group.failures)
                stopped = self._stop()
                ended = stopped or why is not None or group.state.done[phase] >= target
                self._keep(group, phase, target, at_once=ended)
                if why is not None:
                    raise TooManyFailuresError(why, self._so_far())
                if stopped and self._engine.workers == 1 and any(g.state.done[phase] < target for g in behind):
                    raise Interrupted(None)  # no other group is under way, so that none needs another step
                if self._watch is not None and phase == DRAWS:
                    self._watch.look(self._common(phase))
                return None if ended else self._chunk(group, phase, target)

        parts = [self._chunk(group, phase, target) for group in behind]
        try:
            self._engine.run_tasks(advance, self._context, parts, follow, self._watch)
        except KeyboardInterrupt as stop:  # perhaps in the middle of a step, which is lost
            if self._keeper is None and not isinstance(stop, Interrupted):
                raise
            with shielded():
                for group in behind:
                    self._keep(group, phase, target, at_once=True)
            raise Interrupted(self._so_far()) from None
        self._elapsed_s[phase] = before + time.perf_counter() - began
        if any(group.state.done[phase] < target for group in behind):
            raise Interrupted(self._so_far())

    def _chunk(self, group: _RunningGroup, phase: str, target: int) -> Chunk:
        """Return the next chunk of a group's work."""
        done = group.state.done[phase]
        steps = min(MOST_STEPS, target - done)
        turns = math.ceil(self.groups / self._engine.workers)
        seconds = LIVE_S / turns if self._hurried else math.inf
        if self._keeper is not None:
            steps = min(steps, self._keeper.most_steps - (done - group.pending[phase]))
            seconds = min(seconds, self._keeper.most_seconds)
        label = f"{group.index + 1}/{self.groups}" if self.groups > 1 else ""
        return Chunk(group.state, phase, steps, seconds, target, label)

    def _write(self, group: _RunningGroup, phase: str, first: int, steps: Steps) -> None:
        """Record the steps of a group, and count the solves and failures in them."""
        self._records[phase].write(first, group.chains.start, steps)
        self._n_solves += int(steps.stats["n_solves"].sum())
        self._n_failed += int(np.sum(steps.stats.get("n_nonfinite", 0)))

    def _keep(self, group: _RunningGroup, phase: str, target: int, *, at_once: bool) -> None:
        """Save a group's new steps, if any, when `at_once` is True or the checkpointer says that a save is due."""
        first, stop = group.pending[phase], group.state.done[phase]
        if self._keeper is None or stop == first:
            return
        if not (at_once or self._keeper.is_due(group.index, stop - first)):
            return
        steps = self._records[phase].steps(first, stop, group.chains)
        pending = PendingGroup(group.state, dict(self._elapsed_s), phase, first, steps, group.failures, target)
        self._keeper.keep(group.index, pending)
        group.pending[phase], group.failures = stop, []

    def _common(self, phase: str) -> FloatArray:
        """Return the positions at the steps that all groups have completed, (chains, steps, walkers, ndim)."""
        return self._records[phase].steps(0, min(group.state.done[phase] for group in self._groups)).position

    def _so_far(self) -> RunResult | None:
        """Return the result with the draws that all groups have completed, or None if there are none."""
        drawn = min(group.state.done[DRAWS] for group in self._groups)
        return self._result(drawn) if drawn else None

    def _result(self, draws: int) -> RunResult:
        """Return the result of the run, restricted to the first `draws` steps after warm-up."""
        kept = self._records[DRAWS].draws(draws)
        warm = self._records[WARMUP].draws(self.warmup)
        if self.warmup == 0:  # no step has named the statistics
            warm = Draws(warm.position, {key: value[:, :0] for key, value in kept.stats.items()})
        return RunResult(
            warmup=warm,
            posterior=kept,
            sampler=self.sampler.name,
            settings=describe(self.sampler),
            learnt=_merge_learnt([group.state.learnt for group in self._groups]),
            seed=self.seed,
            walkers=self.sampler.walkers,
            draws=draws,
            warmup_draws=self.warmup,
            chains=self.chains,
            groups=self.groups,
            init=self.init,
            wall_s=sum(self._elapsed_s.values()),
            warmup_wall_s=self._elapsed_s[WARMUP],
        )


def run(
    density: LogDensity,
    sampler: Sampler,
    *,
    draws: int,
    warmup: int,
    chains: int,
    seed: int,
    init: str | ArrayLike,
    progress: Report | None = None,
) -> RunResult:
    """Warm up, take `draws` steps, return the result; see `Run` and `Run.extend` for the arguments and errors."""
    draws = whole_number("draws", draws, 1)
    begun = Run(density, sampler, warmup=warmup, chains=chains, seed=seed, init=init, progress=progress)
    return begun.extend(draws)


def n_groups(groups: int | None, chains: int, sampler: Sampler) -> int:
    """Return the number of groups into which the chains are divided.

    If `groups` is None, each ensemble forms a group of its own, but ordinary chains form one group.

    Raises
    ------
    ValueError
        If `groups` is less than 1 or does not divide the number of chains, or if the sampler does not allow this
        number of groups.
    """
    if groups is None:
        return chains if sampler.walkers > 1 else 1
    groups = whole_number("groups", groups, 1)
    if chains % groups:
        raise ValueError(f"groups: must divide the {chains} chains evenly (got {groups})")
    if sampler.walkers > 1 and groups != chains:
        raise ValueError(f"groups: must be the {chains} ensembles, each of which is a group (got {groups})")
    if sampler.learns_together and groups > 1:
        raise ValueError(f"groups: must be 1 for {sampler.name}, whose chains learn together (got {groups})")
    return groups


def _check_same(context: RunContext, group: GroupState) -> None:
    """Raise ValueError unless the density, evaluated again, gives the values that were saved with the chains."""
    then, now = evaluate_again(context, group)
    if not np.allclose(now, then, rtol=1e-6, atol=1e-6):
        worst = np.unravel_index(np.argmax(np.nan_to_num(np.abs(now - then), nan=np.inf)), then.shape)
        was, is_now = apart(float(then[worst]), float(now[worst]), sd=1.0)
        raise ValueError(
            f"checkpoint: must be of the same posterior (at the position of a chain the log-probability "
            f"was {was}, and is now {is_now})"
        )


def _merge_learnt(learnt: list[dict[str, object]]) -> dict[str, object]:
    """Return the learnt settings of all groups as one dict.

    With several groups, each value is a list with one entry per group.
    """
    if len(learnt) == 1:
        return learnt[0]
    return {name: [settings[name] for settings in learnt] for name in learnt[0]}


class _Watch:
    """Forwards progress reports, with diagnostics of the draws that all groups have completed."""

    def __init__(self, progress: Report, live: Callable[..., Mapping[str, float]] | None) -> None:
        self._progress, self._live = progress, live
        self._words: dict[str, float] = {}
        self._last: dict[str, tuple[int, int, Mapping[str, str | int | float]]] = {}
        self._next = 0.0

    def __call__(self, phase: str, done: int, total: int, info: Mapping[str, str | int | float]) -> None:
        if phase == DRAWS:
            self._last[str(info.get("group", ""))] = done, total, info
        self._progress(phase, done, total, {**info, **(self._words if phase == DRAWS else {})})

    def end(self, draws: FloatArray) -> None:
        """Repeat the last report of each group, with the diagnostics on which the verdict is based.

        Nothing is reported if there are fewer than `_ENOUGH` steps, or no function that computes diagnostics.
        """
        if self._live is None or draws.shape[1] < _ENOUGH:
            return
        self._words = dict(self._live(draws, ended=True))
        for done, total, info in self._last.values():
            self._progress(DRAWS, done, total, {**info, **self._words})

    def look(self, draws: FloatArray) -> None:
        """Update the diagnostics of the draws so far, unless they are fewer than `_ENOUGH` per chain.

        At most a fiftieth of the run time is spent on them.
        """
        began = time.monotonic()
        if self._live is None or began < self._next or draws.shape[1] < _ENOUGH:
            return
        self._words = dict(self._live(draws))
        ended = time.monotonic()
        self._next = ended + 50.0 * (ended - began)
