"""Write the HTML page of `fmu check`, which examines a problem before sampling."""

from __future__ import annotations

import os
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from fmu.analysis.identifiability import Identifiability
from fmu.analysis.start.check import Check
from fmu.analysis.uninformed import doubts as doubts_of_information
from fmu.fem.pairing.correlation import LOOK_AT_SENSORS, LOOK_AT_SHAPES
from fmu.numbers import MISSING, change, fixed, given, hertz, listed, significant, with_sd
from fmu.report.document import (
    Details,
    Items,
    Page,
    PageSection,
    PageTable,
    Part,
    Picture,
    Pictures,
    Text,
    Verdict,
    picture,
)
from fmu.report.files import OutputDirectory
from fmu.report.pages import INDEX, render
from fmu.report.plots.correlation import plot_mac_matrix, plot_sensors
from fmu.report.plots.frequencies import Frequencies, plot_frequency_errors
from fmu.report.plots.frf.functions import plot_frf_at_start, shown_frfs
from fmu.report.plots.modes import plot_mode
from fmu.report.plots.style import COLOURS, GREY, NARROW, literal, new_figure, rotate_labels
from fmu.report.sections.frf.functions import MOST_DRAWN
from fmu.report.sections.origin import assumption_parts
from fmu.report.sections.structure import directions, legend_of_parameters

if TYPE_CHECKING:
    import xarray as xr

LOOK_AT_FRFS = (
    "Look for resonances of the test that the model does not have, and for parts that no stiffness could move: a "
    "wrong kind of FRF has another slope, a wrong channel another height or phase."
)
_DRAWN = 560
_MOST_SHAPES = 12


def write_check(found: Check, directory: str | os.PathLike[str]) -> Path:
    """Write the results of a problem check as an HTML page.

    Parameters
    ----------
    found : Check
    directory : path-like
        Output directory, created if it does not exist.

    Returns
    -------
    Path
        Path to ``index.html`` in that directory, a self-contained file.

    Raises
    ------
    ValueError
        If the page would overwrite a file that fmu did not write, `directory` is a file, or the manifest in it is
        invalid.
    """
    output = OutputDirectory(directory)
    name = f"{INDEX}.html"
    output.check([name])
    with output.stage_files() as stage:
        (stage / name).write_text(render(check_page(found)), encoding="utf-8")
    return output.root / name


def check_page(found: Check) -> Page:
    """Return the page for a check.

    Its sections are the model, modes, sensors, FRFs, prior predictions, identifiability and gradient. The sections
    on sensors, FRFs and identifiability are left out if the check has no results on them.
    """
    sections = [_model(found), _modes(found), *_sensors(found), *_responses(found), _prior(found)]
    if found.identifiability is not None:
        sections.append(_identifiability(found.identifiability))
    sections.append(_gradient(found))
    lead = (
        f"{len(found.parameters)} parameters, {len(found.modes.labels)} measured modes. Checked on {date.today()}."
    )
    footer = "Written by fmu check for the model at the start values, before updating."
    assumed = (
        ()
        if found.assumptions is None
        else assumption_parts(found.assumptions, "σ at the start where it is inferred.")
    )
    what = "Check of the problem before sampling"
    return Page(found.name, what, lead, _verdicts(found), tuple(sections), (), footer, assumed)


def _verdicts(found: Check) -> tuple[Verdict, ...]:
    doubts = found.modes.doubts
    answer = "No warnings" if not doubts else f"{len(doubts)} warning{'s' if len(doubts) > 1 else ''}"
    verdicts = [Verdict("Are the modes paired correctly?", answer, not doubts, "Warnings on the pairing", doubts)]
    if found.frfs is not None:
        odd = found.frfs.doubts
        answer = "No doubts" if not odd else f"{len(odd)} warning{'s' if len(odd) > 1 else ''}"
        question = "Are the FRFs what they are said to be?"
        verdicts.append(Verdict(question, answer, not odd, "Warnings on the FRFs", odd))
    if found.modes.correlation is not None or found.points is not None:
        odd = found.sensor_doubts
        is_open = not odd and found.modes.correlation is not None and bool(doubts)
        answer = "Yes" if not odd else f"{len(odd)} warning{'s' if len(odd) > 1 else ''}"
        answer = "Unknown while the pairing is in doubt" if is_open else answer
        good, question = None if is_open else not odd, "Do the sensors agree with the model?"
        verdicts.append(Verdict(question, answer, good, "Warnings on the sensors", odd))
    far = int(found.prior.is_far.sum())
    covered = not far and not found.prior.failed
    expected = covered and not found.priors
    missed = f"{far} of {len(found.prior.labels)} modes not covered" if far else "The model fails"
    answer = missed if not covered else "Yes" if expected else "Priors miss their bounds"
    reasons = (*found.priors, *found.prior.doubts)
    verdicts.append(
        Verdict("Does the prior cover the data?", answer, expected, "What is wrong with the prior", reasons)
    )
    if found.identifiability is not None:
        n, k = len(found.identifiability.names), found.identifiability.n_informed
        answer, unknown = f"{k} of {n} directions, linearised", tuple(doubts_of_information(found.identifiability))
        good = False if unknown else True if k == n else None
        verdicts.append(Verdict("What can the data identify?", answer, good, "What they cannot identify", unknown))
    if found.tests:
        verdicts.append(Verdict("Are the tests independent?", "No", False, "How they are correlated", found.tests))
    agrees = found.gradient.agrees
    reasons = () if agrees else (found.gradient.sentence(),)
    answer = "Yes" if agrees else "No"
    verdicts.append(
        Verdict("Is the gradient correct?", answer, agrees, "What is wrong with the gradient", reasons)
    )
    return tuple(verdicts)


