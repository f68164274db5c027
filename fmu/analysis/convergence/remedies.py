"""How many draws a run needs to converge, and remedies for a run that has not converged."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

from fmu.analysis.convergence.candidates import growth_for_candidates
from fmu.analysis.maxima.kinds import SINGULARITY
from fmu.analysis.trace.reading import has, is_imported
from fmu.numbers import typed
from fmu.samplers.hmc import SHORT_STEPS
from fmu.types import BoolArray, FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


RHAT_LIMIT, RHAT_LIMIT_OF_SCORES = 1.01, 1.05
ESS_PER_CHAIN = 100
ESS_LIMIT = 400
LEAST_ESS = f"{ESS_LIMIT}, or {ESS_PER_CHAIN} per chain if that is more"
"""`required_ess` in words, for any number of chains."""
MIN_AUTOCORRELATION_TIMES = 50
WALKER_RHAT_LIMIT = 1.05
MCSE_LIMIT, MCSE_LIMIT_OF_ENDS = 0.1, 0.12
"""Largest standard errors allowed of the means and of the 90 % interval ends, in posterior sd."""
MCSE_OF_ENDS = ("mcse_eti90_lb", "mcse_eti90_ub")
"""Columns with the Monte-Carlo standard errors of the 90 % interval ends."""

Places = Literal["unknown", "one", "missed"]
RELIABLE_ESS = 50.0
"""ESS below which a prediction of the draws needed is unreliable, because the ESS is off by a third or more."""
RELIABLE_TIMES = 3.0
"""Shortest run, in autocorrelation times, that estimates this time well; a run of length 1 gives half of it."""
_MOST = 2.0
_NEAR, _SLACK, _LEAST, _FIRST_PART = 1.1, 1.01, 1.02, 0.8
_LEAST_FOR_RHAT, _MOST_FOR_RHAT = 1.05, 1.15
_MARGIN, _MARGIN_OF_STEPS = 1.3, 1.1
"""Ratios of recommended to predicted draws, for chains and for ensembles, because predictions scatter."""


def required_ess(chains: int) -> int:
    """Return the bulk and tail ESS that every parameter must reach in a run with `chains` chains."""
    return max(ESS_LIMIT, ESS_PER_CHAIN * chains)


def without_scores(table: pd.DataFrame) -> pd.DataFrame:
    """Return a summary without the rows of test scores, whose ESS and standard errors are not tested.

    A test score is a test's standardised deviation from the population mean. There are many of them, so the worst
    ESS among them is poor by chance alone; for the same reason, their R-hat has a higher limit. Their information
    is contained in the population's mean and standard deviation, and in each test's structural parameters.
    """
    return table[~_is_score(table)]


def _is_score(table: pd.DataFrame) -> BoolArray:
    return np.asarray(table.index.isin(table.attrs.get("scores", [])))


def rhat_limits(names: Sequence[str] | pd.Index, scores: Sequence[str]) -> FloatArray:
    """Return the limit below which each parameter's R-hat must be, shape (n,): 1.01, or 1.05 for a test score."""
    return np.where(np.isin(names, scores), RHAT_LIMIT_OF_SCORES, RHAT_LIMIT)


def growth_needed(table: pd.DataFrame, required: float, lengths: FloatArray | None = None) -> float:
    """Return the factor by which the number of draws must grow until ESS and standard errors suffice.

    ESS grows, and squared standard errors fall, in proportion to the number of draws. With `lengths`, the factor
    also makes the run long enough for an ensemble sampler.

    Parameters
    ----------
    table : pandas.DataFrame
        ``fmu.summary(trace)``.
    required : float
        Bulk and tail ESS required of every parameter.
    lengths : ndarray, shape (ndim,), optional
        For ensembles, the length of the run in autocorrelation times.

    Returns
    -------
    float
        At most 1 if ESS, standard errors and, if given, `lengths` already suffice; NaN if any of these is
        undefined. Test scores are ignored in ESS and standard errors.
    """
    table = without_scores(table)
    limits = {"mcse_mean": MCSE_LIMIT, **dict.fromkeys(MCSE_OF_ENDS, MCSE_LIMIT_OF_ENDS)}
    errors = [(table[column] / table["sd"]).to_numpy() / limit for column, limit in limits.items()]
    factors = [required / fewest(table), float(np.max(errors)) ** 2]
    if lengths is not None:
        factors.append(MIN_AUTOCORRELATION_TIMES / float(np.min(lengths)))
    return float(np.max(factors))


