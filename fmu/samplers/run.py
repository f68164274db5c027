"""The only loop: chains, seeds, progress and what is kept."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .draws import Draws as Draws
from .draws import RunResult as RunResult
from .draws import joined
from .kernel import Info, Kernel, LogDensity, Sampler, State, Tuner
from .scaled import ScaledDensity
from .settings import describe, whole_number
from .starts import check_finite, starting_points

Progress = Callable[[str, int, int, dict[str, str]], None]


@dataclass
class _Task:
    """Chains that advance in lockstep with one generator."""

    kernel: Kernel
    rng: np.random.Generator
    state: State
    first_chain: int
    start: Info | None
    tuner: Tuner | None = None

    def warm_up(self) -> Info:
        """Advance one step, and learn from it."""
        if self.tuner is None:
            return self.step()
        self.kernel = self.tuner.kernel
        info = self.step()
        self.tuner.update(self.state, info)
        return info

    def step(self) -> Info:
        """Advance one step; the first one carries the cost of the start too."""
        self.state, info = self.kernel.step(self.rng, self.state)
        if self.start is not None:
            solves = info.n_solves + self.start.n_solves
            gradients = info.n_gradients + self.start.n_gradients
            info = replace(info, n_solves=solves, n_gradients=gradients)
            self.start = None
        return info


class _Store:
    """Arrays that steps are written into; those of `stats` are made when the first step names them."""

    def __init__(self, scaled: ScaledDensity, chains: int, steps: int, walkers: int) -> None:
        self.scaled = scaled
        self.shape = (chains, steps, walkers)
        self.position = np.empty((*self.shape, scaled.ndim))
        self.stats: dict[str, NDArray[Any]] = {}

    def write(self, step: int, task: _Task, info: Info) -> None:
        named = {
            "lp": info.log_prob,
            "accepted": info.accepted,
            "n_solves": info.n_solves,
            "n_gradients": info.n_gradients,
            **info.extra,
        }
        chains = slice(task.first_chain, task.first_chain + len(info.log_prob))
        theta = self.scaled.to_theta(task.state.position)
        self.position[chains, step] = theta.reshape(len(theta), -1, self.scaled.ndim)
        for name, value in named.items():
            rest = value.shape[info.log_prob.ndim :]  # of a statistic that is a vector
            if name not in self.stats:
                self.stats[name] = np.zeros((*self.shape, *rest), dtype=value.dtype)
            self.stats[name][chains, step] = value.reshape(len(value), -1, *rest)

    def draws(self) -> Draws:
        chains, steps, walkers = self.shape
        stats = {k: value.reshape(chains, steps * walkers, *value.shape[3:]) for k, value in self.stats.items()}
        return Draws(self.position.reshape(chains, steps * walkers, self.scaled.ndim), stats)


class Run:
    """A run that can be carried on: warmed up once, extended as often as wanted.

    The same density, settings and seed give the same draws, bit for bit, in however many parts they are drawn.
    There is one generator a task, from ``SeedSequence(seed).spawn(tasks)``: all chains are one task, but every
    ensemble is its own.

    Parameters
    ----------
    density : LogDensity
        With attributes `offset` and `scale`, (ndim,), for the scaled view if it has them (see ScaledDensity).
    sampler : Sampler
        Settings, in the units of the scaled view.
    warmup : int
        Steps before the draws. What is learnt in them is frozen.
    chains : int
        Chains, or ensembles.
    seed : int
    init : "prior", "start" or array_like, shape (chains, ndim) or (chains, walkers, ndim)
        See starting_points.
    progress : callable, optional
        Called after every step as ``progress(phase, done, total, info)``: phase "warmup" or "draws", steps done
        of the phase's total as far as it is known, and a few words by name.

    Raises
    ------
    ValueError
        If a number is out of range, a setting does not fit the density, or a start is outside the bounds or has a
        log-density that is not finite.
    """

    def __init__(
        self,
        density: LogDensity,
        sampler: Sampler,
        *,
        warmup: int,
        chains: int,
        seed: int,
        init: Any,
        progress: Progress | None = None,
    ) -> None:
        self.sampler, self.progress = sampler, progress
        self.chains, self.warmup = whole_number("chains", chains, 1), whole_number("warmup", warmup, 0)
        self.seed = whole_number("seed", seed, 0)
        self.init = init if isinstance(init, str) else "array"
        self.scaled = ScaledDensity(density)
        kernel = sampler.bind(self.scaled)
        n_tasks = self.chains if sampler.walkers > 1 else 1
        generators = [np.random.default_rng(child) for child in np.random.SeedSequence(self.seed).spawn(n_tasks)]
        positions = starting_points(self.scaled, init, generators, self.chains, sampler.walkers)

        began = time.perf_counter()
        self._tasks = []
        for i, (rng, position) in enumerate(zip(generators, positions, strict=True)):
            first_chain = i * (self.chains // n_tasks)
            state, info = kernel.init(position)
            check_finite(self.scaled, position, info.log_prob, first_chain)
            tuner = sampler.tuner(self.scaled, len(position), self.warmup) if warmup else None
            self._tasks.append(_Task(kernel, rng, state, first_chain, info, tuner))
        self._warm = _phase("warmup", self._tasks, self._store(self.warmup), progress)
        self._learnt = [_frozen(task, self.scaled) for task in self._tasks]
        self._parts: list[Draws] = []
        self._drawn = 0
        self._wall_s = self._warmup_wall_s = time.perf_counter() - began

    def extend(self, draws: int) -> RunResult:
        """Draw as many further steps, and return everything drawn so far.

        Raises
        ------
        ValueError
            If `draws` is not a whole number of at least 1.
        """
        draws = whole_number("draws", draws, 1)
        began = time.perf_counter()
        self._parts.append(_phase("draws", self._tasks, self._store(draws), self.progress, self._drawn))
        self._drawn += draws
        self._wall_s += time.perf_counter() - began
        if len(self._parts) > 1:
            self._parts = [joined(self._parts)]
        (kept,) = self._parts
        warm = self._warm
        if self.warmup == 0:  # no step has named the statistics
            warm = Draws(warm.position, {key: value[:, :0] for key, value in kept.stats.items()})
        return RunResult(
            warmup=warm,
            posterior=kept,
            sampler=self.sampler.name,
            settings=describe(self.sampler),
            learnt=self._learnt[0],
            seed=self.seed,
            walkers=self.sampler.walkers,
            draws=self._drawn,
            warmup_draws=self.warmup,
            chains=self.chains,
            init=self.init,
            wall_s=self._wall_s,
            warmup_wall_s=self._warmup_wall_s,
        )

    def _store(self, steps: int) -> _Store:
        return _Store(self.scaled, self.chains, steps, self.sampler.walkers)


def run(
    density: LogDensity,
    sampler: Sampler,
    *,
    draws: int,
    warmup: int,
    chains: int,
    seed: int,
    init: Any,
    progress: Progress | None = None,
) -> RunResult:
    """Sample a density: warm up, and draw `draws` steps. The arguments are those of `Run` and `Run.extend`."""
    draws = whole_number("draws", draws, 1)
    begun = Run(density, sampler, warmup=warmup, chains=chains, seed=seed, init=init, progress=progress)
    return begun.extend(draws)


def _frozen(task: _Task, scaled: ScaledDensity) -> dict[str, Any]:
    """End a task's adaptation; return the settings that its draws are made with, {} if there was none."""
    if task.tuner is None:
        return {}
    settings = task.tuner.finished()
    task.kernel, task.tuner = settings.bind(scaled), None
    return describe(settings)


def _phase(name: str, tasks: list[_Task], store: _Store, progress: Progress | None, done: int = 0) -> Draws:
    """Run the steps that `store` has room for, all tasks side by side; `done` were run before."""
    steps = store.shape[1]
    for step in range(steps):
        infos = [task.warm_up() if name == "warmup" else task.step() for task in tasks]
        for task, info in zip(tasks, infos, strict=True):
            store.write(step, task, info)
        if progress is not None:
            progress(name, done + step + 1, done + steps, _words(infos))
    return store.draws()


def _words(infos: list[Info]) -> dict[str, str]:
    """Return what a progress line shows of a step."""
    solves = sum(int(info.n_solves.sum()) for info in infos)
    lp = float(np.mean([info.log_prob.mean() for info in infos]))
    return {"lp": f"{lp:.1f}", "solves": str(solves)}
