"""The reference posterior, the errors of running means, and the run length needed for convergence.

A solve is one evaluation of the log-probability. An exact gradient counts as the number of solves that take the
same time (`fmu.analysis.trace.reading.in_solves`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fmu.analysis.convergence.diagnostics import ESS_LIMIT, summary
from fmu.analysis.convergence.growth import growth
from fmu.analysis.convergence.remedies import meets_criterion
from fmu.analysis.trace.reading import array_of, in_solves, parameter_draws, walkers_of
from fmu.report.plots import TITLES
from fmu.types import FloatArray, IntArray

if TYPE_CHECKING:
    import xarray as xr

    from fmu.analysis.convergence.diagnosis import Diagnosis
    from fmu.analysis.maxima.results import Maxima


TRUSTED = ("hmc", "emcee")
"""Samplers whose converged long runs form the reference posterior."""


@dataclass(frozen=True)
class Reference:
    """The best available estimate of the posterior.

    Attributes
    ----------
    mean, sd, mcse : ndarray, shape (ndim,)
        Each parameter's posterior mean and standard deviation, and the Monte Carlo standard error of the mean, SI
        units.
    origin : str
        The source of the estimate, in words.
    """

    mean: FloatArray
    sd: FloatArray
    mcse: FloatArray
    origin: str

    @property
    def resolution(self) -> float:
        """Root mean square of mcse/sd over the parameters. Errors of a run below this value cannot be resolved."""
        return float(np.sqrt(np.mean((self.mcse / self.sd) ** 2)))


def pool_traces(traces: Mapping[str, xr.DataTree], origin: str) -> Reference:
    """Pool several traces into one posterior estimate. For each parameter, a trace is weighted by its bulk ESS."""
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
    """Return a posterior estimate from importance sampling around the maxima of the posterior.

    Each maximum is weighted by its share of the probability. The estimate uses no chains, so it is valid even if
    chains do not cross between separated maxima.
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


def reference_posterior(
    long: Mapping[str, xr.DataTree], diagnoses: Mapping[str, Diagnosis], maxima: Maxima
) -> Reference:
    """Return the reference posterior from the trusted samplers that converged or, if none did, from the maxima."""
    good = {s: long[s] for s in TRUSTED if diagnoses[s].converged}
    if not good:
        return around_the_maxima(maxima)
    return pool_traces(good, f"long runs of {' and '.join(TITLES[s] for s in good)}, pooled")


def starts_in_the_posterior(
    long: Mapping[str, xr.DataTree], diagnoses: Mapping[str, Diagnosis], chains: int
) -> FloatArray | None:
    """Return draws, shape (chains, ndim), evenly spaced over a converged long run of a trusted sampler.

    Return None if no long run of a trusted sampler converged.
    """
    for name in TRUSTED:
        if diagnoses[name].converged:
            draws = parameter_draws(long[name])
            every = np.linspace(0, draws.shape[0] * draws.shape[1] - 1, chains).astype(int)
            return draws.reshape(-1, draws.shape[2])[every]
    return None


POINTS_PER_DECADE = 15
GROWTH = 1.25
SHORTEST = 50
LEAST_ESS_OF_PACE = 10.0
"""Smallest ESS that is a reliable estimate. For four chains that hardly move, the estimate does not fall below
about 4."""


@dataclass(frozen=True)
class Curve:
    """Error of every chain's running mean.

    Attributes
    ----------
    solves : ndarray, shape (points,)
        Model solves by one chain (or ensemble), warm-up included, averaged over the chains.
    error : ndarray, shape (chains, points)
        Root mean square over the parameters of (running mean − reference mean)/(reference sd).
    """

    solves: FloatArray
    error: FloatArray


@dataclass(frozen=True)
class Needed:
    """The shortest run length that passes a convergence check. All longer lengths examined also pass.

    All attributes are None if the run did not pass.

    Attributes
    ----------
    draws : int or None
        Steps per chain after warm-up.
    samples : int or None
        Steps by all chains and walkers up to this length, warm-up included.
    solves, seconds : float or None
        Model solves by all chains, and time in s, up to this length, warm-up included.
    sampling_samples, sampling_solves, sampling_seconds : int or float, optional
        `samples`, `solves` and `seconds` without the warm-up, whose length was chosen beforehand.
    """

    draws: int | None = None
    samples: int | None = None
    solves: float | None = None
    seconds: float | None = None
    sampling_samples: int | None = None
    sampling_solves: float | None = None
    sampling_seconds: float | None = None


def running_error(trace: xr.DataTree, reference: Reference) -> Curve:
    """Return the error of each chain's running mean at geometrically increasing lengths.

    The running mean of an ensemble is over all its walkers.
    """
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


