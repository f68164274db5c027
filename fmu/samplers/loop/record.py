"""Arrays that the steps of a run are written into."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmu.samplers.loop.draws import Draws
from fmu.types import FloatArray


@dataclass(frozen=True)
class Steps:
    """Some steps in a row of some chains.

    Attributes
    ----------
    position : ndarray, shape (chains, steps, walkers, ndim)
        theta, in the density's own coordinates.
    stats : mapping of str to ndarray, shape (chains, steps, walkers, ...)
    """

    position: FloatArray
    stats: Mapping[str, NDArray[Any]]

    def __len__(self) -> int:
        return int(self.position.shape[1])

    def part(self, first: int, stop: int) -> Steps:
        """Return the steps from `first` to before `stop`."""
        return Steps(self.position[:, first:stop], {name: x[:, first:stop] for name, x in self.stats.items()})


class Record:
    """Steps of chains, as they come. The arrays of statistics are made when the first steps name them.

    Parameters
    ----------
    chains, walkers, ndim : int
    """

    def __init__(self, chains: int, walkers: int, ndim: int) -> None:
        self._chains, self._walkers, self._ndim = chains, walkers, ndim
        self._capacity = 0
        self._position = np.empty((chains, 0, walkers, ndim))
        self._stats: dict[str, NDArray[Any]] = {}

    def reserve(self, steps: int) -> None:
        """Make room for so many steps in all. What was returned before stays what it was."""
        if steps > self._capacity:
            self._capacity = steps
            self._position = self._longer(self._position)
            self._stats = {name: self._longer(x) for name, x in self._stats.items()}

    def write(self, step: int, first_chain: int, steps: Steps) -> None:
        """Write the steps of the chains from `first_chain` on, beginning with step number `step`."""
        chains = slice(first_chain, first_chain + len(steps.position))
        rows = slice(step, step + len(steps))
        self._position[chains, rows] = steps.position
        for name, value in steps.stats.items():
            if name not in self._stats:
                shape = (self._chains, self._capacity, *value.shape[2:])
                self._stats[name] = np.zeros(shape, dtype=value.dtype)
            self._stats[name][chains, rows] = value

    def steps(self, first: int, stop: int, chains: slice = slice(None)) -> Steps:
        """Return the steps from `first` to before `stop` of some chains; no copies."""
        rows = slice(first, stop)
        return Steps(self._position[chains, rows], {name: x[chains, rows] for name, x in self._stats.items()})

    def draws(self, stop: int) -> Draws:
        """Return all steps before `stop`, the walkers of each one after another."""
        steps = self.steps(0, stop)
        length = stop * self._walkers
        stats = {name: x.reshape(self._chains, length, *x.shape[3:]) for name, x in steps.stats.items()}
        return Draws(steps.position.reshape(self._chains, length, self._ndim), stats)

    def _longer(self, array: NDArray[Any]) -> NDArray[Any]:
        longer = np.zeros((len(array), self._capacity, *array.shape[2:]), dtype=array.dtype)
        longer[:, : array.shape[1]] = array
        return longer
