"""Record the steps of a run in arrays, and collect them in the result that the run returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fmu.types import AnyArray, FloatArray


@dataclass(frozen=True)
class Draws:
    """The draws from one phase of a run.

    Attributes
    ----------
    position : ndarray, shape (chains, draws, ndim)
        theta, in unscaled coordinates. An ensemble has steps × walkers draws, in step-major order.
    stats : dict of str to ndarray, shape (chains, draws, ...)
        ``lp``, ``accepted``, ``n_solves``, ``n_gradients`` and the statistics that the sampler adds. Summed over
        warm-up and draws, n_solves and n_gradients give the exact cost of the sampling, because the cost of
        the starting points is added to the first step.
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
        Number of groups into which the chains were divided.
    init : str
        Source of the starting points: "prior", "start", "maxima" or "array"; "proposals" for delayed acceptance.
    wall_s, warmup_wall_s : float
        Time spent in s: on the whole run, including warm-up, and on warm-up alone. Both are NaN for chains that
        were imported from emcee.
    learnt : dict
        Settings that were learnt in warm-up and used for the draws; {} if nothing was learnt. With several groups
        of chains, each value is a list with one entry per group.
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
    """Consecutive steps taken by some of the chains.

    Attributes
    ----------
    position : ndarray, shape (chains, steps, walkers, ndim)
        theta, in unscaled coordinates.
    stats : mapping of str to ndarray, shape (chains, steps, walkers, ...)
    """

    position: FloatArray
    stats: Mapping[str, AnyArray]

    def __len__(self) -> int:
        return int(self.position.shape[1])


class Record:
    """Arrays that store the steps of all chains. Statistics get their arrays when the first steps are written.

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
        """Make room for `steps` steps in total. Arrays that were returned earlier do not change."""
        if steps > self._capacity:
            self._capacity = steps
            self._position = self._longer(self._position)
            self._stats = {name: self._longer(x) for name, x in self._stats.items()}

    def write(self, step: int, first_chain: int, steps: Steps) -> None:
        """Write `steps` of consecutive chains, starting at chain `first_chain` and step index `step`.

        Room for these steps must have been reserved.
        """
        chains = slice(first_chain, first_chain + len(steps.position))
        rows = slice(step, step + len(steps))
        self._position[chains, rows] = steps.position
        for name, value in steps.stats.items():
            if name not in self._stats:
                shape = (self._chains, self._capacity, *value.shape[2:])
                self._stats[name] = np.zeros(shape, dtype=value.dtype)
            self._stats[name][chains, rows] = value

    def steps(self, first: int, stop: int, chains: slice = slice(None)) -> Steps:
        """Return steps `first` to `stop` − 1 of the selected chains, as views without copying."""
        rows = slice(first, stop)
        return Steps(self._position[chains, rows], {name: x[chains, rows] for name, x in self._stats.items()})

    def draws(self, stop: int) -> Draws:
        """Return the draws of all steps before step `stop`, in step-major order.

        All walkers of step 0 come first, then all walkers of step 1, and so on.
        """
        steps = self.steps(0, stop)
        length = stop * self._walkers
        stats = {name: x.reshape(self._chains, length, *x.shape[3:]) for name, x in steps.stats.items()}
        return Draws(steps.position.reshape(self._chains, length, self._ndim), stats)

    def _longer(self, array: AnyArray) -> AnyArray:
        longer = np.zeros((len(array), self._capacity, *array.shape[2:]), dtype=array.dtype)
        longer[:, : array.shape[1]] = array
        return longer
