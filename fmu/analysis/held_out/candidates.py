"""Importance-sampling proposals for posteriors with and without a measured mode: Gaussians, and the prior."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.maxima.mode_weights import log_shares
from fmu.analysis.maxima.search import quadratic_at
from fmu.posterior.maxima import local_maxima
from fmu.posterior.scaled import ScaledDensity
from fmu.samplers.mixture.importance import resample
from fmu.samplers.mixture.quadratic import Quadratic, fit_quadratic
from fmu.samplers.mixture.truncated_normal import SequentialNormal
from fmu.types import FloatArray

if TYPE_CHECKING:
    from fmu.posterior.problem import UpdatingProblem

_STARTS = 32
_HOPELESS = 30.0
_MOST_MAXIMA = 8
_FLATTER = 4.0
_RESAMPLED = 2048
_GROUPS, _A_GROUP = 8, 20


def quadratics_at_maxima(problem: UpdatingProblem, scaled: ScaledDensity, near: FloatArray) -> list[Quadratic]:
    """Return quadratic models of log P at the maxima that may have a significant probability, at most eight.

    A maximum counts if it is less than 30 nats below the highest one. The search for maxima starts from `near` (n,
    ndim), SI units, and from other points.
    """
    maxima = local_maxima(problem, _STARTS, near=near)
    that_matter = [m for m in maxima if m.log_prob > maxima[0].log_prob - _HOPELESS][:_MOST_MAXIMA]
    return [quadratic_at(problem, scaled, m)[0] for m in that_matter]


def gaussians(
    models: Sequence[Quadratic], scaled: ScaledDensity, temperatures: Sequence[float]
) -> list[SequentialNormal]:
    """Return one Gaussian per quadratic and temperature, truncated at the bounds."""
    return [model.proposal(scaled.lower, scaled.upper, t) for model in models for t in temperatures]


def fitted_to_draws(models: Sequence[Quadratic], u: FloatArray, log_p: FloatArray) -> list[Quadratic]:
    """Return the quadratic models, each fitted again to the draws around it unless there are too few.

    Draws are weighted by P^(1/4), which gives enough weight to the flanks of the peak, where most draws lie. Draws
    at which `log_p` is not finite are ignored.
    """
    known = np.isfinite(log_p)
    u, log_p = u[known], log_p[known]
    weight = np.exp((log_p - log_p.max()) / _FLATTER)
    fitted = []
    for model, share in zip(models, np.exp(log_shares(models, u)), strict=True):
        own, n = weight * share, u.shape[1]
        is_enough = own.sum() ** 2 > (n + 1) * (n + 2) * np.sum(own**2)  # twice the number of coefficients
        fitted.append(fit_quadratic(u, log_p, own) if is_enough else model)
    return fitted


@dataclass(frozen=True, eq=False)
class PriorCandidates:
    """The prior as an importance-sampling proposal, for which the weights are proportional to the likelihood."""

    problem: UpdatingProblem
    scaled: ScaledDensity

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Return `n` draws from the prior in scaled coordinates, shape (n, ndim)."""
        return self.scaled.to_scaled(self.problem.sample_prior(rng, n))

    def log_density(self, u: FloatArray) -> FloatArray:
        """Return the log-density of the prior, shape (n,), at scaled points u (n, ndim)."""
        log_prior = np.asarray(self.problem.log_prior(self.scaled.to_theta(u)))
        return log_prior + np.sum(np.log(self.scaled.scale))


def gaussians_of_groups(u: FloatArray, log_w: FloatArray, rng: np.random.Generator) -> list[Quadratic]:
    """Divide weighted draws u (n, ndim) into groups by k-means, and return a Gaussian fitted to each group.

    There are at most eight groups. Groups with too few distinct draws are left out. The list is empty if the
    distinct draws are too few for two groups.
    """
    from scipy.cluster.vq import kmeans2

    n = u.shape[1]
    chosen = resample(rng, u, log_w, _RESAMPLED)
    around = np.cov(chosen.T).reshape(n, n) + 1e-12 * np.eye(n)
    standard = np.linalg.solve(np.linalg.cholesky(around), chosen.T).T
    count = min(_GROUPS, len(np.unique(chosen, axis=0)) // (_A_GROUP * n))
    if count < 2:
        return []
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="One of the clusters is empty")
        _, group = kmeans2(standard, count, minit="++", rng=rng)
    found = []
    for members in (chosen[group == g] for g in range(count)):
        if len(np.unique(members, axis=0)) > 2 * n:
            covariance = np.cov(members.T).reshape(n, n) + 1e-3 * around
            found.append(Quadratic(members.mean(axis=0), 0.0, np.zeros(n), np.linalg.inv(covariance)))
    return found
