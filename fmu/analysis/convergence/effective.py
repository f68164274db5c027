"""R-hat, effective sample size and Monte-Carlo standard error of one scalar quantity.

Most functions take draws of shape (chains, draws). Chains that never move are treated as in ArviZ
(`fmu.analysis.convergence.rank_statistics`). The walkers of an ensemble depend on each other, so an ensemble's ESS
follows from the integrated autocorrelation time, nearly as in emcee (Goodman & Weare 2010, section 5; Sokal's
window). A quantity that cannot be computed is NaN, and NaN fails every convergence test. This applies to R-hat of
one chain, to ESS and standard errors if one of several ensembles does not move, and to all quantities of a
constant, of fewer than four draws or of values that are not all finite.
"""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fmu.analysis.convergence.rank_statistics import chain_ess, quantile_ess, rank_ess, rank_rhat, split_chains
from fmu.analysis.trace.reading import parameter_draws, walkers_of
from fmu.types import FloatArray, IntArray

if TYPE_CHECKING:
    import xarray as xr


TAIL = (0.05, 0.95)
"""Quantiles whose ESS gives the tail ESS (Vehtari et al. 2021, section 4.3)."""
WINDOW = 5
"""Number of autocorrelation times over which the autocorrelation is summed (Sokal; emcee's default)."""
_MIN_DRAWS = 4
_LOG_ODDS, _NODES = 0.8, 21
"""Half the range of log p/(1 − p) over which the slope of a quantile is fitted, and the number of quantiles."""
_BATCHES = 20


def rhat(x: FloatArray) -> float:
    """Return rank-normalised split R-hat, the larger of bulk and folded R-hat (Vehtari et al. 2021, section 4.1).

    It is NaN for one chain, a constant, fewer than four draws or a non-finite draw, and infinite if no chain
    moves.
    """
    if len(x) < 2 or _is_degenerate(x):
        return np.nan
    # Chains that stay at different points have no variance within chains: the division correctly gives inf.
    with np.errstate(divide="ignore", invalid="ignore"):
        return rank_rhat(x)


def ess_bulk(x: FloatArray, walkers: int = 1) -> float:
    """Return the bulk ESS. For an ensemble, this is the ESS of the mean, without rank normalisation."""
    if _is_degenerate(x):
        return np.nan
    if walkers > 1:
        return _ensemble_ess(x, walkers)
    return rank_ess(x)


def ess_tail(x: FloatArray, walkers: int = 1) -> float:
    """Return the tail ESS, the smaller of the ESS of the 5 % quantile and the ESS of the 95 % quantile.

    It is also NaN if more than 5 % of the draws equal the largest, or a quantile is outside an ensemble's range.
    """
    if _is_degenerate(x):
        return np.nan
    below = [x <= quantile for quantile in np.quantile(x, TAIL)]
    if any(indicator.all() for indicator in below):
        # more than 5 % of the draws repeat the largest value, and `chain_ess` counts every draw of a constant
        return np.nan
    if walkers > 1:
        return float(np.min([_ensemble_ess(indicator, walkers) for indicator in below]))
    return min(quantile_ess(x, probability) for probability in TAIL)


def ess_mean(x: FloatArray, walkers: int = 1) -> float:
    """Return the ESS of the mean, which determines the mean's standard error."""
    if _is_degenerate(x):
        return np.nan
    if walkers > 1:
        return _ensemble_ess(x, walkers)
    # scaled: `chain_ess` treats a range below 1e-15 as a constant, and second moments of area are 1e-9 m⁴
    return chain_ess(split_chains((x - x.mean()) / x.std()))


def mcse_mean(x: FloatArray, walkers: int = 1) -> float:
    """Return the Monte-Carlo standard error of the mean, sd / sqrt(ESS)."""
    if _is_degenerate(x):
        return np.nan
    return float(np.std(x, ddof=1) / np.sqrt(ess_mean(x, walkers)))


def mcse_sd(x: FloatArray, walkers: int = 1) -> float:
    """Return the Monte-Carlo standard error of the standard deviation s: the standard error of s² divided by 2 s.

    The ESS is that of the squared deviations from the mean or, if smaller, the tail ESS, which shows slow mixing
    in a tail earlier. If one of the two is NaN, the other is used.
    """
    if _is_degenerate(x):
        return np.nan
    squares = (x - x.mean()) ** 2
    ess = np.fmin(ess_mean(squares, walkers), ess_tail(x, walkers))
    return float(np.std(squares, ddof=1) / np.sqrt(ess) / (2.0 * np.std(x, ddof=1)))


