"""The figure of the comparison."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.report.plots.style import DPI, FONT, GREY, PALE, colour, finish, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw(rows: dict[str, list[Any]], out: str) -> Figure:
    """Draw ESS per solve and per second, a bar a sampler: logarithmic, the best per second on top.

    Parameters
    ----------
    rows : dict of str to list of Row
        By experiment.
    out : str
        PNG.

    Returns
    -------
    Figure
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    figure = new_figure(11.0, 0.5 + sum(0.34 * len(of_case) + 0.9 for of_case in rows.values()))
    axes = figure.subplots(len(rows), 2, squeeze=False, height_ratios=[len(of_case) for of_case in rows.values()])
    for pair, (case, of_case) in zip(axes, rows.items(), strict=True):
        ordered = sorted(of_case, key=lambda row: row.per_second())
        _bars(pair[0], ordered, lambda row, warmup_in=False: row.per_solve(warmup_in))
        _bars(pair[1], ordered, lambda row, warmup_in=False: row.per_second(warmup_in))
        pair[0].set_yticks(range(len(ordered)), [row.name for row in ordered], fontsize=FONT - 1)
        pair[1].set_yticks([])
        pair[0].set_title(case, loc="left", fontsize=FONT + 1)
        pair[0].set_xlabel("ESS per solve (a gradient counts as what it costs)", fontsize=FONT)
        pair[1].set_xlabel("ESS per second on one core", fontsize=FONT)
    handles = [
        Patch(facecolor=GREY, label="fmu, default settings (in colour)"),
        Patch(facecolor=PALE, edgecolor=GREY, hatch="///", label="peer"),
        Patch(facecolor="white", edgecolor=GREY, hatch="...", label="peer, steps × time of a dense model"),
        Line2D([], [], color="black", marker="|", linestyle="", markersize=10, label="warm-up counted"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=FONT - 1, frameon=False)
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=DPI)
    return figure


def short(value: float) -> str:
    """Return two significant digits, without an exponent."""
    return np.format_float_positional(float(f"{value:.1e}"), trim="-")


def _bars(axes: Any, rows: list[Any], value: Any) -> None:
    values = np.array([value(row) for row in rows])
    axes.set_xscale("log")
    axes.set_xlim(0.6 * min(value(row, True) for row in rows), 4.0 * values.max())
    for y, (row, width) in enumerate(zip(rows, values, strict=True)):
        style = {"color": colour(row.label)}
        if not row.ours:
            hatch, face = ("...", "white") if row.is_product else ("///", PALE)
            style = {"facecolor": face, "edgecolor": GREY, "hatch": hatch}
        axes.barh(y, width, 0.7, **style)
        axes.plot(value(row, True), y, marker="|", color="black", markersize=11)
        axes.text(1.1 * width, y, short(width), va="center", fontsize=FONT - 2, color=GREY)
    finish(axes)
