"""Estimators of the evidence from the rungs of a temperature ladder and from mixture candidates."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import logsumexp

from fmu.analysis.convergence import effective
from fmu.samplers.tempering.kernel import LOG_LIKELIHOOD
from fmu.samplers.tempering.tempering import first_ladder, rejections
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr

    from fmu.samplers.loop.record import RunResult


class _Estimate(NamedTuple):
    """A log-evidence estimate from a temperature ladder, and each draw's influence on it, (chains, draws)."""

    value: float
    influence: FloatArray


def by_importance(q: FloatArray) -> tuple[float, float]:
    """Return the log-evidence and its standard error, estimated by importance sampling.

    `q` (n,) contains the log-weights log P − log Q of independent draws from a density Q, where P is the
    unnormalised posterior density.
    """
    total = float(logsumexp(q))
    relative = np.exp(q - total) * len(q)
    return total - float(np.log(len(q))), float(np.std(relative) / np.sqrt(len(q)))


def by_bridge(q: FloatArray, p: FloatArray, ratio: float) -> tuple[float, float]:
    """Return the log-evidence and its standard error, estimated by the optimal bridge (Meng & Wong 1996).

    The standard error follows Frühwirth-Schnatter (2004), with two changes. First, the number of posterior draws
    is replaced by the ESS of their contributions or by `ratio` times their number, whichever is smaller. Second,
    the errors of draws that are accepted candidates are correlated with the errors of the candidates. The standard
    error is therefore at least the standard error of the sum of both contributions at each step of the chains.

    Parameters
    ----------
    q : ndarray, shape (chains, draws) or (n,)
        Log-weights log P − log Q (see `by_importance`) of independent draws from Q: the candidates of each step,
        NaN in steps without one; or, in the second form, draws that do not depend on those from the posterior.
    p : ndarray, shape (chains, draws)
        Log-weights of draws from the posterior.
    ratio : float
        Number of independent draws that one posterior draw is worth.
    """
    is_candidate, n = ~np.isnan(q), ratio * p.size
    q = q[is_candidate]
    of_p, of_q = n / (n + len(q)), len(q) / (n + len(q))
    log_z = float(np.median(p))
    for _ in range(_MOST_BRIDGES):
        above = logsumexp(q - np.logaddexp(np.log(of_p) + q - log_z, np.log(of_q))) - np.log(len(q))
        below = logsumexp(-np.logaddexp(np.log(of_p) + p - log_z, np.log(of_q))) - np.log(p.size)
        log_z, before = float(above - below), log_z
        if abs(log_z - before) < 1e-10:
            break
    log_f_p = -np.logaddexp(np.log(of_p) + p - log_z, np.log(of_q))
    log_f_q = q - log_z - np.logaddexp(np.log(of_p) + q - log_z, np.log(of_q))
    f_p, f_q = (np.exp(log_f - logsumexp(log_f)) * log_f.size for log_f in (log_f_p, log_f_q))
    ess = np.fmin(n, effective.ess_mean(f_p))
    error = float(np.sqrt(np.var(f_p) / ess + np.var(f_q) / len(q)))
    if is_candidate.shape != p.shape:
        return log_z, error
    steps = -f_p
    steps[is_candidate] += (f_q - 1.0) * (p.size / len(q))
    return log_z, float(np.fmax(error, effective.mcse_mean(steps)))


def stepping_stone(draws: FloatArray, t: FloatArray) -> _Estimate:
    """Return the stepping-stone estimate of the log-evidence, Σ_k log E_k[exp((t_{k+1} − t_k) l)].

    `draws` (chains, draws, rungs) contains the log-likelihoods l, and `t` (rungs,) the inverse temperatures. E_k
    is the mean over the draws at rung k. Each term estimates the log ratio of the evidences at rungs k + 1 and k
    (Xie et al. 2011).
    """
    log_weight, log_ratio = stones(draws, t)
    # d log E[w] = (w − E[w])/E[w]: the contribution of each draw to the error of the sum
    return _Estimate(float(log_ratio.sum()), np.sum(np.exp(log_weight - log_ratio) - 1.0, axis=2))


