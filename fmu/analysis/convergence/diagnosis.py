"""The verdict on a run: whether it converged and, if not, why not; and whether the model fits the data."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.certificate import certificate_failures
from fmu.analysis.convergence.candidates import growth_for_candidates
from fmu.analysis.convergence.diagnostics import (
    autocorrelation_times_run,
    convergence_failures,
    few_ensembles,
    is_beyond_draws,
    summary_for_verdict,
)
from fmu.analysis.convergence.remedies import (
    MIN_AUTOCORRELATION_TIMES,
    RELIABLE_ESS,
    Places,
    draws_to_come,
    fewest,
    growth_needed,
    required_ess,
    rhat_excess,
)
from fmu.analysis.fit.deviations import deviation_warnings
from fmu.analysis.fit.measured_shapes import sensor_warnings, shape_warnings
from fmu.analysis.fit.model_fit import ModelFit, model_fit
from fmu.analysis.held_out.modes import left_out_warnings
from fmu.analysis.information import information_warnings
from fmu.analysis.maxima import search
from fmu.analysis.maxima.missed import Comparison, check_parameters, compare_shares, missed_places
from fmu.analysis.maxima.results import NEGLIGIBLE, TYPICAL_POINT, Maxima
from fmu.analysis.pairing_changes import jump_warnings
from fmu.analysis.prediction import bound_warnings, search_warnings
from fmu.analysis.repeatability import repeatability_warnings
from fmu.analysis.trace.provenance import check_problem
from fmu.analysis.trace.reading import array_of, check_trace, has, walkers_of, with_group
from fmu.arguments import check_arguments
from fmu.plain_data import mapping_in

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.posterior.problem import UpdatingProblem
    from fmu.types import LogDensity


CONVERGED, LOCALLY, NOT_CONVERGED = "converged", "converged locally", "not converged"
NOTES = "notes on the model and the data"
UNSEARCHED = (
    "judged by its own draws only, as no maxima are known: chains that agree cannot reveal a maximum that "
    "none of them visited; fmu.diagnose(trace, problem) searches for maxima"
)
POPULATION = (
    "judged by its own draws only: the maximum of a population is far from its mass and was not searched for, and "
    "chains that agree cannot reveal a part that none of them visited"
)
_SPARSE = (
    "but the points searched are too far apart to meet a mode as narrow as these draws: give narrower bounds or a "
    "prior, or search more, maxima=fmu.find_map(density, starts=1000)"
)
GROUP = "maxima"
"""Name of the trace group that stores the maxima known when the trace was made."""


@dataclass(frozen=True)
class Diagnosis:
    """The verdict on a run.

    Attributes
    ----------
    converged : bool
        Whether the run has converged, that is, whether there are no `reasons`.
    reasons : tuple of str
        Why the run has not converged, one sentence per reason: maxima missed or visited out of proportion first,
        then failed tests of the draws, then an invalid certificate. Empty if it has converged.
    warnings : tuple of str
        Warnings about the model and the data, whether or not the run converged: failed model checks (`fit`),
        parameters at their bounds, mode shapes unlike the measured ones, a pairing that jumps, parameters that the
        data did not update, repeated tests that are not independent, doubtful masses of maxima, and so on.
    doubts_of_search : tuple of str
        Why there may be maxima that no chain visited, one sentence per reason; empty if the search for maxima was
        complete. A run that misses a maximum can pass all tests, so with any of these doubts it has converged only
        locally.
    search : str
        For a plain log-density: where the search began and what it found. Otherwise empty.
    stopped : str
        If the run was stopped or ended at a limit: the number of draws or the limit, in words. Otherwise empty.
    fit : ModelFit
        Whether the data contradict the model, and which checks could have failed; provisional if the run has not
        converged.
    few : str
        A warning that fewer than four plain emcee ensembles cannot exclude separate modes, with the remedy.
        Otherwise empty.
    """

    converged: bool
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]
    doubts_of_search: tuple[str, ...] = (UNSEARCHED,)
    search: str = ""
    stopped: str = ""
    fit: ModelFit = field(default_factory=lambda: ModelFit((), 0, 0), repr=False)
    few: str = ""

    @property
    def searched(self) -> bool:
        """Whether the search for maxima left no doubt that the chains visited all of them."""
        return not self.doubts_of_search

    @property
    def state(self) -> str:
        """``"converged"``, ``"converged locally"`` if other maxima are not excluded, or ``"not converged"``."""
        if not self.converged:
            return NOT_CONVERGED
        return CONVERGED if self.searched else LOCALLY

    @property
    def verdict(self) -> str:
        """The `state`, followed by the first reason if the run has not converged."""
        return self.state if self.converged else f"{self.state}: {self.reasons[0]}"

    @property
    def remarks(self) -> tuple[str, ...]:
        """The sentences to show below the `state`.

        If the run has not converged, these are the reasons. If it has, they are the doubts about the search for
        maxima or, without doubts, its result; both are left out if `few` is not empty. `few` and `stopped` follow.
        """
        said = self.reasons
        if self.converged and not self.few:
            said = self.doubts_of_search or ((self.search,) if self.search else ())
        return (*said, *(more for more in (self.few, self.stopped) if more))

    @property
    def notes(self) -> tuple[str, ...]:
        """Warnings other than failed model checks."""
        return tuple(warning for warning in self.warnings if warning not in self.fit.against)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Reasons to distrust probabilities computed from the draws: no convergence, or a contradicted model."""
        unfinished = () if self.converged else ("the draws have not converged",)
        return (*unfinished, f"the model is {self.fit.answer}") if self.fit.against else unfinished

    def __str__(self) -> str:
        lines = [self.state, *(f"  - {remark}" for remark in self.remarks)]
        for title, items in self._of_model():
            lines += [title, *(f"  - {item}" for item in items)]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        def block(title: str, items: tuple[str, ...]) -> str:
            entries = "".join(f"<li>{html.escape(item)}</li>" for item in items)
            return f"<p><strong>{title}</strong></p>" + (f"<ul>{entries}</ul>" if entries else "")

        blocks = [(self.state, self.remarks), *self._of_model()]
        return "".join(block(*one) for one in blocks)

    def _of_model(self) -> list[tuple[str, tuple[str, ...]]]:
        """Return pairs of a heading and its sentences: the verdict on the model and the notes, if any."""
        doubt = "" if self.converged else ", provisionally"
        blocks = [(f"the model: {self.fit.answer}{doubt}", self.fit.said)] if self.fit.checks else []
        return blocks + ([(NOTES, self.notes)] if self.notes else [])


