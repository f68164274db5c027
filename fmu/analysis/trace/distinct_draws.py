"""The distinct draws of a run, so that the model is solved only once for repeated draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fmu.progress.phases import by_parts
from fmu.types import FloatArray, IntArray

BATCH = 4096
"""Largest number of draws passed to the model at a time, which bounds the memory of one batched solve."""
_NUMBERS = 2**18
"""Largest number of parameters of these draws together, because a problem of many tests has many of them."""


def batch_of(theta: FloatArray) -> int:
    """Return the number of draws to evaluate at a time, given all draws (n, ndim)."""
    return max(1, min(BATCH, _NUMBERS // theta.shape[1]))


def evaluate_in_parts(function: Callable[..., FloatArray], theta: FloatArray, *others: FloatArray) -> FloatArray:
    """Return ``function(theta, *others)`` for arrays with n rows, computed for a batch of rows at a time."""
    n, batch = len(theta), batch_of(theta)
    parts = [slice(k, k + batch) for k in range(0, max(n, 1), batch)]
    return np.concatenate([function(*(x[part] for x in (theta, *others))) for part in parts])


@dataclass(frozen=True)
class DistinctDraws:
    """The draws of a run without the repetitions from rejected proposals.

    Attributes
    ----------
    theta : ndarray, shape (n, ndim)
        Draws that differ from the previous draw of the same chain (or of the same walker of an ensemble).
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
            Positions in step-major order: the next draw of a walker is `walkers` rows further on.
        walkers : int
        """
        chains, draws, ndim = position.shape
        paths = position.reshape(chains, draws // walkers, walkers, ndim).swapaxes(1, 2)
        moved = np.ones(paths.shape[:3], dtype=bool)
        moved[:, :, 1:] = np.any(paths[:, :, 1:] != paths[:, :, :-1], axis=-1)
        inverse = np.cumsum(moved).reshape(moved.shape) - 1
        return cls(paths[moved], inverse.swapaxes(1, 2).reshape(chains, draws))

    def evaluate(self, function: Callable[[FloatArray], FloatArray], batch: int | None = None) -> FloatArray:
        """Return ``function(theta)`` for every draw, shape (chains, draws, ...), in the phase "predictions".

        Parameters
        ----------
        function : callable
            Maps (n, ndim) to (n, ...). It is called with at most `batch` rows, and once for each distinct draw.
        batch : int, optional
            Defaults to `batch_of` the draws.
        """
        batch = batch_of(self.theta) if batch is None else batch
        return np.concatenate(by_parts("predictions", function, self.theta, batch))[self.inverse]