def fewest(table: pd.DataFrame) -> float:
    """Return the smallest bulk or tail ESS in a summary, or NaN if an ESS is NaN. Test scores are ignored."""
    return float(without_scores(table)[["ess_bulk", "ess_tail"]].to_numpy().min())


def rhat_excess(table: pd.DataFrame) -> float:
    """Return the largest (R-hat − 1)/(limit − 1) of all parameters; NaN if an R-hat is NaN.

    It exceeds 1 if an R-hat exceeds its limit.
    """
    limits = rhat_limits(table.index, table.attrs.get("scores", []))
    return float(np.max((table["rhat"].to_numpy() - 1.0) / (limits - 1.0)))


def meets_criterion(excess: float, ess_min: float, chains: int) -> bool:
    """Return True if R-hat and ESS meet the convergence criterion, which is the same for all samplers.

    Parameters
    ----------
    excess : float
        `rhat_excess` of the run's summary.
    ess_min : float
        Smallest bulk or tail ESS in the run's summary, from `fewest`.
    chains : int
        Number of chains, or of ensembles.
    """
    return excess < 1.0 and ess_min >= required_ess(chains)


def draws_to_come(draws: int, growth: float, is_reliable: bool = True, excess: float = 0.0) -> int:
    """Return the number of steps to draw before an insufficient run is judged again.

    If the smallest ESS is not reliable, the run is doubled. Otherwise:

    - If `growth` lies between 1 and 1.1, the run is extended to 1.01 times the predicted length, or by 2 % if that
      is more.
    - If `growth` is larger, 80 % of the missing steps are drawn, but the run is at most doubled, because a longer
      run gives a better prediction.
    - If `growth` is at most 1 and only R-hat is too high, the run grows by 5 to 15 %, because R-hat scatters too
      much for a prediction.
    - In all other cases, for example if `growth` is NaN, the run is doubled.

    Parameters
    ----------
    draws : int
        Steps drawn so far.
    growth : float
        Factor by which the number of draws must grow, for example from `growth_needed`.
    is_reliable : bool
        Whether the smallest ESS is at least `RELIABLE_ESS`.
    excess : float
        Result of `rhat_excess`.
    """
    factor = _MOST
    if is_reliable and growth > 1.0:
        part = _SLACK * growth if growth < _NEAR else 1.0 + _FIRST_PART * (growth - 1.0)
        factor = min(max(_LEAST, part), _MOST)
    elif is_reliable and growth <= 1.0 <= excess:
        factor = min(max(excess, _LEAST_FOR_RHAT), _MOST_FOR_RHAT)
    return math.ceil((factor - 1.0) * draws)


APART = 1.2
"""R-hat above which chains are in different regions, and more draws may never make them agree."""
SHORTEST_WARMUP = 1000
RATIOS = "if one parameter sets the width of others, sample their ratios to that width instead of them"
"""Remedy for a funnel, where a fixed step length is too long in the neck and too short outside."""


def for_chains_apart(trace: xr.DataTree) -> str:
    """Return the remedy for chains that stay at one point or in a region of negligible probability."""
    if "second_stage_proposals" in trace.attrs:
        return "; the surrogate is too far from the model there: learn it from more solves"
    if is_imported(trace):
        return (
            "; start the walkers around the maxima, in proportion to their probability: problem.walkers(n, seed)"
        )
    if _is_infinite(trace):
        return "" if trace.attrs["sampler"] == "mixture" else "; take the default sampler, the mixture"
    if has(trace, "observed_data") and trace.attrs["init"] != "maxima":
        return '; start the chains at the posterior maxima: init="maxima" (--init maxima)'
    warmup = max(SHORTEST_WARMUP, 2 * int(trace.attrs["warmup"]))
    return f"; lengthen the warm-up: --warmup {warmup}"


