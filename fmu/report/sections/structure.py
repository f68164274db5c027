"""What the data can tell, and what the model looks like before updating and after it."""

from __future__ import annotations

import numpy as np

from fmu.analysis.identifiability import Identifiability, contraction, kept_identifiability
from fmu.analysis.pairing_changes import pairing_changes
from fmu.analysis.prediction import measured_mac
from fmu.analysis.trace.modal_states import GROUP, MEAN, START
from fmu.analysis.trace.reading import has
from fmu.numbers import MISSING, change, decimals, fixed, hertz, share, significant
from fmu.report.document import Details, Items, Omitted, PageSection, PageTable, Part, Pictures, Text, picture
from fmu.report.plots.modes import plot_mac, plot_mode_shapes
from fmu.report.run import ReportedRun

NO_SHAPES = "the trace has no mode shapes: the model gives none, or an older version of fmu sampled it"
_WHERE = {START: "Before updating, at the start", "maximum": "After updating, at the highest maximum"}


def identifiability(run: ReportedRun) -> PageSection | Omitted:
    """Return which directions of the parameter space the data constrain."""
    title = "Identifiability"
    parts: list[Part] = []
    kept = kept_identifiability(run.trace)
    for state, found in kept.items():
        first, *others = found.sentences()
        parts += [Text(f"{_WHERE.get(state, state)}: {first[0].lower()}{first[1:]}"), Items(tuple(others))]
    if kept:
        tables = tuple(directions(found, _WHERE.get(state, state)) for state, found in kept.items())
        parts.append(Details("Directions and singular values", tables))
    if has(run.trace, "prior"):
        parts.append(_contraction(run))
    if not parts:
        return Omitted(title, "the trace has neither a linearised model nor draws from the prior")
    return PageSection("identifiability", title, tuple(parts))


def directions(found: Identifiability, lead: str) -> PageTable:
    """Return the directions of the parameter space and their singular values; the caption begins with `lead`."""
    rows = tuple(
        (
            str(k),
            significant(s),
            significant(1.0 / float(np.hypot(1.0, s))),
            *(fixed(float(x), 2) for x in direction),
        )
        for k, (s, direction) in enumerate(zip(found.singular_values, found.directions, strict=True), 1)
    )
    caption = (
        f"{lead}. Orthonormal directions in units of the prior standard deviations. Sd left: part of the prior "
        f"standard deviation that remains along each direction."
    )
    return PageTable(caption, ("direction", "singular value", "sd left", *found.names), rows)


def _contraction(run: ReportedRun) -> PageTable:
    table, rows = contraction(run.trace), []
    for name in run.names:
        unit = run.unit(name)
        before, after = (float(table[column][name]) / unit.factor for column in ("prior_sd", "posterior_sd"))
        n = decimals(after)
        rows.append(
            (name, unit.name, fixed(before, n), fixed(after, n), fixed(float(table["contraction"][name]), 3))
        )
    caption = (
        "From prior to posterior: contraction is 1 − the ratio of the variances, near 1 where the data "
        "determine a parameter, near 0 where they carry no information on it."
    )
    header = ("parameter", "unit", "prior sd", "posterior sd", "contraction")
    return PageTable(caption, header, tuple(rows), words=(1,))


def mac(run: ReportedRun) -> PageSection | Omitted:
    """Return the MAC of the mode shapes with the reference."""
    title = "Modal assurance criterion"
    if not has(run.trace, GROUP, "mac"):
        return Omitted(title, NO_SHAPES)
    criterion = run.trace[GROUP]["mac"]
    values = criterion.sel(state=MEAN).transpose("reference_mode", "mode").to_numpy()
    diagonal = ", ".join(fixed(x, 2) for x in np.diag(values))
    others = values[~np.eye(len(values), dtype=bool)]
    most = f" and at most {fixed(others.max(), 2)} off the diagonal" if len(others) else ""
    drawing = picture(plot_mac(run.trace), "mac", f"MAC matrix: {diagonal} on the diagonal{most}.",
                      f"MAC at the posterior mean. Reference: {criterion.attrs['reference']}.")  # fmt: skip
    said = Text(f"Reference: {criterion.attrs['reference']}. On the diagonal {diagonal}{most}.")
    return PageSection("mac", title, (said, *_mac_before_and_after(run), Pictures((drawing,))))


