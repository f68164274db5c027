"""Draws of a run: the arrays that steps are written into, and the result that a run returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fmu.types import AnyArray, FloatArray


@dataclass(frozen=True)
class Draws:
    """The draws of one phase of a run.

    Attributes
    ----------
    position : ndarray, shape (chains, draws, ndim)
        theta, in the density's own coordinates. An ensemble has steps × walkers draws, in step-major order.
    stats : dict of str to ndarray, shape (chains, draws)
        ``lp``, ``accepted``, ``n_solves``, ``n_gradients`` and the statistics that the sampler adds. The sums of
        n_solves and n_gradients over warm-up and draws are the exact cost of the run: the cost of the start is
        counted for the first stored step.
    """

    position: FloatArray
    stats: dict[str, AnyArray]


@dataclass(frozen=True)
class RunResult:
    """Draws and configuration of a run.

    Attributes
    ----------
    warmup, posterior : Draws
    sampler : str
        Short name of the sampler.
    settings : dict
        Settings of the sampler, as JSON-able data.
    seed, chains, draws, warmup_draws, walkers : int
        `draws` and `warmup_draws` count steps; an ensemble stores `walkers` draws per step.
    groups : int
        Number of groups that the chains were divided into.
    init : str
        Where the chains started: "prior", "start", "maxima" or "array".
    wall_s, warmup_wall_s : float
        Seconds spent sampling, warm-up included, and in warm-up alone.
    learnt : dict
        The settings that warm-up learnt and that the draws were made with; {} if nothing was learnt. With several
        groups of chains, each value is a list over the groups.
    """

    warmup: Draws
    posterior: Draws
    sampler: str
    settings: Mapping[str, object]
    seed: int
    walkers: int
    draws: int
    warmup_draws: int
    chains: int
    init: str
    wall_s: float
    warmup_wall_s: float
    groups: int = 1
    learnt: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Steps:
    """Consecutive steps of some of the chains.

    Attributes
    ----------
    position : ndarray, shape (chains, steps, walkers, ndim)
        theta, in the density's own coordinates.
    stats : mapping of str to ndarray, shape (chains, steps, walkers, ...)
    """

    position: FloatArray
    stats: Mapping[str, AnyArray]

    def __len__(self) -> int:
        return int(self.position.shape[1])


class Record:
    """Arrays of the steps of all chains. The arrays of statistics are created when the first steps name them.

    Parameters
    ----------
    chains, walkers, ndim : int
    """

    def __init__(self, chains: int, walkers: int, ndim: int) -> None:
        self._chains, self._walkers, self._ndim = chains, walkers, ndim
        self._capacity = 0
        self._position = np.empty((chains, 0, walkers, ndim))
        self._stats: dict[str, AnyArray] = {}

    def reserve(self, steps: int) -> None:
        """Make room for `steps` steps in total. Arrays returned earlier do not change."""
        if steps > self._capacity:
            self._capacity = steps
            self._position = self._longer(self._position)
            self._stats = {name: self._longer(x) for name, x in self._stats.items()}

    def write(self, step: int, first_chain: int, steps: Steps) -> None:
        """Write the steps of the chains from index `first_chain` on, beginning at step index `step`."""
        chains = slice(first_chain, first_chain + len(steps.position))
        rows = slice(step, step + len(steps))
        self._position[chains, rows] = steps.position
        for name, value in steps.stats.items():
            if name not in self._stats:
                shape = (self._chains, self._capacity, *value.shape[2:])
                self._stats[name] = np.zeros(shape, dtype=value.dtype)
            self._stats[name][chains, rows] = value

    def steps(self, first: int, stop: int, chains: slice = slice(None)) -> Steps:
        """Return the steps `first` to `stop` − 1 of the selected chains, without copies."""
        rows = slice(first, stop)
        return Steps(self._position[chains, rows], {name: x[chains, rows] for name, x in self._stats.items()})

    def draws(self, stop: int) -> Draws:
        """Return the draws of all steps before `stop` in order: all walkers of a step, then the next step."""
        steps = self.steps(0, stop)
        length = stop * self._walkers
        stats = {name: x.reshape(self._chains, length, *x.shape[3:]) for name, x in steps.stats.items()}
        return Draws(steps.position.reshape(self._chains, length, self._ndim), stats)

    def _longer(self, array: AnyArray) -> AnyArray:
        longer = np.zeros((len(array), self._capacity, *array.shape[2:]), dtype=array.dtype)
        longer[:, : array.shape[1]] = array
        return longer
