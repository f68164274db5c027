"""How far a posterior's moments may be off, from errors of a surrogate's log-probability at a few draws."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv, stdtrit

from fmu.types import FloatArray

LEVEL = 0.95
HEAVY = 6.0
"""Kurtosis of errors that are Gaussian with a standard deviation that differs from draw to draw."""

_LARGE = 1.0
_MARGIN = 1.3


class ErrorLimits(NamedTuple):
    """Errors e = log p − log p̂ at n draws of p̂, and what follows from them.

    Attributes
    ----------
    n : int
    n_failed : int
        Draws at which the slow model failed.
    sd : float
        Standard deviation of e.
    shift : float
        With 95 % confidence no posterior mean is off by more posterior standard deviations, and no standard
        deviation by more, relative: see `upper_shift`.
    largest : float
        The largest |e|, e taken from its mean, which is without effect.
    share : float
        With 95 % confidence at least so large a share of the posterior has no larger |e| (Wilks 1941, *Ann. Math.
        Stat.* 12, 91–96).
    """

    n: int
    n_failed: int
    sd: float
    shift: float
    largest: float
    share: float

    @classmethod
    def of(cls, errors: FloatArray, draws: FloatArray, posterior: FloatArray, expected: float) -> ErrorLimits:
        """Return the limits for errors (n,), not finite where the slow model failed.

        `shift` is `upper_shift`, but not less than `expected`, the standard deviation of e over the posterior that
        the surrogate expects: where errors are large in few places, few draws may not show it.
        """
        finite = np.isfinite(errors)
        n, n_failed = len(errors), int(np.sum(~finite))
        if n_failed:
            return cls(n, n_failed, np.inf, np.inf, np.inf, 0.0)
        share = (1.0 - LEVEL) ** (1.0 / n)
        apart = errors - errors.mean()
        shift = max(upper_shift(errors, draws, posterior), expected)
        return cls(n, 0, float(np.std(errors, ddof=1)), shift, float(np.max(np.abs(apart))), share)


def upper_shift(errors: FloatArray, draws: FloatArray, posterior: FloatArray) -> float:
    """Return the 95 % upper limit of how far errors e move posterior means and standard deviations.

    The true posterior has the weight w = exp(e)/E[exp(e)] beside the surrogate's, and with z = (θ − mean)/sd of
    each parameter it moves the mean by Cov(z, w) posterior standard deviations, and the standard deviation,
    relative and to first order, by ½ Cov(z², w). Limits of the means follow from their values at the draws, by
    Student's t with Bonferroni's correction. The standard deviations depend on few draws far out, so that for
    them it is what none exceeds (by Cauchy and Schwarz), ½ sd(z²) sd(w). The limit of sd(w) is that of a
    variance with Satterthwaite's degrees of freedom (1946, *Biometrics Bull.* 2, 110–114), ν = 2n/(κ − (n −
    3)/(n − 1)), for the kurtosis κ of the sample, or `HEAVY` if that is larger. Where it is so large that few
    draws do not tell how far the means are off, it is the limit of them as well: |Cov(z, w)| ≤ sd(w).

    Parameters
    ----------
    errors : ndarray, shape (n,), n ≥ 5
    draws : ndarray, shape (n, ndim)
        θ of the errors, drawn from the surrogate's posterior.
    posterior : ndarray, shape (N, ndim)
        Many draws of it: means and standard deviations are theirs.

    Returns
    -------
    float
        In posterior standard deviations.
    """
    n, ndim = draws.shape
    weights = np.exp(errors - errors.max())
    apart = weights / weights.mean() - 1.0
    of_weights = max(_upper_sd(errors), _upper_sd(apart))
    if of_weights > _LARGE:
        return of_weights
    mean, sd = posterior.mean(axis=0), posterior.std(axis=0)
    moved = (draws - mean) / sd * apart[:, None]
    standard_errors = np.std(moved, axis=0, ddof=1) / np.sqrt(n)
    of_means = np.max(np.abs(moved.mean(axis=0)) + _quantile(n, ndim) * standard_errors)
    return float(max(of_means, largest_sd_shift(posterior) * of_weights))


def largest_sd_shift(posterior: FloatArray) -> float:
    """Return how far a standard deviation moves at most, relative, over sd(w): ½ sd(z²), from draws (N, ndim)."""
    z = (posterior - posterior.mean(axis=0)) / posterior.std(axis=0)
    return float(0.5 * np.max(np.std(z**2, axis=0)))


def draws_needed(sd: float, posterior: FloatArray, tolerance: float, fewest: int, most: int) -> int:
    """Return how many draws make an `upper_shift` within a tolerance likely, for errors with an sd; 0 if none do.

    Their standard deviation may be larger by `_MARGIN`, and their means off by as many standard errors.
    """
    of_sds = largest_sd_shift(posterior)
    for n in range(fewest, most + 1):
        of_means = (_MARGIN + _quantile(n, posterior.shape[1])) / np.sqrt(n)
        if _MARGIN * sd * max(of_means, of_sds * _factor(n, HEAVY), 1.0) <= tolerance:
            return n
    return 0


def _quantile(n: int, ndim: int) -> float:
    """Return how many standard errors ndim means of n values are off at most."""
    return float(stdtrit(n - 1, 1.0 - (1.0 - LEVEL) / (2 * ndim)))


def _upper_sd(values: FloatArray) -> float:
    """Return the upper limit of the standard deviation of n values."""
    n = len(values)
    variance = float(np.var(values, ddof=1))
    if variance == 0.0:
        return 0.0
    kurtosis = n * np.sum((values - values.mean()) ** 4) / ((n - 1) * variance) ** 2
    return float(np.sqrt(variance)) * _factor(n, max(kurtosis, HEAVY))


def _factor(n: int, kurtosis: float) -> float:
    """Return the ratio of the upper limit of a standard deviation to the standard deviation of n values."""
    freedom = 2.0 * n / (kurtosis - (n - 3.0) / (n - 1.0))
    return float(np.sqrt(freedom / (2.0 * gammaincinv(0.5 * freedom, 1.0 - LEVEL))))  # of chi-square
