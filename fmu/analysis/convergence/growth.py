"""R-hat and ESS as a run grows, and the number of solves at which it first met the convergence criterion."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fmu.analysis.convergence.effective import MOST_RANKED, apart, ess_bulk, ess_tail, lengths, rhat
from fmu.analysis.convergence.remedies import meets_criterion, rhat_limits
from fmu.analysis.trace.reading import (
    array_of,
    has,
    in_solves,
    parameter_draws,
    parameter_names,
    score_names,
    walkers_of,
)
from fmu.types import FloatArray, IntArray

if TYPE_CHECKING:
    import xarray as xr

_HALVINGS = 5
_RANKED_IN_FULL = 10_000
"""Largest number of draws per chain for which R-hat is computed from all draws."""


class Growth(NamedTuple):
    """R-hat and ESS of the worst parameter, for increasing numbers of draws.

    Attributes
    ----------
    steps : ndarray of int, shape (n,)
        Increasing numbers of draws per chain, or of steps for an ensemble.
    solves : ndarray, shape (n,)
        Cost of these draws in solves, including the warm-up but not the search for maxima; an exact gradient
        counts as ``gradient_cost`` solves.
    ess : ndarray, shape (n,)
        The smaller of bulk and tail ESS. Test scores are ignored.
    excess : ndarray, shape (n,)
        Largest (R-hat − 1)/(limit − 1), as `fmu.analysis.convergence.remedies.rhat_excess`.
    """

    steps: IntArray
    solves: FloatArray
    ess: FloatArray
    excess: FloatArray


def growth(trace: xr.DataTree, at: IntArray | None = None) -> Growth:
    """Return R-hat, ESS and cost over the first draws of a run, for increasing numbers of draws.

    R-hat of more than 10 000 draws per chain is computed from every k-th draw, at most 2000 per chain. R-hat and
    ESS are NaN if they are undefined for any parameter. As in the verdict, test scores have a higher limit of
    R-hat than the other parameters, and their ESS is not tested.

    Parameters
    ----------
    trace : xarray.DataTree
    at : ndarray of int, optional
        Numbers of draws per chain, or of steps for an ensemble. Defaults to the `lengths` of the run.
    """
    walkers = walkers_of(trace)
    draws = np.moveaxis(parameter_draws(trace), -1, 0)
    names, scores = parameter_names(trace), score_names(trace)
    allowed, of_ess = rhat_limits(names, scores) - 1.0, ~np.isin(names, scores)
    at = lengths(draws.shape[2] // walkers) if at is None else at
    spent = _cumulative(trace, walkers)
    ess, excess = np.empty(len(at)), np.empty(len(at))
    for k, steps in enumerate(at):
        first = draws[..., : steps * walkers]
        distance = apart(steps * walkers, MOST_RANKED, walkers) if steps * walkers > _RANKED_IN_FULL else 1
        excess[k] = np.max((np.array([rhat(x[:, ::distance]) for x in first]) - 1.0) / allowed)
        ess[k] = np.min([min(ess_bulk(x, walkers), ess_tail(x, walkers)) for x in first[of_ess]])
    return Growth(at, spent[at - 1], ess, excess)


def _cumulative(trace: xr.DataTree, walkers: int) -> FloatArray:
    """Return the cumulative number of solves after each step, warm-up included, shape (steps,)."""
    warm, drawn = (
        in_solves(trace, *(_of_steps(trace, group, name, walkers) for name in ("n_solves", "n_gradients")))
        for group in ("warmup_sample_stats", "sample_stats")
    )
    return np.asarray(warm.sum() + np.cumsum(drawn))


def _of_steps(trace: xr.DataTree, group: str, name: str, walkers: int) -> FloatArray:
    """Return a per-draw statistic of the trace for each step, summed over chains and walkers, shape (steps,).

    The result is empty if the trace does not store the statistic.
    """
    if not has(trace, group, name):
        return np.zeros(0)
    counts = array_of(trace, group, name)
    return np.asarray(counts.reshape(len(counts), -1, walkers).sum(axis=(0, 2)), dtype=float)


def solves_to_criterion(trace: xr.DataTree, grown: Growth | None = None) -> float:
    """Return the number of solves at which a run first met the convergence criterion, warm-up included.

    The solves of the search for maxima are not included. The result belongs to the first number of draws in
    `grown` that meets the criterion. Up to five bisections between this number and the one before it make the
    result more accurate. The result is NaN if the run never met the criterion.

    Parameters
    ----------
    trace : xarray.DataTree
    grown : Growth, optional
        ``growth(trace)``, if already computed.
    """
    grown = growth(trace) if grown is None else grown
    chains = trace["posterior"].sizes["chain"]
    met = [meets_criterion(*both, chains) for both in zip(grown.excess, grown.ess, strict=True)]
    if not any(met):
        return np.nan
    k = met.index(True)
    low, high, solves = int(grown.steps[k - 1]) if k else 0, int(grown.steps[k]), float(grown.solves[k])
    for _ in range(_HALVINGS if k else 0):
        middle = (low + high) // 2
        if middle == low:
            break
        found = growth(trace, np.array([middle]))
        if meets_criterion(found.excess[0], found.ess[0], chains):
            high, solves = middle, float(found.solves[0])
        else:
            low = middle
    return solves
