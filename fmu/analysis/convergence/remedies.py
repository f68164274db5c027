"""How many draws a run needs by the rule of convergence, and what to do about one that has not converged."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.trace.reading import has
from fmu.numbers import typed
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


RHAT_LIMIT = 1.01
ESS_PER_CHAIN = 100
ESS_LIMIT = 400
MIN_AUTOCORRELATION_TIMES = 50
WALKER_RHAT_LIMIT = 1.05
MCSE_LIMIT = 0.1

RELIABLE_ESS = 50.0
"""An effective sample size below this is too uncertain for a prediction: its error is a third or more."""
_SLACK, _LEAST, _MOST_BLIND, _MOST = 1.02, 1.05, 2.0, 4.0
_FIRST_PART = 0.8
_MOST_FOR_RHAT = 1.15


def required_ess(chains: int) -> int:
    """Return the bulk and tail ESS that every parameter must have."""
    return max(ESS_LIMIT, ESS_PER_CHAIN * chains)


def growth_needed(table: pd.DataFrame, required: float, lengths: FloatArray | None = None) -> float:
    """Return the factor by which the draws must grow until effective sample sizes and standard errors suffice.

    An effective sample size grows, and a squared standard error falls, in proportion to the number of draws.

    Parameters
    ----------
    table : pandas.DataFrame
        ``fmu.summary(trace)``.
    required : float
        Bulk and tail ESS that every parameter must have.
    lengths : ndarray, shape (ndim,), optional
        For ensembles: the length of the run in autocorrelation times.

    Returns
    -------
    float
        At most 1 if they suffice; NaN if one of them is undefined.
    """
    ess = table[["ess_bulk", "ess_tail"]].to_numpy().min()
    errors = (table["mcse_mean"] / table["sd"]).to_numpy() / MCSE_LIMIT
    factors = [required / ess, float(np.max(errors)) ** 2]
    if lengths is not None:
        factors.append(MIN_AUTOCORRELATION_TIMES / float(np.min(lengths)))
    return float(np.max(factors))


def draws_to_come(
    draws: int, table: pd.DataFrame, required: float, lengths: FloatArray | None, walker_rhat: FloatArray | None
) -> int:
    """Return how many steps to draw before an insufficient run is judged again.

    As many as `growth_needed` asks for, and 2 % more. If that more than doubles the run, first four fifths of
    it, and at most four times the present length: the effective sample size is then better known. If the ESS is
    below 50, too uncertain for a prediction, the run is doubled. If only R-hat is too high, which scatters too
    much for a prediction, the run grows by 5 to 15 %. In all other cases the run is doubled.

    Parameters
    ----------
    draws : int
        Steps drawn so far.
    table : pandas.DataFrame
        ``fmu.summary(trace)``.
    required : float
        Bulk and tail ESS that every parameter must have.
    lengths, walker_rhat : ndarray, shape (ndim,), or None
        For ensembles: the length of the run in autocorrelation times, and R-hat over walkers.
    """
    growth = growth_needed(table, required, lengths)
    ess = table[["ess_bulk", "ess_tail"]].to_numpy().min()
    excess = [np.max(table["rhat"].to_numpy() - 1.0) / (RHAT_LIMIT - 1.0)]
    if walker_rhat is not None:
        excess.append(np.max(walker_rhat - 1.0) / (WALKER_RHAT_LIMIT - 1.0))
    if not (np.isfinite(growth) and ess >= RELIABLE_ESS):
        factor = _MOST_BLIND
    elif growth > 1.0:
        factor = _SLACK * growth
        if factor > _MOST_BLIND:
            factor = min(max(_MOST_BLIND, _FIRST_PART * factor), _MOST)
    elif np.max(excess) >= 1.0:
        factor = min(float(np.max(excess)), _MOST_FOR_RHAT)
    else:  # no number of draws is known to help, or R-hat is NaN
        factor = _MOST_BLIND
    return math.ceil((max(factor, _LEAST) - 1.0) * draws)


APART = 1.2
"""With an R-hat above this the chains are in different places; more draws may never bring them together."""
SHORTEST_WARMUP = 1000


def for_chains_apart(trace: xr.DataTree) -> str:
    """Return the remedy for chains that do not move, or are in a region of negligible probability."""
    if has(trace, "observed_data") and trace.attrs["init"] != "maxima":
        return '; start the chains at the posterior maxima: init="maxima" (--init maxima)'
    warmup = max(SHORTEST_WARMUP, 2 * int(trace.attrs["warmup"]))
    return f"; lengthen the warm-up: --warmup {warmup}"


def for_missed_maximum(trace: xr.DataTree) -> str:
    """Return the remedy for a maximum that no chain visited, or that chains cannot enter and leave."""
    if trace.attrs["sampler"] != "tempering" and (
        trace.attrs["init"] == "maxima" or not has(trace, "observed_data")
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
    """Return about how many draws a run needs; for chains that are far apart, how to bring them together.

    Empty if R-hat or an effective sample size is undefined.

    Parameters
    ----------
    trace : xarray.DataTree
    table : pandas.DataFrame
        ``fmu.summary(trace)``.
    required : float
        Bulk and tail ESS that every parameter must have.
    lengths, walker_rhat : ndarray, shape (ndim,), optional
        For ensembles: the length of the run in autocorrelation times, and R-hat over walkers.
    """
    if len(trace["posterior"]["chain"]) < 2:
        return ""  # another message already asks for more chains
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
