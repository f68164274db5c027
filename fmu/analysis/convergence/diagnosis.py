"""The verdict on a run: converged or not, and why; whether the model fits; and samplers side by side."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.analysis.convergence.diagnostics import (
    autocorrelation_times_run,
    convergence_failures,
    rhat_over_walkers,
    summary,
)
from fmu.analysis.convergence.remedies import draws_to_come, required_ess
from fmu.analysis.information import information_warnings
from fmu.analysis.maxima.missed import compared, missed_places
from fmu.analysis.maxima.results import Maxima
from fmu.analysis.pairing_changes import jump_warnings
from fmu.analysis.prediction import bound_warnings, fit_warnings, search_warnings, shape_warnings
from fmu.analysis.repeatability import repeatability_warnings
from fmu.analysis.trace.reading import check_trace, has, parameter_names, walkers_of, with_group
from fmu.tables import data_frame

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.posterior.problem import UpdatingProblem


CONVERGED = "converged"
UNSEARCHED = (
    "judged by its own draws only, as no maxima are known: chains that agree cannot reveal a maximum that "
    "none of them visited; "
    "fmu.diagnose(trace, problem) searches for maxima"
)
GROUP = "maxima"
"""Group of a trace that keeps the maxima known when it was made."""


@dataclass(frozen=True)
class Diagnosis:
    """What can be said of a run.

    Attributes
    ----------
    converged : bool
        Whether nothing speaks against it.
    reasons : tuple of str
        Why not, one sentence each, the gravest first; empty if it has converged.
    warnings : tuple of str
        What speaks against the model, converged or not: parameters at their bounds, modes that are not fitted,
        shapes unlike the measured ones, a pairing that jumps; and what speaks of the data: parameters that they
        did not update, repeated tests that are not independent.
    searched : bool
        Whether maxima of the posterior were known. Without them a run that missed one may pass for converged.
    stopped : str
        How far a run came that was stopped before its end, in words; empty if it was not.
    """

    converged: bool
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]
    searched: bool = False
    stopped: str = ""

    @property
    def verdict(self) -> str:
        """``"converged"``, or ``"not converged: "`` and the first reason."""
        return CONVERGED if self.converged else f"not converged: {self.reasons[0]}"

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is to be said beside the verdict: the reasons, or what a good one does not cover."""
        said = (UNSEARCHED,) if self.converged and not self.searched else self.reasons
        return (*said, self.stopped) if self.stopped else said

    def __str__(self) -> str:
        lines = [CONVERGED if self.converged else "not converged", *(f"  - {remark}" for remark in self.remarks)]
        if self.warnings:
            lines += ["the model", *(f"  - {warning}" for warning in self.warnings)]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        def block(title: str, items: tuple[str, ...]) -> str:
            entries = "".join(f"<li>{html.escape(item)}</li>" for item in items)
            return f"<p><strong>{title}</strong></p>" + (f"<ul>{entries}</ul>" if entries else "")

        text = block(CONVERGED if self.converged else "not converged", self.remarks)
        return text + (block("the model", self.warnings) if self.warnings else "")


def diagnose(
    trace: xr.DataTree,
    problem: UpdatingProblem | None = None,
    others: Mapping[str, xr.DataTree] | Iterable[xr.DataTree] = (),
) -> Diagnosis:
    """Say whether a run has converged, and if not, why; and what speaks against the model.

    A run has converged where nothing speaks against it: the rule of
    `fmu.analysis.convergence.diagnostics.convergence_failures`, in which whatever is NaN fails; and no place that
    holds 1 % of the probability was left out. Such places are known from `find_map` and from other runs. Chains
    alone cannot tell: in one of several modes they agree with each other perfectly.

    Parameters
    ----------
    trace : xarray.DataTree
    problem : UpdatingProblem, optional
        What was sampled; its maxima are searched for. Those that the trace or the others keep are considered
        anyhow.
    others : mapping of str to xarray.DataTree, or iterable of xarray.DataTree, optional
        Other runs on the same posterior.

    Returns
    -------
    Diagnosis

    Raises
    ------
    ValueError
        If `trace` or one of `others` is no trace, or the problem or one of `others` has other parameters.
    """
    check_trace(trace)
    if problem is not None and tuple(problem.names) != parameter_names(trace):
        raise ValueError(
            f"problem: must have the parameters {parameter_names(trace)} (got {tuple(problem.names)})"
        )
    named = dict(others) if isinstance(others, Mapping) else {str(k): other for k, other in enumerate(others, 1)}
    for name, other in named.items():
        check_trace(other, f"others.{name}")
    known = [maxima_of(other) for other in (trace, *named.values())]
    if problem is not None:
        from fmu.analysis.maxima.search import find_map

        known.append(find_map(problem))
    return judge(trace, [maxima for maxima in known if maxima is not None], named)


