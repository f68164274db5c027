"""Find the distinct draws of a run, so that the model is solved only once for repeated draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fmu.progress.phases import by_parts
from fmu.types import FloatArray, IntArray

BATCH = 4096
"""Largest number of draws passed to the model at a time, which limits the memory of one batched solve."""
_NUMBERS = 2**18
"""Largest total number of parameter values in a batch, because a problem with many tests has many parameters."""


def batch_of(theta: FloatArray) -> int:
    """Return the number of draws of theta (n, ndim) in one batch: `BATCH`, or fewer if ndim is large."""
    return max(1, min(BATCH, _NUMBERS // theta.shape[1]))


def evaluate_in_parts(function: Callable[..., FloatArray], theta: FloatArray, *others: FloatArray) -> FloatArray:
    """Evaluate ``function(theta, *others)`` in batches of rows, and concatenate the results along axis 0."""
    n, batch = len(theta), batch_of(theta)
    parts = [slice(k, k + batch) for k in range(0, max(n, 1), batch)]
    return np.concatenate([function(*(x[part] for x in (theta, *others))) for part in parts])


@dataclass(frozen=True)
class DistinctDraws:
    """A run's draws without the repetitions that rejected proposals cause.

    Attributes
    ----------
    theta : ndarray, shape (n, ndim)
        The first draw of each chain (or walker of an ensemble), and each later one that differs from the draw
        before.
    inverse : ndarray of int, shape (chains, draws)
        Row of `theta` for each draw.
    """

    theta: FloatArray
    inverse: IntArray

    @classmethod
    def of(cls, position: FloatArray, walkers: int = 1) -> DistinctDraws:
        """Remove consecutive repetitions from the draws.

        Parameters
        ----------
        position : ndarray, shape (chains, steps * walkers, ndim)
            Positions in step-major order: a walker's next draw is `walkers` rows further on.
        walkers : int
        """
        chains, draws, ndim = position.shape
        paths = position.reshape(chains, draws // walkers, walkers, ndim).swapaxes(1, 2)
        moved = np.ones(paths.shape[:3], dtype=bool)
        moved[:, :, 1:] = np.any(paths[:, :, 1:] != paths[:, :, :-1], axis=-1)
        inverse = np.cumsum(moved).reshape(moved.shape) - 1
        return cls(paths[moved], inverse.swapaxes(1, 2).reshape(chains, draws))

    def evaluate(self, function: Callable[[FloatArray], FloatArray], batch: int | None = None) -> FloatArray:
        """Return a function's values at every draw, shape (chains, draws, ...).

        The progress is reported as the phase "predictions".

        Parameters
        ----------
        function : callable
            Maps (n, ndim) to (n, ...). It is called with at most `batch` rows, which are distinct draws.
        batch : int, optional
            Defaults to `batch_of` the draws.
        """
        batch = batch_of(self.theta) if batch is None else batch
        return np.concatenate(by_parts("predictions", function, self.theta, batch))[self.inverse]
