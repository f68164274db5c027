"""Stationary processes with known quantiles, to check the standard error of an estimated quantile.

Every process returns draws of shape (replicates, chains, draws), with `CHAINS` chains.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy import stats
from scipy.optimize import brentq
from scipy.signal import lfilter
from scipy.special import ndtr

from fmu.types import FloatArray

CHAINS, WALKERS = 4, 32
_DIMENSIONS = 3
"""Dimensions of the normal target distribution; only its first coordinate is recorded."""
_SHARES, _APART, _FRESH = (0.7, 0.3), 6.0, 0.1
"""Weights of two modes, distance between them, and probability per step of choosing a mode anew."""
_TOGETHER = 50
"""Replicates simulated in one batch."""


@dataclass(frozen=True)
class Process:
    """A process, its length, and its quantile function.

    Attributes
    ----------
    title : str
    draws : int
        Steps of each chain.
    make : callable
        Maps a random generator, a number of replicates and a number of steps to draws.
    quantile : callable
        Quantile function of the marginal distribution.
    walkers : int
        Walkers per ensemble; 1 for single chains.
    """

    title: str
    draws: int
    make: Callable[[np.random.Generator, int, int], FloatArray]
    quantile: Callable[[float], float]
    walkers: int = 1

    def runs(self, rng: np.random.Generator, replicates: int) -> Iterator[FloatArray]:
        """Yield the draws of each replicate, shape (chains, draws)."""
        for first in range(0, replicates, _TOGETHER):
            yield from self.make(rng, min(_TOGETHER, replicates - first), self.draws)


def _ar1(phi: float, margin: stats.rv_continuous) -> Callable[[np.random.Generator, int, int], FloatArray]:
    """Return a Gaussian AR(1) process transformed to the marginal distribution `margin`."""

    def made(rng: np.random.Generator, replicates: int, draws: int) -> FloatArray:
        noise = rng.standard_normal((replicates, CHAINS, draws))
        noise[..., 1:] *= np.sqrt(1.0 - phi**2)
        return np.asarray(margin.ppf(ndtr(lfilter([1.0], [1.0, -phi], noise))))

    return made


def _independence(scale: float, df: float) -> Callable[[np.random.Generator, int, int], FloatArray]:
    """Return an independence sampler for a standard normal target.

    The proposal is a t distribution with `df` degrees of freedom, normal if `df` is infinite, scaled by `scale`.
    The first 50 steps are discarded.
    """

    def made(rng: np.random.Generator, replicates: int, draws: int) -> FloatArray:
        shape = (draws + 50, replicates * CHAINS)
        y = scale * rng.standard_normal((*shape, _DIMENSIONS))
        if np.isfinite(df):
            y /= np.sqrt(rng.chisquare(df, shape) / df)[..., None]
        square = np.sum((y / scale) ** 2, axis=-1)
        log_q = -0.5 * (df + _DIMENSIONS) * np.log1p(square / df) if np.isfinite(df) else -0.5 * square
        log_w = -0.5 * np.sum(y**2, axis=-1) - log_q
        u = -rng.standard_exponential(shape)
        x, at, weight = np.empty(shape), y[0, :, 0], log_w[0]
        for k in range(len(x)):
            moves = u[k] <= log_w[k] - weight
            at, weight = np.where(moves, y[k, :, 0], at), np.where(moves, log_w[k], weight)
            x[k] = at
        return x[50:].T.reshape(replicates, CHAINS, draws)

    return made


def _walk(rng: np.random.Generator, replicates: int, draws: int) -> FloatArray:
    """Return random-walk Metropolis chains for a standard normal target."""
    at = rng.standard_normal((replicates * CHAINS, _DIMENSIONS))
    x = np.empty((draws, len(at)))
    for k in range(draws):
        to = at + 2.4 / np.sqrt(_DIMENSIONS) * rng.standard_normal(at.shape)
        moves = -rng.standard_exponential(len(at)) <= 0.5 * np.sum(at**2 - to**2, axis=1)
        at = np.where(moves[:, None], to, at)
        x[k] = at[:, 0]
    return x.T.reshape(replicates, CHAINS, draws)


def _two_places(rng: np.random.Generator, replicates: int, draws: int) -> FloatArray:
    """Return independent normal draws around one of two modes; the mode is chosen anew in one step of ten."""
    shape = (replicates, CHAINS, draws)
    chosen = rng.random(shape) < _FRESH
    chosen[..., 0] = True
    last = np.maximum.accumulate(np.where(chosen, np.arange(draws), 0), axis=-1)
    second = np.take_along_axis(rng.random(shape) > _SHARES[0], last, axis=-1)
    return rng.standard_normal(shape) + _APART * second


def _quantile_of_two(p: float) -> float:
    cdf = lambda x: _SHARES[0] * ndtr(x) + _SHARES[1] * ndtr(x - _APART) - p  # noqa: E731
    return float(brentq(cdf, -10.0, 20.0))


def _stretch(rng: np.random.Generator, replicates: int, draws: int) -> FloatArray:
    """Return ensembles with stretch moves (Goodman & Weare 2010); all walkers of a step are adjacent."""
    half, n = WALKERS // 2, replicates * CHAINS
    at = rng.standard_normal((n, WALKERS, _DIMENSIONS))
    x = np.empty((draws, n, WALKERS))
    for k in range(draws):
        for own, other in ((slice(0, half), slice(half, None)), (slice(half, None), slice(0, half))):
            z = 0.5 * (1.0 + rng.random((n, half))) ** 2
            partner = np.take_along_axis(at[:, other], rng.integers(half, size=(n, half, 1)), axis=1)
            to = partner + z[..., None] * (at[:, own] - partner)
            log_ratio = 0.5 * np.sum(at[:, own] ** 2 - to**2, axis=-1) + (_DIMENSIONS - 1) * np.log(z)
            moves = -rng.standard_exponential((n, half)) <= log_ratio
            at[:, own] = np.where(moves[..., None], to, at[:, own])
        x[k] = at[..., 0]
    return x.transpose(1, 0, 2).reshape(replicates, CHAINS, draws * WALKERS)


def _of_normal(p: float) -> float:
    return float(stats.norm.ppf(p))


MARGINS = {
    "normal": stats.norm(),
    "log-normal": stats.lognorm(0.8),
    "uniform": stats.uniform(),
    "exponential": stats.expon(),
    "t with 3 degrees of freedom": stats.t(3),
}
PROCESSES = (
    *(
        Process(f"AR(1), φ = {phi:g}, {name}", draws, _ar1(phi, margin), margin.ppf)
        for (phi, lengths), (name, margin) in product(
            ((0.0, (100, 800)), (0.5, (160, 1400)), (0.9, (800,))), MARGINS.items()
        )
        for draws in lengths
    ),
    *(
        Process(f"independence sampler, {name}", draws, _independence(scale, df), _of_normal)
        for name, scale, df, lengths in (
            ("t proposal", 1.0, 5.0, (150, 1200)),
            ("wider proposal (1.3 times the sd)", 1.3, np.inf, (200, 1600)),
            ("narrower proposal (0.9 times the sd)", 0.9, np.inf, (300, 2000)),
        )
        for draws in lengths
    ),
    *(Process("random-walk Metropolis", draws, _walk, _of_normal) for draws in (900, 6000)),
    *(Process("two modes", draws, _two_places, _quantile_of_two) for draws in (600, 2000)),
    Process("ensemble of stretch moves", 200, _stretch, _of_normal, WALKERS),
)
