"""The posterior that errors are measured against."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import xarray as xr

    from fmu.posterior.maxima import Maximum
    from fmu.posterior.problem import UpdatingProblem

FloatArray = NDArray[np.float64]

MISSED = 12.0
"""A trace that never comes this near to the log-probability of a maximum has not been there.

Near a maximum in d dimensions the log-probability of a draw lies below it by half a χ² variable of d degrees of
freedom (by the sum of d exponential ones in a corner of the bounds): for d = 5, less than 12 in all but one of a
hundred draws even in the corner, and a trace has hundreds of draws.
"""


@dataclass(frozen=True)
class Reference:
    """The best estimate of the posterior at hand.

    Attributes
    ----------
    mean, sd, mcse : ndarray, shape (ndim,)
        SI units; `mcse` is the standard error of `mean`.
    origin : str
        In words, where it comes from.
    converged : bool
        Whether the verdict on every run in it was good.
    """

    mean: FloatArray
    sd: FloatArray
    mcse: FloatArray
    origin: str
    converged: bool

    @property
    def resolution(self) -> float:
        """Root mean square over the parameters of mcse/sd: smaller errors cannot be told from none."""
        return float(np.sqrt(np.mean((self.mcse / self.sd) ** 2)))


def pooled(traces: Mapping[str, xr.DataTree], origin: str, converged: bool) -> Reference:
    """Return the mean of several traces, each weighted by its effective sample size, and their sd."""
    from fmu.analysis.diagnostics import summary

    tables = [summary(trace) for trace in traces.values()]
    mean, sd, ess = (
        np.array([table[column].to_numpy() for table in tables]) for column in ("mean", "sd", "ess_bulk")
    )
    weight = np.where(np.isfinite(ess), ess, 1.0)
    weight = weight / weight.sum(axis=0)
    centre = np.sum(weight * mean, axis=0)
    spread = np.sqrt(np.sum(weight * (sd**2 + (mean - centre) ** 2), axis=0))
    mcse = np.array([table["mcse_mean"].to_numpy() for table in tables])
    return Reference(centre, spread, np.sqrt(np.sum((weight * mcse) ** 2, axis=0)), origin, converged)


def missed(trace: xr.DataTree, maxima: Sequence[Maximum]) -> list[str]:
    """Say that a trace never came near the highest known maximum, if so: its chains alone cannot tell."""
    reached = float(trace["sample_stats"]["lp"].max())
    short = maxima[0].log_prob - reached
    if short < MISSED:
        return []
    return [f"the highest maximum was never visited (log-probability {short:.3g} above the best draw)"]


def around(problem: UpdatingProblem, maximum: Maximum, chains: int, seed: int) -> FloatArray:
    """Return starts near a maximum and inside the bounds, shape (chains, ndim)."""
    rng = np.random.default_rng(seed)
    spread = 1e-3 * problem.scale * np.abs(rng.standard_normal((chains, problem.ndim)))
    towards_middle = np.where(maximum.theta > 0.5 * (problem.lower + problem.upper), -1.0, 1.0)
    return np.clip(maximum.theta + towards_middle * spread, problem.lower, problem.upper)
