"""Report sections on identifiability and on the modes before and after updating, and the structure's drawing."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from fmu.analysis.fit.measured_shapes import measured_mac
from fmu.analysis.identifiability import Identifiability, kept_identifiability
from fmu.analysis.information import (
    CRITERION,
    Information,
    compared_with_draws,
    information,
    left_along,
    why_unknown,
)
from fmu.analysis.maxima.results import NEGLIGIBLE
from fmu.analysis.pairing_changes import pairing_changes
from fmu.analysis.trace.modal_states import GROUP, MEAN, MEASURED, START, sketch_of
from fmu.analysis.trace.reading import has, parameter_names
from fmu.fem.frame.drawing import UNCHANGED, draw_svg, parameter_colours
from fmu.numbers import MISSING, change, decimals, fixed, hertz, share, significant
from fmu.posterior.frf.likelihood import FRFS
from fmu.report.document import Details, Items, Omitted, PageSection, PageTable, Part, Pictures, Text, picture
from fmu.report.model_view import model_view
from fmu.report.plots.modes import plot_mac, plot_mode_shapes
from fmu.report.run import ReportedRun
from fmu.report.sections.information import sensitivity
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr

NO_SHAPES = "the trace has no mode shapes: the model gives none, or an older version of fmu sampled it"
_WHERE = {START: "Before updating, at the start", "maximum": "After updating, at the highest maximum"}


MOST_DRAWN = 5000
"""Largest number of elements of a structure that is drawn."""


def structure_drawing(trace: xr.DataTree) -> Markup:
    """Return a drawing of the structure with its legend.

    It is empty if the trace has no geometry, or the structure has more than `MOST_DRAWN` elements.
    """
    found = sketch_of(trace)
    if found is None or len(found.elements) > MOST_DRAWN:
        return Markup("")
    # the drawing contains no text of the user; an SVG inside HTML needs no namespace
    svg = Markup(draw_svg(found).replace(' xmlns="http://www.w3.org/2000/svg"', "", 1))
    several = has(trace, "structure", "structural")  # then a column of the sketch is a parameter of the structure
    names = trace["structure"]["structural"].to_numpy() if several else parameter_names(trace)
    return svg + legend_of_parameters(names, parameter_colours(found), svg)


def legend_of_parameters(names: Iterable[str], colours: Iterable[str | None], svg: str) -> Markup:
    """Return a drawing's legend: the parameters of each colour.

    A parameter whose colour is None changes no element and is left out. Drawn elements that no parameter changes
    have their own entry.
    """
    entries: dict[str, list[str]] = {}
    for name, colour in zip(names, colours, strict=False):  # inferred errors, at the end, have no colour
        if colour is not None:
            entries.setdefault(colour, []).append(str(name))
    if f'stroke="{UNCHANGED}" stroke-width="4"' in svg:
        entries[UNCHANGED] = ["no parameter"]
    return legend((colour, ", ".join(those)) for colour, those in entries.items())


def legend(entries: Iterable[tuple[str, str]]) -> Markup:
    """Return a drawing's legend from pairs of a colour and its meaning."""
    entry = Markup('<li><span aria-hidden="true" style="background:{}"></span>{}</li>')
    return Markup('<ul class="legend">{}</ul>').format(Markup("").join(entry.format(*one) for one in entries))


