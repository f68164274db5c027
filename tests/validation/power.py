"""Power of a gate on ranks: the errors of a Gaussian posterior that the gate detects."""

from __future__ import annotations

import numpy as np
from scipy.stats import norm

from tests.validation.bands import UniformRanks

POWER = 0.9
SIMULATIONS = 500
SHIFTS = np.arange(0.0, 2.0, 0.02)
FACTORS = np.arange(1.0, 3.0, 0.02)


def detection_rate(uniform: UniformRanks, level: float, shift: float = 0.0, factor: float = 1.0) -> float:
    """Return the probability that a gate of the given level rejects a posterior with an error.

    Parameters
    ----------
    uniform : UniformRanks
    level : float
        Significance level of the gate.
    shift : float
        Error of the posterior mean, in standard deviations of the draws.
    factor : float
        True standard deviation divided by the standard deviation of the draws: above 1, the draws are too narrow.
    """
    rng = np.random.default_rng(0)
    truth = norm.cdf(shift + factor * rng.standard_normal((SIMULATIONS, uniform.replicates)))
    lowest, highest = uniform.simultaneous_band(level)
    found = 0
    for ranks in rng.binomial(uniform.largest, truth):
        counts = uniform.counts(ranks)
        found += bool(np.any((counts < lowest) | (counts > highest)))
    return found / SIMULATIONS


def detectable(uniform: UniformRanks, level: float) -> tuple[float, float]:
    """Return the smallest shift and factor that are detected with probability `POWER`; NaN if there is none."""
    shift = next((x for x in SHIFTS if detection_rate(uniform, level, shift=float(x)) >= POWER), np.nan)
    factor = next((x for x in FACTORS if detection_rate(uniform, level, factor=float(x)) >= POWER), np.nan)
    return float(shift), float(factor)
