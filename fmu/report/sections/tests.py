"""Several tests of one structure: how much it varies, what the next test will measure, and damage."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from fmu.analysis.trace.damage import ANY, GROUP, damage, probably
from fmu.analysis.trace.modal_states import sketch_of
from fmu.analysis.trace.reading import has
from fmu.fem.frame.drawing import UNCHANGED, WIDTH, drawn
from fmu.numbers import decimals, fixed, interval, share, shown, with_sd
from fmu.report.document import Omitted, PageSection, PageTable, Part, Picture, Pictures, Text, picture
from fmu.report.model_view import damage_view
from fmu.report.plots.tests import plot_losses, plot_values
from fmu.report.run import ReportedRun
from fmu.report.sections.structure import MOST_DRAWN, legend

if TYPE_CHECKING:
    import pandas as pd

ONE_TEST = "there is one test"
_BEYOND = (0.05, 0.1)
_STEPS = (0.1, 0.5, 0.9)
_SCALE = (
    ("#C8C8C8", "below 10 %"),
    ("#F2B25C", "10 to 50 %"),
    ("#E0672E", "50 to 90 %"),
    ("#9C1414", "above 90 %"),
)
"""Colours between those probabilities."""
_ADDRESS = ' xmlns="http://www.w3.org/2000/svg"'
"""Inside HTML an SVG has no need of it."""


def population(run: ReportedRun) -> PageSection | Omitted:
    """Return how much the structure varies between the tests, and what the next one will measure."""
    title = "Variability between tests"
    if not has(run.trace, "tests"):
        return Omitted(title, ONE_TEST)
    posterior = run.trace["posterior"].to_dataset()
    names, rows = [], []
    for name in map(str, run.trace["tests"].data_vars):
        of_logarithm = f"{name} median" in posterior
        centre, width = (f"{name} {x}" for x in (("median", "log sd") if of_logarithm else ("mean", "sd")))
        if centre not in posterior:
            continue
        names.append(name)
        unit = shown(posterior[centre].attrs.get("units", ""))
        middle = posterior[centre].to_numpy() / unit.factor
        spread = posterior[width].to_numpy() / (1.0 if of_logarithm else unit.factor)
        relative = spread if of_logarithm else spread / np.abs(middle)
        rows.append(
            (
                name,
                with_sd(float(middle.mean()), float(middle.std())),
                unit.name,
                with_sd(float(spread.mean()), float(spread.std())) + (" of the logarithm" if of_logarithm else ""),
                share(float(relative.mean())),
            )
        )
    if not names:
        return Omitted(title, "no parameter scatters over the tests")
    n = run.trace["tests"].sizes["test"]
    words = Text(
        f"The structure itself varied between the {n} tests: that is the population's sd, which more tests do not "
        "make smaller. The error of the population's mean, after ±, is what more tests do make smaller. Both are "
        "inferred together with the value in every test."
    )
    header = ("parameter", "mean", "unit", "sd over the tests", "of the mean")
    table = PageTable("Populations, posterior mean ± sd", header, tuple(rows), (2,))
    alt = f"Values of {', '.join(names)} in {n} tests with 90 % intervals, and the population behind them."
    caption = "Bars: the value in each test, 90 %. Band: the population, mean ± sd."
    drawn = picture(plot_values(run.trace), f"{run.name}-tests", alt, caption)
    parts: list[Part] = [words, table, Pictures((drawn,))]
    if has(run.trace, "populations"):
        parts.append(_correlations(run))
    if has(run.trace, "next_test"):
        parts.append(_next_test(run))
    return PageSection("population", title, tuple(parts))


def _correlations(run: ReportedRun) -> PageTable:
    matrices = run.trace["populations"].to_dataset()["correlation"]
    names = matrices["population"].to_numpy().tolist()
    rows = []
    for i, j in combinations(range(len(names)), 2):
        r = matrices[..., i, j].to_numpy().ravel()
        low, high = np.quantile(r, (0.05, 0.95)).tolist()
        rows.append((f"{names[i]}, {names[j]}", with_sd(float(r.mean()), float(r.std())), interval(low, high, 2)))
    header = ("parameters", "correlation over the tests", "90 %")
    return PageTable("Correlations of the populations, posterior mean ± sd", header, tuple(rows))


def _next_test(run: ReportedRun) -> PageTable:
    following = run.trace["next_test"].to_dataset()
    rows = []
    for mode in following["mode"].to_numpy().tolist():
        draws = following["frequency"].sel(mode=mode).to_numpy().ravel()
        low, lower, middle, upper, high = np.quantile(draws, (0.05, 0.25, 0.5, 0.75, 0.95)).tolist()
        places = decimals(float(draws.std()))
        rows.append(
            (str(mode), fixed(middle, places), interval(lower, upper, places), interval(low, high, places))
        )
    return PageTable(
        "The next test like the first one, Hz: variability, uncertainty and measurement error together",
        ("mode", "median", "50 %", "90 %"),
        tuple(rows),
    )


def losses(run: ReportedRun) -> PageSection | Omitted:
    """Return the losses of the parameters that vary between groups of tests."""
    title = "Damage"
    if not has(run.trace, GROUP):
        return Omitted(title, "no parameter varies between groups of tests")
    reference = str(run.trace[GROUP].attrs["reference"])
    table = damage(run.trace, _BEYOND)
    rows = []
    for (state, name), (mean, sd, low, high, *exceeded) in zip(
        table.index.tolist(), table.to_numpy().tolist(), strict=True
    ):
        what, places = "the largest of all" if name == ANY else name, decimals(100.0 * sd)
        ends = interval(100.0 * low, 100.0 * high, places)
        rows.append((state, what, f"{fixed(100.0 * mean, places)} %", f"{ends} %", *map(probably, exceeded)))
    columns = ("state", "parameter", "loss", "90 %", *(f"P(loss > {share(x)})" for x in _BEYOND))
    words = Text(
        f"The share of each parameter that was lost since the reference, {reference!r}, from all tests together. "
        "Two losses can be separated only if they change the modes differently."
    )
    worst = table.drop(index=ANY, level=1).iloc[:, 4]
    named = [f"{name} in {state}" for state, name in worst.index[worst > 0.5]]
    said = f"probably beyond {share(_BEYOND[0])}: {', '.join(named)}" if named else "none is probably beyond 5 %"
    caption = f"Median, 50 % and 90 % of each loss; red where it is probably beyond {share(_BEYOND[0])}."
    drawn = picture(
        plot_losses(run.trace, _BEYOND[0]), f"{run.name}-loss", f"Losses of stiffness: {said}.", caption
    )
    found = PageTable("Losses", columns, tuple(rows), (1,))
    return PageSection("damage", title, (words, Pictures((drawn,)), *_where(run, table), found))


def _where(run: ReportedRun, table: pd.DataFrame) -> tuple[Part, ...]:
    """Return the structure in each state, its elements in the colours of the probabilities of their losses."""
    sketch = sketch_of(run.trace)
    if sketch is None or len(sketch.elements) > MOST_DRAWN:
        return ()
    names = run.trace["structure"]["structural"].to_numpy().tolist()
    drawings = []
    for state in run.trace[GROUP]["state"].to_numpy().tolist():
        probability = np.full((len(sketch.elements), len(names)), -1.0)
        lost = table.loc[state].iloc[:, 4].drop(ANY)
        for name, p in lost.items():
            probability[sketch.changed[:, names.index(name)], names.index(name)] = p
        worst = probability.max(axis=1)
        colours = [UNCHANGED if p < 0 else _SCALE[int(np.searchsorted(_STEPS, p))][0] for p in worst]
        without = [(UNCHANGED, "no parameter with a loss")] if UNCHANGED in colours else []
        said = ", ".join(f"{name} {probably(float(p))}" for name, p in lost.items())
        svg = drawn(sketch, colours, f"P(loss > {share(_BEYOND[0])}) in {state}: {said}").replace(_ADDRESS, "", 1)
        caption = (
            f"{state}: probability that more than {share(_BEYOND[0])} of an element's stiffness is lost, the "
            "largest of the parameters that change it."
        )
        drawings.append(Picture(Markup(svg) + legend([*_SCALE, *without]), caption, round(WIDTH)))
    view = damage_view(sketch, names, table.iloc[:, :5].drop(index=ANY, level=1), share(_BEYOND[0]))
    return view, Pictures(tuple(drawings))
