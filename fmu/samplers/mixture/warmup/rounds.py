"""Adaptive importance sampling of a curved density, in rounds that each use a mixture fitted to earlier rounds."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from scipy.special import logsumexp

from fmu.samplers.kernel import Target
from fmu.samplers.mixture.curved import CurvedMixture, fit_curved
from fmu.samplers.mixture.importance import cut_largest, even_out, sum_densities
from fmu.types import FloatArray

PER_ROUND = 2000
"""Largest number of candidates in a round."""
ENOUGH = 0.45
"""Efficiency that makes further rounds unnecessary if two successive rounds reach it."""
_TWICE = 2
_MILDER = 0.8
_LEAST_POINTS = 60
"""Effective number of points per coordinate below which the weights in a fit are raised to a power below 1, if
it is also below the share `_MOST_PART` of all points."""
_MOST_PART = 0.2
_SAMPLE = 1000  # draws from which the efficiency of a mixture is estimated
_FEWEST = 200
"""Smallest number of candidates in a round."""


class Rounds:
    """Candidates from several rounds, importance-weighted by the combined density of all rounds' mixtures.

    This is adaptive multiple importance sampling (AMIS, Cornuet et al. 2012).

    Attributes
    ----------
    target : Target
    position : ndarray, shape (n, ndim)
        Candidates with a finite log-density.
    log_prob : ndarray, shape (n,)
    mixtures : list
        The mixture used in each round; every mixture after the first is fitted to the earlier rounds.
    counts, found : list of int
        Candidates drawn in each round, and how many of them had a finite log-density.
    n_solves : int
        Number of evaluations in all rounds so far.
    """

    def __init__(self, target: Target) -> None:
        self.target = target
        self.position, self.log_prob = np.empty((0, target.ndim)), np.empty(0)
        self.mixtures: list[CurvedMixture] = []
        self.counts, self.found = list[int](), list[int]()
        self.n_solves = 0
        self._by_mixture = np.empty((0, 0))

    def draw(self, mixture: CurvedMixture, rng: np.random.Generator, n: int) -> None:
        """Add a round: draw `n` candidates from `mixture` and evaluate those within the bounds."""
        u = mixture.draw(rng, n)
        found = self.target.evaluate(u)
        self.n_solves += int(found.n_solves.sum())
        u, log_prob = (one[np.isfinite(found.log_prob)] for one in (u, found.log_prob))
        by_others = np.stack([q.log_density(u) for q in self.mixtures]) if self.mixtures else np.empty((0, len(u)))
        self.position = np.concatenate([self.position, u])
        self.log_prob = np.concatenate([self.log_prob, log_prob])
        known = np.concatenate([self._by_mixture, by_others], axis=1)
        self._by_mixture = np.concatenate([known, mixture.log_density(self.position)[None]])
        self.mixtures.append(mixture)
        self.counts.append(n)
        self.found.append(len(u))

    @property
    def log_weight(self) -> FloatArray:
        """Log importance weights of the candidates up to a constant, shape (n,), with the largest truncated."""
        return cut_largest(self.log_ratio)

    @property
    def log_ratio(self) -> FloatArray:
        """Log importance weights of the candidates up to a constant, shape (n,), before truncation."""
        return self.log_prob - sum_densities(self._by_mixture, self.counts)

    def fit_mixture(self) -> CurvedMixture:
        """Fit a mixture to all candidates.

        If a few candidates have nearly all the weight, the weights are raised to a power below 1. The mixture is
        then wider than the density, so that the next round covers it better. Raise LinAlgError as `fit_curved`
        does.
        """
        log_w = self.log_weight
        log_w = even_out(log_w, min(_LEAST_POINTS * self.target.ndim, _MOST_PART * len(log_w)), _MILDER)
        weight = np.exp(log_w - log_w.max())
        return fit_curved(self.position, weight, self.target.lower, self.target.upper)

    def efficiency(self, k: int) -> float:
        """Return the effective sample size per candidate of an independence sampler that uses mixture k.

        The value is 1/E[2/a(x) − 1], where a(x) is the acceptance rate of candidates at x and x follows the
        density (Liu 1996, Statistics and Computing 6, 113-119). The points x are resampled by weight from all
        rounds' candidates, so a mixture that misses a region covered by another mixture is rated as poor. The
        value is 0 if no candidate of round k has a finite log-density.
        """
        first, own = int(sum(self.found[:k])), self.found[k]
        if not own:
            return 0.0
        log_w = self.log_weight
        weight = np.cumsum(np.exp(log_w - logsumexp(log_w)))
        draws = np.minimum(np.searchsorted(weight, (np.arange(_SAMPLE) + 0.5) / _SAMPLE), len(weight) - 1)
        r = self.log_prob - self._by_mixture[k]
        log_rate = np.minimum(0.0, r[first : first + own] - r[draws][:, None])
        rate = np.exp(logsumexp(log_rate, axis=1)) / self.counts[k]
        return float(1.0 / np.mean(2.0 / rate - 1.0))


def learn_in_rounds(
    target: Target, u: FloatArray, rng: np.random.Generator, most: int
) -> tuple[CurvedMixture | None, float, int]:
    """Fit a curved mixture in rounds; return the best one, its efficiency, and the number of evaluations.

    The efficiency is the effective sample size per candidate. The rounds end when two in a row reach `ENOUGH`,
    when `most` leaves fewer than `_FEWEST` candidates, when a fit fails, or when no candidate so far has a finite
    log-density. The mixture is None, with efficiency 0, if no round was drawn.

    Parameters
    ----------
    target : Target
    u : ndarray, shape (n, ndim)
        Points where the density is high, such as the draws of local steps.
    rng : Generator
    most : int
        Largest number of candidates in all rounds together.
    """
    rounds = Rounds(target)
    n, good = min(PER_ROUND, most), 0
    with suppress(np.linalg.LinAlgError):  # continue with the rounds drawn so far
        mixture = fit_curved(u, np.ones(len(u)), target.lower, target.upper)
        while n >= _FEWEST:
            rounds.draw(mixture, rng, n)
            good = good + 1 if rounds.efficiency(len(rounds.counts) - 1) >= ENOUGH else 0
            if good == _TWICE or not len(rounds.position):
                break
            n = min(PER_ROUND, most - sum(rounds.counts))
            mixture = rounds.fit_mixture()
    if not rounds.mixtures:
        return None, 0.0, rounds.n_solves
    rates = [rounds.efficiency(k) for k in range(len(rounds.mixtures))]
    best = int(np.argmax(rates))
    return rounds.mixtures[best], rates[best], rounds.n_solves