def _is_infinite(trace: xr.DataTree) -> bool:
    """Return True if a search found that the density is infinite at a bound, where no chain should start."""
    return has(trace, "maxima") and SINGULARITY in trace["maxima"]["kind"].to_numpy()


def for_divergences(trace: xr.DataTree) -> str:
    """Return the remedy for diverging trajectories, given the trace's sampler and its target acceptance rate."""
    if trace.attrs["sampler"] == "mixture":
        return f"; {RATIOS}"
    settings = json.loads(trace.attrs["settings"]) | json.loads(trace.attrs.get("learnt", "{}"))
    if np.max(settings.get("target_accept") or 0.0) >= SHORT_STEPS:  # one value per group
        return f"; take the default sampler, the mixture; {RATIOS}"
    return f"; use a shorter step: fmu.HamiltonianMonteCarlo(target_accept={typed(SHORT_STEPS)})"


def for_missed_maximum(trace: xr.DataTree) -> str:
    """Return the remedy for a maximum that no chain visited, or that chains do not enter and leave."""
    if (
        trace.attrs["sampler"] != "tempering"
        and not is_imported(trace)
        and (trace.attrs["init"] == "maxima" or not has(trace, "observed_data") or _is_infinite(trace))
    ):
        return "; use parallel tempering, which moves between maxima: --sampler tempering"
    return for_chains_apart(trace)


def for_too_few_draws(
    trace: xr.DataTree,
    table: pd.DataFrame,
    required: float,
    lengths: FloatArray | None = None,
    are_apart: bool = False,
    places: Places = "unknown",
) -> str:
    """Return a clause on how many draws a run needs, or on how to make its chains agree.

    If chains or walkers stay in separate regions, the clause states the remedy. Otherwise it states a number of
    draws; it is then empty if an ESS or a standard error is undefined. The clause is always empty for a single
    chain that is not from plain emcee.

    Parameters
    ----------
    trace : xarray.DataTree
    table : pandas.DataFrame
        ``fmu.summary(trace)``.
    required : float
        Bulk and tail ESS required of every parameter.
    lengths : ndarray, shape (ndim,), optional
        For ensembles, the length of the run in autocorrelation times.
    are_apart : bool
        For ensembles, whether walkers stay in separate regions.
    places : {"unknown", "one", "missed"}
        As in `fmu.analysis.convergence.diagnostics.convergence_failures`.
    """
    if len(trace["posterior"]["chain"]) < 2 and not is_imported(trace):
        return ""  # another message already asks for more chains
    if are_apart or (places != "one" and np.max(table["rhat"].to_numpy()) > APART):
        return for_missed_maximum(trace)
    excess = np.fmax(rhat_excess(table), growth_for_candidates(trace))  # R-hat of a single ensemble is NaN
    growth = np.maximum(growth_needed(table, required, lengths), excess)
    if not np.isfinite(growth):
        return ""
    margin = _MARGIN if lengths is None else _MARGIN_OF_STEPS
    number = in_two_digits(margin * growth * int(trace.attrs["draws"]))
    is_reliable = fewest(table) >= RELIABLE_ESS if lengths is None else np.min(lengths) >= RELIABLE_TIMES
    about, what = "about" if is_reliable else "at least", "draws" if lengths is None else "steps"
    needed = f"; {about} {number} {what} are needed"
    if "limit" in trace.attrs:
        return needed
    if is_imported(trace):
        missing = in_two_digits((number - int(trace.attrs["draws"])) * json.loads(trace.attrs["settings"])["thin"])
        return f"{needed}: continue with sampler.run_mcmc(None, {missing})"
    python = f"Python: until_ess={typed(required)} or draws={number}"
    return f"{needed}: leave out --draws, or --draws {number} ({python})"


def in_two_digits(draws: float) -> int:
    """Return a number of draws rounded up to two significant digits: 3400 for 3327."""
    unit = 10 ** max(0, math.floor(math.log10(draws)) - 1)
    return math.ceil(draws / unit) * unit
