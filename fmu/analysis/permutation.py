"""Permutation tests: statistics of a sequence, compared with the same statistics in random orders."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fmu.types import BoolArray, FloatArray

_PERMUTATIONS = 2000
_AT_ONCE = 1_000_000
"""Number of array entries that are permuted at a time."""

type Statistics = Callable[[FloatArray, BoolArray], FloatArray]
"""Function from sequences (n_orders, n, m) and the mask of their present values to statistics (n_orders, …)."""


def in_random_orders(z: FloatArray, present: BoolArray, statistics: Statistics) -> FloatArray:
    """Return the statistics of a sequence, followed by those in random orders, shape (1 + n_orders, …).

    The same sequence always gives the same result.

    Parameters
    ----------
    z : ndarray, shape (n, m)
        The sequence, zero where a value is missing. Rows are permuted together, because the columns may depend on
        each other.
    present : ndarray of bool, shape (n, m)
        Whether each value is present.
    statistics : Statistics
    """
    rng = np.random.default_rng(0)
    orders = np.array([np.arange(len(z)), *(rng.permutation(len(z)) for _ in range(_PERMUTATIONS))])
    parts = np.array_split(orders, 1 + orders.size * z.shape[1] // _AT_ONCE)
    return np.concatenate([statistics(z[part], present[part]) for part in parts])


def adjusted_probabilities(statistics: FloatArray, two_sided: BoolArray) -> FloatArray:
    """Return the adjusted p-values of the statistics under random order, shape (k,).

    Every statistic is standardised by its mean and standard deviation over random orders and compared with the
    largest of all statistics in each random order (Westfall & Young 1993, *Resampling-based multiple testing*,
    section 2.3). The smallest p-value is one over the number of orders.

    Parameters
    ----------
    statistics : ndarray, shape (1 + n_orders, k)
        Result of `in_random_orders`.
    two_sided : ndarray of bool, shape (k,)
        Whether a statistic is unusual if it is far from zero on either side; otherwise it is unusual if it is
        large.
    """
    sizes = np.where(two_sided, np.abs(statistics), statistics)
    given, shuffled = sizes[0], sizes[1:]
    centre = np.where(two_sided, 0.0, shuffled.mean(axis=0))
    spread = np.sqrt(np.mean((shuffled - centre) ** 2, axis=0))
    spread[spread == 0] = np.inf
    largest = ((shuffled - centre) / spread).max(axis=1)
    reached = np.mean(largest[:, None] >= ((given - centre) / spread - 1e-9), axis=0)
    n = len(shuffled)
    return np.asarray((reached * n + 1.0) / (n + 1.0))


def lag_one(z: FloatArray, present: BoolArray) -> FloatArray:
    """Return the lag-1 autocorrelation of each column of centred sequences, shape (n_orders, m)."""
    square, n = np.sum(z**2, axis=1), present.sum(axis=1)
    pairs = np.maximum(np.sum(present[:, 1:] & present[:, :-1], axis=1), 1)
    return np.asarray(np.sum(z[:, 1:] * z[:, :-1], axis=1) / square * (n - 1) / pairs)


def correlation_with(x: FloatArray, z: FloatArray, present: BoolArray) -> FloatArray:
    """Return the correlation of each column of centred sequences with x (n,), shape (n_orders, m)."""
    square, n = np.sum(z**2, axis=1), present.sum(axis=1)
    t = np.where(present, x[:, None], 0.0)
    t = np.where(present, t - (t.sum(axis=1) / n)[:, None], 0.0)
    return np.asarray(np.sum(t * z, axis=1) / np.sqrt(square * np.sum(t**2, axis=1)))


def between_groups(of_group: FloatArray, z: FloatArray, present: BoolArray) -> FloatArray:
    """Return the share of the variance between groups for each column of centred sequences, (n_orders, m).

    The matrix `of_group`, (n, n_groups), is one where a row belongs to a group.
    """
    sums = np.einsum("onm,ng->omg", z, of_group)
    counts = np.einsum("onm,ng->omg", present.astype(float), of_group)
    return np.asarray(np.sum(sums**2 / np.maximum(counts, 1.0), axis=2) / np.sum(z**2, axis=1))