@check_arguments
def diagnose(
    trace: xr.DataTree,
    problem: LogDensity | None = None,
    others: Mapping[str, xr.DataTree] | Iterable[xr.DataTree] = (),
) -> Diagnosis:
    """Judge whether a run has converged and whether the model fits the data, with reasons.

    A run has converged if it passes the tests in `fmu.analysis.convergence.diagnostics.convergence_failures`, has
    missed no region with more than 1 % of the probability, has visited the known maxima roughly in proportion to
    their mass and, with a surrogate, has a valid certificate or draws made exact by delayed acceptance. Missed
    regions are known from `find_map` and other runs. Chains that all stay in one mode agree and reveal no other.

    Parameters
    ----------
    trace : xarray.DataTree
    problem : LogDensity, optional
        The problem or density that was sampled. If given, `find_map` is run on it, unless it is hierarchical.
        Maxima stored in the traces are always used.
    others : mapping of str to xarray.DataTree, or iterable of xarray.DataTree, optional
        Other runs on the same posterior.

    Returns
    -------
    Diagnosis

    Raises
    ------
    ValueError
        If `trace` or one of `others` is not a trace, `problem` or one of `others` has different parameters,
        `problem` has another posterior, such as one with other data, or its log-density is finite at no starting
        point of `find_map`.
    """
    check_trace(trace)
    check_problem(problem, trace)
    named = mapping_in(others) or {str(k): other for k, other in enumerate(others, 1)}
    for name, other in named.items():
        check_trace(other, f"others.{name}")
    check_parameters(trace, named)
    return judge(trace, _kept_maxima(trace, named) + _search(problem), named)


