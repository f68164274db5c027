"""Bound the errors of posterior moments, from a surrogate's log-probability errors at a few draws."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv, stdtrit

from fmu.types import FloatArray

LEVEL = 0.95
HEAVY = 6.0
"""Assumed kurtosis of errors that are Gaussian with a standard deviation that varies from draw to draw."""

_LARGE = 1.0
_MARGIN = 1.3


class ErrorLimits(NamedTuple):
    """Statistics of a surrogate's errors e = log p − log p̂ at n draws, and the resulting error limits.

    Here p and p̂ are the posterior densities with the slow model and with the surrogate, and the draws are from
    p̂. If the slow model failed at any draw, `sd`, `shift` and `largest` are infinite and `share` is 0.

    Attributes
    ----------
    n : int
        Number of draws.
    n_failed : int
        Number of draws at which the slow model failed.
    sd : float
        Standard deviation of e.
    shift : float
        Upper 95 % confidence limit on the error of any posterior mean, in posterior standard deviations, and on
        the relative error of any posterior standard deviation; see `ErrorLimits.of`.
    largest : float
        Largest absolute deviation of e from its mean; the mean itself has no effect.
    share : float
        Fraction of the posterior in which, with 95 % confidence, no deviation exceeds `largest` (Wilks 1941, *Ann.
        Math. Stat.* 12, 91–96).
    """

    n: int
    n_failed: int
    sd: float
    shift: float
    largest: float
    share: float

    @classmethod
    def of(cls, errors: FloatArray, draws: FloatArray, posterior: FloatArray, expected: float) -> ErrorLimits:
        """Return the limits, given errors (n,) that are not finite where the slow model failed.

        `draws` (n, ndim) and `posterior` (N, ndim) are as in `upper_shift`. `shift` is the larger of `upper_shift`
        and `expected`, because a few draws may miss small regions with large errors. `expected` is the standard
        deviation of e over the posterior, as predicted by the surrogate.
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
    """Return the upper 95 % limit on the changes of posterior means and standard deviations due to errors e.

    The ratio of the true posterior to the surrogate's is w = exp(e)/E[exp(e)]. With z = (θ − mean)/sd for each
    parameter, the mean changes by Cov(z, w) posterior standard deviations, and the standard deviation, to first
    order, by the relative amount ½ Cov(z², w).

    The changes of the means are estimated from the draws, with limits from Student's t distribution with
    Bonferroni's correction. The changes of the standard deviations depend on a few outlying draws; they are
    therefore bounded by ½ sd(z²) sd(w) (Cauchy–Schwarz inequality). The upper limit of sd(w), or of sd(e) if that
    is larger, uses the chi-square distribution with Satterthwaite's degrees of freedom (1946, *Biometrics Bull.*
    2, 110–114), ν = 2n/(κ − (n − 3)/(n − 1)), where κ is the larger of the sample kurtosis and `HEAVY`. If this
    limit exceeds 1, a few draws cannot give the means, and the limit itself is returned, because |Cov(z, w)| ≤
    sd(w).

    Parameters
    ----------
    errors : ndarray, shape (n,), n ≥ 5
        The errors e at the draws.
    draws : ndarray, shape (n, ndim)
        The draws θ from the surrogate's posterior.
    posterior : ndarray, shape (N, ndim)
        Many draws from the surrogate's posterior, which determine its means and standard deviations.

    Returns
    -------
    float
        The limit, in posterior standard deviations.
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
    """Return the largest ½ sd(z²) of any parameter, from draws (N, ndim) with z = (θ − mean)/sd.

    Multiplied by sd(w), it bounds the relative change of any posterior standard deviation; see `upper_shift`.
    """
    z = (posterior - posterior.mean(axis=0)) / posterior.std(axis=0)
    return float(0.5 * np.max(np.std(z**2, axis=0)))


def draws_needed(sd: float, posterior: FloatArray, tolerance: float, fewest: int, most: int) -> int:
    """Return the smallest number of draws for which `ErrorLimits.shift` is likely to be within `tolerance`.

    The number is between `fewest` and `most`, or 0 if even `most` draws are not enough. `sd` is the expected
    standard deviation of the errors. As a margin, the sample standard deviation is taken to be larger by the
    factor `_MARGIN`, and the changes of the means to be `_MARGIN` standard errors.
    """
    of_sds = largest_sd_shift(posterior)
    for n in range(fewest, most + 1):
        of_means = (_MARGIN + _quantile(n, posterior.shape[1])) / np.sqrt(n)
        if _MARGIN * sd * max(of_means, of_sds * _factor(n, HEAVY), 1.0) <= tolerance:
            return n
    return 0


def _quantile(n: int, ndim: int) -> float:
    """Return the joint 95 % limit on the errors of `ndim` means of n values, in standard errors."""
    return float(stdtrit(n - 1, 1.0 - (1.0 - LEVEL) / (2 * ndim)))


def _upper_sd(values: FloatArray) -> float:
    """Return the upper 95 % confidence limit on a population's standard deviation, given a sample of values."""
    n = len(values)
    variance = float(np.var(values, ddof=1))
    if variance == 0.0:
        return 0.0
    kurtosis = n * np.sum((values - values.mean()) ** 4) / ((n - 1) * variance) ** 2
    return float(np.sqrt(variance)) * _factor(n, max(kurtosis, HEAVY))


def _factor(n: int, kurtosis: float) -> float:
    """Return the upper 95 % limit on a standard deviation, divided by the estimate from n values."""
    freedom = 2.0 * n / (kurtosis - (n - 3.0) / (n - 1.0))
    return float(np.sqrt(freedom / (2.0 * gammaincinv(0.5 * freedom, 1.0 - LEVEL))))  # chi-square quantile
