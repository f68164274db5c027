"""Report sections for several tests of one structure: variation between tests, the next test, and damage."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from fmu.analysis.trace.damage import (
    ANY,
    BY_TEST,
    WITHHELD,
    before_and_after,
    before_in_words,
    damage,
    damage_by_test,
    probably,
    state_in_words,
)
from fmu.analysis.trace.modal_states import sketch_of
from fmu.analysis.trace.reading import LOSSES, has, roles_of, sds_of_population
from fmu.fem.frame.drawing import UNCHANGED, WIDTH, draw_svg, without_sensors
from fmu.numbers import MISSING, customary_unit, decimals, fixed, interval, share, significant, with_sd
from fmu.report.document import (
    Omitted,
    PageSection,
    PageTable,
    Part,
    Picture,
    Pictures,
    Text,
    Verdict,
    View,
    picture,
)
from fmu.report.model_view import damage_view
from fmu.report.plots.tests import plot_damage_by_test, plot_losses, plot_values, times_of_tests
from fmu.report.run import ReportedRun
from fmu.report.sections.structure import MOST_DRAWN, legend

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

ONE_TEST = "there is one test"
_BEYOND = (0.05, 0.1)
_CERTAIN, _FEW = 0.9, 3
"""Smallest probability of a loss stated as certain on the first screen; largest number of names in a line."""
_UNLIKELY, _MOST_OUTLIERS = 0.05, 20
"""Smallest outlier probability of a test that is listed, and largest number of tests listed."""
_STEPS = (0.1, 0.5, 0.9)
_SCALE = (
    ("#C8C8C8", "below 10 %"),
    ("#F2B25C", "10 to 50 %"),
    ("#E0672E", "50 to 90 %"),
    ("#9C1414", "above 90 %"),
)
"""Colour and label of each interval between the probabilities in `_STEPS`."""
_ADDRESS = ' xmlns="http://www.w3.org/2000/svg"'
"""The namespace of an SVG, which is not needed inside HTML."""


def population(run: ReportedRun) -> PageSection | Omitted:
    """Return the section on the variability between tests and the predicted next test.

    Return `Omitted` if there is only one test, or no parameter has a population.
    """
    title = "Variability between tests"
    if not has(run.trace, "tests"):
        return Omitted(title, ONE_TEST)
    posterior = run.trace["posterior"].to_dataset()
    names, rows = [], []
    for name in map(str, run.trace["tests"].data_vars):
        of_logarithm = f"{name} median" in posterior
        centre = f"{name} {'median' if of_logarithm else 'mean'}"
        if centre not in posterior:
            continue
        names.append(name)
        unit = customary_unit(posterior[centre].attrs.get("units", ""))
        middle = posterior[centre].to_numpy() / unit.factor
        for group, width in sds_of_population(run.trace, name).items():
            spread = posterior[width].to_numpy() / (1.0 if of_logarithm else unit.factor)
            relative = spread if of_logarithm else spread / np.abs(middle)
            of_scatter = with_sd(float(spread.mean()), float(spread.std()))
            rows.append(
                (
                    f"{name} in {group}" if group else name,
                    with_sd(float(middle.mean()), float(middle.std())),
                    unit.name,
                    of_scatter + (" of the logarithm" if of_logarithm else ""),
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
    some = any(f"{name} median" in posterior for name in names)
    centre, relative_to = ("mean or median", "relative scatter") if some else ("mean", "of the mean")
    header = ("parameter", centre, "unit", "sd over the tests", relative_to)
    title_of = "Populations, posterior mean ± sd"
    title_of += (
        "; of a log-normal one: its median, and the sd of the logarithm as its relative scatter" if some else ""
    )
    table = PageTable(title_of, header, tuple(rows), (2,))
    alt = f"Values of {', '.join(names)} in {n} tests with 90 % intervals, and the population behind them."
    caption = "Bars: the value in each test, 90 %. Band: the population, mean ± sd"
    caption += ", or median times exp(± sd of the logarithm)." if some else "."
    drawn = picture(plot_values(run.trace), f"{run.name}-tests", alt, caption)
    parts: list[Part] = [words, table, Pictures((drawn,))]
    if has(run.trace, "populations", "outlier"):
        parts += _outliers(run)
    if has(run.trace, "populations", "correlation"):
        parts.append(_correlations(run))
    if has(run.trace, "next_test"):
        parts.append(_next_test(run))
    return PageSection("population", title, tuple(parts))


def _outliers(run: ReportedRun) -> list[Part]:
    """Return a paragraph on the tests that may be outliers, and a table of the most probable outliers.

    The table lists at most 20 tests, each an outlier with a probability of at least `_UNLIKELY`. If there are no
    such tests, there is no table.
    """
    group = run.trace["populations"].to_dataset()
    names, tests = group["population"].to_numpy().tolist(), group["test"].to_numpy().tolist()
    p = group["outlier"].to_numpy()
    of_each = group["outlier_of"].transpose("test", "population").to_numpy()
    likely = [t for t in np.argsort(-p, kind="stable") if p[t] >= _UNLIKELY][:_MOST_OUTLIERS]
    found = [str(tests[t]) for t in likely if p[t] > 0.5]
    said = f"Probably outliers: {', '.join(found)}." if found else "No test is probably an outlier."
    parts: list[Part] = [
        Text(
            f"{said} The values of an outlier are drawn from a wider population, and hardly count for the mean "
            f"and sd of the others. The expected number of outliers is {significant(float(p.sum()), 2)} of "
            f"{len(tests)} tests."
        )
    ]
    rows = [(str(tests[t]), probably(float(p[t])), *map(probably, of_each[t].tolist())) for t in likely]
    if rows:
        header = ("test", "P(outlier)", *(f"of {name}" for name in names))
        title = f"Tests that are outliers with a probability of {share(_UNLIKELY)} or more"
        parts.append(PageTable(title, header, tuple(rows)))
    return parts


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
    """Return the section on damage: losses in each state of the structure, and losses since an unknown date.

    Return `Omitted` if the trace has no losses of either kind.
    """
    title = "Damage"
    parts = [*_losses_of_groups(run), *_losses_by_test(run)]
    if not parts:
        return Omitted(title, "no parameter varies between groups of tests")
    return PageSection("damage", title, tuple(parts))


def _losses_by_test(run: ReportedRun) -> list[Part]:
    """Return the text and the figure on losses since an unknown date; empty if the trace has no such losses."""
    if not has(run.trace, BY_TEST):
        return []
    dates = [name for name, (kind, *_) in roles_of(run.trace).items() if kind == "date"]
    draws = {name: run.trace["posterior"][name].to_numpy() for name in dates}
    ends = {name: np.quantile(x, (0.05, 0.95)).tolist() for name, x in draws.items()}
    said = [
        f"{name}: {with_sd(float(x.mean()), float(x.std()))}, "
        f"90 % {interval(ends[name][0], ends[name][1], decimals(float(x.std())))}."
        for name, x in draws.items()
    ]
    every = damage_by_test(run.trace, _BEYOND[:1])
    tests = run.trace[BY_TEST]["test"].to_numpy().tolist()
    last = {n: tests[int(np.argmax(times_of_tests(run.trace, n)))] for n in map(str, run.trace[BY_TEST].data_vars)}
    found = ", ".join(f"{n} {probably(float(every.loc[test, n].iloc[4]))} in {test}" for n, test in last.items())
    words = Text(
        f"{' '.join(said)} P(loss > {share(_BEYOND[0])}) in the last test: {found}. Where a loss is not "
        f"larger than its error, its date means nothing. {every.attrs[WITHHELD]}".rstrip()
    )
    caption = f"Above: P(loss > {share(_BEYOND[0])}) by test. Below: the loss, mean and 90 %."
    drawn = plot_damage_by_test(run.trace, _BEYOND[0])
    return [words, Pictures((picture(drawn, f"{run.name}-loss-by-test", f"Losses by test. {found}.", caption),))]


def _losses_of_groups(run: ReportedRun) -> list[Part]:
    """Return the text, figures and table on the losses in each state; empty if the trace has no such losses."""
    if not has(run.trace, LOSSES):
        return []
    table, values = damage(run.trace, _BEYOND), before_and_after(run.trace)
    rows = []
    for (state, name), (mean, sd, low, high, *exceeded) in zip(
        table.index.tolist(), table.to_numpy().tolist(), strict=True
    ):
        places, ends = decimals(100.0 * sd), [MISSING, MISSING]
        if name != ANY:
            unit = customary_unit(run.trace["tests"][name].attrs.get("units", ""))
            both = (values.loc[(state, name)] / unit.factor).tolist()
            ends = [f"{fixed(x, decimals(abs(both[0]) * sd))} {unit.name}".rstrip() for x in both]
        what = "the largest of all" if name == ANY else name
        within = interval(100.0 * low, 100.0 * high, places)
        lost = (f"{fixed(100.0 * mean, places)} %", f"{within} %", *map(probably, exceeded))
        rows.append((state, what, *ends, *lost))
    columns = (
        "state",
        "parameter",
        "before",
        "after",
        "loss",
        "90 %",
        *(f"P(loss > {share(x)})" for x in _BEYOND),
    )
    words = Text(
        f"The share of each parameter that was lost since {before_in_words(run.trace)}, from all tests together. "
        f"Two losses can be separated only if they change the modes differently. {table.attrs[WITHHELD]}".rstrip()
    )
    worst = table.drop(index=ANY, level=1).iloc[:, 4]
    named = [f"{name} in {state}" for state, name in worst.index[worst > 0.5]]
    beyond = f"probably beyond {share(_BEYOND[0])}"
    said = f"{beyond}: {', '.join(named)}" if named else f"none is {beyond}"
    said = f"P is {WITHHELD}" if table.attrs[WITHHELD] else said
    caption = f"Median, 50 % and 90 % of each loss; red where it is {beyond}."
    picture_of = picture(plot_losses(run.trace, _BEYOND[0]), f"{run.name}-loss", f"Losses: {said}.", caption)
    found = PageTable("Losses and posterior means before and after", columns, tuple(rows), (1,))
    drawings, view = _where(run, table)
    return [words, *drawings, Pictures((picture_of,)), found, *view]


def lost(run: ReportedRun) -> tuple[Verdict, ...]:
    """Return one verdict on the losses in each state except the reference; empty if the trace has no losses."""
    if not has(run.trace, LOSSES):
        return ()
    doubts = f" Do not rely on P: {' and '.join(run.diagnosis.doubts)}." if run.diagnosis.doubts else ""
    every = damage(run.trace, _BEYOND[:1])
    table, reason = every.drop(index=ANY, level=1), every.attrs[WITHHELD]
    states = table.index.unique("state")
    if reason:
        return tuple(_withheld_in(run, state, table.loc[state], reason) for state in states)
    return tuple(_lost_in(run, state, table.loc[state], doubts) for state in states)


def _withheld_in(run: ReportedRun, state: str, table: pd.DataFrame, reason: str) -> Verdict:
    """Return the verdict on one state whose loss probabilities are withheld for the given `reason`."""
    most = str(table["mean"].idxmax())
    _, sd, low, high = (100.0 * table.loc[most].to_numpy(dtype=float)[:4]).tolist()
    within = interval(low, high, decimals(sd))
    said = f"{reason} In this model the largest loss is that of {most}: 90 % interval {within} %."
    return Verdict(_question(run, state), "Unknown: P is withheld", False, said=said)


def _question(run: ReportedRun, state: str) -> str:
    return f"What was lost? After: {state_in_words(run.trace, state)}"


def _lost_in(run: ReportedRun, state: str, table: pd.DataFrame, doubts: str) -> Verdict:
    """Return the verdict on the losses in one state. `table` has a row for each parameter.

    A loss above 5 % is called certain if its probability is at least `_CERTAIN`, and possible if it is above 50 %.
    At most three of each are named. If there are none, the parameter with the most probable loss is named.
    """
    question = _question(run, state)
    p, beyond = table.iloc[:, 4], f"P(loss > {share(_BEYOND[0])})"
    by_size = table["mean"].sort_values(ascending=False).index
    certain = [name for name in by_size if p[name] >= _CERTAIN]
    possible = [name for name in by_size if _CERTAIN > p[name] > 0.5]

    def in_words(name: str) -> str:
        mean, sd, low, high = table.loc[name].to_numpy(dtype=float)[:4].tolist()
        n = decimals(100.0 * sd)
        size = "" if name in certain[:_FEW] else f" {fixed(100.0 * mean, n)} %"
        return (
            f"{name}{size}: 90 % interval {interval(100.0 * low, 100.0 * high, n)} %, {beyond} {_equals(p[name])}."
        )

    few = certain[:_FEW] or possible[:_FEW] or [max(by_size, key=lambda name: p[name])]
    said = [in_words(name) for name in few]
    if certain and possible:
        said.append(f"Possible: {' '.join(in_words(name) for name in possible[:_FEW])}")
    if not certain and not possible:
        answer = f"No loss above {share(_BEYOND[0])} is probable"
        return Verdict(question, answer, None, said=f"Most probable: {said[0]}{doubts}")
    if not certain:
        return Verdict(question, "Possibly something", None, said=" ".join(said) + doubts)
    answer = ", ".join(f"{name} {fixed(100.0 * table.loc[name, 'mean'], 0)} %" for name in few)
    answer += f" and {len(certain) - _FEW} more" if len(certain) > _FEW else ""
    return Verdict(question, answer, False, said=" ".join(said) + doubts)


def _equals(p: float) -> str:
    """Return a probability as text with a relation sign: ``"= 32 %"``, ``"> 99 %"``."""
    text = probably(float(p))
    return text if text[0] in "<>" else f"= {text}"


def damage_drawing(trace: xr.DataTree) -> Markup:
    """Return a drawing of the structure in each state, coloured by the probability of a loss above 5 %.

    The result is empty if the trace has no losses or no geometry, or the structure is too large to draw.
    """
    if not has(trace, LOSSES):
        return Markup("")
    drawings = _drawings(trace, damage(trace, _BEYOND[:1]))
    each = [Markup("<div>{}<p>{}</p></div>").format(svg, state) for state, (svg, _) in drawings.items()]
    if not each:
        return Markup("")
    entries = dict.fromkeys(entry for _, entries in drawings.values() for entry in entries)
    title = Markup("<p>P(loss &gt; {})</p>").format(share(_BEYOND[0]))
    return Markup('<div class="states">{}</div>').format(Markup("").join(each)) + title + legend(entries)


def _drawings(trace: xr.DataTree, table: pd.DataFrame) -> dict[str, tuple[Markup, list[tuple[str, str]]]]:
    """Return a drawing coloured by the loss probabilities, and the drawing's legend, keyed by state.

    The dict is empty if the trace has no geometry or the structure is too large to draw.
    """
    sketch = sketch_of(trace)
    if sketch is None or len(sketch.elements) > MOST_DRAWN:
        return {}
    sketch = without_sensors(sketch)
    names = trace["structure"]["structural"].to_numpy().tolist()
    found = {}
    for state in trace[LOSSES]["state"].to_numpy().tolist():
        lost = table.loc[state].iloc[:, 4].drop(ANY)
        of_parameters = np.array([lost.get(name, -1.0) for name in names])
        colours = [_shade(p) for p in np.where(sketch.changed, of_parameters, -1.0).max(axis=1)]
        grey = "no parameter with a loss" if np.isfinite(lost).all() else f"P is {WITHHELD}"
        without = [(UNCHANGED, grey)] if UNCHANGED in colours else []
        said = ", ".join(f"{name} {probably(float(p))}" for name, p in lost.items())
        words = f"P(loss > {share(_BEYOND[0])}) in {state}: {said}"
        svg = draw_svg(sketch, colours, words, [_shade(p) for p in of_parameters]).replace(_ADDRESS, "", 1)
        found[str(state)] = Markup(svg), [*_SCALE, *without]
    return found


def _shade(p: float) -> str:
    """Return the colour for a probability; a negative number or NaN gives the colour for elements without loss."""
    return UNCHANGED if p < 0 or np.isnan(p) else _SCALE[int(np.searchsorted(_STEPS, p))][0]


def _where(run: ReportedRun, table: pd.DataFrame) -> tuple[tuple[Pictures, ...], tuple[View, ...]]:
    """Return drawings of the structure in each state, and a view of it that can be rotated.

    They are coloured by the loss probabilities. Both tuples are empty if the trace has no geometry or the
    structure is too large to draw.
    """
    sketch, drawings = sketch_of(run.trace), _drawings(run.trace, table)
    if sketch is None or not drawings:
        return (), ()
    pictures = []
    for state, (svg, entries) in drawings.items():
        caption = (
            f"{state}: probability of a loss of more than {share(_BEYOND[0])}, the largest of the parameters that "
            "change an element."
        )
        svg = Markup(svg.replace("The structure:", "The damaged structure:", 1))  # also in the page's head
        pictures.append(Picture(svg + legend(entries), caption, round(WIDTH)))
    names = run.trace["structure"]["structural"].to_numpy().tolist()
    view = damage_view(sketch, names, table.iloc[:, :5].drop(index=ANY, level=1), share(_BEYOND[0]))
    return (Pictures(tuple(pictures)),), (view,)