def _kept_maxima(trace: xr.DataTree, others: Mapping[str, xr.DataTree]) -> list[Maxima]:
    """Return the maxima that earlier searches found and stored in the traces."""
    return [maxima for maxima in map(maxima_of, (trace, *others.values())) if maxima is not None]


def judge(
    trace: xr.DataTree,
    known: Iterable[Maxima] = (),
    others: Mapping[str, xr.DataTree] | None = None,
    table: pd.DataFrame | None = None,
) -> Diagnosis:
    """Return the verdict on a trace, given the known maxima.

    Parameters
    ----------
    trace : xarray.DataTree
    known : iterable of Maxima
        Results of `find_map` on the same posterior; the result with the largest total mass is used.
    others : mapping of str to xarray.DataTree, optional
        Other runs on the same posterior.
    table : pandas.DataFrame, optional
        ``summary(trace)``, if already computed.
    """
    best = max(known, key=lambda maxima: maxima.log_evidence, default=None)
    reasons, warnings = _reasons(trace, best, others or {}, table)
    reasons += certificate_failures(trace.attrs)
    if best is not None and not best.search:
        warnings += search_warnings(trace, best[0].log_prob)
    fit = model_fit(trace)
    unlike = [warning for warning in shape_warnings(trace) if warning not in fit.against]
    warnings += [*fit.against, *bound_warnings(trace), *unlike, *sensor_warnings(trace), *jump_warnings(trace)]
    warnings += [*deviation_warnings(trace), *information_warnings(trace), *repeatability_warnings(trace)]
    warnings += left_out_warnings(trace)
    steps = int(trace.attrs["draws"]) if not trace.attrs.get("complete", 1) else 0
    stopped = f"the run was stopped after {steps} draws and can be resumed" if steps else ""
    if "limit" in trace.attrs:
        stopped = f"the run ended at its limit of {trace.attrs['limit']}{trace.attrs.get('beyond_limit', '')}"
    return Diagnosis(
        not reasons,
        tuple(reasons),
        tuple(warnings),
        doubts_of_search=doubts_of_search(trace, best),
        search="" if best is None else best.search,
        stopped=stopped,
        fit=fit,
        few=few_ensembles(trace),
    )


def doubts_of_search(trace: xr.DataTree, best: Maxima | None) -> tuple[str, ...]:
    """Return the reasons why there may be maxima that no chain visited, one sentence each, or an empty tuple.

    Parameters
    ----------
    trace : xarray.DataTree
    best : Maxima or None
        Result of the search for maxima; None if there was no search.
    """
    if best is None:
        started = json.loads(trace.attrs["configuration"])["run"].get("init")
        return (POPULATION if started == TYPICAL_POINT else UNSEARCHED,)
    if not best.search:
        return best.doubts
    doubts = best.doubts or ((f"{best.search}, {_SPARSE}",) if _is_above(trace, best.level) else ())
    return doubts + tuple(search_warnings(trace, best[0].log_prob))


def _is_above(trace: xr.DataTree, level: float) -> bool:
    """Return True if about nine tenths of the draws or more have a log-density above `level`."""
    return float(np.quantile(array_of(trace, "sample_stats", "lp"), 0.1)) > level


def _reasons(
    trace: xr.DataTree, best: Maxima | None, others: Mapping[str, xr.DataTree], table: pd.DataFrame | None
) -> tuple[list[str], list[str]]:
    """Return reasons against convergence, except the certificate's, and warnings on doubtful masses of maxima."""
    against = Comparison([], []) if best is None else compare_shares(trace, best)
    reasons = against.reasons + missed_places(trace, others, best)
    is_single = best is not None and sum(m.share > NEGLIGIBLE for m in best) == 1
    places: Places = "missed" if reasons else "one" if is_single else "unknown"
    return reasons + convergence_failures(trace, table, places), against.outweighed


