"""Permutation tests, which compare statistics of a sequence with the same statistics in random orders.

The sequences are frequencies, or test scores in units of their standard deviation. Different statistics are put on
a common scale: minus the log of their tail probability under Gaussian values (`improbability`). The random orders
then make the test exact for any distribution of the values.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import betainc, log_ndtr

from fmu.types import BoolArray, FloatArray

_PERMUTATIONS = 2000
_TINY = 1e-300
_PLACES = np.linspace(0.15, 0.85, 15)
"""Quantiles of a covariate at which a dependence on it may bend."""
_FEWEST_BESIDE, _STRAIGHT = 4, 1e-6
"""Smallest number of tests on either side of a bend; relative size below which a bend counts as a line."""
_AT_ONCE = 1_000_000
"""Number of array entries that are permuted at a time."""

type Statistics = Callable[[FloatArray, BoolArray], FloatArray]
"""Function from sequences (n_orders, n, m) and the mask of their present values to statistics (n_orders, …)."""


def in_random_orders(z: FloatArray, present: BoolArray, statistics: Statistics) -> FloatArray:
    """Return statistics of a sequence, first in its own order and then in random orders, (1 + n_orders, …).

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
    """Return the p-value of each statistic under random order, adjusted for the number of statistics, (k,).

    Each statistic is standardised by its mean and standard deviation over random orders and compared with the
    largest of all statistics in each random order (Westfall & Young 1993, *Resampling-based multiple testing*,
    section 2.3). The mean of a two-sided statistic is taken as 0. The smallest possible p-value is 1/(1 +
    n_orders).

    Parameters
    ----------
    statistics : ndarray, shape (1 + n_orders, k)
        Result of `in_random_orders`.
    two_sided : ndarray of bool, shape (k,)
        True for a statistic that is unusual far from zero on either side, False for one that is unusual if large.
    """
    sizes = np.where(two_sided, np.abs(statistics), statistics)
    shuffled = sizes[1:]
    centre = np.where(two_sided, 0.0, shuffled.mean(axis=0))
    spread = np.sqrt(np.mean((shuffled - centre) ** 2, axis=0))
    spread[spread == 0] = np.inf
    return probabilities_of_largest((sizes - centre) / spread)


def probabilities_of_largest(sizes: FloatArray) -> FloatArray:
    """Return the p-value of each statistic under random order, adjusted for the number of statistics, (k,).

    The p-value is the fraction of orders, the actual one included, in which the largest of all statistics is at
    least as large as this statistic is in the actual order.

    Parameters
    ----------
    sizes : ndarray, shape (1 + n_orders, k)
        The statistics in the actual order, then in random orders, on a common scale.
    """
    largest, n = sizes[1:].max(axis=1), len(sizes) - 1
    reached = np.sum(largest[:, None] >= sizes[0] - 1e-9, axis=0)
    return np.asarray((reached + 1.0) / (n + 1.0))


def improbability(r_squared: FloatArray, n: FloatArray, k: int = 1) -> FloatArray:
    """Return −log P(R² ≥ r²), where R² is the squared multiple correlation of n Gaussian values with k regressors.

    Different statistics can be compared on this scale. R² follows a beta distribution with parameters k/2 and
    (n − 1 − k)/2. The result is at most 691, since smaller probabilities are replaced by 1e-300.
    """
    left = np.maximum(0.5 * (n - 1.0 - k), 0.5)
    return np.asarray(-np.log(np.maximum(betainc(left, 0.5 * k, np.clip(1.0 - r_squared, 0.0, 1.0)), _TINY)))


def improbability_of_lag_one(r: FloatArray, n: FloatArray) -> FloatArray:
    """Return −log P(R ≥ r) for the lag-1 autocorrelation R of n independent values, approximately N(−1/n, 1/n)."""
    return np.asarray(-log_ndtr(-(r + 1.0 / n) * np.sqrt(n)))


def lag_one(z: FloatArray, present: BoolArray) -> FloatArray:
    """Return the lag-1 autocorrelation of each column, (n_orders, m), of centred sequences z (n_orders, n, m).

    `present`, of the same shape as z, marks the values that exist; z is 0 elsewhere. Pairs with a missing value
    are left out. A constant column gives NaN.
    """
    square, n = np.sum(z**2, axis=1), present.sum(axis=1)
    pairs = np.maximum(np.sum(present[:, 1:] & present[:, :-1], axis=1), 1)
    return np.asarray(np.sum(z[:, 1:] * z[:, :-1], axis=1) / square * (n - 1) / pairs)


