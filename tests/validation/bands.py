"""Simultaneous bands for the empirical distribution function of ranks, exact.

Of N independent uniform values R_i lie below the evaluation point z_i, z_1 < … < z_K: each R_i is binomial(N,
z_i). A band leaves out of every R_i the same pointwise tail probability. The probability that all of them stay
within follows by recursion from R_{i+1} − R_i ~ binomial(N − R_i, (z_{i+1} − z_i)/(1 − z_i)).

Säilynoja, Bürkner & Vehtari (2022), Statistics and Computing 32, 32, section 2.2: the adjustment by optimisation.
ArviZ adjusts by simulation, which cannot reach the small levels that many comparisons ask for.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import gammaln, xlog1py, xlogy
from scipy.stats import binom

from fmu.types import FloatArray, IntArray


@dataclass(frozen=True)
class UniformRanks:
    """What `replicates` independent ranks, uniform on 0, …, `largest`, do.

    The evaluation points are z_i = i/(largest + 1), i = 1, …, largest: below z_i lie the ranks smaller than i.

    Attributes
    ----------
    replicates, largest : int
    """

    replicates: int
    largest: int

    @property
    def points(self) -> FloatArray:
        """Evaluation points z_i, shape (largest,)."""
        return np.arange(1, self.largest + 1) / (self.largest + 1)

    def counts(self, ranks: IntArray) -> IntArray:
        """Return how many of `ranks`, shape (replicates,), lie below each evaluation point, shape (largest,).

        Raises
        ------
        ValueError
            If there are not as many ranks as replicates, or one is out of range.
        """
        if len(ranks) != self.replicates or not np.all((ranks >= 0) & (ranks <= self.largest)):
            raise ValueError(f"ranks: must be {self.replicates} in 0..{self.largest} (got {len(ranks)}: {ranks})")
        return np.searchsorted(np.sort(ranks), np.arange(1, self.largest + 1), side="left")

    def band(self, tail: float) -> tuple[IntArray, IntArray]:
        """Return the smallest and the largest counts whose two-sided tail probability exceeds `tail`.

        Where there is none, the smallest is larger than the largest.
        """
        inside = self._tails > tail * (1.0 + 1e-9)  # mirrored counts have the same tail but for rounding
        lowest = np.where(inside.any(axis=0), np.argmax(inside, axis=0), self.replicates + 1)
        return lowest, self.replicates - np.argmax(inside[::-1], axis=0)

    def escape(self, tail: float) -> float:
        """Return the probability that uniform ranks leave ``band(tail)`` somewhere."""
        reached, probability, before = np.zeros(1, dtype=int), np.ones(1), 0.0
        for z, low, high in zip(self.points, *self.band(tail), strict=True):
            inside = np.arange(low, high + 1)
            probability = probability @ self._transition(reached, inside, (z - before) / (1.0 - before))
            reached, before = inside, z
        return float(max(0.0, 1.0 - probability.sum()))

    def p_value(self, ranks: IntArray) -> float:
        """Return the probability that uniform ranks stray as far as these, anywhere."""
        return self.escape(float(self._tails[self.counts(ranks), np.arange(self.largest)].min()))

    def simultaneous_band(self, level: float) -> tuple[IntArray, IntArray]:
        """Return the narrowest band that uniform ranks leave with a probability of at most `level`."""
        tails = np.unique(self._tails)
        within, beyond = 0, len(tails)
        while beyond - within > 1:
            middle = (within + beyond) // 2
            within, beyond = (middle, beyond) if self.escape(tails[middle]) <= level else (within, middle)
        return self.band(tails[within])

    @cached_property
    def _tails(self) -> FloatArray:
        """Two-sided tail probability of every count at every point, shape (replicates + 1, largest)."""
        count = np.arange(self.replicates + 1)[:, None]
        below, above = (f(count - k, self.replicates, self.points) for k, f in ((0, binom.cdf), (1, binom.sf)))
        return 2.0 * np.minimum(below, above)

    def _transition(self, before: IntArray, after: IntArray, step: float) -> FloatArray:
        """P(R_{i+1} = after | R_i = before), shape (len(before), len(after)): binomial(N − R_i, step)."""
        left, gained = (self.replicates - before)[:, None], after[None, :] - before[:, None]
        possible = gained >= 0
        g = np.where(possible, gained, 0)
        log_ways = gammaln(left + 1.0) - gammaln(g + 1.0) - gammaln(np.where(possible, left - g, 0) + 1.0)
        log_pmf = log_ways + xlogy(g, step) + xlog1py(left - g, -step)
        return np.where(possible, np.exp(np.where(possible, log_pmf, 0.0)), 0.0)