def judge(
    trace: xr.DataTree,
    known: Iterable[Maxima] = (),
    others: Mapping[str, xr.DataTree] | None = None,
    table: pd.DataFrame | None = None,
) -> Diagnosis:
    """Give the verdict on a trace, with the maxima that are known.

    Parameters
    ----------
    trace : xarray.DataTree
    known : iterable of Maxima
        Results of `find_map` on the same posterior; of several, the one of the greatest mass counts.
    others : mapping of str to xarray.DataTree, optional
    table : pandas.DataFrame, optional
        ``summary(trace)``, where it is at hand.
    """
    best = max(known, key=lambda maxima: maxima.log_evidence, default=None)
    reasons, warnings = [], []
    if best is not None:
        against = compared(trace, best)
        reasons += against.reasons
        warnings += against.outweighed + search_warnings(trace, best[0].log_prob)
    reasons += missed_places(trace, others or {}, best)
    reasons += convergence_failures(trace, table)
    warnings += bound_warnings(trace) + fit_warnings(trace) + shape_warnings(trace) + jump_warnings(trace)
    warnings += information_warnings(trace) + repeatability_warnings(trace)
    steps = int(trace.attrs["draws"]) if not trace.attrs.get("complete", 1) else 0
    stopped = f"the run was stopped after {steps} draws and can be resumed" if steps else ""
    return Diagnosis(not reasons, tuple(reasons), tuple(warnings), searched=best is not None, stopped=stopped)


def diagnose_all(
    traces: Mapping[str, xr.DataTree],
    problem: UpdatingProblem | None = None,
    summaries: Mapping[str, pd.DataFrame] | None = None,
) -> dict[str, Diagnosis]:
    """Diagnose several runs, each with what the others on the same posterior know.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
    problem : UpdatingProblem, optional
        What was sampled, by all of them.
    summaries : mapping of str to pandas.DataFrame, optional
        ``summary(trace)`` of each, where they are at hand.
    """
    searched = []
    if problem is not None:
        from fmu.analysis.maxima.search import find_map

        searched.append(find_map(problem))
    found = {}
    for name, trace in traces.items():
        others = {key: other for key, other in traces.items() if key != name and _same_posterior(trace, other)}
        kept = [maxima_of(other) for other in (trace, *others.values())]
        known = searched + [maxima for maxima in kept if maxima is not None]
        found[name] = judge(trace, known, others, None if summaries is None else summaries[name])
    return found


def is_enough(found: Diagnosis, table: pd.DataFrame, until_ess: float) -> bool:
    """Say whether a run has converged and every ESS of its summary is at least `until_ess`; NaN is not."""
    return found.converged and bool(table[["ess_bulk", "ess_tail"]].to_numpy().min() >= until_ess)


def draws_missing(trace: xr.DataTree, until_ess: float | None, maxima: Maxima | None) -> int:
    """Return how many steps to draw before a run is looked at again; 0 if it needs no more.

    Parameters
    ----------
    trace : xarray.DataTree
    until_ess : float, optional
        Bulk and tail ESS that every parameter is to have, beside a good verdict; if not given, nothing is missing.
    maxima : Maxima, optional
    """
    if until_ess is None:
        return 0
    table = summary(trace)
    if is_enough(judge(trace, [] if maxima is None else [maxima], table=table), table, until_ess):
        return 0
    required = max(until_ess, required_ess(trace["posterior"].sizes["chain"]))
    ensembles = walkers_of(trace) > 1
    lengths = autocorrelation_times_run(trace) if ensembles else None
    walker_rhat = rhat_over_walkers(trace) if ensembles else None
    return draws_to_come(int(trace.attrs["draws"]), table, required, lengths, walker_rhat)


def _same_posterior(one: xr.DataTree, other: xr.DataTree) -> bool:
    """Say whether two traces come from one posterior, as their configurations have it."""
    first, second = (json.loads(trace.attrs["configuration"])["problem"] for trace in (one, other))
    return bool(first == second)


