"""What updating changed: parameters, frequencies, and the maxima of the posterior."""

from __future__ import annotations

import numpy as np

from fmu.analysis.maxima import Maxima
from fmu.analysis.maxima_text import MOST_SHOWN, share_of_mass
from fmu.numbers import MISSING, change, decimals, fixed, given, hertz, rounded, span
from fmu.report.document import Items, Omitted, Part, Pictures, Section, Table, Text
from fmu.report.plots.frequencies import frequencies_before, plot_frequency_updates
from fmu.report.plots.parameters import plot_parameter_updates
from fmu.report.plots.style import constant
from fmu.report.run import Run
from fmu.report.svg import picture
from fmu.report.units import shown

NO_FREQUENCIES = "the trace holds no frequencies to compare with measured ones"


def parameters(run: Run) -> Section:
    """Return the updated parameters beside start and bounds."""
    rows, seen = [], []
    for name in run.names:
        unit = run.unit(name)
        start, lower, upper = (constant(run.trace, c, name) / unit.factor for c in ("start", "lower", "upper"))
        mean, sd, low, high = (run.value(name, c) for c in ("mean", "sd", "eti90_lb", "eti90_ub"))
        n = decimals(sd)
        bounds = span(lower, upper, max(0, n - 1)) if np.isfinite([lower, upper]).any() else "none"
        rows.append(
            (
                name, unit.name or MISSING, fixed(start, n), fixed(mean, n), span(low, high, n), fixed(sd, n),
                change(mean / start - 1) if start else MISSING, bounds,
            )
        )  # fmt: skip
        words = f"{name} {fixed(mean, n)} {unit.name} ({span(low, high, n)})".replace("  ", " ")
        seen.append(f"{words}, start {fixed(start, n)}, bounds {bounds}")
    header = ("parameter", "unit", "start", "mean", "90 % interval", "sd", "change", "bounds")
    table = Table("Posterior of the parameters", header, tuple(rows), words=(1,))
    maximum = run.maxima[0].theta if run.maxima else None
    axes = plot_parameter_updates({run.name: run.trace}, maximum=maximum, summaries={run.name: run.summary})
    drawing = picture(axes, "updates", f"Posterior means with 90 % intervals. {'; '.join(seen)}.",
                      "Means and 90 % intervals between the bounds.")  # fmt: skip
    return Section("parameters", "Updated parameters", (table, Pictures((drawing,))))


def frequencies(run: Run) -> Section | Omitted:
    """Return the frequencies measured, before updating and after it."""
    title, table = "Frequencies", run.prediction
    if table is None:
        return Omitted(title, NO_FREQUENCIES)
    before = frequencies_before(run.trace)
    before = np.full(len(table), np.nan) if before is None else before
    is_noisy = "noisy_sd" in table
    rows, seen = [], []
    for (mode, row), f in zip(table.iterrows(), before, strict=True):
        n = max(1, decimals(row["sd"]))
        errors = [change(value / row["measured"] - 1) for value in (f, row["mean"])]
        noisy = span(row["noisy_eti90_lb"], row["noisy_eti90_ub"], n) if is_noisy else MISSING
        rows.append(
            (
                str(mode), given(row["measured"]), fixed(f, n), errors[0], fixed(row["mean"], n),
                errors[1], span(row["eti90_lb"], row["eti90_ub"], n), noisy,
            )
        )  # fmt: skip
        seen.append(f"mode {mode} {errors[0]} before, {errors[1]} after")
    header = (
        "mode", "measured, Hz", "before, Hz", "error before", "after, Hz", "error after",
        "90 %, without noise, Hz", "90 %, with noise, Hz",
    )  # fmt: skip
    caption = (
        "After: posterior mean of the model's frequency. Its 90 % interval without the measurement noise is where "
        "the model's frequency lies, with it where a new measurement would."
    )
    if np.isnan(before).all():
        caption += " The trace does not keep the frequencies before updating."
    axes = plot_frequency_updates(run.trace)
    drawing = picture(axes, "frequencies", f"Errors of the frequencies: {'; '.join(seen)}.",
                      "Distance of the model's frequencies from the measured ones.")  # fmt: skip
    return Section("frequencies", title, (Table(caption, header, tuple(rows)), Pictures((drawing,))))


def maxima(run: Run) -> Section | Omitted:
    """Return the maxima of the posterior: deterministic updating."""
    title = "Maxima of the posterior: deterministic updating"
    if run.maxima is None:
        return Omitted(title, "the trace keeps none; fmu run searches for them first")
    found = run.maxima
    count = "One maximum was found." if len(found) == 1 else f"{len(found)} maxima were found, the highest first."
    lead = f"{count} Share: of the posterior's probability. Starts: how many climbs ended there."
    said = found.at_bounds()
    if len(found) > MOST_SHOWN:
        said.append(f"The other {len(found) - MOST_SHOWN} are lower, and in map.csv.")
    parts: tuple[Part, ...] = (Text(lead), _maxima_table(run, found))
    if said:
        parts = (*parts, Items(tuple(said)))
    return Section("maxima", title, parts)


def _maxima_table(run: Run, found: Maxima) -> Table:
    """Return a column a maximum, beside start, posterior mean and measurement."""
    best = found.maxima[:MOST_SHOWN]
    names = tuple(f"maximum {k}" for k in range(1, len(best) + 1))
    nothing = (MISSING,) * 2
    rows = [
        ("log-probability", "nats", MISSING, *(rounded(m.log_prob, 1.0) for m in best), *nothing),
        ("share", "", MISSING, *map(share_of_mass, best), *nothing),
        ("starts", "", MISSING, *(str(m.starts) for m in best), *nothing),
    ]
    for k, (name, si) in enumerate(zip(found.names, found.units, strict=True)):
        unit = shown(si)
        n = decimals(run.value(name, "sd"))
        values = [found.start[k], *(m.theta[k] for m in best), float(run.summary["mean"][name])]
        rows.append((name, unit.name, *(fixed(value / unit.factor, n) for value in values), MISSING))
    mean = [np.nan] * len(found.labels) if run.prediction is None else list(run.prediction["mean"])
    for k, label in enumerate(found.labels):
        values = [found.before[k], *(m.frequencies[k] for m in best), mean[k]]
        rows.append((f"mode {label}", "Hz", *hertz(*values), given(found.measured[k])))
    header = ("quantity", "unit", "start", *names, "posterior mean", "measured")
    return Table("The model at the start, at the maxima and on average", header, tuple(rows), words=(1,))
