"""How far a posterior's moments may be off, from errors of a surrogate's log-probability at a few draws."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from fmu.types import FloatArray

LEVEL = 0.95
HEAVY = 6.0
"""Kurtosis of errors that are Gaussian with a standard deviation that differs from draw to draw."""


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
        Upper 95 % confidence limit of it: to first order no posterior mean is off by more posterior standard
        deviations, and no standard deviation by more than 0.71 times as much, relative.
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
    def of(cls, errors: FloatArray) -> ErrorLimits:
        """Return the limits for errors (n,), not finite where the slow model failed."""
        finite = np.isfinite(errors)
        n, n_failed = len(errors), int(np.sum(~finite))
        if n_failed:
            return cls(n, n_failed, np.inf, np.inf, np.inf, 0.0)
        share = (1.0 - LEVEL) ** (1.0 / n)
        apart = errors - errors.mean()
        return cls(n, 0, float(np.std(errors, ddof=1)), upper_shift(errors), float(np.max(np.abs(apart))), share)


def upper_shift(errors: FloatArray) -> float:
    """Return the 95 % upper limit of how far e moves posterior means, in posterior standard deviations.

    The true posterior has the weight w = exp(e)/E[exp(e)] beside the surrogate's, and moves the mean of θ by
    Cov(θ, w) ≤ sd(θ) sd(w). To first order sd(w) is sd(e); the larger of the two counts. Its limit is that of a
    variance with Satterthwaite's degrees of freedom (1946, *Biometrics Bull.* 2, 110–114), ν = 2n/(κ −
    (n − 3)/(n − 1)), for the kurtosis κ of the sample, or `HEAVY` if that is larger: few draws do not tell that
    the errors are Gaussian.

    Parameters
    ----------
    errors : ndarray, shape (n,), n ≥ 5
    """
    weights = np.exp(errors - errors.max())
    return max(_upper_sd(errors), _upper_sd(weights / weights.mean()))


def _upper_sd(values: FloatArray) -> float:
    n = len(values)
    variance = float(np.var(values, ddof=1))
    if variance == 0.0:
        return 0.0
    kurtosis = n * np.sum((values - values.mean()) ** 4) / ((n - 1) * variance) ** 2
    freedom = 2.0 * n / (max(kurtosis, HEAVY) - (n - 3.0) / (n - 1.0))
    return float(np.sqrt(freedom * variance / chi2.ppf(1.0 - LEVEL, freedom)))