def identifiability(run: ReportedRun) -> PageSection | Omitted:
    """Return the section on identifiability, judged from the posterior draws, the linearised model, or both.

    Return `Omitted` if the trace has no linearised model and the draws cannot be judged, because the trace has no
    draws from the prior or all posterior draws are the same.
    """
    title = "Identifiability"
    found, kept = information(run.trace), kept_identifiability(run.trace)
    if found is None and not kept:
        return Omitted(title, f"the trace has no linearised model, and {why_unknown(run.trace)}")
    if found is None:
        said = [f"{_WHERE.get(at, at)}. {sentence}" for at, one in kept.items() for sentence in one.sentences()]
        tables = tuple(directions(one, _WHERE.get(at, at)) for at, one in kept.items())
        return PageSection("identifiability", title, (Items(tuple(said)), Details("Directions", tables)))
    said = found.sentences()
    if kept:
        at, linearised = list(kept.items())[-1]
        n_maxima = 1 if run.maxima is None else sum(one.share > NEGLIGIBLE for one in run.maxima)
        place = {START: "the start"}.get(at, "the highest maximum")
        said += compared_with_draws(run.trace, linearised, place, n_maxima, run.diagnosis.converged)
    by_model = (directions(one, _WHERE.get(at, at), left_along(run.trace, one)) for at, one in kept.items())
    tables = (_drawn_directions(found), *by_model)
    parts: list[Part] = [Items(tuple(said)), Text(CRITERION), _contraction(run, found)]
    if kept and FRFS not in list(kept.values())[-1].labels:  # their rows are directions, not measured quantities
        words, drawing = sensitivity(run, list(kept.values())[-1])
        parts += [words, Pictures((drawing,))]
    return PageSection("identifiability", title, (*parts, Details("Directions", tables)))


def _drawn_directions(found: Information) -> PageTable:
    """Return the table of the draws' principal directions, starting with the least informed direction."""
    rows = tuple(
        (str(k), significant(left), fixed(1.0 - left**2, 2), *(fixed(float(x), 2) for x in direction))
        for k, (left, direction) in enumerate(zip(found.remaining_sd, found.directions, strict=True), 1)
    )
    caption = (
        "By the draws: their principal directions, in prior standard deviations, the least informed first. Sd "
        "left: part of the prior standard deviation that remains."
    )
    return PageTable(
        caption,
        ("direction", "sd left", "contraction", *found.names),
        rows,
        greyed=tuple(np.flatnonzero(found.is_left)),
    )


def directions(found: Identifiability, lead: str, drawn: FloatArray | None = None) -> PageTable:
    """Return the table of a linearised model's directions, with a caption that begins with `lead`.

    If `drawn` is given (`fmu.analysis.information.left_along`), one column shows the spread of the draws along
    each direction.
    """
    rows = tuple(
        (
            str(k),
            significant(s),
            significant(1.0 / float(np.hypot(1.0, s))),
            *(() if drawn is None else (significant(float(drawn[k - 1])),)),
            *(fixed(float(x), 2) for x in direction),
        )
        for k, (s, direction) in enumerate(zip(found.singular_values, found.directions, strict=True), 1)
    )
    caption = (
        f"{lead}: linearised, the bounds not counted. Orthonormal directions in units of the prior standard "
        f"deviations. Sd left: part of the prior standard deviation that would remain along each direction"
        f"{'' if drawn is None else ', and what the draws have along the same direction'}."
    )
    beside = () if drawn is None else ("sd left, draws",)
    return PageTable(caption, ("direction", "singular value", "sd left", *beside, *found.names), rows)


def _contraction(run: ReportedRun, found: Information) -> PageTable:
    """Return the table of prior and posterior moments. Parameters that the data did not inform are grey."""
    rows = []
    for k, name in enumerate(run.names):
        unit, prior = run.unit(name), run.trace["prior"][name].to_numpy()
        mean, sd = prior.mean() / unit.factor, prior.std(ddof=1) / unit.factor
        n = decimals(run.value(name, "sd"))
        what = "logarithm" if found.of_logarithm[k] else "value"
        values = (mean, sd, run.value(name, "mean"), run.value(name, "sd"))
        rows.append((name, unit.name, *(fixed(x, n) for x in values), fixed(float(found.contraction[k]), 2), what))
    caption = (
        "From prior to posterior: means and standard deviations within the bounds. Where the prior is "
        "log-normal, the contraction is that of the logarithm."
    )
    header = ("parameter", "unit", "prior mean", "prior sd", "posterior mean", "posterior sd", "contraction", "of")
    return PageTable(caption, header, tuple(rows), words=(1, 7), greyed=tuple(np.flatnonzero(~found.informed)))


