"""What warm-up has evaluated, and the mixture that the draws of its local steps show."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmu.samplers.mixture.proposal import Mixture, Points, fit_mixture
from fmu.samplers.mixture.quadratic import fit_quadratic
from fmu.samplers.mixture.warp import Warp
from fmu.types import FloatArray, IntArray, LogDensity

FAR = 10.0
"""Points with a log-density further below the median, plus one per coordinate, are on the way to a maximum."""
_APART = 3.0
"""Standard deviations, along the line between two chains' means, beyond which the chains are apart."""
_LEAST_MOVE = 1e-8  # in scaled units


class Evaluated(NamedTuple):
    """Points (n, ndim) at which the density was evaluated, its logarithm there (n,), and gradients or NaN."""

    position: FloatArray
    log_prob: FloatArray
    gradient: FloatArray

    @classmethod
    def none(cls, ndim: int) -> Evaluated:
        """Return no points."""
        return cls(np.empty((0, ndim)), np.empty(0), np.empty((0, ndim)))

    def with_more(self, position: FloatArray, log_prob: FloatArray, slope: FloatArray | None = None) -> Evaluated:
        """Return these points and others."""
        more = position, log_prob, np.full_like(position, np.nan) if slope is None else slope
        return Evaluated(*(np.concatenate(both) for both in zip(self, more, strict=True)))


def fit_to_draws(draws: Evaluated, chains: int, density: LogDensity) -> Mixture:
    """Return a mixture fitted to the later half of local steps' draws, each group of chains by itself.

    Parameters
    ----------
    draws : Evaluated
        Of one step after the other, each of all chains.
    chains : int
    density : LogDensity
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
    return fit_mixture(points, Mixture(each, np.sum(members, axis=1), warp))


def groups_of_chains(u: FloatArray) -> IntArray:
    """Return the group of each chain of u (steps, chains, ndim): apart where chains are at separated maxima.

    Two chains are together if their means are within `_APART` standard deviations along the line between them.
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
    """Say whether draws (n, ndim) have been at enough points to have a covariance."""
    return len(np.unique(u, axis=0)) > u.shape[1] and bool(np.all(np.ptp(u, axis=0) > _LEAST_MOVE))


def first_warp(density: LogDensity) -> Warp:
    """Return the warp before anything is learnt: coordinates with a lower bound alone are bent."""
    bent = np.isfinite(density.lower) & ~np.isfinite(density.upper)
    return Warp(density.lower, density.upper, bent)
