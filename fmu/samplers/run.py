"""The only loop: chains, seeds, progress and what is kept."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .kernel import FloatArray, Info, Kernel, LogDensity, Sampler, State, Tuner
from .scaled import ScaledDensity
from .settings import describe, whole_number
from .starts import check_finite, starting_points

Progress = Callable[[str, int, int, dict[str, str]], None]


@dataclass(frozen=True)
class Draws:
    """What was drawn in one phase.

    Attributes
    ----------
    position : ndarray, shape (chains, draws, ndim)
        theta, in the density's own coordinates. The draws of an ensemble are steps × walkers, step-major.
    stats : dict of str to ndarray, shape (chains, draws)
        ``lp``, ``accepted``, ``n_solves``, ``n_gradients`` and what the sampler adds. The sums of n_solves and
        n_gradients over warm-up and draws are exactly what the density was asked for: the cost of the start is
        booked on the first stored step.
    """

    position: FloatArray
    stats: dict[str, NDArray[Any]]


@dataclass(frozen=True)
class RunResult:
    """Draws of a run and its configuration.

    Attributes
    ----------
    warmup, posterior : Draws
    sampler : str
        Short name of the sampler.
    settings : dict
        Its settings, as JSON-able data.
    seed, chains, draws, warmup_draws, walkers : int
        `draws` and `warmup_draws` count steps; an ensemble stores `walkers` draws a step.
    init : str
        "prior", "start" or "array".
    wall_s, warmup_wall_s : float
        Seconds spent sampling, warm-up included, and in warm-up alone.
    learnt : dict
        The settings that warm-up arrived at and the draws were made with, {} where nothing was learnt.
    """

    warmup: Draws
    posterior: Draws
    sampler: str
    settings: dict[str, Any]
    seed: int
    walkers: int
    draws: int
    warmup_draws: int
    chains: int
    init: str
    wall_s: float
    warmup_wall_s: float
    learnt: dict[str, Any] = field(default_factory=dict)


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
            info = Info(info.accepted, info.log_prob, solves, gradients, info.extra)
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
            if name not in self.stats:
                self.stats[name] = np.zeros(self.shape, dtype=value.dtype)
            self.stats[name][chains, step] = value.reshape(len(value), -1)

    def draws(self) -> Draws:
        chains, steps, walkers = self.shape
        stats = {name: value.reshape(chains, steps * walkers) for name, value in self.stats.items()}
        return Draws(self.position.reshape(chains, steps * walkers, self.scaled.ndim), stats)


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
    """Sample a density.

    The same density, settings and seed give the same draws, bit for bit. There is one generator a task, from
    ``SeedSequence(seed).spawn(tasks)``: all chains are one task, but every ensemble is its own.

    Parameters
    ----------
    density : LogDensity
        With attributes `offset` and `scale`, (ndim,), for the scaled view if it has them (see ScaledDensity).
    sampler : Sampler
        Settings, in the units of the scaled view.
    draws, warmup : int
        Steps kept as draws, and before them.
    chains : int
        Chains, or ensembles.
    seed : int
    init : "prior", "start" or array_like, shape (chains, ndim) or (chains, walkers, ndim)
        See starting_points.
    progress : callable, optional
        Called after every step as ``progress(phase, done, total, info)``: phase "warmup" or "draws", steps done
        of the phase's total, and a few words by name.

    Raises
    ------
    ValueError
        If a number is out of range, a setting does not fit the density, or a start is outside the bounds or has a
        log-density that is not finite.
    """
    draws, chains = whole_number("draws", draws, 1), whole_number("chains", chains, 1)
    warmup, seed = whole_number("warmup", warmup, 0), whole_number("seed", seed, 0)
    scaled = ScaledDensity(density)
    kernel = sampler.bind(scaled)
    n_tasks = chains if sampler.walkers > 1 else 1
    generators = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(n_tasks)]
    positions = starting_points(scaled, init, generators, chains, sampler.walkers)

    began = time.perf_counter()
    tasks = []
    for i, (rng, position) in enumerate(zip(generators, positions, strict=True)):
        first_chain = i * (chains // n_tasks)
        state, info = kernel.init(position)
        check_finite(scaled, position, info.log_prob, first_chain)
        tuner = sampler.tuner(scaled, len(position), warmup) if warmup else None
        tasks.append(_Task(kernel, rng, state, first_chain, info, tuner))
    warm = _phase("warmup", tasks, _Store(scaled, chains, warmup, sampler.walkers), progress)
    learnt = [_frozen(task, scaled) for task in tasks]
    warmup_wall_s = time.perf_counter() - began
    kept = _phase("draws", tasks, _Store(scaled, chains, draws, sampler.walkers), progress)
    if warmup == 0:  # no step has named the statistics
        warm = Draws(warm.position, {key: value[:, :0] for key, value in kept.stats.items()})
    return RunResult(
        warmup=warm,
        posterior=kept,
        sampler=sampler.name,
        settings=describe(sampler),
        learnt=learnt[0],
        seed=seed,
        walkers=sampler.walkers,
        draws=draws,
        warmup_draws=warmup,
        chains=chains,
        init=init if isinstance(init, str) else "array",
        wall_s=time.perf_counter() - began,
        warmup_wall_s=warmup_wall_s,
    )


def _frozen(task: _Task, scaled: ScaledDensity) -> dict[str, Any]:
    """End a task's adaptation; return the settings that its draws are made with, {} if there was none."""
    if task.tuner is None:
        return {}
    settings = task.tuner.finished()
    task.kernel, task.tuner = settings.bind(scaled), None
    return describe(settings)


def _phase(name: str, tasks: list[_Task], store: _Store, progress: Progress | None) -> Draws:
    """Run the steps that `store` has room for, all tasks side by side."""
    total = store.shape[1]
    for step in range(total):
        infos = [task.warm_up() if name == "warmup" else task.step() for task in tasks]
        for task, info in zip(tasks, infos, strict=True):
            store.write(step, task, info)
        if progress is not None:
            progress(name, step + 1, total, _words(infos))
    return store.draws()


def _words(infos: list[Info]) -> dict[str, str]:
    """Return what a progress line shows of a step."""
    solves = sum(int(info.n_solves.sum()) for info in infos)
    lp = float(np.mean([info.log_prob.mean() for info in infos]))
    return {"lp": f"{lp:.1f}", "solves": str(solves)}
