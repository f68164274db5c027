"""The figure of the comparison."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.report.plots.style import DPI, FONT, GREY, PALE, colour, finish, new_figure
from tests.benchmarks.peers.whole_runs.rows import doubts
from tests.benchmarks.peers.whole_runs.runs import ENOUGH

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw(rows: dict[str, list[Any]], whole: dict[str, list[Any]], out: str) -> Figure:
    """Draw ESS per solve and per second, a bar a sampler: logarithmic, the best per second on top.

    Below them the whole runs, a line a posterior and a marker a sampler; hollow where the run is not right.

    Parameters
    ----------
    rows : dict of str to list of Row
        By experiment.
    whole : dict of str to list of WholeRow
        By posterior.
    out : str
        PNG.

    Returns
    -------
    Figure
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    heights = [*(len(of_case) for of_case in rows.values()), 2.0 + 1.5 * len(whole)]
    figure = new_figure(11.0, 0.5 + sum(0.34 * height + 0.9 for height in heights))
    axes = figure.subplots(len(heights), 2, squeeze=False, height_ratios=heights)
    for pair, (case, of_case) in zip(axes[:-1], rows.items(), strict=True):
        ordered = sorted(of_case, key=lambda row: row.per_second())
        _bars(pair[0], ordered, lambda row, warmup_in=False: row.per_solve(warmup_in))
        _bars(pair[1], ordered, lambda row, warmup_in=False: row.per_second(warmup_in))
        pair[0].set_yticks(range(len(ordered)), [row.name for row in ordered], fontsize=FONT - 1)
        pair[1].set_yticks([])
        pair[0].set_title(case, loc="left", fontsize=FONT + 1)
        pair[0].set_xlabel("ESS per solve (a gradient counts as what it costs)", fontsize=FONT)
        pair[1].set_xlabel("ESS per second on one core", fontsize=FONT)
    _whole_runs(axes[-1], whole)
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


PEERS = {"nautilus": "s", "nautilus, no networks": "D", "dynesty, dynamic": "^"}
"""Their markers; fmu's samplers are circles in their colours."""


def _whole_runs(pair: Any, whole: dict[str, list[Any]]) -> None:
    """Draw the whole runs of all posteriors, ESS per evaluation and per second."""
    figures = (("per_evaluation", "log-probability"), ("per_second", "second"))
    for axes, (value, what) in zip(pair, figures, strict=True):
        for y, of_posterior in enumerate(reversed(list(whole.values()))):
            for row in of_posterior:
                edge = colour(row.label) if row.ours else GREY
                style = {"marker": PEERS.get(row.label, "o"), "markeredgecolor": edge, "linestyle": ""}
                face = "white" if doubts(row, of_posterior) else edge
                label = row.name if y == 0 else None
                axes.plot(getattr(row, value)(), y, markersize=8, markerfacecolor=face, label=label, **style)
        axes.set_xscale("log")
        axes.set_ylim(-0.6, len(whole) - 0.4)
        axes.set_xlabel(f"ESS per {what}, everything counted", fontsize=FONT)
        axes.grid(axis="y", color=PALE)
        finish(axes)
    pair[0].set_yticks(range(len(whole)), [_folded(name) for name in reversed(whole)], fontsize=FONT - 1)
    pair[1].set_yticks(range(len(whole)), [])
    pair[0].set_title(f"from nothing to {ENOUGH} effective draws", loc="left", fontsize=FONT + 1)
    pair[1].legend(fontsize=FONT - 2, title="hollow: not right", title_fontsize=FONT - 2, loc="best")


def _folded(name: str) -> str:
    return name.replace(", ", ",\n")


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
