"""The reference posterior, running errors against it, and the length at which a run passed for converged.

A solve is a log-probability here, and an exact gradient counts as many as it takes the time of
(`fmu.analysis.trace.reading.in_solves`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence.diagnostics import ESS_LIMIT, summary
from fmu.analysis.trace.reading import array_of, in_solves, parameter_draws, walkers_of
from fmu.types import FloatArray, IntArray

if TYPE_CHECKING:
    import xarray as xr

    from fmu.analysis.maxima.results import Maxima


@dataclass(frozen=True)
class Reference:
    """The best available estimate of the posterior.

    Attributes
    ----------
    mean, sd, mcse : ndarray, shape (ndim,)
        SI units; `mcse` is the standard error of `mean`.
    origin : str
        Its source, in words.
    """

    mean: FloatArray
    sd: FloatArray
    mcse: FloatArray
    origin: str

    @property
    def resolution(self) -> float:
        """Root mean square over the parameters of mcse/sd: smaller errors cannot be resolved."""
        return float(np.sqrt(np.mean((self.mcse / self.sd) ** 2)))


def pool_traces(traces: Mapping[str, xr.DataTree], origin: str) -> Reference:
    """Return the mean of several traces, each weighted by its effective sample size, and their sd."""
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
    """Return the estimate of importance sampling around the maxima found, each weighted by its mass.

    It uses no chains, so that it also holds if chains stay in separate modes.
    """
    share = np.array([m.share for m in maxima])[:, np.newaxis]
    mean, sd = np.array([m.mean for m in maxima]), np.array([m.sd for m in maxima])
    draws = np.array([max(m.effective_draws, 1.0) for m in maxima])[:, np.newaxis]
    centre = np.sum(share * mean, axis=0)
    spread = np.sqrt(np.sum(share * (sd**2 + (mean - centre) ** 2), axis=0))
    mcse = np.sqrt(np.sum((share * sd) ** 2 / draws, axis=0))
    return Reference(
        centre, spread, mcse, "importance sampling around the maxima found, for want of a converged run"
    )


POINTS_PER_DECADE = 15
GROWTH = 1.25
SHORTEST = 50


@dataclass(frozen=True)
class Curve:
    """The error of the running mean of every chain.

    Attributes
    ----------
    solves : ndarray, shape (points,)
        Model solves of one chain (one ensemble), warm-up included, averaged over the chains.
    error : ndarray, shape (chains, points)
        Root mean square over the parameters of (running mean − reference mean)/reference sd.
    """

    solves: FloatArray
    error: FloatArray


@dataclass(frozen=True)
class Needed:
    """The length from which on a run passed for converged, at every longer length examined too.

    None where the run never passed.

    Attributes
    ----------
    draws : int or None
        Retained steps.
    samples : int or None
    solves, seconds : float or None
        Steps of all chains or walkers up to there, their solves and the time they took; warm-up included.
    """

    draws: int | None = None
    samples: int | None = None
    solves: float | None = None
    seconds: float | None = None


def running_error(trace: xr.DataTree, reference: Reference) -> Curve:
    """Return the error of the running mean of each chain, at geometrically growing lengths."""
    walkers = walkers_of(trace)
    draws = parameter_draws(trace)
    chains, total, ndim = draws.shape
    steps = total // walkers
    standardised = (draws - reference.mean) / reference.sd
    per_step = standardised.reshape(chains, steps, walkers, ndim).mean(axis=2)
    lengths = lengths_up_to(steps, 10.0 ** (1 / POINTS_PER_DECADE), 1)
    means = np.cumsum(per_step, axis=1)[:, lengths - 1] / lengths[:, np.newaxis]
    solves = solves_by_step(trace).mean(axis=0)[lengths - 1]
    return Curve(solves, np.sqrt(np.mean(means**2, axis=2)))


def solves_needed(trace: xr.DataTree, failures: Callable[[xr.DataTree], list[str]]) -> Needed:
    """Return the shortest length from which on the run passes for converged.

    Parameters
    ----------
    trace : xarray.DataTree
    failures : callable
        Returns why a trace has not converged: `fmu.analysis.convergence.diagnostics.convergence_failures`, for
        example.

    Notes
    -----
    The warm-up is unchanged; the draws are truncated at lengths that grow by `GROWTH`. Going backwards from the
    whole run, and stopping at the first failure, guards against lengths that pass by chance.
    """
    walkers = walkers_of(trace)
    steps = trace["posterior"].sizes["draw"] // walkers
    solves = solves_by_step(trace).sum(axis=0)
    attrs, before_s = trace.attrs, float(trace.attrs["warmup_wall_s"])
    step_s = (float(attrs["wall_s"]) - before_s) / steps
    needed = Needed()
    for length in lengths_up_to(steps, GROWTH, SHORTEST)[::-1]:
        if failures(shorten_trace(trace, int(length) * walkers)):
            break
        samples = trace["posterior"].sizes["chain"] * walkers * (int(attrs["warmup"]) + int(length))
        needed = Needed(int(length), samples, float(solves[length - 1]), before_s + step_s * int(length))
    return needed


def solves_at_this_pace(trace: xr.DataTree) -> int | None:
    """Return how many model solves a run would take to the effective sample size required by the verdict.

    Extrapolated from the smallest bulk or tail ESS of the draws, without warm-up; None if that is NaN.
    """
    ess = float(summary(trace)[["ess_bulk", "ess_tail"]].to_numpy().min())
    solves = int(trace["sample_stats"]["n_solves"].sum())
    return round(solves * ESS_LIMIT / ess) if ess > 0 else None


def solves_by_step(trace: xr.DataTree) -> FloatArray:
    """Return each chain's model solves up to every step kept, warm-up included, shape (chains, steps)."""
    kept, before = (
        in_solves(trace, *(array_of(trace, group, name) for name in ("n_solves", "n_gradients")))
        for group in ("sample_stats", "warmup_sample_stats")
    )
    kept = kept.reshape(len(kept), -1, walkers_of(trace)).sum(axis=2)
    return before.sum(axis=1, keepdims=True) + np.cumsum(kept, axis=1)


def shorten_trace(trace: xr.DataTree, draws: int) -> xr.DataTree:
    """Return the first `draws` draws of a trace, with the groups that a verdict needs."""
    import xarray as xr

    groups = {name: trace[name].to_dataset().isel(draw=slice(0, draws)) for name in ("posterior", "sample_stats")}
    short = xr.DataTree.from_dict(groups)
    short.attrs = dict(trace.attrs)
    return short


def lengths_up_to(total: int, growth: float, first: int) -> IntArray:
    """Return whole numbers from `first` to `total`, each about `growth` times the one before."""
    if total <= first:
        return np.array([total])
    count = int(np.ceil(np.log(total / first) / np.log(growth))) + 1
    return np.unique(np.geomspace(first, total, count).round().astype(int))