def has_met_criterion(trace: xr.DataTree) -> bool:
    """Return True if R-hat is below 1.01 and bulk and tail ESS are at least 400, and 100 per chain.

    This is the criterion of `fmu.compare`, the same for all samplers. `fmu.diagnose` has further tests for some of
    them: emcee, for example, must run for 50 autocorrelation times.
    """
    steps = trace["posterior"].sizes["draw"] // walkers_of(trace)
    grown = growth(trace, np.array([steps]))
    return meets_criterion(grown.excess[0], grown.ess[0], trace["posterior"].sizes["chain"])


def solves_needed(trace: xr.DataTree, passes: Callable[[xr.DataTree], bool]) -> Needed:
    """Return the shortest run length that passes a convergence check, together with all longer examined lengths.

    Parameters
    ----------
    trace : xarray.DataTree
    passes : callable
        Returns True if a trace has converged, such as `has_met_criterion`.

    Notes
    -----
    Each examined length consists of the whole warm-up and the first draws. The numbers of draws increase by a
    factor of about `GROWTH`. The lengths are examined from the whole run downwards until the first
    failure, so that a shorter length that passes by chance does not count. If the whole run fails, all attributes
    of the result are None.
    """
    walkers = walkers_of(trace)
    steps = trace["posterior"].sizes["draw"] // walkers
    solves, before = solves_by_step(trace).sum(axis=0), float(_solves(trace, "warmup_sample_stats").sum())
    attrs, before_s = trace.attrs, float(trace.attrs["warmup_wall_s"])
    step_s = (float(attrs["wall_s"]) - before_s) / steps
    chains, needed = trace["posterior"].sizes["chain"] * walkers, Needed()
    for length in map(int, lengths_up_to(steps, GROWTH, SHORTEST)[::-1]):
        if not passes(shorten_trace(trace, length * walkers)):
            break
        total, drawing_s = float(solves[length - 1]), step_s * length
        with_warmup = chains * (int(attrs["warmup"]) + length), total, before_s + drawing_s
        needed = Needed(length, *with_warmup, chains * length, total - before, drawing_s)
    return needed


class Pace(NamedTuple):
    """Number of solves that a run would need for an ESS of `ESS_LIMIT`, and the run's own smallest ESS."""

    solves: int
    ess: float


def solves_at_this_pace(trace: xr.DataTree) -> Pace | None:
    """Return the number of model solves that a run would need for an effective sample size of `ESS_LIMIT`.

    The number is extrapolated from the draws' smallest bulk or tail ESS, excluding the warm-up. An exact gradient
    counts as one solve. The result is None if that ESS is NaN. An ESS below `LEAST_ESS_OF_PACE` is too large an
    estimate, so the number is then a lower bound.
    """
    ess = float(summary(trace)[["ess_bulk", "ess_tail"]].to_numpy().min())
    solves = int(trace["sample_stats"]["n_solves"].sum())
    return Pace(round(solves * ESS_LIMIT / ess), ess) if ess > 0 else None


def solves_by_step(trace: xr.DataTree) -> FloatArray:
    """Return each chain's cumulative model solves at every retained step, shape (chains, steps).

    The solves in the warm-up are included.
    """
    kept, before = (_solves(trace, group) for group in ("sample_stats", "warmup_sample_stats"))
    kept = kept.reshape(len(kept), -1, walkers_of(trace)).sum(axis=2)
    return before.sum(axis=1, keepdims=True) + np.cumsum(kept, axis=1)


def _solves(trace: xr.DataTree, group: str) -> FloatArray:
    """Return the model solves of each draw in a group of the trace, shape (chains, draws)."""
    return in_solves(trace, *(array_of(trace, group, name) for name in ("n_solves", "n_gradients")))


def shorten_trace(trace: xr.DataTree, draws: int) -> xr.DataTree:
    """Return the first `draws` draws of a trace. Only the groups needed by the convergence checks are included."""
    import xarray as xr

    groups = {name: trace[name].to_dataset().isel(draw=slice(0, draws)) for name in ("posterior", "sample_stats")}
    short = xr.DataTree.from_dict(groups)
    short.attrs = dict(trace.attrs)
    return short


def lengths_up_to(total: int, growth: float, first: int) -> IntArray:
    """Return integers from `first` to `total` that increase by a factor of about `growth`.

    Return only `total` if it is not larger than `first`.
    """
    if total <= first:
        return np.array([total])
    count = int(np.ceil(np.log(total / first) / np.log(growth))) + 1
    return np.unique(np.geomspace(first, total, count).round().astype(int))
