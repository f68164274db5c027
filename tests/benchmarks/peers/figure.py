"""The figure of all samplers on one posterior."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fmu.numbers import significant
from fmu.report.plots.style import DPI, FONT, GREY, PALE, colour, finish, new_figure
from tests.benchmarks.peers.rows import Row, doubts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PANELS = (("evaluations", "log-probability"), ("cpu_s", "second on one core"))


def draw(rows: list[Row], out: str) -> Figure:
    """Draw effective draws per evaluation and per second, one bar per sampler, the best per second at the top.

    A bar is for the whole run, and a mark for the draws after warm-up. Runs that are not right are hatched.

    Parameters
    ----------
    rows : list of Row
        Rows of one posterior; rows without draws are left out.
    out : str
        Name of the PNG file.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    having = [row for row in rows if np.isfinite(row.ess())]
    ordered = sorted(having, key=lambda row: row.per("cpu_s", True))
    figure = new_figure(11.0, 1.6 + 0.3 * len(ordered))
    for axes, (unit, what) in zip(figure.subplots(1, 2), PANELS, strict=True):
        in_all, after = ([row.per(unit, whole) for row in ordered] for whole in (True, False))
        axes.set_xscale("log")
        axes.set_xlim(0.6 * min(in_all), 5.0 * max(after))
        for y, (row, value, later) in enumerate(zip(ordered, in_all, after, strict=True)):
            style = {"facecolor": colour(row.label) if row.ours else PALE, "edgecolor": GREY}
            axes.barh(y, value, 0.7, hatch="///" if doubts(row, rows) else None, **style)
            axes.plot(later, y, marker="|", color="black", markersize=10)
            axes.text(1.15 * later, y, significant(value, 2), va="center", fontsize=FONT - 2, color=GREY)
        axes.set_xlabel(f"ESS per {what}", fontsize=FONT)
        finish(axes)
        axes.set_yticks(range(len(ordered)), [""] * len(ordered))
    figure.axes[0].set_yticks(range(len(ordered)), [row.name for row in ordered], fontsize=FONT - 1)
    handles = [
        Patch(facecolor=GREY, label="fmu (in colour)"),
        Patch(facecolor=PALE, edgecolor=GREY, label="peer"),
        Patch(facecolor="white", edgecolor=GREY, hatch="///", label="not right"),
        Line2D([], [], color="black", marker="|", linestyle="", markersize=10, label="draws after warm-up"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=FONT - 1, frameon=False)
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=DPI)
    return figure
