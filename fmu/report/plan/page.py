"""The HTML page for a planned test."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.plan.result import PLANNED, Plan, cell
from fmu.analysis.plan.sensors.baselines import largest_off_diagonal
from fmu.analysis.plan.targets import with_probabilities_in_words
from fmu.analysis.trace.damage import probably
from fmu.numbers import customary_unit, fixed, share, significant
from fmu.report.document import Items, Page, PageSection, PageTable, Part, Picture, Pictures, Verdict, picture
from fmu.report.plan.figures import plot_expected_sds, plot_information, plot_sensors_on_structure, plot_simulated
from fmu.report.plots.correlation import plot_mac_matrix
from fmu.sampling.simulated_updates import SimulatedTests

if TYPE_CHECKING:
    import pandas as pd

_MOST_CASES = 12
_DOUBT = 0.05  # largest probability of a wrong decision
_CASES = (
    "Tests in which expected and real differ. The ratio of the sds is a product. True values: the sd "
    "linearised at the true parameters over the expected one. Noise: the sd linearised at the posterior "
    "mean over that. Shape: the real sd over that. At bounds: share of draws close to a bound. Crossed: "
    "with modes in another order."
)


def plan_page(plan: Plan, simulated: SimulatedTests | None = None) -> Page:
    """Return the page for a plan: verdicts, sensors, accuracy, customary choices, and further tests.

    Simulated tests are shown if there are any.
    """
    n = len(plan.chosen)
    lead = f"{len(plan.design.names)} parameters, {len(plan.design.modes)} modes, {n} sensors. {date.today()}."
    sections = [_sensors(plan), _accuracy(plan), _choices(plan), _further(plan)]
    if simulated is not None:
        sections.append(_show_simulated_tests(simulated))
    footer = (
        "Written by fmu plan. Information: ½ E log det(I + Σ Jᵀ Σ_e⁻¹ J), linearised at draws of the parameters."
    )
    return Page(
        plan.problem.name, "Plan of a modal test", lead, _verdicts(plan, simulated), tuple(sections), (), footer
    )


def _verdicts(plan: Plan, simulated: SimulatedTests | None) -> tuple[Verdict, ...]:
    doubts, sd = plan.doubts, plan.parameters()
    ratio = sd["after"] / sd["before"]
    wrong = float(plan.pairing.wrong.max())
    found = [
        Verdict(
            "Is the plan recommended?", "Yes" if not doubts else "No", not doubts, "What stands against it", doubts
        ),
        Verdict(
            "How much does it tell?",
            f"Median sd {share(float(ratio.median()))} of the one before",
            None,
            "What the plan is expected to tell",
            tuple(plan.sentences()),
        ),
        Verdict("How far from the best?", f"At most {share(plan.gap)}", None),
        Verdict("Can modes be paired?", f"Wrong in {share(wrong)} of tests at most", plan.pairing.ok),
    ]
    if plan.decision is not None:
        false_alarm, power = (float(plan.choices[key].loc[PLANNED]) for key in ("if_none", "if_twice"))
        answer = f"P of damage {probably(power)} if there is, {probably(false_alarm)} if not"
        decides = power > 1.0 - _DOUBT and false_alarm < _DOUBT
        found.append(Verdict("Does it decide about damage?", answer, decides))
    if simulated is not None:
        middle = float(np.median(simulated.ratios()))
        found.append(
            Verdict(
                "Is the accuracy real?",
                f"Real sd {fixed(middle, 2)} of the expected",
                0.9 <= middle <= 1.1,
                "Simulated tests",
                tuple(simulated.sentences()),
            )
        )
    return tuple(found)


def _sensors(plan: Plan) -> PageSection:
    parts: list[Part] = []
    if plan.structure is not None and plan.structure.geometry is not None and plan.places is not None:
        axes = plot_sensors_on_structure(plan, plan.structure)
        alt = f"The structure with {len(plan.every)} sensors, numbered: {_list_sensors(plan)}."
        caption = (
            "Sensors, the most needed first. Grey: mounted already. Arrows: directions (with two heads or curved: "
            "rotations)."
        )
        parts.append(Pictures((picture(axes, "sensors", alt, caption),)))
    parts.append(table_of("Sensors, mounted ones first, then in the order of the choice.", plan.sensor_table()))
    curve = plan.with_bounds()["information"]
    alt = f"Information by number of sensors: {', '.join(significant(float(x)) for x in curve)} nats."
    caption = "Expected information of the first sensors."
    if np.isinf(plan.limits.budget):
        caption += " No choice is above the dashed line."
    parts.append(Pictures((picture(plot_information(plan), "information", alt, caption),)))
    return PageSection("sensors", "Sensors", tuple(parts))


def _list_sensors(plan: Plan) -> str:
    return "; ".join(f"{place} {direction}" for place, direction in plan.named_sensors)


def _accuracy(plan: Plan) -> PageSection:
    table = plan.parameters()
    rows = []
    for p, (name, row) in zip(plan.design.parameters, table.iterrows(), strict=True):
        unit = customary_unit(p.unit)
        sds = [significant(float(row[key]) / unit.factor) for key in ("before", "frequencies", "after")]
        rows.append((str(name), unit.name or "", *sds, share(float(row["after"] / row["before"]))))
    header = ("parameter", "unit", "sd before", "frequencies alone", "after the test", "after / before")
    said = "; ".join(f"{row[0]} {row[-1]}" for row in rows)
    figure = picture(plot_expected_sds(plan), "accuracy", f"Expected sd relative to the one before: {said}.",
                     "Expected standard deviations, relative to those before the test.")  # fmt: skip
    parts: list[Part] = [PageTable("Expected standard deviations.", header, tuple(rows), words=(1,))]
    parts.append(Pictures((figure,)))
    losses = plan.losses()
    if plan.decision is not None and losses is not None:
        beyond, twice = share(plan.decision.beyond), share(2.0 * plan.decision.beyond)
        caption = (
            f"Losses. Probability of a loss of more than {beyond}: before the test, and expected after it if "
            f"there is no loss (if none) or the loss is {twice} (if twice)."
        )
        parts.append(table_of(caption, with_probabilities_in_words(losses)))
    return PageSection("accuracy", "Expected accuracy of the parameters", tuple(parts))


def _choices(plan: Plan) -> PageSection:
    labels = [str(i + 1) for i in plan.design.modes]
    pictures: list[Picture] = []
    if len(labels) > 1:
        shapes = plan.design.found.nominal.shapes[0][:, list(plan.design.modes)]
        picked = shapes[plan.design.candidates.rows(plan.every)]
        most = fixed(float(largest_off_diagonal(picked.T @ picked)), 2)
        axes = plot_mac_matrix(plan.auto_mac, labels, labels, x="mode", y="mode")
        alt = f"AutoMAC of the plan: at most {most} off the diagonal."
        pictures.append(picture(axes, "automac", alt, "AutoMAC of the modes at the sensors, before updating."))
    caption = (
        "Sensors chosen by other rules. Median sd: relative to the one before the test. Wrong pairs: largest "
        "share of simulated tests in which a mode was paired with another one."
    )
    if plan.decision is not None:
        caption += " If none, if twice: the worst expected probabilities of the losses that matter."
    parts: list[Part] = [table_of(caption, with_probabilities_in_words(plan.choices))]
    return PageSection(
        "choices", "Beside the customary choices", (*parts, *([Pictures(tuple(pictures))] * bool(pictures)))
    )


def _further(plan: Plan) -> PageSection:
    modes = (
        "Modes. Alone: information of this mode only; needed: what is lost without it; frequency only: what is "
        "lost if its shape is not measured; twice as accurate: gain if its frequency errs half as much. In nats."
    )
    parts: list[Part] = [table_of(modes, plan.modes)]
    repeats = f"Repeats of the test. Median sd: relative to the one before the test. {plan.shared_by_repeats}"
    parts.append(table_of(repeats.rstrip(), plan.repeats))
    if plan.second_tests is not None:
        caption = "Second tests with a change of the structure. Gain: information added, in nats."
        parts.append(table_of(caption, plan.second_tests))
    return PageSection("further", "Modes, repeats and further tests", tuple(parts))


def _show_simulated_tests(found: SimulatedTests) -> PageSection:
    table = found.table()
    alt = f"Real over expected sd: {'; '.join(f'{i} {fixed(x, 2)}' for i, x in table['median'].items())}."
    figure = picture(plot_simulated(found), "simulated", alt, "A point is a parameter in a simulated test.")
    caption = "Real over expected standard deviation of simulated tests, and the median real sd over the plan's."
    parts: list[Part] = [Items(tuple(found.sentences())), table_of(caption, table), Pictures((figure,))]
    cases = found.cases()
    if len(cases):
        rest = f" The worst {_MOST_CASES} of {len(cases)}." if len(cases) > _MOST_CASES else ""
        parts.append(table_of(_CASES + rest, cases.iloc[:_MOST_CASES]))
    return PageSection("simulated", "What the expected accuracy is worth", tuple(parts))


def table_of(caption: str, table: pd.DataFrame) -> PageTable:
    """Convert a data frame to a table on a page."""
    header = tuple(str(name).replace("_", " ") for name in (table.index.name, *table.columns))
    rows = tuple((str(i), *map(cell, row)) for i, row in zip(table.index, _rows(table), strict=True))
    return PageTable(caption, header, rows)


def _rows(table: pd.DataFrame) -> Sequence[Sequence[object]]:
    return [list(row) for row in table.itertuples(index=False)]
