"""What to do about a run that has not converged, in one sentence each."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence.needed import RHAT_LIMIT, WALKER_RHAT_LIMIT, growth_needed
from fmu.numbers import typed
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


APART = 1.2
"""With an R-hat above this the chains are in different places, and more draws may never bring them together."""
SHORTEST_WARMUP = 1000


def for_chains_apart(trace: xr.DataTree) -> str:
    """Return the remedy for chains that stand still, or are where next to no probability is."""
    if "observed_data" in trace.children and trace.attrs["init"] != "maxima":
        return '; start the chains at the posterior maxima: init="maxima" (--init maxima)'
    warmup = max(SHORTEST_WARMUP, 2 * int(trace.attrs["warmup"]))
    return f"; lengthen the warm-up: --warmup {warmup}"


def for_missed_maximum(trace: xr.DataTree) -> str:
    """Return the remedy for a maximum that no chain visited, or that chains cannot travel to and from."""
    if trace.attrs["sampler"] != "tempering" and (
        trace.attrs["init"] == "maxima" or "observed_data" not in trace.children
    ):
        return "; use parallel tempering, which moves between maxima: --sampler tempering"
    return for_chains_apart(trace)


def for_too_few_draws(
    trace: xr.DataTree,
    table: pd.DataFrame,
    required: float,
    lengths: FloatArray | None = None,
    walker_rhat: FloatArray | None = None,
) -> str:
    """Return about how many draws a run needs; of chains that are far apart, what brings them together.

    Nothing where R-hat or an effective sample size does not exist.

    Parameters
    ----------
    trace : xarray.DataTree
    table : pandas.DataFrame
        ``fmu.summary(trace)``.
    required : float
        Bulk and tail ESS that every parameter must have.
    lengths, walker_rhat : ndarray, shape (ndim,), optional
        Of ensembles, the run's length in autocorrelation times, and R-hat over walkers.
    """
    if len(trace["posterior"]["chain"]) < 2:
        return ""  # that more chains are needed has been said
    rhat = float(np.max(table["rhat"].to_numpy()))
    over_walkers = 1.0 if walker_rhat is None else float(np.max(walker_rhat))
    growth = growth_needed(table, required, lengths)
    if rhat > APART or over_walkers > APART:
        return for_missed_maximum(trace)
    if not np.isfinite(rhat + over_walkers + growth):
        return ""
    excess = max((rhat - 1.0) / (RHAT_LIMIT - 1.0), (over_walkers - 1.0) / (WALKER_RHAT_LIMIT - 1.0))
    number = in_two_digits(int(trace.attrs["draws"]) * max(growth, excess))
    what = "draws" if lengths is None else "steps"
    return f"; about {number} {what} are needed: --draws {number}, or --until-ess {typed(required)}"


def in_two_digits(draws: float) -> int:
    """Return a number of draws rounded up to two significant digits: 3327 to 3400."""
    unit = 10 ** max(0, math.floor(math.log10(draws)) - 1)
    return math.ceil(draws / unit) * unit
