"""Report sections and verdicts that compare samplers of one posterior, with costs relative to those of emcee."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence.agreement import Agreement, agreement
from fmu.analysis.convergence.comparison import (
    COUNTED,
    about_solves,
    at_both_points,
    costs_side_by_side,
    over_baseline,
)
from fmu.analysis.convergence.growth import Growth, growth
from fmu.analysis.convergence.remedies import LEAST_ESS, RHAT_LIMIT
from fmu.numbers import decimals, fixed, interval, names_in_words, significant
from fmu.report.document import (
    Details,
    Link,
    Omitted,
    PageSection,
    PageTable,
    Picture,
    Pictures,
    Text,
    Verdict,
    picture,
)
from fmu.report.plots.chains import plot_traces
from fmu.report.plots.samplers import plot_forest, plot_growth, plot_overlaid_marginals, plot_ranks_of_samplers
from fmu.report.plots.style import NARROW, height_of_row, new_figure
from fmu.report.run import ReportedRun
from fmu.report.sections.chains import LOOK_AT_PATHS
from fmu.samplers.registry import BASELINE

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


@dataclass(frozen=True, eq=False)
class Compared:
    """Several runs on one posterior, with comparisons that several sections use.

    Attributes
    ----------
    runs : mapping of str to ReportedRun
    grown : mapping of str to Growth
        Each run's R-hat and effective sample size as the run grew.
    costs : pandas.DataFrame
        The result of ``costs_side_by_side`` for the runs.
    agreed : Agreement
        How well the posterior estimates agree.
    """

    runs: Mapping[str, ReportedRun]
    grown: Mapping[str, Growth]
    costs: pd.DataFrame
    agreed: Agreement

    @classmethod
    def of(cls, runs: Mapping[str, ReportedRun]) -> Compared:
        """Compare the given runs and return all comparisons as a `Compared`."""
        traces = {name: run.trace for name, run in runs.items()}
        grown = {name: growth(trace) for name, trace in traces.items()}
        agreed = agreement(traces, {name: run.summary for name, run in runs.items()})
        return cls(runs, grown, costs_side_by_side(traces, grown), agreed)

    @property
    def traces(self) -> dict[str, xr.DataTree]:
        """Each run's trace, keyed by run name."""
        return {name: run.trace for name, run in self.runs.items()}

    @property
    def summaries(self) -> dict[str, pd.DataFrame]:
        """Each run's summary, keyed by run name."""
        return {name: run.summary for name, run in self.runs.items()}


def verdicts_on_samplers(found: Compared) -> tuple[Verdict, ...]:
    """Return three verdicts: whether the samplers agree, whether they converged, and their costs."""
    runs, agreed = found.runs, found.agreed
    answer = {True: "Yes", False: "No", None: "Not known"}[agreed.agrees]
    failed = [run for run in runs.values() if not run.diagnosis.converged]
    good = len(runs) - len(failed)
    converged = "All converged" if not failed else f"{good} of {len(runs)} converged" if good else "None converged"
    reasons = tuple(f"{run.title}: {run.diagnosis.verdict}" for run in failed)
    return (
        Verdict("Do the samplers agree?", answer, agreed.agrees, "Agreement" if agreed.agrees is None else "",
                said=agreed.sentence),
        Verdict("Can the runs be trusted?", converged, not failed, because="Not converged", reasons=reasons),
        _cost(found),
    )  # fmt: skip


def _cost(found: Compared) -> Verdict:
    """Return the verdict on how many model solves each sampler needed to meet the convergence criterion.

    The sampler that needed the fewest solves comes first. Samplers that did not meet the criterion are left out.
    If no sampler met it, the verdict says so.
    """
    costs = found.costs.sort_values("criterion_solves")
    met = [(str(name), float(x)) for name, x in costs["criterion_solves"].items() if not np.isnan(x)]
    question = "What did they cost?"
    if not met:
        return Verdict(question, "No sampler met the criterion", None)
    answer = ", ".join(f"{name} {about_solves(solves)}" for name, solves in met)
    per = [
        f"{name} {over_baseline(float(x))}" for name, x in costs["per_ess_over_baseline"].items()
        if not np.isnan(x) and name != BASELINE
    ]  # fmt: skip
    said = f"Model solves to R-hat below {RHAT_LIMIT} and ESS of {LEAST_ESS}, search and warm-up counted."
    said += f" Per effective draw, over {BASELINE}: {', '.join(per)}." * bool(per)
    return Verdict(question, answer, None, said=said)


def posterior(found: Compared) -> PageSection:
    """Return the section on the samplers' posterior estimates, and on how their effective sample sizes grew."""
    runs, traces = found.runs, found.traces
    seen = "; ".join(f"{row[0]} {', '.join(row[2:])} {row[1]}".rstrip() for row in _means(runs))
    forest = picture(
        plot_forest(traces, found.summaries), "forest", f"Means and 90 % intervals of {', '.join(runs)}: {seen}.",
        "Means with 50 % and 90 % intervals; R-hat, bulk and tail ESS. Look for means apart in units of the bars.",
    )  # fmt: skip
    met = found.costs["criterion_solves"]
    solves = "; ".join(
        f"{name} {about_solves(float(met[name]))}, {fixed(float(one.ess[-1]), 0)} effective draws at its end"
        for name, one in found.grown.items()
    )
    search = float(found.costs["search_solves"].iloc[0])
    grown = picture(
        plot_growth(traces, found.grown, search), "growth", f"Solves to the criterion: {solves}.",
        "Effective draws of the worst parameter over model solves, as the runs grew. Dot: criterion first met.",
    )  # fmt: skip
    parts = Pictures((forest, grown)), _means_table(runs)
    return PageSection("posterior", "The posterior by every sampler", parts)


