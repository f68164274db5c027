"""R-hat, effective sample size and Monte-Carlo standard error of one scalar quantity.

All functions take draws of shape (chains, draws). Chains of a single point are measured with ArviZ (Vehtari,
Gelman, Simpson, Carpenter & Bürkner 2021, doi:10.1214/20-BA1221). An ensemble's walkers depend on one another, so
that its draws are measured by the integrated autocorrelation time of emcee (Goodman & Weare 2010, section 5;
Sokal's window).

What cannot be computed (one chain, a constant, a value that is not finite) is NaN, and NaN is a failure to
everyone who asks for a verdict.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fmu.types import FloatArray

TAIL = (0.05, 0.95)
"""The quantiles whose estimates the tail ESS is about (Vehtari et al. 2021, section 4.3)."""
WINDOW = 5
"""Autocorrelation times over which the autocorrelation is summed (Sokal; emcee's default)."""
_MIN_DRAWS = 4


def rhat(x: FloatArray) -> float:
    """Return the rank-normalised split R-hat, the larger of bulk and folded (Vehtari et al. 2021, section 4.1).

    NaN for one chain, a constant, fewer than four draws, or a draw that is not finite.
    """
    from arviz_stats.base.array import array_stats

    if len(x) < 2 or _is_degenerate(x):
        return np.nan
    # Chains that stand still at different places have no variance within: the division gives inf, as it should.
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(array_stats.rhat(x, chain_axis=0, draw_axis=1, method="rank"))


def ess_bulk(x: FloatArray, walkers: int = 1) -> float:
    """Return the bulk effective sample size: rank-normalised for chains, of the mean for ensembles."""
    from arviz_stats.base.array import array_stats

    if _is_degenerate(x):
        return np.nan
    if walkers > 1:
        return _ensemble_ess(x, walkers)
    return float(array_stats.ess(x, chain_axis=0, draw_axis=1, method="bulk"))


def ess_tail(x: FloatArray, walkers: int = 1) -> float:
    """Return the effective sample size of the 5 % and the 95 % quantile, the smaller of the two."""
    from arviz_stats.base.array import array_stats

    if _is_degenerate(x):
        return np.nan
    below = [x <= quantile for quantile in np.quantile(x, TAIL)]
    if any(indicator.all() for indicator in below):
        # More than 5 % of the draws repeat the largest value. ArviZ counts every draw of a constant as effective.
        return np.nan
    if walkers > 1:
        return float(np.min([_ensemble_ess(indicator, walkers) for indicator in below]))
    return float(array_stats.ess(x, chain_axis=0, draw_axis=1, method="tail", prob=TAIL))


def ess_mean(x: FloatArray, walkers: int = 1) -> float:
    """Return the effective sample size that the standard error of the mean rests on."""
    from arviz_stats.base.array import array_stats

    if _is_degenerate(x):
        return np.nan
    if walkers > 1:
        return _ensemble_ess(x, walkers)
    # ArviZ takes a range below 1e-15 for a constant, whatever the unit: second moments of area are 1e-9 m⁴.
    standardised = (x - x.mean()) / x.std()
    return float(array_stats.ess(standardised, chain_axis=0, draw_axis=1, method="mean"))


def mcse_mean(x: FloatArray, walkers: int = 1) -> float:
    """Return the Monte-Carlo standard error of the mean, sd / sqrt(ESS)."""
    if _is_degenerate(x):
        return np.nan
    return float(np.std(x, ddof=1) / np.sqrt(ess_mean(x, walkers)))


def by_walker(x: NDArray[np.generic], walkers: int) -> NDArray[np.generic]:
    """Reshape (ensembles, steps * walkers, ...), step-major, to (ensembles, walkers, steps, ...)."""
    return x.reshape(len(x), x.shape[1] // walkers, walkers, *x.shape[2:]).swapaxes(1, 2)


def autocorrelation_times(x: NDArray[np.generic], walkers: int) -> FloatArray:
    """Return the integrated autocorrelation time of each ensemble, in steps, shape (ensembles,).

    The sum of the autocorrelation up to a window of five times itself, as in emcee, with two differences. The
    autocovariance is taken about the mean of the whole ensemble, not about each walker's own, and averaged over
    the walkers before it is divided by the variance: that spares short runs their downward bias (4 % instead of
    33 % for 32 walkers and 20 autocorrelation times of an AR(1) process), counts walkers that sit in separate
    modes as the correlation that they are, and exists where a single walker never moves. And where the run is
    shorter than its window, all of it is summed; emcee.autocorr.integrated_time then takes lag 0 alone, tau = 1.

    NaN for an ensemble that stands still; at least 1/log10 of the number of draws, as in Vehtari et al. 2021.
    """
    times = np.full(len(x), np.nan)
    for i, correlation in enumerate(autocorrelation(x, walkers)):
        if np.isfinite(correlation[0]):
            tau = 2.0 * np.cumsum(correlation) - 1.0
            is_wide_enough = np.arange(len(tau)) >= WINDOW * tau
            window = np.argmax(is_wide_enough) if is_wide_enough.any() else -1
            times[i] = max(tau[window], 1.0 / np.log10(x.shape[1]))
    return times


def autocorrelation(x: NDArray[np.generic], walkers: int = 1) -> FloatArray:
    """Return the autocorrelation of each chain at lags 0, 1, ..., shape (chains, steps).

    About the mean of all walkers of an ensemble, and averaged over them; NaN for a chain that stands still.
    """
    paths = by_walker(x, walkers).astype(float)
    return np.array([_autocorrelation(p) if np.ptp(p) > 0 else np.full(p.shape[1], np.nan) for p in paths])


def apart(draws: int, most: int, walkers: int = 1) -> int:
    """Return the distance between draws that leaves about `most` of them and sees all walkers alike."""
    distance = max(1, -(-draws // most))
    while math.gcd(distance, walkers) > 1:
        distance += 1
    return distance


def _autocorrelation(paths: FloatArray) -> FloatArray:
    """Return the autocorrelation at lags 0, 1, ... of walkers (walkers, steps), about their common mean."""
    from scipy.fft import irfft, next_fast_len, rfft

    steps = paths.shape[1]
    padded = next_fast_len(2 * steps, real=True)  # with zeros, or the end of a path would meet its beginning
    power = np.abs(rfft(paths - paths.mean(), padded)) ** 2
    autocovariance = irfft(power.sum(axis=0), padded)[:steps]
    return autocovariance / autocovariance[0]


def _ensemble_ess(x: NDArray[np.generic], walkers: int) -> float:
    """Return the draws of every ensemble over its autocorrelation time, summed."""
    return float(np.sum(x.shape[1] / autocorrelation_times(x, walkers)))


def _is_degenerate(x: FloatArray) -> bool:
    """Say whether the draws are too few, not finite, or all the same."""
    return x.shape[1] < _MIN_DRAWS or not np.all(np.isfinite(x)) or bool(np.ptp(x) == 0)