def _model(found: Check) -> PageSection:
    parts: list[Part] = [Items(found.model)]
    if found.drawing:
        caption = (
            "Squares: supports. Discs: masses. Zigzags, rings: springs. Arrows, small dots: sensors (with two "
            "heads or curved: of rotations)."
        )
        # fmu.fem.frame.drawing escapes the text in the drawing
        drawing = Markup(found.drawing) + legend_of_parameters(
            found.parameters.index, found.colours, found.drawing
        )
        parts.append(Pictures((Picture(drawing, caption, _DRAWN),)))
    if found.points is not None:
        table = found.point_table()
        rows = tuple(tuple(map(str, row)) for row in table.itertuples(index=False))
        caption = "Points of the test on the nodes of the mesh, the farthest first. Spacing: to the next node."
        matched = PageTable(caption, tuple(table.columns), rows)
        parts += [Items(found.points.notes), Details("Points of the test", (matched,))]
    words = ("prior", "changes") if "changes" in found.parameters else ("prior",)
    header = ("parameter", "unit", "start", "lower", "upper", "prior, cut off at the bounds", *words[1:])
    rows = tuple(
        (
            str(name),
            row.unit or MISSING,
            *(given(value) for value in (row.start, row.lower, row.upper)),
            *(row[column] or MISSING for column in words),
        )
        for name, row in found.parameters.iterrows()
    )
    parts.append(PageTable("Parameters", header, rows, words=(1, *range(5, len(header)))))
    return PageSection("model", "The model", tuple(parts))


def _modes(found: Check) -> PageSection:
    modes = found.modes
    table = found.mode_table()
    rows = tuple(tuple(map(str, row)) for row in table.itertuples(index=False))
    words = tuple(i for i, name in enumerate(table.columns) if name in ("measured mode", "moves"))
    caption = "Lowest modes of the model at the start, and the measured modes that they are paired with."
    if "moves" in table.columns:
        caption += " Moves: directions with most of the mode's kinetic energy."
    parts: list[Part] = [Text(_largest_error(found)), PageTable(caption, tuple(table.columns), rows, words)]
    if modes.notes:
        parts.append(Items(modes.notes))
    if found.shapes is not None and "displacement" in found.shapes:
        parts.append(Pictures(_shapes(found, found.shapes)))
    return PageSection("modes", "Modes at the start", tuple(parts))


def _sensors(found: Check) -> list[PageSection]:
    """Return a list with the section that compares test and model at the sensors.

    The list is empty if no shapes were measured.
    """
    alike = found.modes.correlation
    if alike is None:
        return []
    sensors, table = alike.sensors, found.sensor_table()
    worst = ", ".join(f"{row.sensor} {row.ecomac}" for row in table[:3].itertuples())
    along = plot_sensors(sensors, {"at the start": (alike.comac, alike.ecomac)})
    alt = f"CoMAC and ECoMAC of {len(sensors)} sensors. The largest ECoMAC: {worst}."
    pictures = [picture(along, "sensors", alt, LOOK_AT_SENSORS)]
    if len(alike.labels) > 1:
        most = fixed(float(np.triu(alike.auto_mac, 1).max()), 2)
        axes = plot_mac_matrix(alike.auto_mac, alike.labels, alike.labels)
        pictures.append(picture(axes, "automac", f"AutoMAC: at most {most} off the diagonal.", LOOK_AT_SHAPES))
    rows = tuple(tuple(map(str, row)) for row in table.itertuples(index=False))
    every = Details(
        "Sensor by sensor", (PageTable("The largest ECoMAC first.", ("sensor", "CoMAC", "ECoMAC"), rows),)
    )
    return [PageSection("sensors", "Test and model at the sensors", (Pictures(tuple(pictures)), every))]


