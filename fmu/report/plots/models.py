"""Plots that compare several models of the same data: predictions of held-out modes, and parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence.diagnostics import summary
from fmu.analysis.trace.reading import constant, parameter_names
from fmu.report.plots import style
from fmu.report.plots.frequencies import Frequencies, plot_frequency_errors

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ROW = 0.16
"""Height in inches of one interval."""


def colours_of(names: Sequence[str]) -> dict[str, str]:
    """Return a colour for each model, keyed by name. The first model (the reference) is grey.

    The colours repeat if there are more models than colours.
    """
    palette = [style.GREY, *style.PALETTE]
    return {name: palette[k % len(palette)] for k, name in enumerate(names)}


def plot_held_out(tables: Mapping[str, pd.DataFrame], figure: Figure | None = None) -> Axes:
    """Plot each model's error, in %, in predicting every mode from the other modes, with 90 % intervals.

    Parameters
    ----------
    tables : mapping of str to pandas.DataFrame
        For each model, the result of `fmu.leave_one_out`. All results must have the same modes.
    figure : Figure, optional

    Returns
    -------
    Axes
    """
    colours, first = colours_of(list(tables)), next(iter(tables.values()))
    series = [
        Frequencies(name, table["mean"], colours[name], interval_hz=table[["eti90_lb", "eti90_ub"]].to_numpy().T)
        for name, table in tables.items()
    ]
    labels = [style.literal(str(mode)) for mode in first.index]
    width = max(7.2, 0.2 * len(labels) * len(series))
    figure = figure or style.new_figure(width, 5.2 if style.rotate_labels(labels, width) else 4.2)
    axes = plot_frequency_errors(first["measured"].to_numpy(), series, labels, figure)
    axes.set_ylabel("(predicted − measured)/measured, %")
    return axes


def plot_intervals(traces: Mapping[str, xr.DataTree], figure: Figure | None = None) -> Axes:
    """Plot each parameter's mean and 90 % interval under every model, relative to the parameter's start value.

    The parameters and their start values are those of the first model. Parameters whose start value is 0 or
    unknown are shown in SI units.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        Traces, keyed by the names of the models.
    figure : Figure, optional

    Returns
    -------
    Axes
    """
    first = next(iter(traces.values()))
    names, colours = parameter_names(first), colours_of(list(traces))
    starts = np.array([constant(first, "start", name) for name in names])
    scale = np.where(np.isfinite(starts) & (starts != 0.0), starts, 1.0)
    figure = figure or style.new_figure(7.2, _ROW * len(names) * (len(traces) + 1) + 1.2)
    axes = figure.subplots()
    place = -np.arange(len(names), dtype=float)
    axes.axvline(1.0, color=style.BLACK, linewidth=0.8, zorder=0)
    for k, (label, trace) in enumerate(traces.items()):
        table = summary(trace).reindex(list(names))
        y = place - 0.7 * ((k + 0.5) / len(traces) - 0.5)
        low, mean, high = (table[column].to_numpy() / scale for column in ("eti90_lb", "mean", "eti90_ub"))
        axes.hlines(y, low, high, color=colours[label], linewidth=3.0, alpha=0.55)
        axes.plot(mean, y, "o", markersize=4.0, color=colours[label], label=style.literal(label))
    axes.set_yticks(place, [style.literal(name) for name in names])
    style.finish(axes, "value / start value, mean and 90 % interval")
    style.legend_below(axes)
    return axes
