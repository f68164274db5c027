"""Samplers side by side."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np
import pandas as pd

from fmu.numbers import decimals, fixed, interval, significant, whole
from fmu.report.document import Items, Link, PageSection, PageTable, Pictures, Text, picture
from fmu.report.plots.parameters import plot_efficiency, plot_parameter_updates
from fmu.report.run import ReportedRun

CLOSE = 4.0
"""Differences of means of converged runs below so many standard errors are chance: 1 in 16 000 goes beyond."""


def overview(runs: Mapping[str, ReportedRun], pages: Mapping[str, str]) -> PageSection:
    """Return verdict, reliability and cost of each run, its name leading to its page."""
    rows = []
    for name, run in runs.items():
        costs = run.costs
        rows.append((
            Link(run.title, pages[name]), "converged" if run.diagnosis.converged else "not converged",
            fixed(float(costs["rhat_max"]), 4), fixed(float(costs["ess_bulk_min"]), 0),
            fixed(float(costs["ess_tail_min"]), 0), whole(costs["n_solves"]), fixed(float(costs["wall_s"]), 1),
            significant(1000 * float(costs["ess_per_solve"])), significant(float(costs["ess_per_s"])),
        ))  # fmt: skip
    header = (
        "sampler", "verdict", "R-hat", "bulk ESS", "tail ESS", "solves", "time, s", "ESS / 1000 solves", "ESS / s"
    )  # fmt: skip
    caption = (
        "R-hat and ESS of the worst parameter; model solves and time with the warm-up. "
        f"{_gradients(runs)}The ESS of a run that has not converged is not reliable."
    )
    return PageSection("overview", "Samplers side by side", (PageTable(caption, header, tuple(rows), words=(1,)),))


def _gradients(runs: Mapping[str, ReportedRun]) -> str:
    """Say how many solves an exact gradient counts as in ESS per solve; empty if none was taken."""
    costs = {run.title: float(run.costs["gradient_cost"]) for run in runs.values()}
    listed = ", ".join(
        f"{significant(cost, 2)} solves ({title})" for title, cost in costs.items() if not np.isnan(cost)
    )
    if not listed:
        return ""
    return f"An exact gradient costs as much as {listed} and is counted so. "


def efficiency(runs: Mapping[str, ReportedRun]) -> PageSection:
    """Return effective draws per solve."""
    seen = ", ".join(
        f"{run.title} {significant(1000 * float(run.costs['ess_per_solve']))}"
        + ("" if run.diagnosis.converged else " (not converged)")
        for run in runs.values()
    )
    costs = pd.DataFrame({name: run.costs for name, run in runs.items()}).T.infer_objects()
    axes = plot_efficiency({name: run.trace for name, run in runs.items()}, costs)
    alt = f"Effective draws per 1000 model solves: {seen}."
    caption = (
        f"Effective draws of the worst parameter per 1000 model solves, warm-up included. {_gradients(runs)}"
        "Outline only: not converged."
    )
    return PageSection("efficiency", "Efficiency", (Pictures((picture(axes, "efficiency", alt, caption),)),))


def agreement(runs: Mapping[str, ReportedRun]) -> PageSection:
    """Return the posterior means side by side, and whether converged runs agree."""
    first = next(iter(runs.values()))
    rows = []
    for name in first.names:
        n = decimals(min(run.value(name, "sd") for run in runs.values()))
        cells = []
        for run in runs.values():
            mean, low, high = (run.value(name, column) for column in ("mean", "eti90_lb", "eti90_ub"))
            cells.append(f"{fixed(mean, n)} ({interval(low, high, n)})")
        rows.append((name, first.unit(name).name, *cells))
    titled = {run.title: run for run in runs.values()}
    table = PageTable(
        "Posterior means and 90 % intervals", ("parameter", "unit", *titled), tuple(rows), words=(1,)
    )
    axes = plot_parameter_updates(
        {title: run.trace for title, run in titled.items()},
        summaries={title: run.summary for title, run in titled.items()},
    )
    seen = "; ".join(f"{name} {', '.join(cells)} {unit}".rstrip() for name, unit, *cells in rows)
    alt = f"Posterior means and intervals of {', '.join(titled)}: {seen}."
    drawing = picture(axes, "means", alt, "Posterior means and 90 % intervals between the bounds.")
    if len(runs) == 1:
        return PageSection("agreement", "Posterior means", (table, Pictures((drawing,))))
    return PageSection("agreement", "Do the samplers agree?", (_judgement(runs), table, Pictures((drawing,))))


def _judgement(runs: Mapping[str, ReportedRun]) -> Text | Items:
    """Say by how many standard errors the means of the converged runs differ."""
    converged = [run for run in runs.values() if run.diagnosis.converged]
    if len(converged) < 2:
        few = "None of the samplers" if not converged else f"Only {converged[0].title}"
        return Text(f"{few} has converged, so the samplers cannot be compared yet.")
    said, furthest = [], 0.0
    for one, other in combinations(converged, 2):
        difference = (one.summary["mean"] - other.summary["mean"]).abs().to_numpy()
        ratio = difference / np.hypot(*(run.summary["mcse_mean"].to_numpy() for run in (one, other)))
        k = int(np.argmax(ratio))
        furthest = max(furthest, float(ratio[k]))
        sds = difference[k] / one.summary["sd"].to_numpy()[k]
        said.append(
            f"{one.title} and {other.title}: at most {fixed(ratio[k], 1)} standard errors of the difference "
            f"apart, {significant(sds, 2)} posterior sd, in {one.names[k]}."
        )
    if furthest < CLOSE:
        return Items(("The converged runs agree.", *said))
    return Items(("Converged runs differ by more than chance: at least one is wrong.", *said))
