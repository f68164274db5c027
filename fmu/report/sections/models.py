"""Sections of the page that compares models of the same data, and verdicts on the best model and the misfit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.models.comparison import ModelComparison, common_modes
from fmu.analysis.models.scatter import Scatter, interval_ratios, ratio_words, scatter_words, scatters
from fmu.analysis.trace.reading import parameter_names
from fmu.numbers import MISSING, fixed, names_in_words, share, significant
from fmu.report.document import Items, Omitted, PageSection, PageTable, Pictures, Verdict, picture
from fmu.report.plots.models import plot_held_out, plot_intervals

if TYPE_CHECKING:
    import xarray as xr

_SURE = 0.95


def verdicts(found: ModelComparison, traces: Mapping[str, xr.DataTree]) -> tuple[Verdict, ...]:
    """Return the verdicts of the page that compares models.

    The first is on the most probable model, the second on the predictions of left-out modes. The third, on the
    parameters that scatter over the modes, is missing if no model has an inferred scatter.
    """
    table = found.table
    known = table["probability"].dropna()
    best = str(known.idxmax()) if len(known) else ""
    answer = f"{best}, probability {share(float(known[best]))}" if best else "Unknown"
    said = "By their evidences, if all were equally probable before the test."
    preferred = Verdict("Which model do the data prefer?", answer, None, said=said)
    n = int(table["held_out"].max())
    counts = ", ".join(f"{name} {int(table['inside'][name])}" for name in table.index if table["held_out"][name])
    left = Verdict(
        "How many of the modes left out are inside their 90 % intervals?",
        counts or "Unknown: no modes were left out",
        None,
        said=f"Of {n}; {significant(0.9 * n, 2)} are expected." if n else "",
    )
    return preferred, left, *_where(traces)


def _where(traces: Mapping[str, xr.DataTree]) -> tuple[Verdict, ...]:
    """Return a tuple with the verdict on which group of parameters scatters most over the modes.

    The tuple is empty if no model has an inferred scatter. The verdict is taken from the model with the most
    inferred scatters, and is stated as certain if its probability is at least 95 %. If this model has only one
    scatter, the verdict says whether the model needs it.
    """
    name, found = _most_scatters(traces)
    if not found:
        return ()
    if len(found) == 1:
        answer = f"{'Yes' if found[0].needed >= _SURE else 'Not shown'}, probability {share(found[0].needed)}"
        return (Verdict("Must the parameters scatter over the modes?", answer, None, said=f"By {name}."),)
    first = max(found, key=lambda one: one.largest)
    who = names_in_words(first.parameters)
    answer = who if first.largest >= _SURE else f"Not sure; the most probable: {who}, {share(first.largest)}"
    return (Verdict("Where does the misfit live?", answer, None, said=f"By {name}."),)


def _most_scatters(traces: Mapping[str, xr.DataTree]) -> tuple[str, tuple[Scatter, ...]]:
    """Return the name of the model with the most inferred scatters, together with these scatters."""
    every = {name: scatters(trace) for name, trace in traces.items()}
    name = max(every, key=lambda one: len(every[one]))
    return name, every[name]


def comparison(found: ModelComparison) -> PageSection:
    """Return the section with the table that compares the models."""
    caption = (
        "Models of the same measured data. Probability: if all models were equally probable before the test. "
        "z: the error of a mode predicted from the others, in standard deviations. elpd: the log-density of what "
        "was measured in these predictions, and its standard error over the modes."
    )
    rows = tuple(tuple(cells) for cells in found.rows())
    headings = tuple(found.headings)
    table = PageTable(caption, headings, rows, words=(len(headings) - 2,))
    return PageSection("models", "The models", (Items(found.sentences), table))


def held_out(traces: Mapping[str, xr.DataTree]) -> PageSection | Omitted:
    """Return the section with every model's prediction of each mode from the other modes.

    Models without these predictions are left out. Only modes that all remaining models predict are compared.
    Return `Omitted` if there are no such modes.
    """
    title, tables = "Each mode predicted from the others", common_modes(traces)
    if not tables or not len(next(iter(tables.values()))):
        return Omitted(title, "no mode was left out by all models")
    header = ["mode", "measured, Hz"]
    for name in tables:
        header += [f"{name}: 90 %, Hz", "off by, sd"]
    rows = []
    for mode in next(iter(tables.values())).index:
        cells = [str(mode), significant(float(next(iter(tables.values()))["measured"][mode]), 5)]
        for table in tables.values():
            row = table.loc[mode]
            cells += [
                f"{significant(row['eti90_lb'], 4)} to {significant(row['eti90_ub'], 4)}",
                fixed((row["measured"] - row["mean"]) / row["sd"], 1),
            ]
        rows.append(tuple(cells))
    caption = "Predictions of the measurement, noise and discrepancy included."
    errors = {name: 100 * (table["mean"] / table["measured"] - 1) for name, table in tables.items()}
    alt = "; ".join(f"{name}: {', '.join(fixed(x, 2) for x in error)} %" for name, error in errors.items())
    look = "Errors of each frequency predicted by the other modes. Look for bars that miss zero."
    drawing = picture(plot_held_out(tables), "held-out", f"Errors of the predictions. {alt}.", look)
    return PageSection("held-out", title, (PageTable(caption, tuple(header), tuple(rows)), Pictures((drawing,))))


def misfit(traces: Mapping[str, xr.DataTree]) -> PageSection | Omitted:
    """Return the section on how each group of parameters scatters over the modes.

    Return `Omitted` if no model has an inferred scatter.
    """
    rows = [_scatter_row(name, one) for name, trace in traces.items() for one in scatters(trace)]
    title = "Where the misfit lives"
    if not rows:
        return Omitted(title, "no model has an inferred scatter of its parameters")
    header = (
        "model", "τ", "parameters", "median, %", "90 %, %", "prior median, %", "needed", "the largest",
    )  # fmt: skip
    caption = (
        "The scatter τ of the parameters over the modes. Needed: probability that it is not 0, if that was 50 % "
        "before the test. The largest: probability that no other group of the same model scatters more."
    )
    words = Items(tuple(scatter_words(_most_scatters(traces)[1])))
    return PageSection("misfit", title, (words, PageTable(caption, header, tuple(rows), words=(1, 2))))


def _scatter_row(name: str, one: Scatter) -> tuple[str, ...]:
    return (
        name,
        one.name,
        ", ".join(one.parameters),
        significant(100 * one.median, 2),
        f"{significant(100 * one.low, 2)} to {significant(100 * one.high, 2)}",
        significant(100 * one.prior_median, 2),
        share(one.needed),
        share(one.largest) if np.isfinite(one.largest) else MISSING,
    )


def intervals(traces: Mapping[str, xr.DataTree]) -> PageSection:
    """Return the section that compares the models' parameter estimates.

    A table gives the width of each interval relative to the width under the first model.
    """
    reference = next(iter(traces))
    ratios = interval_ratios(traces, reference)
    header = ("parameter", *map(str, ratios.columns))
    rows = tuple((str(name), *(significant(value, 2) for value in row)) for name, row in zip(
        ratios.index, ratios.to_numpy(), strict=True))  # fmt: skip
    caption = f"Width of the 90 % interval of each parameter, over that with {reference}."
    alt = f"Means and 90 % intervals of {len(parameter_names(traces[reference]))} parameters by each model."
    look = "Parameters by each model. Look for intervals that exclude each other."
    drawing = picture(plot_intervals(traces), "intervals", alt, look)
    words = Items(tuple(ratio_words(ratios, reference)))
    return PageSection(
        "parameters", "The parameters", (words, PageTable(caption, header, rows), Pictures((drawing,)))
    )
