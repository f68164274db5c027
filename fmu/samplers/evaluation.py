"""Evaluation of a density in batches, with the account that every sampler keeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fmu.types import BoolArray, FloatArray, IntArray, LogDensity


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


def of_chains(density: LogDensity, chain: Any) -> LogDensity:
    """Return the density of the chains that the index `chain` picks.

    The density itself, unless it is another one for each chain and says so by a method ``of_chains``.
    """
    pick = getattr(density, "of_chains", None)
    return density if pick is None else pick(chain)


def evaluate(density: LogDensity, position: FloatArray, chain: IntArray | None = None) -> Evaluation:
    """Evaluate the density where `position`, shape (n, ndim), is inside the box, in one batch.

    `chain`, shape (n,), says whose points they are; if not given, there is one point a chain.

    Points outside are never handed to the density. A value that is not finite (a failed eigensolve) counts as
    ``-inf``, so that it stops this point alone.
    """
    inside = inside_box(density, position)
    log_prob = np.full(len(position), -np.inf)
    if inside.any():
        whose = inside if chain is None else chain[inside]
        log_prob[inside] = of_chains(density, whose).log_prob(position[inside])
    failed = inside & ~np.isfinite(log_prob)
    log_prob[failed] = -np.inf
    return Evaluation(log_prob, inside.astype(np.int64), failed.astype(np.int64))
