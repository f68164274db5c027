"""The posterior that errors are measured against."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr

    from fmu.analysis.maxima.results import Maxima


@dataclass(frozen=True)
class Reference:
    """The best estimate of the posterior at hand.

    Attributes
    ----------
    mean, sd, mcse : ndarray, shape (ndim,)
        SI units; `mcse` is the standard error of `mean`.
    origin : str
        In words, where it comes from.
    """

    mean: FloatArray
    sd: FloatArray
    mcse: FloatArray
    origin: str

    @property
    def resolution(self) -> float:
        """Root mean square over the parameters of mcse/sd: smaller errors cannot be told from none."""
        return float(np.sqrt(np.mean((self.mcse / self.sd) ** 2)))


def pooled(traces: Mapping[str, xr.DataTree], origin: str) -> Reference:
    """Return the mean of several traces, each weighted by its effective sample size, and their sd."""
    from fmu.analysis.convergence.diagnostics import summary

    tables = [summary(trace) for trace in traces.values()]
    mean, sd, mcse, ess = (
        np.array([table[column].to_numpy() for table in tables])
        for column in ("mean", "sd", "mcse_mean", "ess_bulk")
    )
    weight = ess / ess.sum(axis=0)
    centre = np.sum(weight * mean, axis=0)
    spread = np.sqrt(np.sum(weight * (sd**2 + (mean - centre) ** 2), axis=0))
    return Reference(centre, spread, np.sqrt(np.sum((weight * mcse) ** 2, axis=0)), origin)


def around_the_maxima(maxima: Maxima) -> Reference:
    """Return what importance sampling around the maxima found says, each maximum weighted by its mass.

    No chain is in it, so that it holds where chains stay in the mode that they fell into.
    """
    share = np.array([m.share for m in maxima])[:, np.newaxis]
    mean, sd = (np.array([getattr(m, name) for m in maxima]) for name in ("mean", "sd"))
    draws = np.array([max(m.effective_draws, 1.0) for m in maxima])[:, np.newaxis]
    centre = np.sum(share * mean, axis=0)
    spread = np.sqrt(np.sum(share * (sd**2 + (mean - centre) ** 2), axis=0))
    mcse = np.sqrt(np.sum((share * sd) ** 2 / draws, axis=0))
    return Reference(
        centre, spread, mcse, "importance sampling around the maxima found, for want of a converged run"
    )
