"""The distinct draws of a run, so that the model is solved only once for repeated draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fmu.progress.phases import by_parts
from fmu.types import FloatArray, IntArray

BATCH = 4096
"""Number of draws passed to the model at a time, which bounds the memory of one batched solve."""


@dataclass(frozen=True)
class DistinctDraws:
    """The draws of a run without the repetitions from rejected proposals.

    Attributes
    ----------
    theta : ndarray, shape (n, ndim)
        Draws that differ from their predecessor in the same chain (in the same walker of an ensemble).
    inverse : ndarray of int, shape (chains, draws)
        Row index into `theta` for each draw.
    """

    theta: FloatArray
    inverse: IntArray

    @classmethod
    def of(cls, position: FloatArray, walkers: int = 1) -> DistinctDraws:
        """Return the draws without consecutive repetitions.

        Parameters
        ----------
        position : ndarray, shape (chains, steps * walkers, ndim)
            Positions in step-major order: the next draw of a walker lies `walkers` rows further on.
        walkers : int
        """
        chains, draws, ndim = position.shape
        paths = position.reshape(chains, draws // walkers, walkers, ndim).swapaxes(1, 2)
        moved = np.ones(paths.shape[:3], dtype=bool)
        moved[:, :, 1:] = np.any(paths[:, :, 1:] != paths[:, :, :-1], axis=-1)
        inverse = np.cumsum(moved).reshape(moved.shape) - 1
        return cls(paths[moved], inverse.swapaxes(1, 2).reshape(chains, draws))

    def evaluate(self, function: Callable[[FloatArray], FloatArray], batch: int = BATCH) -> FloatArray:
        """Return ``function(theta)`` for every draw, shape (chains, draws, ...), in the phase "predictions".

        Parameters
        ----------
        function : callable
            Maps (n, ndim) to (n, ...); called with at most `batch` rows, once for each distinct draw.
        batch : int
        """
        return np.concatenate(by_parts("predictions", function, self.theta, batch))[self.inverse]
