"""Evaluation of a density in batches, with the account that every sampler keeps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .kernel import BoolArray, FloatArray, IntArray, LogDensity


@dataclass(frozen=True)
class Evaluation:
    """Log-densities of a batch and what they cost.

    Attributes
    ----------
    log_prob : ndarray, shape (n,)
        ``-inf`` outside the box, and where the density is not finite inside it.
    n_solves : ndarray of int, shape (n,)
        1 inside the box, 0 outside.
    n_nonfinite : ndarray of int, shape (n,)
        1 where the density inside the box is not finite.
    """

    log_prob: FloatArray
    n_solves: IntArray
    n_nonfinite: IntArray


def inside_box(density: LogDensity, position: FloatArray) -> BoolArray:
    """Return which points lie in the box; a NaN coordinate does not."""
    return np.all((position >= density.lower) & (position <= density.upper), axis=-1)


def evaluate(density: LogDensity, position: FloatArray) -> Evaluation:
    """Evaluate the density where `position`, shape (n, ndim), is inside the box, in one batch.

    Points outside are never handed to the density. A value that is not finite (a failed eigensolve) counts as
    ``-inf``, so that it stops this point alone.
    """
    inside = inside_box(density, position)
    log_prob = np.full(len(position), -np.inf)
    if inside.any():
        log_prob[inside] = density.log_prob(position[inside])
    failed = inside & ~np.isfinite(log_prob)
    log_prob[failed] = -np.inf
    return Evaluation(log_prob, inside.astype(np.int64), failed.astype(np.int64))
