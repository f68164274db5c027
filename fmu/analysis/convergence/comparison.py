"""Compare samplers: their verdicts, errors and costs, with costs also relative to a baseline sampler."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fmu.analysis.convergence.diagnosis import Diagnosis, diagnose_all, maxima_of
from fmu.analysis.convergence.diagnostics import summary
from fmu.analysis.convergence.growth import Growth, growth, solves_to_criterion
from fmu.analysis.convergence.remedies import (
    LEAST_ESS,
    MIN_AUTOCORRELATION_TIMES,
    RHAT_LIMIT,
    WALKER_RHAT_LIMIT,
)
from fmu.analysis.trace.provenance import check_problem
from fmu.analysis.trace.reading import check_trace, in_solves, walkers_of
from fmu.arguments import ArgumentError, check_arguments
from fmu.numbers import MISSING, fixed, significant, whole
from fmu.samplers.registry import BASELINE
from fmu.tables import data_frame

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.posterior.problem import UpdatingProblem

COUNTED = (
    "Cost in model solves, everything counted: search for maxima, preparation, warm-up, draws; an exact gradient "
    f"counts as the solves that take as long. Criterion: R-hat below {RHAT_LIMIT}, bulk and tail ESS at least "
    f"{LEAST_ESS}, of every parameter. {BASELINE} is the baseline."
)
_ROWS = {
    "search_solves": "search, shared",
    "criterion_solves": "to the criterion",
    "criterion_over_baseline": f"  over {BASELINE}'s",
    "solves_per_ess": "per effective draw",
    "per_ess_over_baseline": f"  over {BASELINE}'s",
    "total_solves": "whole run",
}


@check_arguments
def compare(traces: Mapping[str, xr.DataTree], problem: UpdatingProblem | None = None) -> pd.DataFrame:
    """Compare the traces of several samplers on one problem.

    The costs ``n_solves``, ``n_gradients``, ``wall_s``, ``ess_per_solve`` and ``ess_per_s`` include the warm-up;
    the attributes of each trace give counts without it. In ``ess_per_solve`` a solve is one evaluation of the
    log-probability, and an exact gradient counts as ``gradient_cost`` solves.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        Traces keyed by row name.
    problem : UpdatingProblem, optional
        The problem that was sampled. If given, its maxima are searched for, unless it is hierarchical, and a run
        that missed an important maximum has not converged. Maxima stored in a trace, and regions that other runs
        on the same posterior found, are always used.

    Returns
    -------
    pandas.DataFrame
        One row per sampler:

        - ``verdict``: ``"converged"``, ``"converged locally"`` if other maxima are not excluded, or
          ``"not converged: "`` and the first reason of `fmu.diagnose`;
        - ``rhat_max``, ``ess_bulk_min``, ``ess_tail_min``: largest R-hat and smallest ESS of any parameter; NaN if
          one is NaN;
        - ``mcse_over_sd_max``: largest ratio of a posterior mean's standard error to the posterior sd;
        - ``accept_rate``: fraction of the retained draws that differ from the previous position, or emcee's
          acceptance fraction for an imported run that did not store all steps;
        - ``divergences``: retained draws whose trajectory diverged, missing for samplers without trajectories;
        - ``n_solves``, ``n_gradients``, ``wall_s``: cost, warm-up included. Each exact gradient is also counted in
          ``n_solves``. The time is NaN for an imported run;
        - ``gradient_cost``: time for an exact gradient divided by the time for a log-probability, measured at the
          end of the run; NaN if it was not measured, as in runs without exact gradients;
        - ``ess_per_solve``, ``ess_per_s``: the smallest bulk ESS per solve and per second of these costs; NaN if
          the cost is zero or unknown;
        - the columns of `costs_side_by_side`: solves until the convergence criterion was met, solves in total and
          solves per effective draw, the first and the last also relative to emcee.

    Raises
    ------
    ValueError
        If `traces` is empty or contains something other than traces, `problem` has other parameters or another
        posterior, or its log-density is finite at no starting point of the search for maxima.
    """
    if not traces:
        raise ArgumentError("traces", "must be a mapping of at least one name to a trace", f"{traces!r:.60}")
    for name, trace in traces.items():
        check_trace(trace, f"traces.{name}")
        check_problem(problem, trace, f"of {name}, ")
    return compare_runs(traces, problem).comparison.join(costs_side_by_side(traces))


class Judged(NamedTuple):
    """Summaries and verdicts of several runs on one posterior, keyed by name, and a table that compares them.

    The table has the columns of `compare` other than those of `costs_side_by_side`.
    """

    summaries: Mapping[str, pd.DataFrame]
    verdicts: dict[str, Diagnosis]
    comparison: pd.DataFrame


def compare_runs(
    traces: Mapping[str, xr.DataTree],
    problem: UpdatingProblem | None = None,
    summaries: Mapping[str, pd.DataFrame] | None = None,
) -> Judged:
    """Return the summaries, verdicts and comparison table of several runs.

    The arguments are those of `fmu.analysis.convergence.diagnosis.diagnose_all`.
    """
    summaries = summaries or {name: summary(trace) for name, trace in traces.items()}
    verdicts = diagnose_all(traces, problem, summaries)
    rows = [_row(trace, summaries[name], verdicts[name]) for name, trace in traces.items()]
    table = data_frame(rows, "sampler", list(traces))
    table["divergences"] = table["divergences"].astype("Int64")
    return Judged(summaries, verdicts, table)


def _row(trace: xr.DataTree, table: pd.DataFrame, diagnosis: Diagnosis) -> dict[str, object]:
    """Return one row of the comparison table as a dict that maps column names to values."""
    import pandas as pd

    stats = trace["sample_stats"]
    # to_numpy(), because pandas would skip a NaN, which must show.
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
        "gradient_cost": float(trace.attrs.get("gradient_cost", np.nan)),
        "wall_s": wall_s,
        "ess_per_solve": ess / in_solves(trace, solves, gradients) if solves else np.nan,
        "ess_per_s": ess / wall_s if wall_s > 0 else np.nan,
    }


def costs_side_by_side(
    traces: Mapping[str, xr.DataTree], grown: Mapping[str, Growth] | None = None
) -> pd.DataFrame:
    """Return the cost of each sampler in solves, both absolute and relative to the sampler `BASELINE`.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
    grown : mapping of str to Growth, optional
        ``growth(trace)`` of each trace, if already computed.

    Returns
    -------
    pandas.DataFrame
        One row per trace:

        - ``search_solves``: solves of the search for maxima, which all samplers share and which is part of each
          sampler's cost; zero if unknown;
        - ``criterion_solves``: search, warm-up and draws until R-hat of every parameter was below 1.01, and bulk
          and tail ESS were at least 400 and at least 100 per chain (test scores: R-hat below 1.05, any ESS); NaN
          if this was never reached;
        - ``total_solves``: search, warm-up and all draws; ``criterion_solves`` and ``total_solves`` include the
          solves that adapted the sampler to the maxima before the warm-up (``before_n_solves`` of the trace);
        - ``solves_per_ess``: solves after the warm-up per effective draw of the worst parameter; NaN if its ESS is
          undefined;
        - ``criterion_over_baseline``, ``per_ess_over_baseline``: ``criterion_solves`` and ``solves_per_ess``, each
          divided by the baseline's value; NaN without a baseline.
    """
    grown = {name: growth(trace) for name, trace in traces.items()} if grown is None else grown
    search = _search(traces)
    rows = []
    for name, trace in traces.items():
        warm = in_solves(trace, *(int(trace.attrs[f"warmup_{of}"]) for of in ("n_solves", "n_gradients")))
        total, ess = float(grown[name].solves[-1]), float(grown[name].ess[-1])
        first = search + float(trace.attrs.get("before_n_solves", 0))
        rows.append({
            "search_solves": search,
            "criterion_solves": first + solves_to_criterion(trace, grown[name]),
            "total_solves": first + total,
            "solves_per_ess": (total - warm) / ess if ess > 0 else np.nan,
        })  # fmt: skip
    samplers = [str(trace.attrs["sampler"]) for trace in traces.values()]
    unit = rows[samplers.index(BASELINE)] if BASELINE in samplers else dict.fromkeys(rows[0], np.nan)
    for row in rows:
        row["criterion_over_baseline"] = row["criterion_solves"] / unit["criterion_solves"]
        row["per_ess_over_baseline"] = row["solves_per_ess"] / unit["solves_per_ess"]
    return data_frame(rows, "sampler", list(traces))


def cost_rows(costs: pd.DataFrame) -> list[list[str]]:
    """Return the costs as rows of text: a label, then one cell per sampler. Rows that are all NaN are omitted."""
    rows = []
    for column, label in _ROWS.items():
        values = list(map(float, costs[column]))
        if not np.all(np.isnan(values)):
            is_ratio = column.endswith("over_baseline")
            rows.append([label, *(over_baseline(x) if is_ratio else about_solves(x) for x in values)])
    return rows


def at_both_points(costs: pd.DataFrame, converged: Mapping[str, bool], traces: Mapping[str, xr.DataTree]) -> str:
    """Return sentences that compare two costs of each ensemble sampler, in solves.

    One sentence per ensemble sampler states the cost at which R-hat and ESS met the criterion, the total cost, and
    whether the run had converged by its end (`converged`, keyed by name). A last sentence names the further tests
    of an ensemble. The text is empty if no trace is from an ensemble sampler.
    """
    said = []
    for name, trace in traces.items():
        if walkers_of(trace) == 1:
            continue
        first, total = (float(costs[of][name]) for of in ("criterion_solves", "total_solves"))
        met = (
            f"met the criterion after {about_solves(first)} solves" if first > 0 else "did not meet the criterion"
        )
        word = "had" if converged[name] else "had not"
        said.append(f"{name} {met}; it {word} converged after {about_solves(total)}.")
    if said:
        said.append(
            f"To converge, an ensemble must also be {MIN_AUTOCORRELATION_TIMES} autocorrelation times long and "
            f"have an R-hat over walkers below {WALKER_RHAT_LIMIT}."
        )
    return " ".join(said)


def over_baseline(ratio: float) -> str:
    """Format a cost ratio, for example as ``"0.85 ×"``; return a dash for NaN."""
    return MISSING if np.isnan(ratio) else f"{fixed(ratio, 2) if ratio < 10 else significant(ratio, 2)} ×"


def about_solves(solves: float) -> str:
    """Format a number of solves with three significant digits; return ``"not met"`` for NaN."""
    if np.isnan(solves):
        return "not met"
    return whole(round(solves, 2 - int(np.log10(solves)))) if solves >= 100 else significant(solves)


def _search(traces: Mapping[str, xr.DataTree]) -> float:
    """Return the cost of the search for maxima in solves, or 0 if no trace stores a search.

    Gradients are converted to solves at the cost measured in one of the runs, or count as one solve if no run
    measured it.
    """
    known = next((m for m in map(maxima_of, traces.values()) if m is not None), None)
    if known is None:
        return 0.0
    measured = [t for t in traces.values() if "gradient_cost" in t.attrs]
    return float(in_solves((measured or list(traces.values()))[0], known.n_solves, known.n_gradients))
