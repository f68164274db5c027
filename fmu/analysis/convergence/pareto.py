"""Pareto shape parameter k of importance weights, and Pareto-smoothed weights (PSIS).

Vehtari, Simpson, Gelman, Yao & Gabry 2024, *JMLR* 25, 72; the generalised Pareto distribution is fitted as in
Zhang & Stephens (2009, *Technometrics* 51, 316–325). The formulas are those of ArviZ; a test compares the results.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from fmu.numbers import given, significant
from fmu.types import FloatArray, IntArray

GOOD_K = 0.7
"""Pareto k above which the mean of importance weights is unreliable."""
_FEWEST = 5
_PRIOR_SCALE, _PRIOR_DRAWS, _PRIOR_SHAPE = 3.0, 10.0, 0.5
_NEGLIGIBLE = 10.0 * np.finfo(float).eps


class _Tail(NamedTuple):
    """The largest weights: their indices in ascending order of weight, Pareto shape k and scale, and the cutoff.

    The cutoff is the largest weight below the tail.
    """

    places: IntArray
    shape: float
    scale: float
    cutoff: float


def pareto_k(log_w: FloatArray) -> float:
    """Return the Pareto shape parameter k of importance weights, given their logarithms (n,).

    k is infinite if there are no weights, if fewer than five form the tail, if the largest are all equal, as in a
    chain that has not moved, or if the fit is undefined. It is minus infinity if all weights are equal, and NaN if
    the lower quarter of the tail is constant.
    """
    try:
        return _tail(log_w - np.max(log_w)).shape
    except ValueError:
        return -np.inf if log_w.size and np.ptp(log_w) == 0 else np.inf


def heavy_tail_in_words(k: float) -> str:
    """Return a clause if the candidate weights' Pareto k is above `GOOD_K` or NaN, otherwise an empty string."""
    if k <= GOOD_K:
        return ""
    return (
        f"Pareto k {significant(k, 2)} of the candidates' weights is above {given(GOOD_K)}: the mixture does not "
        "fit the density well enough"
    )


def smoothed_weights(log_w: FloatArray, efficiency: float = 1.0) -> tuple[FloatArray, float]:
    """Return the logarithms of Pareto-smoothed weights, (n,), and the Pareto shape k of their tail.

    Unless k is infinite or NaN, the largest weights are replaced by quantiles of a generalised Pareto distribution
    fitted to them; quantiles above the largest weight are reduced to it. The weights returned sum to 1.

    Parameters
    ----------
    log_w : ndarray, shape (n,)
    efficiency : float
        ESS divided by the number of draws.

    Raises
    ------
    ValueError
        If the largest weights are all equal, or there are fewer than five of them.
    """
    log_w = log_w - np.max(log_w)
    tail = _tail(log_w, efficiency)
    if np.isfinite(tail.shape):
        n = len(tail.places)
        p = np.arange(0.5, n) / n
        steps = -np.log1p(-p) if tail.shape == 0 else np.expm1(-tail.shape * np.log1p(-p)) / tail.shape
        quantiles = tail.cutoff + tail.scale * steps
        log_w[tail.places] = np.minimum(np.log(quantiles), np.max(log_w[tail.places]))
    return log_w - logsumexp(log_w), tail.shape


def _tail(log_w: FloatArray, efficiency: float = 1.0) -> _Tail:
    """Return the tail of log-weights (n,) whose maximum is 0.

    Raise ValueError if the tail has fewer than five weights or all its weights are equal.
    """
    n = len(log_w)
    size = int(3.0 * (n / efficiency) ** 0.5 if n * efficiency > 225 else n / 5)
    if size < _FEWEST:
        raise ValueError(f"log_w: must have a tail of at least {_FEWEST} weights (got {size})")
    order = np.argsort(log_w)
    places = order[n - size :]
    if log_w[places[-1]] - log_w[places[0]] < np.finfo(float).tiny:
        raise ValueError("log_w: the largest weights must differ")
    cutoff = np.exp(log_w[order[n - size - 1]])
    shape, scale = _generalised_pareto(np.exp(log_w[places]) - cutoff)
    return _Tail(places, shape, scale, float(cutoff))


@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def _generalised_pareto(x: FloatArray) -> tuple[float, float]:
    """Fit a generalised Pareto distribution to values x (n,) in ascending order; return its shape k and scale.

    The estimate is the posterior mean of b = −k/scale under the prior of Zhang & Stephens, on a grid. The shape k
    is shrunk towards 0.5 as if by ten more draws. Both values are NaN if the smallest quarter of x is constant; k
    is infinite and the scale NaN if the estimate is undefined, as where x exceeds the range of floating-point
    numbers.
    """
    n = len(x)
    quartile = x[int((n / 4 + 0.5) - 1)]
    if quartile <= x[0]:
        return np.nan, np.nan
    m = 30 + int(n**0.5)
    b = 1.0 - np.sqrt(m / (np.arange(1, m + 1, dtype=float) - 0.5))
    b /= _PRIOR_SCALE * quartile
    b += 1.0 / x[-1]
    k = np.mean(np.log1p(-b[:, None] * x), axis=1)
    log_likelihood = n * (np.log(-b / k) - k - 1.0)
    weight = np.exp(log_likelihood - logsumexp(log_likelihood))
    kept = weight >= _NEGLIGIBLE
    weight, b = weight[kept], b[kept]
    mean = np.sum(b * (weight / weight.sum()))
    shape = float(np.mean(np.log1p(-mean * x)))
    scale = -shape / mean
    shape = (n * shape + _PRIOR_DRAWS * _PRIOR_SHAPE) / (n + _PRIOR_DRAWS)
    return (float(shape), float(scale)) if scale > 0.0 else (np.inf, np.nan)
