"""Is the effective sample size what it says? The error that runs make against the error that they predict.

The mean of S independent runs' squared errors, divided by the mean of what the runs predict, var/ESS, is χ²_S/S.

- The ESS of the mean, on which the standard errors rest: the error of the mean of x_k against the exact mean.
- The bulk ESS, on which the verdicts rest, is that of the mean of the normal scores of the ranks (Vehtari et al.
  2021, section 3.1), not of x_k: the scores are taken among the draws of all runs, whose mean they are compared
  with. For ensembles it is the ESS of the mean, and not asked again.

All runs of one sampler advance in lockstep after one pooled warm-up: given the frozen kernel, which is what an
ESS is about, they are independent.
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
"""Bounded, correlated and skewed by it; unbounded, correlated and skewed. A density that vanishes at a wall, where
no step size suits the leapfrog, is no posterior of an updating problem, and left out."""
BIAS = 0.05
"""What a correct estimator of the ESS may be wrong by, in runs of some hundred autocorrelation times."""


@dataclass(frozen=True)
class Ratio:
    """Mean squared error over its prediction, for one coordinate and one kind of ESS.

    Attributes
    ----------
    target : str
    kind : {"mean", "bulk"}
    coordinate : int
    runs : int
    freedom : int
        Degrees of freedom of the mean squared error.
    ess : float
        Median over the runs.
    value : float
    """

    target: str
    kind: str
    coordinate: int
    runs: int
    freedom: int
    ess: float
    value: float


def limits(freedom: int, level: float) -> tuple[float, float]:
    """Return the ratios that an ESS with a bias of at most `BIAS` leaves with the probability `level`."""
    lowest, highest = chi2.ppf(level / 2.0, freedom) / freedom, chi2.isf(level / 2.0, freedom) / freedom
    return float(lowest * (1.0 - BIAS)), float(highest * (1.0 + BIAS))


def error_ratios(contender: Contender, target: Target, runs: int, seed: int) -> list[Ratio]:
    """Return the ratios of every coordinate from that many independent runs."""
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
    """Return the normal scores of the ranks among all values (Vehtari et al. 2021, eq. 14)."""
    return ndtri((rankdata(x).reshape(x.shape) - 0.375) / (x.size + 0.25))