def correlation_with(x: FloatArray, z: FloatArray, present: BoolArray) -> FloatArray:
    """Return the correlation of x (n,) with each column of centred sequences z (n_orders, n, m).

    `present`, of the same shape as z, marks the values that exist; z is 0 elsewhere. The rows of x without a value
    in a column are left out of its correlation. The result has shape (n_orders, m), with NaN for constant columns.
    """
    square, n = np.sum(z**2, axis=1), present.sum(axis=1)
    t = np.where(present, x[:, None], 0.0)
    t = np.where(present, t - (t.sum(axis=1) / n)[:, None], 0.0)
    return np.asarray(np.sum(t * z, axis=1) / np.sqrt(square * np.sum(t**2, axis=1)))


def between_groups(of_group: FloatArray, z: FloatArray, present: BoolArray) -> FloatArray:
    """Return the between-group fraction of each column's variance, (n_orders, m), in centred sequences z.

    `z` has shape (n_orders, n, m) and is 0 where `present`, of the same shape, is False. `of_group` (n, n_groups)
    is 1 where a row belongs to a group, otherwise 0. A constant column gives NaN.
    """
    sums = np.einsum("onm,ng->omg", z, of_group)
    counts = np.einsum("onm,ng->omg", present.astype(float), of_group)
    return np.asarray(np.sum(sums**2 / np.maximum(counts, 1.0), axis=2) / np.sum(z**2, axis=1))


def slow_waves(n: int) -> FloatArray:
    """Return the first two cosine waves over a sequence of n values, each of unit length, shape (n, 2)."""
    waves = np.cos(np.pi * (np.arange(n)[:, None] + 0.5) * np.array([1.0, 2.0]) / n)
    return np.asarray(waves / np.linalg.norm(waves, axis=0))


def share_along(basis: FloatArray, z: FloatArray, present: BoolArray) -> FloatArray:
    """Return the fraction of each column's sum of squares in the span of a basis, shape (n_orders, m).

    The centred sequences `z` have shape (n_orders, n, m) and are 0 where a value is missing; `present` is not
    used. The columns of `basis` (n, k) are orthonormal. A constant column gives NaN.
    """
    return np.asarray(np.sum(np.einsum("onm,nk->omk", z, basis) ** 2, axis=2) / np.sum(z**2, axis=1))


class Bends:
    """Values of a covariate x at which the dependence of a sequence on x may bend.

    Parameters
    ----------
    x : ndarray, shape (n,)
        The covariate; NaN where it is not known.

    Attributes
    ----------
    places : ndarray, shape (n_places,)
        At most 15 values of x from its 15 % to its 85 % quantile. At least four tests lie on either side of each
        value. The array is empty if no value qualifies.
    """

    def __init__(self, x: FloatArray) -> None:
        known = ~np.isnan(x)
        at = np.unique(np.quantile(x[known], _PLACES)) if known.any() else np.empty(0)
        enough = [min(np.sum(x < c), np.sum(x > c)) >= _FEWEST_BESIDE for c in at]
        line = _orthonormal(np.stack([known.astype(float), np.where(known, x, 0.0)], axis=1))
        hinges = np.where(known[:, None], np.maximum(x[:, None] - at, 0.0), 0.0)
        bent = hinges - line @ (line.T @ hinges)
        size = np.linalg.norm(bent, axis=0)
        kept = np.array(enough, dtype=bool) & (size > _STRAIGHT * np.linalg.norm(hinges, axis=0))
        self.places, self._line, self._bent, self._known = at[kept], line, bent[:, kept] / size[kept], known

    def shares(self, z: FloatArray) -> FloatArray:
        """Return the fraction of the variance about a straight line in x that a bend at each place explains.

        The sequences `z` have shape (…, n, m).

        Returns
        -------
        ndarray, shape (…, m, n_places)
        """
        z = np.where(self._known[:, None], z, 0.0)
        left = np.sum(z**2, axis=-2) - np.sum(np.einsum("...nm,nk->...mk", z, self._line) ** 2, axis=-1)
        return np.asarray(np.einsum("...nm,nc->...mc", z, self._bent) ** 2 / left[..., None])

    def largest(self, z: FloatArray, present: BoolArray) -> FloatArray:
        """Return the largest of `shares` over all places, shape (n_orders, m); `present` is not used.

        There must be at least one place.
        """
        return np.asarray(self.shares(z).max(axis=-1))


def _orthonormal(columns: FloatArray) -> FloatArray:
    return np.linalg.qr(columns)[0]