def mac(run: ReportedRun) -> PageSection | Omitted:
    """Return the section on the MAC between updated modes and measured shapes.

    If no shapes were measured, the updated modes are compared with the modes before updating. Return `Omitted` if
    the trace has no mode shapes.
    """
    if not has(run.trace, GROUP, "mac"):
        return Omitted("Modal assurance criterion", NO_SHAPES)
    criterion = run.trace[GROUP]["mac"]
    is_measured = criterion.attrs["reference"] == MEASURED
    title = "MAC with the measured shapes" if is_measured else "MAC with the model's modes before updating"
    values = criterion.sel(state=MEAN).transpose("reference_mode", "mode").to_numpy()
    diagonal = ", ".join(fixed(x, 2) for x in np.diag(values))
    others = values[~np.eye(len(values), dtype=bool)]
    most = f" and at most {fixed(others.max(), 2)} off the diagonal" if len(others) else ""
    caption = (
        "Modal assurance criterion of the modes at the posterior mean with the measured shapes, at the sensors. "
        "Look for a diagonal below 0.9 (a mode that differs, or is paired wrongly) and for dark cells off it."
        if is_measured
        else "Modal assurance criterion of the modes at the posterior mean with those before updating, at all "
        "translations. It tells how much updating changed the modes, not whether they are right: no shapes were "
        "measured. Look for dark cells off the diagonal: modes that turned into each other."
    )
    drawing = picture(plot_mac(run.trace), "mac", f"MAC matrix: {diagonal} on the diagonal{most}.", caption)
    said = Text(f"On the diagonal {diagonal}{most}.")
    return PageSection("mac", title, (said, *_mac_before_and_after(run), Pictures((drawing,))))


def _mac_before_and_after(run: ReportedRun) -> tuple[PageTable, ...]:
    """Return a tuple with a table of the MAC between each mode and its measured shape, before and after updating.

    The tuple is empty if no shapes were measured.
    """
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
    """Return the section on how mode pairing changes over the draws.

    Return `Omitted` if the trace has no frequencies before updating or none at the draws.
    """
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
    """Return the section on the mode shapes before and after updating, and the measured shapes if there are any.

    Return `Omitted` if the trace has neither a geometry nor measured shapes.
    """
    title = "Mode shapes before and after"
    kind = next((name for name in ("displacement", "component") if has(run.trace, GROUP, name)), None)
    if kind is None:
        return Omitted(title, "the trace has no geometry to draw them on, and no shapes were measured")
    modes = run.trace[GROUP].to_dataset()
    moved = modes[kind]
    turned = np.abs((moved.sel(state=MEAN) - moved.sel(state=START)).to_numpy()).reshape(len(modes["mode"]), -1)
    rows, seen = [], []
    for k, label in enumerate(map(str, modes["mode"].to_numpy())):
        before, after = (float(modes["frequency"].sel(state=state)[k]) for state in (START, MEAN))
        hz = hertz(before, after)
        rows.append((label, *hz, change(after / before - 1), share(float(turned[k].max()))))
        seen.append(f"mode {label} from {hz[0]} to {hz[1]} Hz, its shape by up to {rows[-1][-1]}")
    caption = (
        "At the start and at the posterior mean. Change of shape: largest change, relative to the "
        "largest displacement."
    )
    header = ("mode", "before, Hz", "after, Hz", "change", "change of shape")
    alt = f"Deformed structure in each mode, before and after: {'; '.join(seen)} of the largest displacement."
    words = "Dashed grey: before updating. Solid: at the posterior mean."
    if "measured" in modes:
        words += " Diamonds: measured, each mode scaled to the posterior mean."
        if "expanded" in modes:
            words += " Dotted: expanded, the combination of the modes that is closest (SEREP)."
        alt += " The measured shapes are marked at the sensors."
    drawing = picture(plot_mode_shapes(run.trace), "shapes", alt, words)
    view = model_view(run)
    turning = () if view is None else (view,)
    return PageSection("shapes", title, (*turning, PageTable(caption, header, tuple(rows)), Pictures((drawing,))))