def mcse_quantile(x: FloatArray, probability: float, walkers: int = 1) -> float:
    """Return the Monte-Carlo standard error of a quantile q_p; NaN if no draw exceeds q_p.

    It is the error of the fraction of draws below q_p, divided by the density at q_p:

    - The error of the fraction follows from the ESS of the indicator x ≤ q_p (Vehtari et al. 2021, section 4.3).
      If overlapping batch means give a larger error, that error is used instead, because the sum of
      autocorrelations ends too early if the correlation is weak at the quantile but decays slowly.
    - The reciprocal density is the slope of q_p against log(p/(1 − p)), divided by p (1 − p). The slope is fitted
      by least squares to quantiles whose odds p/(1 − p) are 0.45 to 2.2 times those of q_p.
    - The slope itself scatters, by some 20 % if 20 effective draws lie beyond the quantile. The variance is
      therefore multiplied by 1 + 2/(ESS p (1 − p)).

    In replicates of known processes, the errors of quantiles divided by this standard error have a standard
    deviation of 0.9 to 1.1 (``results/replicates.md``).

    Parameters
    ----------
    x : ndarray, shape (chains, draws)
    probability : float
        Probability p of the quantile.
    walkers : int
    """
    if _is_degenerate(x):
        return np.nan
    below = x <= np.quantile(x, probability)
    if below.all():
        return np.nan
    binomial = probability * (1.0 - probability)
    ess = _ensemble_ess(below, walkers) if walkers > 1 else quantile_ess(x, probability)
    variance = float(np.maximum(binomial / ess, _variance_by_batches(below, walkers)))
    odds = np.linspace(-_LOG_ODDS, _LOG_ODDS, _NODES)
    quantiles = np.quantile(x, 1.0 / (1.0 + (1.0 / probability - 1.0) * np.exp(-odds)))
    slope = float(odds @ quantiles / (odds @ odds)) / binomial
    return slope * math.sqrt(variance * (1.0 + 2.0 * variance / binomial**2))


