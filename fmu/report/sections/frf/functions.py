"""The report section on measured and predicted frequency response functions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.fit.check import HELD_OUT, RESPONSES
from fmu.analysis.frf.predictions import GROUP
from fmu.numbers import MISSING, names_in_words, share, significant, whole, with_sd
from fmu.report.document import Omitted, PageSection, PageTable, Part, Picture, Pictures, Text, picture
from fmu.report.plots.frf.functions import LARGE, frf_names, plot_frf
from fmu.report.run import ReportedRun

if TYPE_CHECKING:
    import xarray as xr

LOOK_AT_FRFS = (
    "Look for a stretch of points beside the band, and for distances above the dashed line in a row: there the "
    f"model is wrong, or the channel. Of noise alone, 1 % of the distances exceed {significant(LARGE, 2)}."
)
MOST_DRAWN = 6
"""Largest number of functions that are drawn; the others are in the table."""


def frfs(run: ReportedRun) -> PageSection | Omitted:
    """Return the section on the frequency response functions, or `Omitted` if none were measured.

    All functions are listed, but at most `MOST_DRAWN` are drawn: those with the largest errors.
    """
    title, names = "Frequency response functions", frf_names(run.trace)
    if not names:
        return Omitted(title, "none were measured")
    group = run.trace[GROUP].to_dataset()
    rows = tuple(_row(run, group.sel(frf=name), name) for name in names)
    header = ("FRF", "values", "FRAC", "Σ r²", "expected", "p", "not used", "of them in 90 %")
    caption = (
        "By FRF, response / drive: number of complex values in use; frequency response assurance criterion of the "
        "model's mean; sum of the squared errors in standard deviations, at the draws; p as in the checks of the "
        "model; values that are not used but predicted, and the share of their amplitudes in the 90 % interval."
    )
    parts: list[Part] = [Text(_say(run, group)), PageTable(caption, header, rows)]
    order = _worst_first(group)
    pictures = tuple(_drawing(run, names[i], k) for k, i in enumerate(order[:MOST_DRAWN]))
    parts += [Pictures((one,)) for one in pictures]
    if len(names) > MOST_DRAWN:
        left = len(names) - MOST_DRAWN
        parts.append(
            Text(
                f"The {MOST_DRAWN} with the largest errors are drawn; fmu.report.plots.plot_frf draws {left} more."
            )
        )
    channels = _channels(run, group)
    return PageSection("frfs", title, (*parts, *channels))


def _say(run: ReportedRun, group: xr.Dataset) -> str:
    """Return sentences on how well the functions fit, and on how well held-out values are predicted, if any."""
    failed = [
        check.of for check in run.diagnosis.fit.checks if check.failed and check.kind in (RESPONSES, HELD_OUT)
    ]
    n = group.sizes["frf"]
    said = [
        f"Beyond the noise: {names_in_words(failed)}." if failed
        else f"No FRF of {n} differs from the updated model by more than noise." if n > 1
        else "The FRF does not differ from the updated model by more than noise."
    ]  # fmt: skip
    used, held = int(group["freedom"].sum()) // 2, int(group["held_freedom"].sum()) // 2
    said.append(f"{whole(used)} complex values were used.")
    if held:
        inside = int(group["held_inside"].sum()) / held
        said.append(
            f"{whole(held)} others were not used and test the model: {share(inside)} of their amplitudes lie in "
            "the 90 % interval of their prediction."
        )
    return " ".join(said)


def _row(run: ReportedRun, one: xr.Dataset, name: str) -> tuple[str, ...]:
    p = {check.of: check.p for check in run.diagnosis.fit.checks if check.kind == RESPONSES}
    used, held = int(one["freedom"]) // 2, int(one["held_freedom"]) // 2
    frac, squares = float(one["frac"]), float(one["squares"].mean())
    return (
        name,
        whole(used),
        significant(frac, 4) if np.isfinite(frac) else MISSING,
        significant(squares) if used else MISSING,
        whole(2 * used) if used else MISSING,
        significant(p[f"FRF {name}"], 2) if f"FRF {name}" in p else MISSING,
        whole(held),
        share(int(one["held_inside"]) / held) if held else MISSING,
    )


def _worst_first(group: xr.Dataset) -> list[int]:
    """Return the functions' indices.

    If there are more than `MOST_DRAWN` functions, those with the largest errors come first.
    """
    if group.sizes["frf"] <= MOST_DRAWN:
        return list(range(group.sizes["frf"]))
    error = np.nanmean(group["distance"].to_numpy() ** 2, axis=1)
    return [int(i) for i in np.argsort(-error)]


def _drawing(run: ReportedRun, name: str, k: int) -> Picture:
    group = run.trace[GROUP].to_dataset().sel(frf=name)
    worst = float(np.nanmax(group["distance"].to_numpy()))
    at = float(group["line"].to_numpy()[int(np.nanargmax(group["distance"].to_numpy()))])
    alt = (
        f"Amplitude, phase and distance of the FRF {name}: measured, and 90 % intervals of the prediction. The "
        f"largest distance, as a normal score, is {significant(worst, 2)}, at {significant(at, 4)} Hz."
    )
    return picture(plot_frf(run.trace, name), f"frf{k}", alt, LOOK_AT_FRFS if k == 0 else f"FRF {name}.")


def _channels(run: ReportedRun, group: xr.Dataset) -> tuple[Part, ...]:
    """Return a tuple with a table of the response channels' gains and delays.

    The tuple is empty if no gain and no delay is inferred.
    """
    names = [str(name) for name in group["channel"].to_numpy()]
    rows = []
    for name, gain, sd in zip(names, group["gain"].to_numpy(), group["gain_sd"].to_numpy(), strict=True):
        if f"gain error of {name}" in run.names:
            gain, sd = (float(run.summary[key][f"gain error of {name}"]) for key in ("mean", "sd"))
        found = with_sd(1.0 + float(gain), float(sd)) if sd > 0.0 else MISSING
        delay = MISSING
        if f"delay of {name}" in run.names:
            mean, spread = (1e3 * float(run.summary[key][f"delay of {name}"]) for key in ("mean", "sd"))
            delay = with_sd(mean, spread)
        rows.append((name, found, delay))
    if all(row[1:] == (MISSING, MISSING) for row in rows):
        return ()
    caption = (
        "Gains and delays of the response channels, found from the FRFs. A gain of 1 is that of the calibration."
    )
    table = PageTable(caption, ("channel", "gain", "delay, ms"), tuple(rows))
    return (table,)