def _mac_before_and_after(run: ReportedRun) -> tuple[PageTable, ...]:
    """Return the MAC of each mode with its measured shape, if shapes were measured."""
    alike = measured_mac(run.trace)
    if alike is None:
        return ()
    before, after = (alike.sel(state=state).to_numpy() for state in (START, MEAN))
    rows = []
    for k, label in enumerate(map(str, alike["mode"].to_numpy())):
        others = np.delete(after[k], k)
        nearest = fixed(float(others.max()), 2) if len(others) else MISSING
        rows.append((label, fixed(float(before[k, k]), 2), fixed(float(after[k, k]), 2), nearest))
    caption = (
        "MAC with the measured shape: before updating (start) and after (posterior mean). Last column: "
        "the most similar other mode, after updating."
    )
    return (PageTable(caption, ("mode", "MAC before", "MAC after", "of another mode"), tuple(rows)),)


def pairing(run: ReportedRun) -> PageSection | Omitted:
    """Return how often the pairing of modes changed over the draws."""
    title = "Pairing over the draws"
    if not has(run.trace, GROUP) or not has(run.trace, "posterior_predictive"):
        return Omitted(title, "the trace has no frequencies at the draws and before updating")
    found = pairing_changes(run.trace)
    parts: list[Part] = [Items(found.sentences())]
    if found.swapped.any() or found.jumps:
        rows = tuple(
            (
                str(mode),
                share(row["swapped_percent"] / 100),
                str(row["swapped_with"]),
                share(row["other_mode_percent"] / 100),
            )
            for mode, row in found.table().iterrows()
        )
        caption = (
            "Order swapped: share of the draws in which two modes are in another order than before updating. "
            "Other computed mode: share of the draws examined in which the mode is not paired with the same "
            "computed mode as at the most probable draw."
        )
        header = ("mode", "order swapped", "with mode", "other computed mode")
        parts.append(Details("Changes by mode", (PageTable(caption, header, rows, words=(2,)),)))
    return PageSection("pairing", title, tuple(parts))


def shapes(run: ReportedRun) -> PageSection | Omitted:
    """Return the structure deformed in its modes."""
    title = "Mode shapes before and after"
    if not has(run.trace, GROUP, "displacement"):
        return Omitted(title, "the trace has no geometry to draw them on")
    modes = run.trace[GROUP].to_dataset()
    moved = modes["displacement"]
    turned = np.abs((moved.sel(state=MEAN) - moved.sel(state=START)).to_numpy()).max(axis=(1, 2))
    rows, seen = [], []
    for k, label in enumerate(map(str, modes["mode"].to_numpy())):
        before, after = (float(modes["frequency"].sel(state=state)[k]) for state in (START, MEAN))
        hz = hertz(before, after)
        rows.append((label, *hz, change(after / before - 1), share(float(turned[k]))))
        seen.append(f"mode {label} from {hz[0]} to {hz[1]} Hz, its shape by up to {rows[-1][-1]}")
    caption = (
        "At the start and at the posterior mean. Change of shape: largest change, relative to the "
        "largest displacement."
    )
    header = ("mode", "before, Hz", "after, Hz", "change", "change of shape")
    alt = f"Deformed structure in each mode, before and after: {'; '.join(seen)} of the largest displacement."
    drawing = picture(
        plot_mode_shapes(run.trace), "shapes", alt, "Dashed grey: before updating. Solid: at the posterior mean."
    )
    return PageSection("shapes", title, (PageTable(caption, header, tuple(rows)), Pictures((drawing,))))