def _responses(found: Check) -> list[PageSection]:
    """Return a list with the section on frequency response functions.

    The list is empty if none were measured. At most `MOST_DRAWN` functions are plotted; the table lists all of
    them.
    """
    if found.frfs is None:
        return []
    table = found.frfs.table().reset_index()
    rows = tuple(tuple(map(str, row)) for row in table.itertuples(index=False))
    caption = (
        "Median error of the values in use, and frequency response assurance criterion of the model at the start."
    )
    parts: list[Part] = [PageTable(caption, tuple(table.columns), rows)]
    said = (*found.frfs.doubts, *found.frfs.notes)
    parts += [Items(said)] if said else []
    drawn = [pair for one in found.frfs.tests for pair in zip(shown_frfs(one), one.computed, strict=True)]
    for k, (shown, computed) in enumerate(drawn[:MOST_DRAWN]):
        axes = plot_frf_at_start(shown, computed)
        alt = f"Amplitude and phase of the FRF {shown.name}, measured and computed before updating."
        parts.append(Pictures((picture(axes, f"frf{k}", alt, LOOK_AT_FRFS if k == 0 else f"FRF {shown.name}."),)))
    return [PageSection("frfs", "Frequency response functions at the start", tuple(parts))]


def _shapes(found: Check, shapes: xr.Dataset) -> tuple[Picture, ...]:
    """Return figures of the computed modes that are paired with the first 12 measured modes."""
    coordinates, ends = shapes["coordinates"].to_numpy(), shapes["ends"].to_numpy()
    pictures = []
    for k, label in enumerate(found.modes.labels[:_MOST_SHAPES]):
        displacement = shapes["displacement"].isel(state=0, mode=k).to_numpy()
        mode = found.modes.of(k)
        node, axis = np.unravel_index(np.argmax(np.abs(displacement)), displacement.shape)
        place = listed(coordinates[node])
        measured = found.modes.measured_hz[k]
        hz = hertz(mode.frequency_hz, measured=measured)[0]
        caption = f"Mode {label}: computed mode {mode.number}, {hz} Hz, measured {given(measured)} Hz."
        alt = f"{caption} The largest displacement is in {'xyz'[axis]} at ({place}) m."
        pictures.append(picture(plot_mode(coordinates, ends, displacement), f"mode{k}", alt, caption))
    return tuple(pictures)


def _largest_error(found: Check) -> str:
    errors = [found.modes.error_percent(k) for k in range(len(found.modes.labels))]
    k = max(range(len(errors)), key=lambda i: abs(errors[i]))
    return f"Largest frequency error before updating: {change(errors[k] / 100)} in mode {found.modes.labels[k]}."


def _prior(found: Check) -> PageSection:
    prior, labels = found.prior, found.prior.labels
    parts: list[Part] = [Items(tuple(prior.sentences()))]
    start = [found.modes.of(k).frequency_hz for k in range(len(labels))]
    if len(prior.frequencies) > 1:
        series = (
            Frequencies("at the start", start, GREY, filled=False),
            Frequencies("prior: mean, 90 % interval", prior.mean, COLOURS["hmc"], interval_hz=prior.interval),
        )
        figure = new_figure(NARROW, 5.2 if rotate_labels(labels, NARROW) else 4.2)
        axes = plot_frequency_errors(prior.measured, series, [literal(label) for label in labels], figure)
        said = "; ".join(
            f"mode {label} measured {given(m)}, at the start {hertz(f, measured=m)[0]}, prior prediction "
            f"{with_sd(mean, sd)} Hz"
            for label, m, f, mean, sd in zip(labels, prior.measured, start, prior.mean, prior.sd, strict=True)
        )
        alt = f"Measured, computed and predicted frequencies: {said}."
        caption = "Frequency error of the model before updating, and the range that the prior allows."
        parts.append(Pictures((picture(axes, "prior", alt, caption),)))
        table = found.prior_table()
        rows = tuple((label, *row) for label, row in zip(labels, table.to_numpy(), strict=True))
        is_noisy = np.isfinite(prior.noise_sd).all()
        noise = f"The sd is that of {found.measurement}, with its error." if is_noisy else ""
        header = ("mode", "measured, Hz", "prior prediction, Hz", "distance, sd")
        parts.append(PageTable(f"{len(prior.frequencies)} draws from the prior. {noise}".strip(), header, rows))
    return PageSection("prior", "Prior prediction", tuple(parts))


def _identifiability(informed: Identifiability) -> PageSection:
    table = Details("Directions and singular values", (directions(informed, "Before updating, at the start"),))
    later = Text("Bounds, curvature and several maxima are not counted: after a run the draws tell what is left.")
    return PageSection("informed", "Identifiability", (Items(tuple(informed.sentences())), later, table))


def _gradient(found: Check) -> PageSection:
    gradient = found.gradient
    rows = tuple(
        (name, *(significant(float(error), 2) for error in errors))
        for name, errors in zip(gradient.names, gradient.relative_error.T, strict=True)
    )
    caption = (
        "Exact gradient of the log-probability compared with central differences: their difference relative "
        "to the size of the gradient at the point, with parameters scaled to order one."
    )
    table = Details("Parameter by parameter", (PageTable(caption, ("parameter", *gradient.points), rows),))
    return PageSection("gradient", "Gradient", (Text(gradient.sentence()), table))
