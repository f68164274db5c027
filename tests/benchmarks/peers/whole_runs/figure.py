"""The figure of the whole runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.report.plots.style import DPI, FONT, GREY, PALE, colour, finish, new_figure
from tests.benchmarks.peers.whole_runs.rows import doubts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MARKERS = {"nautilus": "s", "nautilus, no networks": "D", "dynesty, dynamic": "^"}
"""Of the peers; fmu's samplers are circles in their colours."""
FIGURES = (("per_evaluation", "log-probability"), ("per_second", "second on one core"))


def draw(whole: dict[str, list[Any]], out: str) -> Figure:
    """Draw ESS per evaluation and per second: a line a posterior, a marker a sampler, hollow if not right.

    Parameters
    ----------
    whole : dict of str to list of WholeRow
        By posterior.
    out : str
        PNG.

    Returns
    -------
    Figure
    """
    from matplotlib.lines import Line2D
    from matplotlib.ticker import NullFormatter

    figure = new_figure(11.0, 1.7 + 0.5 * len(whole))
    handles = {}
    for axes, (value, what) in zip(figure.subplots(1, 2), FIGURES, strict=True):
        values = []
        for y, of_posterior in enumerate(reversed(list(whole.values()))):
            for row in of_posterior:
                edge = colour(row.label) if row.ours else GREY
                style = {"marker": MARKERS.get(row.label, "o"), "markeredgecolor": edge, "linestyle": ""}
                style |= {"markersize": 8}
                face = "white" if doubts(row, of_posterior) else edge
                values.append(getattr(row, value)())
                axes.plot(values[-1], y, markerfacecolor=face, **style)
                handles[row.name] = Line2D([], [], markerfacecolor=edge, label=row.name, **style)
        axes.set_xscale("log")
        decades = np.log10(values)
        axes.set_xlim(10.0 ** np.floor(decades.min()), 10.0 ** np.ceil(decades.max()))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_ylim(-0.6, len(whole) - 0.4)
        axes.set_yticks(range(len(whole)), [""] * len(whole))
        axes.set_xlabel(f"ESS per {what}, everything counted", fontsize=FONT)
        axes.grid(axis="y", color=PALE)
        finish(axes)
    names = [name.replace(", ", ",\n") for name in reversed(whole)]
    figure.axes[0].set_yticks(range(len(whole)), names, fontsize=FONT - 1)
    hollow = {"marker": "o", "markeredgecolor": GREY, "markerfacecolor": "white", "linestyle": ""}
    handles["hollow"] = Line2D([], [], markersize=8, label="hollow: not right", **hollow)
    figure.legend(
        handles=list(handles.values()), loc="outside lower center", ncols=5, fontsize=FONT - 1, frameon=False
    )
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=DPI)
    return figure