def diagnose_all(
    traces: Mapping[str, xr.DataTree],
    problem: UpdatingProblem | None = None,
    summaries: Mapping[str, pd.DataFrame] | None = None,
) -> dict[str, Diagnosis]:
    """Return the verdicts on several runs, keyed by name. Each run is compared with the others on its posterior.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
    problem : UpdatingProblem, optional
        The problem that all of the runs sampled. If given, its maxima are searched for, unless it is hierarchical.
    summaries : mapping of str to pandas.DataFrame, optional
        ``summary(trace)`` of each trace, if already computed.
    """
    searched, found = _search(problem), {}
    for name, trace in traces.items():
        others = {key: other for key, other in traces.items() if key != name and _same_posterior(trace, other)}
        known = searched + _kept_maxima(trace, others)
        found[name] = judge(trace, known, others, None if summaries is None else summaries[name])
    return found


def _search(problem: LogDensity | None) -> list[Maxima]:
    """Return the maxima found by `find_map`, as a list.

    The list is empty if `problem` is None or hierarchical: the maximum of a hierarchical posterior lies far from
    its probability mass.
    """
    return [search.find_map(problem)] if problem is not None and search.is_searchable(problem) else []


def choose_run(verdicts: Mapping[str, Diagnosis], summaries: Mapping[str, pd.DataFrame]) -> str:
    """Return the name of the run with the largest ESS, chosen among the converged runs if there are any.

    If no sampler is named, this run supplies the verdict on the model, the damage (losses of the parameters) and
    the exported values. A run's ESS is the smallest bulk or tail ESS of its parameters; NaN ranks last. Ties are
    resolved alphabetically, so the order of the runs does not matter.

    Parameters
    ----------
    verdicts : mapping of str to Diagnosis
    summaries : mapping of str to pandas.DataFrame
        ``summary(trace)`` of each trace.
    """

    def rank(name: str) -> tuple[bool, float]:
        ess = fewest(summaries[name])
        return verdicts[name].converged, ess if np.isfinite(ess) else -np.inf

    return max(sorted(verdicts), key=rank)


def is_enough(found: Diagnosis, table: pd.DataFrame, until_ess: float) -> bool:
    """Return True if a run has converged and every bulk and tail ESS is at least `until_ess` (False for NaN)."""
    return found.converged and fewest(table) >= until_ess


def draws_missing(trace: xr.DataTree, until_ess: float, maxima: Maxima | None) -> int:
    """Return the number of steps to draw before a run is judged again.

    Return 0 if none are needed, or if divergences or heavy-tailed weights make more steps useless.

    Parameters
    ----------
    trace : xarray.DataTree
    until_ess : float
        Bulk and tail ESS required of every parameter, in addition to convergence.
    maxima : Maxima or None
        Known maxima of the posterior; None if they were not searched for.
    """
    draws = int(trace.attrs["draws"])
    if is_beyond_draws(trace):
        return 0
    if walkers_of(trace) > 1:  # ensembles: the length is fast to compute and usually the last to suffice
        growth = MIN_AUTOCORRELATION_TIMES / float(np.min(autocorrelation_times_run(trace)))
        if growth > 1:
            return draws_to_come(draws, growth)
    table = summary_for_verdict(trace)
    growth = growth_needed(table, max(until_ess, required_ess(trace["posterior"].sizes["chain"])))
    growth = max(growth, growth_for_candidates(trace))
    if not growth > 1 and not _reasons(trace, maxima, {}, table)[0]:
        return 0
    return draws_to_come(draws, growth, fewest(table) >= RELIABLE_ESS, rhat_excess(table))


def _same_posterior(one: xr.DataTree, other: xr.DataTree) -> bool:
    first, second = (json.loads(trace.attrs["configuration"])["problem"] for trace in (one, other))
    return bool(first == second)


def maxima_of(trace: xr.DataTree) -> Maxima | None:
    """Return the maxima stored in a trace, or None if it stores none."""
    return Maxima.from_dataset(trace[GROUP].to_dataset()) if has(trace, GROUP) else None


def with_maxima(trace: xr.DataTree, maxima: Maxima) -> xr.DataTree:
    """Return the trace with the maxima stored in it, so that every later verdict uses them."""
    return with_group(trace, GROUP, maxima.to_dataset())