def costs(found: Compared, pages: Mapping[str, str]) -> PageSection:
    """Return the section with each run's verdict, reliability and cost, and a link to its page."""
    rows = []
    for name, run in found.runs.items():
        cost, of = {column: float(found.costs[column][name]) for column in found.costs}, run.costs
        rows.append((
            Link(f"{run.title}{_is_baseline(run)}", pages[name]),
            run.diagnosis.state,
            about_solves(cost["criterion_solves"]), over_baseline(cost["criterion_over_baseline"]),
            significant(cost["solves_per_ess"]), over_baseline(cost["per_ess_over_baseline"]),
            about_solves(cost["total_solves"]), fixed(float(of["rhat_max"]), 4),
            fixed(float(of["ess_bulk_min"]), 0), fixed(float(of["ess_tail_min"]), 0),
            fixed(float(of["wall_s"]), 1),
        ))  # fmt: skip
    header = (
        "sampler", "verdict", "to the criterion", f"/ {BASELINE}", "per eff. draw", f"/ {BASELINE}", "whole run",
        "R-hat", "bulk ESS", "tail ESS", "time, s",
    )  # fmt: skip
    search = about_solves(float(found.costs["search_solves"].iloc[0]))
    caption = (
        f"{COUNTED} The search took {search} solves, which all share. Per effective draw: after warm-up. R-hat "
        f"and ESS at the end of the run, of the worst parameter. {_gradients(found.runs)}"
    )
    converged = {name: run.diagnosis.converged for name, run in found.runs.items()}
    said = at_both_points(found.costs, converged, found.traces)
    table = PageTable(caption, header, tuple(rows), words=(1,))
    return PageSection("costs", "What each sampler cost", (table, *((Text(said),) if said else ())))


def _is_baseline(run: ReportedRun) -> str:
    return ", the baseline" if run.trace.attrs["sampler"] == BASELINE else ""


def _gradients(runs: Mapping[str, ReportedRun]) -> str:
    """Return a sentence on the cost of an exact gradient in solves; empty if no run has a gradient cost."""
    known = {run.title: float(run.costs["gradient_cost"]) for run in runs.values()}
    listed = ", ".join(f"{significant(cost, 2)} ({title})" for title, cost in known.items() if not np.isnan(cost))
    return f"An exact gradient costs as much as so many solves: {listed}." * bool(listed)


def marginals(found: Compared) -> PageSection | Omitted:
    """Return the section on the samplers' posterior densities and on the ranks of their draws.

    Return `Omitted` if there is only one sampler.
    """
    title, runs = "Marginals and ranks", found.runs
    if len(runs) < 2:
        return Omitted(title, "there is one sampler")
    axes = plot_ranks_of_samplers(found.traces, found.summaries)
    far = [
        max(float(np.max(np.abs(line.get_ydata()))) for line in axis.lines if len(line.get_xdata()))
        for axis in axes
    ]
    names = next(iter(runs.values())).names
    furthest = ", ".join(f"{name} {fixed(x, 2)}" for name, x in zip(names, far, strict=True))
    ranks = picture(
        axes, "ranks", f"Rank plots of {names_in_words(list(runs))}. Largest distance from uniform: {furthest}.",
        "Ranks of each sampler's draws among those of all: difference of their distribution from a uniform one, "
        "with the p-value of a test. Look for p below 0.01: samplers that do not draw from the same distribution.",
    )  # fmt: skip
    means = "; ".join(
        f"{name} " + ", ".join(significant(run.value(name, "mean"), 4) for run in runs.values()) for name in names
    )
    densities = picture(
        plot_overlaid_marginals(found.traces), "densities", f"Densities by {names_in_words(list(runs))}: {means}.",
        "Posterior densities, one over the other. Look for curves that differ in place or width.",
    )  # fmt: skip
    return PageSection("marginals", title, (Pictures((densities, ranks)),))


def paths(found: Compared) -> PageSection:
    """Return the section with every sampler's trace plots."""
    return PageSection(
        "paths", "Trace plots", (Text(LOOK_AT_PATHS), Pictures(tuple(map(_paths, found.runs.values()))))
    )


def _paths(run: ReportedRun) -> Picture:
    figure = new_figure(NARROW, height_of_row(len(run.names)) * len(run.names) + 0.9)
    worst = fixed(float(run.summary["rhat"].max()), 4)
    axes = plot_traces({"": run.trace}, figure=figure)
    return picture(
        axes,
        f"paths-{run.name}",
        f"Paths of {run.title}, {run.chains_in_words}. R-hat at most {worst}.",
        f"{run.title}.",
    )


def _means(runs: Mapping[str, ReportedRun]) -> list[tuple[str, ...]]:
    """Return one table row per parameter: its name, its unit, and each sampler's mean with its 90 % interval."""
    first, rows = next(iter(runs.values())), []
    for name in first.names:
        n = decimals(min(run.value(name, "sd") for run in runs.values()))
        cells = []
        for run in runs.values():
            mean, low, high = (run.value(name, column) for column in ("mean", "eti90_lb", "eti90_ub"))
            cells.append(f"{fixed(mean, n)} ({interval(low, high, n)})")
        rows.append((name, first.unit(name).name, *cells))
    return rows


def _means_table(runs: Mapping[str, ReportedRun]) -> Details:
    """Return the table of every sampler's posterior means, which is hidden until the reader opens it."""
    titles = (run.title for run in runs.values())
    words = "Posterior means and 90 % intervals"
    return Details(
        f"{words} in numbers", (PageTable(words, ("parameter", "unit", *titles), tuple(_means(runs)), (1,)),)
    )
