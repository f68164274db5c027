"""Bound the errors of posterior moments, from a surrogate's log-probability errors at a few draws."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import betaincinv, gammaincinv

from fmu.types import FloatArray

LEVEL = 0.95
HEAVY = 12.0
"""Smallest kurtosis assumed for the errors, because a few draws understate the kurtosis of heavy tails."""

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
        Largest absolute deviation of e from its mean at the draws; the mean itself has no effect.
    share : float
        Fraction of the posterior in which, with at least 95 % confidence, no deviation from this mean exceeds
        `largest`. It is the 5 % quantile of Beta(n − 1, 2), the distribution of the fraction of the posterior in
        which e lies between its smallest and its largest value at the draws (Wilks 1941, *Ann. Math. Stat.* 12,
        91–96). Neither of these values deviates from the mean by more than `largest`.
    """

    n: int
    n_failed: int
    sd: float
    shift: float
    largest: float
    share: float

    @classmethod
    def of(cls, errors: FloatArray, posterior: FloatArray, expected: float) -> ErrorLimits:
        """Return the limits, given errors (n,) that are not finite where the slow model failed.

        `posterior` (N, ndim) is as in `upper_shift`. `shift` is the larger of `upper_shift` and `expected`,
        because a few draws may miss small regions with large errors. `expected` is the standard deviation of e
        over the posterior, as predicted by the surrogate.
        """
        finite = np.isfinite(errors)
        n, n_failed = len(errors), int(np.sum(~finite))
        if n_failed:
            return cls(n, n_failed, np.inf, np.inf, np.inf, 0.0)
        share = float(betaincinv(n - 1, 2, 1.0 - LEVEL))
        apart = errors - errors.mean()
        shift = max(upper_shift(errors, posterior), expected)
        return cls(n, 0, float(np.std(errors, ddof=1)), shift, float(np.max(np.abs(apart))), share)


def upper_shift(errors: FloatArray, posterior: FloatArray) -> float:
    """Return the upper 95 % limit on the changes of posterior means and standard deviations due to errors e.

    The ratio of the true posterior to the surrogate's is w = exp(e)/E[exp(e)]. With z = (θ − mean)/sd for each
    parameter, the mean changes by Cov(z, w) posterior standard deviations, and the standard deviation, to first
    order, by the relative amount ½ Cov(z², w).

    Estimates of these covariances from a few draws depend on the outlying ones. The changes are therefore bounded
    by sd(w) and by ½ sd(z²) sd(w) (Cauchy–Schwarz inequality). The upper limit of sd(w), or of sd(e) if that is
    larger, uses the chi-square distribution with Satterthwaite's degrees of freedom (1946, *Biometrics Bull.* 2,
    110–114), ν = 2n/(κ − (n − 3)/(n − 1)), where κ is the larger of the sample kurtosis and `HEAVY`. In
    simulations with 8 to 100 draws of normal parameters, the limit held in at least 93 % if the errors were cubic
    in a parameter, and in at least 99 % if they were linear or quadratic. Errors with heavier tails are not
    covered.

    Parameters
    ----------
    errors : ndarray, shape (n,), n ≥ 5
        The errors e at draws from the surrogate's posterior.
    posterior : ndarray, shape (N, ndim)
        Many draws from the surrogate's posterior, which determine its means and standard deviations.

    Returns
    -------
    float
        The limit, in posterior standard deviations.
    """
    weights = np.exp(errors - errors.max())
    of_weights = max(_upper_sd(errors), _upper_sd(weights / weights.mean()))
    return largest_shift(posterior) * of_weights


def largest_shift(posterior: FloatArray) -> float:
    """Return the larger of 1 and ½ sd(z²) of any parameter, from draws (N, ndim) with z = (θ − mean)/sd.

    Multiplied by sd(w), it bounds the changes of posterior means and standard deviations; see `upper_shift`.
    """
    z = (posterior - posterior.mean(axis=0)) / posterior.std(axis=0)
    return max(1.0, float(0.5 * np.max(np.std(z**2, axis=0))))


def draws_needed(sd: float, posterior: FloatArray, tolerance: float, fewest: int, most: int) -> int:
    """Return the smallest number of draws for which `ErrorLimits.shift` is likely to be within `tolerance`.

    The number is between `fewest` and `most`, or 0 if even `most` draws are not enough. `sd` is the expected
    standard deviation of the errors. As a margin, the sample standard deviation is taken to be larger by the
    factor `_MARGIN`.
    """
    shift = _MARGIN * sd * largest_shift(posterior)
    return next((n for n in range(fewest, most + 1) if shift * _factor(n, HEAVY) <= tolerance), 0)


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
