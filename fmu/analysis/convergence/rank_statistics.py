"""R-hat and ESS of chains, as ArviZ computes them (Vehtari et al. 2021, doi:10.1214/20-BA1221).

A test compares the results with ArviZ. The formulas are repeated here because importing ArviZ's array functions
takes longer than sampling a small model. All functions take draws of shape (chains, draws) that are finite and
not all equal, with at least four draws per chain.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from fmu.types import AnyArray, FloatArray

_OFFSET = 3.0 / 8.0
"""Offset of ranks (Blom 1958)."""


def split_chains(x: AnyArray) -> AnyArray:
    """Split each chain into its first and second half, shape (2 · chains, draws // 2)."""
    half = x.shape[1] // 2
    return np.concatenate([x[:, :half], x[:, -half:]])


def normal_scores(x: FloatArray) -> FloatArray:
    """Return the normal scores Φ⁻¹((rank − 3/8)/(n + 1/4)) of all n draws, same shape as `x` (section 4.1).

    Equal draws share the mean of their ranks.
    """
    order = np.argsort(x, axis=None)
    ordered = x.ravel()[order]
    begins = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    sizes = np.diff(np.append(begins, x.size))
    rank = np.empty(x.size)
    rank[order] = np.repeat(begins + 0.5 * (sizes + 1.0), sizes)
    return np.asarray(ndtri((rank - _OFFSET) / (x.size - 2.0 * _OFFSET + 1.0))).reshape(x.shape)


def potential_scale_reduction(x: FloatArray) -> float:
    """Return R-hat, √((B/W + n − 1)/n), of chains without splitting or ranking them.

    This is eq. 4 of Vehtari et al. 2021. Here n is the number of draws per chain, W is the mean of the variances
    within the chains, and B is n times the variance of the chains' means.
    """
    n = x.shape[1]
    between = n * np.var(np.mean(x, axis=1), ddof=1)
    within = np.mean(np.var(x, axis=1, ddof=1))
    return float(np.sqrt((between / within + n - 1) / n))


def rank_rhat(x: FloatArray) -> float:
    """Return the larger of bulk and folded R-hat of rank-normalised split chains (section 4.1)."""
    split = split_chains(x)
    folded = np.abs(split - np.median(split))
    return max(potential_scale_reduction(normal_scores(one)) for one in (split, folded))


def rank_ess(x: FloatArray) -> float:
    """Return the bulk ESS: rank-normalise the split chains and take the ESS of their mean (section 4.3)."""
    return chain_ess(normal_scores(split_chains(x)))


def quantile_ess(x: FloatArray, probability: float) -> float:
    """Return the ESS of a quantile estimate (section 4.3)."""
    return chain_ess(split_chains(x <= np.quantile(x, probability)))


def chain_ess(draws: FloatArray) -> float:
    """Return the ESS n/τ of the chains' mean, without splitting or ranking them (section 3.2).

    Here n is the total number of draws, and the autocorrelation time τ = −1 + 2 Σ ρ_t is estimated over all chains
    by Geyer's initial monotone sequence: the sums ρ_2k + ρ_2k+1 are used up to the first that is not positive, and
    none may be larger than the one before it. τ is at least 1/log₁₀ n. The ESS of a constant is n.
    """
    from scipy.fft import next_fast_len

    x = np.asarray(draws, dtype=float)
    n_chains, n = x.shape
    if np.ptp(x) < np.finfo(float).resolution:
        return float(x.size)
    padded = next_fast_len(2 * n, real=True)
    power = np.fft.rfft(x - x.mean(axis=1, keepdims=True), padded)
    power *= np.conjugate(power)
    covariance = np.ascontiguousarray((np.fft.irfft(power, padded)[:, :n] / n).T).mean(axis=1)
    within = covariance[0] * n / (n - 1.0)
    variance = within * (n - 1.0) / n
    if n_chains > 1:
        variance += np.var(x.mean(axis=1), ddof=1)
    correlation = 1.0 - (within - covariance) / variance
    correlation[0] = 1.0

    pairs = correlation[: n - n % 2].reshape(-1, 2).sum(axis=1)
    most = max(-(-(n - 4) // 2), 0)
    ended = np.flatnonzero(~(pairs[:most] > 0.0))
    k = int(ended[0]) if ended.size else most
    first = correlation[2 * k] if correlation[2 * k] > 0.0 or pairs[k] >= 0.0 else 0.0
    tau = -1.0 + 2.0 * np.sum(np.minimum.accumulate(pairs[:k])) + first
    return float(x.size / max(tau, 1.0 / np.log10(x.size)))
