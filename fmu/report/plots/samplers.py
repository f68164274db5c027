"""Samplers beside one another."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from fmu.numbers import significant
from fmu.report.plots.style import FONT, GREY, NARROW, TITLES, colour, finish, literal, new_figure

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ROOM = 1.25
"""Width of the frame over that of the longest bar, which leaves room for the number behind it."""


def plot_efficiency(
    traces: Mapping[str, xr.DataTree], table: pd.DataFrame | None = None, figure: Figure | None = None
) -> Axes:
    """Draw a bar a sampler: effective draws of its worst parameter per 1000 model solves, warm-up counted.

    A bar that is only outlined belongs to a run that has not converged: its ESS is not to be relied on.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
    table : pandas.DataFrame, optional
        ``fmu.compare(traces)``, where it is at hand.
    figure : Figure, optional

    Returns
    -------
    Axes
    """
    from fmu.analysis.convergence.comparison import CONVERGED, compare

    table = compare(traces) if table is None else table
    figure = figure or new_figure(NARROW, 0.62 * len(traces) + 0.9)
    axes = figure.subplots()
    y = np.arange(len(traces), dtype=float)
    widths = 1000.0 * np.nan_to_num(table.loc[list(traces), "ess_per_solve"].to_numpy())
    names = []
    for k, (label, trace) in enumerate(traces.items()):
        shade = colour(str(trace.attrs["sampler"]))
        is_converged = table.loc[label, "verdict"] == CONVERGED
        axes.barh(y[k], widths[k], 0.62, color=shade if is_converged else "none", edgecolor=shade, linewidth=1.6)
        axes.annotate(significant(widths[k]), (widths[k], y[k]), (4, 0), textcoords="offset points", va="center",
                      fontsize=FONT - 1, color=GREY)  # fmt: skip
        names.append(TITLES.get(label, literal(label)) + ("" if is_converged else "\n(not converged)"))
    axes.set_yticks(y, names)
    axes.invert_yaxis()
    axes.set_xlim(0.0, _ROOM * max(widths.max(), 1e-300))
    axes.set_xlabel("effective draws per 1000 model solves", fontsize=FONT)
    axes.set_ylabel("sampler", fontsize=FONT)
    finish(axes)
    return axes