def _variance_by_batches(x: NDArray[np.generic], walkers: int) -> float:
    """Return the variance of the overall mean, from overlapping batches that are a twentieth of a chain long."""
    steps = x.reshape(len(x), -1, walkers).mean(axis=2)
    n = steps.shape[1]
    size = max(1, n // _BATCHES)
    sums = np.cumsum(np.pad(steps, ((0, 0), (1, 0))), axis=1)
    batches = (sums[:, size:] - sums[:, :-size]) / size
    part = size / steps.size
    return float(np.mean((batches - steps.mean()) ** 2)) * part / (1.0 - part)


def by_walker(x: NDArray[np.generic], walkers: int) -> NDArray[np.generic]:
    """Reshape step-major draws (ensembles, steps * walkers, ...) to (ensembles, walkers, steps, ...)."""
    return x.reshape(len(x), x.shape[1] // walkers, walkers, *x.shape[2:]).swapaxes(1, 2)


def autocorrelation_times(x: NDArray[np.generic], walkers: int) -> FloatArray:
    """Return the integrated autocorrelation time of each ensemble, in steps, shape (ensembles,).

    The autocorrelation is summed up to a window of five autocorrelation times, as in emcee, with two differences.
    First, the autocovariance is taken about the mean of the whole ensemble and averaged over the walkers before it
    is divided by the variance. emcee takes it about each walker's own mean. The common mean reduces the downward
    bias for short runs (4 % instead of 33 % for 32 walkers and 20 autocorrelation times of an AR(1) process), and
    walkers that stay in separate regions count as correlated. Second, if the run is shorter than the window, all
    lags are summed; emcee.autocorr.integrated_time then uses lag 0 alone, tau = 1.

    The time is NaN for an ensemble that does not move. It is at least 1/log10 of the number of draws, as in
    Vehtari et al. 2021.
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
    """Return the autocorrelation of each chain at lags 0, 1, ..., shape (chains, steps); NaN if it does not move.

    An ensemble's autocorrelation is taken about the mean of all its walkers and averaged over the walkers.
    """
    paths = by_walker(x, walkers).astype(float)
    return np.array([_autocorrelation(p) if np.ptp(p) > 0 else np.full(p.shape[1], np.nan) for p in paths])


def apart(draws: int, most: int, walkers: int = 1) -> int:
    """Return the smallest interval that thins step-major draws to at most `most` and is coprime with `walkers`."""
    distance = max(1, -(-draws // most))
    while math.gcd(distance, walkers) > 1:
        distance += 1
    return distance


def _autocorrelation(paths: FloatArray) -> FloatArray:
    """Return the autocorrelation, shape (steps,), of walker paths (walkers, steps) about their common mean."""
    from scipy.fft import irfft, next_fast_len, rfft

    steps = paths.shape[1]
    padded = next_fast_len(2 * steps, real=True)  # zero padding separates the end of a path from its beginning
    power = np.abs(rfft(paths - paths.mean(), padded)) ** 2
    autocovariance = irfft(power.sum(axis=0), padded)[:steps]
    return autocovariance / autocovariance[0]


def _ensemble_ess(x: NDArray[np.generic], walkers: int) -> float:
    """Return the ESS of the mean: draws divided by autocorrelation time, summed over ensembles."""
    return float(np.sum(x.shape[1] / autocorrelation_times(x, walkers)))


def _is_degenerate(x: FloatArray) -> bool:
    """Return True if chains have fewer than four draws, a draw is not finite, or all draws are equal."""
    return x.shape[1] < _MIN_DRAWS or not np.all(np.isfinite(x)) or bool(np.ptp(x) == 0)


def longest_stands(position: FloatArray, walkers: int = 1) -> IntArray:
    """Return each chain's or walker's largest number of consecutive identical draws, shape (chains, walkers).

    Parameters
    ----------
    position : ndarray, shape (chains, steps · walkers, ndim)
        Positions in step-major order.
    walkers : int
    """
    path = by_walker(position, walkers)
    step = np.arange(path.shape[2])
    moved = np.ones(path.shape[:3], dtype=bool)
    moved[:, :, 1:] = np.any(path[:, :, 1:] != path[:, :, :-1], axis=-1)
    arrived = np.maximum.accumulate(np.where(moved, step, 0), axis=2)
    return np.max(step - arrived, axis=2) + 1


def energy_fraction(energy: FloatArray) -> FloatArray:
    """Return the Bayesian fraction of missing information (E-BFMI) of each chain, shape (chains,).

    E-BFMI = Σ (E_n − E_{n−1})² / Σ (E_n − Ē)² (Betancourt 2016, arXiv:1604.00695). A small value means that new
    momenta change the energy little compared with its range, so that a chain explores the energies slowly. It is
    NaN if the energy never changes, or if there is only one draw.

    Parameters
    ----------
    energy : ndarray, shape (chains, draws)
    """
    if energy.shape[1] < 2:
        return np.full(len(energy), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.mean(np.diff(energy, axis=1) ** 2, axis=1) / np.var(energy, axis=1, ddof=1)


MOST_RANKED = 2000
"""Largest number of draws per chain used for R-hat of a run in progress."""
MOST_BATCHES = 2000
"""Largest number of batch means per chain used for the ESS of a run in progress."""
MOST_STEPS = 20_000
"""Largest number of steps per chain that enter the batches."""


def live_diagnostics(draws: FloatArray, walkers: int = 1, *, ended: bool = False) -> dict[str, float]:
    """Return the worst R-hat and bulk ESS over the parameters of a run in progress.

    Both are defined as in `fmu.summary`, and equal its values up to 2000 draws per chain.

    Parameters
    ----------
    draws : ndarray, shape (chains, draws, ndim) or (chains, steps, walkers, ndim)
        In the first form the draws of an ensemble are step-major.
    walkers : int
        Number of walkers of an ensemble, for the first form.
    ended : bool
        Whether the run has ended. Both values then equal those of `fmu.summary` for a run of any length.

    Returns
    -------
    dict of str to float
        ``rhat`` and ``ess``. A value is NaN if it is undefined for any parameter: R-hat of one chain, fewer than
        four draws, a parameter that has not moved yet, a draw that is not finite.

    Notes
    -----
    For longer runs, R-hat is computed from every k-th draw, up to 2000 per chain; this changes it by less than its
    own error. ESS is computed from batch means, because batching, unlike thinning, does not change the variance of
    the mean: with batch means b of the draws z, ESS = ESS(b) var(z)/var(b). Beyond 20 000 steps per chain only
    every k-th step is used; the ESS of nearly independent draws is then a lower bound, about 20 000 per chain.
    """
    if draws.ndim == 4:
        draws, walkers = draws.reshape(len(draws), -1, draws.shape[3]), draws.shape[2]
    parameters = [np.ascontiguousarray(x) for x in np.moveaxis(draws, -1, 0)]
    of_rhat = rhat if ended else partial(_live_rhat, walkers=walkers)
    of_ess = partial(ess_bulk if ended else _live_ess, walkers=walkers)
    return {
        "rhat": float(np.max([of_rhat(x) for x in parameters])),
        "ess": float(np.min([of_ess(x) for x in parameters])),
    }


def _live_rhat(x: FloatArray, walkers: int) -> float:
    if not np.all(np.isfinite(x)):  # including the draws that are skipped
        return np.nan
    return rhat(x[:, :: apart(x.shape[1], MOST_RANKED, walkers)])


def _live_ess(x: FloatArray, walkers: int) -> float:
    """Return the bulk ESS of a parameter's draws, (chains, steps · walkers), by batch means if the run is long."""
    steps = x.shape[1] // walkers
    if steps <= MOST_BATCHES or not np.all(np.isfinite(x)) or np.ptp(x) == 0:
        return ess_bulk(x, walkers)
    paths = x.reshape(len(x), steps, walkers)[:, :: -(-steps // MOST_STEPS)]
    if walkers == 1:
        paths = _rank_normalised(paths)
    steps = paths.shape[1]
    k = -(-steps // MOST_BATCHES)
    paths = paths[:, steps % k :]  # skip the first few steps rather than the last
    batches = paths.reshape(len(x), -1, k, walkers).mean(axis=2)
    # about the mean of each ensemble, like its autocorrelation
    axes = (1, 2) if walkers > 1 else (0, 1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):  # NaN if an ensemble does not move
        ratio = np.var(paths, axis=axes) / np.var(batches, axis=axes)
    flat = batches.reshape(len(x), -1)
    if walkers == 1:
        return float(min(ess_mean(flat) * ratio, paths.size * np.log10(paths.size)))
    each = flat.shape[1] / autocorrelation_times(flat, walkers) * ratio
    return float(np.sum(np.minimum(each, paths[0].size * np.log10(paths[0].size))))


def _rank_normalised(x: FloatArray) -> FloatArray:
    """Return the normal scores (Blom) of all draws, same shape as `x`, with ranks taken from a thinned sample."""
    from scipy.special import ndtri

    among = np.sort(x[:, :: -(-x.shape[1] // MOST_RANKED)], axis=None)
    # twice the number of draws below, ties counted half
    place = np.searchsorted(among, x, "left") + np.searchsorted(among, x, "right")
    scores = ndtri((0.5 * np.arange(2 * len(among) + 1) + 0.125) / (len(among) + 0.25))
    return np.asarray(scores[place])


LENGTHS = 20
_FEWEST = 20
MOST_RANKED_OF_RUNNING = 1500
"""Largest number of draws per chain that are ranked for R-hat of a run's first draws."""


def lengths(steps: int, n: int = LENGTHS) -> IntArray:
    """Return up to `n` increasing step counts from 20 (or less) to `steps`, evenly spaced on a log scale."""
    return np.unique(np.geomspace(min(_FEWEST, steps), steps, n).round().astype(np.int64))


def running_means(trace: xr.DataTree, at: IntArray | None = None) -> tuple[IntArray, FloatArray]:
    """Return each chain's mean over its first draws, for increasing numbers of draws.

    Parameters
    ----------
    trace : xarray.DataTree
    at : ndarray of int, shape (n,), optional
        Numbers of steps. By default, those of `lengths`.

    Returns
    -------
    at : ndarray, shape (n,)
    means : ndarray, shape (n, chains, ndim), SI units
        Means over the first steps, and over all walkers of an ensemble.
    """
    walkers = walkers_of(trace)
    draws = parameter_draws(trace)
    at = lengths(draws.shape[1] // walkers) if at is None else np.asarray(at)
    sums = np.cumsum(draws, axis=1)[:, at * walkers - 1]
    return at, np.moveaxis(sums / (at * walkers)[None, :, None], 1, 0)


def running_rhat(trace: xr.DataTree, most: int = MOST_RANKED_OF_RUNNING) -> tuple[IntArray, FloatArray]:
    """Return R-hat over the first draws of a run, for increasing numbers of draws.

    In long runs only every k-th draw is ranked; with 1500 draws per chain this changes R-hat by less than its own
    error.

    Parameters
    ----------
    trace : xarray.DataTree
    most : int
        Largest number of draws per chain that are ranked.

    Returns
    -------
    at : ndarray, shape (n,)
        Numbers of steps.
    rhat : ndarray, shape (n, ndim)
        R-hat over chains, or over ensembles for an ensemble sampler; NaN if it is undefined (`rhat`).
    """
    walkers = walkers_of(trace)
    draws = parameter_draws(trace)
    at = lengths(draws.shape[1] // walkers)
    values = np.empty((len(at), draws.shape[2]))
    for row, steps in zip(values, at, strict=True):
        distance = apart(steps * walkers, most, walkers)
        first = draws[:, : steps * walkers : distance]
        row[:] = [rhat(x) for x in np.moveaxis(first, -1, 0)]
    return at, values
