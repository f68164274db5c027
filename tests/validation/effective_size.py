"""Accuracy of the effective sample size: the actual errors of many runs over the errors that the runs predict.

The squared error of a mean, averaged over S independent runs and divided by the average prediction var/ESS, is
distributed as χ²_S/S.

- The ESS of the mean determines the Monte-Carlo standard errors. The error is that of the mean of x_k, against the
  exact mean.
- The bulk ESS determines the convergence verdicts. It is the ESS of the mean of the normal scores of the ranks
  (Vehtari et al. 2021, section 3.1), not of x_k. The scores are computed among the draws of all runs together, and
  the error is taken against the mean of all scores, which is 0. For ensembles the bulk ESS equals the ESS of the
  mean and is not tested separately.

All runs of one sampler share one warm-up and then advance together. Given the fixed kernel after warm-up, to which
an ESS refers, they are independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri
from scipy.stats import chi2, rankdata

from fmu.analysis.convergence.effective import ess_bulk, ess_mean
from fmu.samplers import run
from fmu.types import FloatArray
from tests.samplers.targets import SkewedGumbel, Target, TruncatedGaussian
from tests.validation.contenders import Contender

TARGETS = (TruncatedGaussian, SkewedGumbel)
"""A correlated Gaussian, bounded and therefore skewed; an unbounded, correlated and skewed density. Densities that
vanish at a bound are left out: no step size of the leapfrog suits them, and updating problems have no such
posterior."""
BIAS = 0.05
"""Relative bias allowed to a correct estimator of the ESS, in runs of a few hundred autocorrelation times."""


@dataclass(frozen=True)
class Ratio:
    """Mean squared error over its prediction, for one coordinate and one kind of ESS.

    Attributes
    ----------
    target : str
    kind : {"mean", "bulk"}
    coordinate : int
        Index of the coordinate, from 0.
    runs : int
    freedom : int
        Degrees of freedom of the mean squared error.
    ess : float
        Median ESS of the runs.
    value : float
        The ratio.
    """

    target: str
    kind: str
    coordinate: int
    runs: int
    freedom: int
    ess: float
    value: float


def limits(freedom: int, level: float) -> tuple[float, float]:
    """Return limits that a ratio leaves with probability `level`, if the bias of the ESS is at most `BIAS`."""
    lowest, highest = chi2.ppf(level / 2.0, freedom) / freedom, chi2.isf(level / 2.0, freedom) / freedom
    return float(lowest * (1.0 - BIAS)), float(highest * (1.0 + BIAS))


def error_ratios(contender: Contender, target: Target, runs: int, seed: int) -> list[Ratio]:
    """Return the ratios of every coordinate, from `runs` independent runs."""
    walkers, length = contender.sampler.walkers, contender.replicate
    result = run(
        target,
        contender.sampler,
        draws=length.draws,
        warmup=length.warmup,
        chains=length.chains * runs,
        seed=seed,
        init="prior",
    )
    position = result.posterior.position.reshape(runs, length.chains, -1, target.ndim)
    ratios = []
    for k in range(target.ndim):
        x = position[..., k]
        ess = np.array([ess_mean(one, walkers) for one in x])
        value = _ratio(x, float(target.mean[k]), ess)
        ratios.append(Ratio(target.name, "mean", k, runs, runs, float(np.median(ess)), value))
        if walkers == 1:
            ess = np.array([ess_bulk(one) for one in x])
            value = _ratio(_normal_scores(x), 0.0, ess) * runs / (runs - 1)
            ratios.append(Ratio(target.name, "bulk", k, runs, runs - 1, float(np.median(ess)), value))
    return ratios


def _ratio(x: FloatArray, exact: float, ess: FloatArray) -> float:
    """Return the ratio for draws (runs, chains, draws), the exact mean and the ESS of each run."""
    squared_error = (x.mean(axis=(1, 2)) - exact) ** 2
    return float(np.mean(squared_error) / np.mean(x.var(axis=(1, 2)) / ess))


def _normal_scores(x: FloatArray) -> FloatArray:
    """Return the normal scores of the ranks of all values together (Vehtari et al. 2021, eq. 14)."""
    return ndtri((rankdata(x).reshape(x.shape) - 0.375) / (x.size + 0.25))