def stones(draws: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (t_{k+1} − t_k) l for log-likelihoods l, and the log of the mean of its exponential at each rung.

    The shapes are (chains, draws, rungs − 1) and (rungs − 1,).
    """
    log_weight = np.diff(t) * draws[..., :-1]
    highest = log_weight.max(axis=(0, 1))  # taken out of the exponential, which would overflow or vanish
    return log_weight, highest + np.log(np.mean(np.exp(log_weight - highest), axis=(0, 1)))


def thermodynamic(draws: FloatArray, t: FloatArray) -> _Estimate:
    """Return the log-evidence ∫₀¹ m(t) dt, where m and v are the mean and variance of the log-likelihood l at t.

    `draws` (chains, draws, rungs) contains the log-likelihoods, and `t` (rungs,) the inverse temperatures. The
    corrected trapezium rule Σ_k h_k (g_k + g_{k+1})/2 − h_k² (g'_{k+1} − g'_k)/12 is applied in s = log(t + a)
    instead of t, where h_k is the distance in s between rungs k and k + 1, and g = m (t + a). For a Gaussian
    likelihood in d dimensions m varies as −d/(2 (t + a)) towards the prior, so g is smooth in s. Its derivative is
    g' = v (t + a)² + m (t + a), because dm/dt = v. The constant a is chosen so that the first three rungs are
    evenly spaced in s, but is at most 1. If the model fails in part of the prior, the mean at t = 0 is taken over
    the rest, and the logarithm of the fraction in which it does not fail is added.
    """
    known = np.isfinite(draws)
    share = known.mean(axis=(0, 1))
    # with this a the first three rungs are equidistant in s: (t_1 + a)² = a (t_2 + a), a = t_1²/(t_2 − 2 t_1)
    curved = len(t) > 2 and t[2] > 2.0 * t[1]
    w = t + (min(1.0, t[1] ** 2 / (t[2] - 2.0 * t[1])) if curved else 1.0)
    h = np.diff(np.log(w))
    # weights of the rungs: half of both neighbouring intervals for g, and h²/12 with opposite signs for g'
    of_g = 0.5 * (np.append(h, 0.0) + np.append(0.0, h))
    of_slope = (np.append(h**2, 0.0) - np.append(0.0, h**2)) / 12.0
    # with g = w m and g' = w² v + w m the integral is a weighted sum of the means and variances
    of_mean, of_variance = w * (of_g + of_slope), w**2 * of_slope
    finite = np.where(known, draws, 0.0)
    mean = finite.mean(axis=(0, 1)) / share
    away = np.where(known, finite - mean, 0.0)
    variance = np.mean(away**2, axis=(0, 1)) / share
    value = mean @ of_mean + variance @ of_variance + np.sum(np.log(share))
    # the influence of each draw: (l − m)/share on m, ((l − m)² − v)/share on v, (1 − share)/share on log share
    moved = away * of_mean + np.where(known, away**2 - variance, 0.0) * of_variance + known - share
    return _Estimate(float(value), moved @ (1.0 / share))


_MOST_BRIDGES = 200


def tempering_group(result: RunResult) -> xr.Dataset:
    """Return a dataset of the log-likelihoods and swaps at all rungs of a parallel-tempering run.

    Returns
    -------
    xarray.Dataset
        ``log_likelihood`` (chain, draw, rung) from the prior to the posterior, and ``inverse_temperature`` and
        ``rejection`` (rejection rate of swaps with the next rung; NaN at the last) along ``rung``. Attributes:
        ``barrier``, Λ, the sum of the rejection rates; ``round_trips`` of replicas from the posterior to the prior
        and back; ``round_trip_rate``, per draw and chain; ``round_trip_limit``, (2 + 2Λ)⁻¹, the rate if replicas
        forget their position in every step (Syed et al. 2022, section 3.4).
    """
    import xarray as xr

    draws = result.posterior.stats[LOG_LIKELIHOOD]
    given = result.learnt.get("temperatures") or result.settings["temperatures"]
    t = first_ladder(draws.shape[2]) if given is None else np.asarray(given)
    rejection = rejections(draws, t).mean(axis=0)
    barrier, trips = float(rejection.sum()), int(result.posterior.stats["round_trips"].sum())
    chains, steps, rungs = draws.shape
    return xr.Dataset(
        {
            "log_likelihood": (("chain", "draw", "rung"), draws),
            "inverse_temperature": ("rung", t),
            "rejection": ("rung", np.append(rejection, np.nan)),
        },
        coords={"chain": np.arange(chains), "draw": np.arange(steps), "rung": np.arange(rungs)},
        attrs={
            "barrier": barrier,
            "round_trips": trips,
            "round_trip_rate": trips / (chains * steps),
            "round_trip_limit": 1.0 / (2.0 + 2.0 * barrier),
        },
    )