def maxima_of(trace: xr.DataTree) -> Maxima | None:
    """Return the maxima that a trace keeps, None if it keeps none."""
    return Maxima.from_dataset(trace[GROUP].to_dataset()) if has(trace, GROUP) else None


def with_maxima(trace: xr.DataTree, maxima: Maxima) -> xr.DataTree:
    """Return the trace with the maxima kept in it, so that every later verdict on it knows of them."""
    return with_group(trace, GROUP, maxima.to_dataset())


def compare(traces: Mapping[str, xr.DataTree], problem: UpdatingProblem | None = None) -> pd.DataFrame:
    """Compare the traces of several samplers on one problem.

    What a sampler costs is what its user waits for: ``n_solves``, ``n_gradients`` and ``wall_s`` count the warm-up
    in, and so do ``ess_per_solve`` and ``ess_per_s``. The counts without it are attributes of each trace.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        Traces under the names that the rows shall have.
    problem : UpdatingProblem, optional
        What was sampled. Its maxima are searched for, and a run that left out one that matters has not converged.
        Maxima that a trace keeps, and what the other runs on the same posterior found, count without it too.

    Returns
    -------
    pandas.DataFrame
        One row a sampler:

        - ``verdict``: ``"converged"``, or ``"not converged: "`` and the first reason of `fmu.diagnose`;
        - ``rhat_max``, ``ess_bulk_min``, ``ess_tail_min``: of the worst parameter, NaN if one is NaN;
        - ``mcse_over_sd_max``: largest standard error of a posterior mean over the posterior's sd;
        - ``accept_rate``: share of the retained draws that left the previous position;
        - ``divergences``: retained draws whose trajectory diverged, missing for samplers without trajectories;
        - ``n_solves``, ``n_gradients``, ``wall_s``: cost, warm-up included;
        - ``ess_per_solve``, ``ess_per_s``: the smallest bulk ESS per solve and per second of that cost.

    Raises
    ------
    ValueError
        If `traces` is empty or holds something else than traces.
    """
    if not isinstance(traces, Mapping) or not traces:
        raise ValueError(f"traces: must be a mapping of at least one name to a trace (got {traces!r:.60})")
    for name, trace in traces.items():
        check_trace(trace, f"traces.{name}")
    summaries = {name: summary(trace) for name, trace in traces.items()}
    return side_by_side(traces, summaries, diagnose_all(traces, problem, summaries))


def side_by_side(
    traces: Mapping[str, xr.DataTree], summaries: Mapping[str, pd.DataFrame], verdicts: Mapping[str, Diagnosis]
) -> pd.DataFrame:
    """Return the table of `compare`, where summaries and verdicts are at hand."""
    rows = [_row(trace, summaries[name], verdicts[name]) for name, trace in traces.items()]
    table = data_frame(rows, "sampler", list(traces))
    table["divergences"] = table["divergences"].astype("Int64")
    return table


def _row(trace: xr.DataTree, table: pd.DataFrame, diagnosis: Diagnosis) -> dict[str, Any]:
    """Return one row of the comparison."""
    import pandas as pd

    stats = trace["sample_stats"]
    # to_numpy(), because pandas skips NaN where a NaN must win.
    ess = float(np.min(table["ess_bulk"].to_numpy()))
    solves, gradients = (
        int(trace.attrs[name]) + int(trace.attrs[f"warmup_{name}"]) for name in ("n_solves", "n_gradients")
    )
    wall_s = float(trace.attrs["wall_s"])
    return {
        "verdict": diagnosis.verdict,
        "rhat_max": float(np.max(table["rhat"].to_numpy())),
        "ess_bulk_min": ess,
        "ess_tail_min": float(np.min(table["ess_tail"].to_numpy())),
        "mcse_over_sd_max": float(np.max((table["mcse_mean"] / table["sd"]).to_numpy())),
        "accept_rate": float(stats["accepted"].mean()),
        "divergences": int(stats["diverging"].sum()) if "diverging" in stats else pd.NA,
        "n_solves": solves,
        "n_gradients": gradients,
        "wall_s": wall_s,
        "ess_per_solve": ess / solves if solves else np.nan,
        "ess_per_s": ess / wall_s if wall_s > 0 else np.nan,
    }
