"""Estimates while the run grows: they must settle."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fmu.numbers import given
from fmu.report.plots.style import (
    BLACK,
    FONT,
    GREY,
    NARROW,
    PALE,
    chain_colours,
    colour,
    finish,
    legend_below,
    literal,
    new_figure,
    stacked,
    unit_of,
)

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DASHES = ("-", "--", "-.", ":")
_FLOOR = 1e-3
"""What is nearer to 1 than this, or below, tells nothing apart."""


def plot_running_means(
    trace: xr.DataTree, table: pd.DataFrame | None = None, figure: Figure | None = None
) -> NDArray[Any]:
    """Draw the mean of each chain's first draws, one row a parameter.

    The band is the mean of all draws with twice its standard error.

    Parameters
    ----------
    trace : xarray.DataTree
    table : pandas.DataFrame, optional
        ``fmu.summary(trace)``, where it is at hand.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (parameters,)
    """
    from fmu.analysis.convergence.diagnostics import parameter_names, summary, walkers_of
    from fmu.analysis.convergence.running import lengths, running_means

    names = parameter_names(trace)
    table = summary(trace) if table is None else table
    axes = stacked(len(names), figure)
    steps = trace["posterior"].sizes["draw"] // walkers_of(trace)
    at, means = running_means(trace, lengths(steps, 60))
    for i, (name, axis) in enumerate(zip(names, axes, strict=True)):
        unit = unit_of(trace, name)
        mean, error = (float(table[column][name]) / unit.factor for column in ("mean", "mcse_mean"))
        if np.isfinite(error):
            axis.axhspan(mean - 2 * error, mean + 2 * error, color=PALE, linewidth=0, zorder=0)
        axis.axhline(mean, color=GREY, linewidth=0.8, zorder=1)
        for chain, shade in enumerate(chain_colours(trace)):
            axis.plot(at, means[:, chain, i] / unit.factor, color=shade, linewidth=1.2)
        axis.set_xscale("log")
        axis.minorticks_off()
        axis.set_ylabel(literal(unit.label(name)), fontsize=FONT)
        finish(axis)
    axes[-1].set_xlabel("steps kept", fontsize=FONT)
    axes[0].figure.align_ylabels(axes)
    return axes


def plot_running_rhat(trace: xr.DataTree, figure: Figure | None = None) -> Axes:
    """Draw R-hat of each parameter while the run grows, with the limit that the verdict uses.

    Parameters
    ----------
    trace : xarray.DataTree
    figure : Figure, optional

    Returns
    -------
    Axes
    """
    from fmu.analysis.convergence.diagnostics import RHAT_LIMIT, parameter_names
    from fmu.analysis.convergence.running import running_rhat

    figure = figure or new_figure(NARROW, 3.4)
    axes = figure.subplots()
    at, rhat = running_rhat(trace)
    shades = chain_colours(trace)
    base = colour(str(trace.attrs["sampler"]))
    for i, name in enumerate(parameter_names(trace)):
        dashes = _DASHES[i % len(_DASHES)]
        shade = base if i < len(_DASHES) else shades[-1]
        above = np.maximum(rhat[:, i] - 1.0, _FLOOR)
        axes.plot(at, above, label=literal(name), color=shade, linestyle=dashes, linewidth=1.6)
    axes.plot(at[[0, -1]], [RHAT_LIMIT - 1.0] * 2, color=BLACK, linewidth=1.0)
    axes.annotate(f"limit {given(RHAT_LIMIT)}", (at[-1], RHAT_LIMIT - 1.0), (0, 3), textcoords="offset points",
                  ha="right", fontsize=FONT - 2)  # fmt: skip
    finite = rhat[np.isfinite(rhat)] - 1.0
    axes.set_ylim(_FLOOR, max(3.0 * (RHAT_LIMIT - 1.0), 1.3 * finite.max(initial=0.0)))
    axes.set(xscale="log", yscale="log")
    axes.minorticks_off()
    axes.set_xlabel("steps kept", fontsize=FONT)
    axes.set_ylabel(f"R-hat − 1 (at least {given(_FLOOR)})", fontsize=FONT)
    finish(axes)
    legend_below(axes)
    return axes
