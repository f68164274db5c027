"""Collect the points evaluated in warm-up, and fit a mixture to the draws of local steps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmu.samplers.mixture.curve import fit_infinite_margins
from fmu.samplers.mixture.proposal import WIDE, Mixture, Points, fit_mixture
from fmu.samplers.mixture.quadratic import fit_quadratic, measure_kurtosis
from fmu.samplers.mixture.warp import Warp
from fmu.types import FloatArray, IntArray, LogDensity

FAR = 10.0
"""Distance below the median log-density, plus one per coordinate, beyond which a point is not near a maximum."""
_APART = 3.0
"""Smallest distance between the means of separated chains, in standard deviations along the line between the
means."""
_HEAVY, _FITS_BADLY = 1.6, 0.8
"""Kurtosis, relative to a Gaussian's, above which tails are heavy, and ESS per draw below which Gaussians fit
heavy tails badly."""
_LEAST_MOVE = 1e-8  # smallest extent of draws that have moved, in scaled units


class Evaluated(NamedTuple):
    """Points (n, ndim) with their log-densities (n,) and gradients (n, ndim); unknown gradients are NaN."""

    position: FloatArray
    log_prob: FloatArray
    gradient: FloatArray

    @classmethod
    def none(cls, ndim: int) -> Evaluated:
        """Return an empty set of points with `ndim` coordinates."""
        return cls(np.empty((0, ndim)), np.empty(0), np.empty((0, ndim)))

    def with_more(self, position: FloatArray, log_prob: FloatArray, slope: FloatArray | None = None) -> Evaluated:
        """Return these points followed by the given ones, whose gradients are NaN if `slope` is None."""
        more = position, log_prob, np.full_like(position, np.nan) if slope is None else slope
        return Evaluated(*(np.concatenate(both) for both in zip(self, more, strict=True)))


def fit_to_draws(draws: Evaluated, chains: int, density: LogDensity, wide: float = WIDE) -> Mixture:
    """Fit a mixture to the later half of the local draws, with one initial component per group of chains.

    Draws far below their chain's median log-density, and chains that have hardly moved, are left out. If no chain
    has moved, all chains form one group.

    Parameters
    ----------
    draws : Evaluated
        The draws of all chains at the first step, then at the second step, and so on.
    chains : int
    density : LogDensity
    wide : float
        Fraction of each component's weight that goes to its wider copies.
    """
    u, log_prob, slope = (one.reshape(-1, chains, *one.shape[1:]) for one in draws)
    u, log_prob, slope = (one[len(one) // 2 :] for one in (u, log_prob, slope))
    near = log_prob >= np.median(log_prob, axis=0) - FAR - density.ndim
    moved = np.array([_has_moved(u[near[:, k], k]) for k in range(chains)])
    near &= moved | ~moved.any()
    group = np.broadcast_to(groups_of_chains(u) if moved.any() else 0, near.shape)[near]
    slopes = None if np.isnan(slope).any() else slope[near]
    points = Points(u[near], log_prob[near], np.ones(int(near.sum())), slopes)
    warp = first_warp(density)
    x, value, of_x = points.under(warp)
    members = [(group == k).astype(float) for k in np.unique(group)]
    each = [fit_quadratic(x, value, member, of_x) for member in members]
    return fit_mixture(points, Mixture(each, np.sum(members, axis=1), warp, wide))


def better_of(one: Mixture, other: Mixture, draws: Evaluated) -> Mixture:
    """Return the mixture with the larger effective sample size per draw, judged by the draws of local steps."""
    points = Points(draws.position, draws.log_prob, np.ones(len(draws.log_prob)))
    shares = [np.nan_to_num(points.effective_share(q.log_density(points.position))) for q in (one, other)]
    return one if shares[0] > shares[1] else other


def is_infinite(points: Points | None, density: LogDensity) -> bool:
    """Return True if weighted candidates show that a density is infinite at a bound; False without candidates."""
    if points is None:
        return False
    shapes = fit_infinite_margins(points.position, points.weight, density.lower, density.upper)
    return bool(np.isfinite(shapes).any())


def has_heavy_tails(points: Points | None, mixture: Mixture | None, visited: Evaluated, chains: int) -> bool:
    """Return True if a density has one maximum and tails too heavy for a good fit by Gaussians.

    The weights P/q of Gaussian candidates are then unbounded, and the standard error of an evidence computed
    from these weights is wrong. Return False if there are no candidates or no local draws before the first fit,
    or if the mixture in use is curved.

    Parameters
    ----------
    points : Points or None
        Weighted candidates.
    mixture : Mixture or None
        The mixture in use; None if it is curved.
    visited : Evaluated
        Local draws of all chains before the first fit.
    chains : int
    """
    if points is None or mixture is None or not len(visited.log_prob):
        return False
    if groups_of_chains(visited.position.reshape(-1, chains, visited.position.shape[1])).any():
        return False
    share = points.effective_share(mixture.log_density(points.position))
    return not share >= _FITS_BADLY and measure_kurtosis(points.under(mixture.warp)[0], points.weight) > _HEAVY


def groups_of_chains(u: FloatArray) -> IntArray:
    """Group chains that are near the same maximum; return each chain's group index, shape (chains,).

    The draws u have shape (steps, chains, ndim). A chain joins the group of the first chain whose mean is at most
    `_APART` standard deviations away, measured along the line between the means.
    """
    mean = u.mean(axis=0)
    group = np.arange(len(mean))
    for i in range(1, len(mean)):
        for j in range(i):
            line = mean[i] - mean[j]
            spread = np.sum([((u[:, k] - mean[k]) @ line).var() for k in (i, j)])
            if line @ line <= _APART * np.sqrt(spread):
                group[i] = group[j]
                break
    return group


def _has_moved(u: FloatArray) -> bool:
    """Return True if the draws (n, ndim) contain enough distinct points to estimate a covariance."""
    return len(np.unique(u, axis=0)) > u.shape[1] and bool(np.all(np.ptp(u, axis=0) > _LEAST_MOVE))


def first_warp(density: LogDensity) -> Warp:
    """Return the initial warp, logarithmic in coordinates that have a lower bound but no upper bound."""
    bent = np.isfinite(density.lower) & ~np.isfinite(density.upper)
    return Warp(density.lower, density.upper, bent)
