"""Plots that compare samplers of one posterior: forest plot, marginals, ranks, and growth of the ESS."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence.diagnostics import summary
from fmu.analysis.convergence.growth import Growth, growth
from fmu.analysis.convergence.remedies import fewest, meets_criterion, required_ess
from fmu.analysis.trace.reading import array_of, parameter_names
from fmu.numbers import fixed
from fmu.report.plots import style
from fmu.report.plots.chains import draw_ranks
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LINE, _BINS = 0.19, 32
_INSIDE = (0.05, 0.25, 0.75, 0.95)
_NUMBERS = (("rhat", "R-hat", 3, 0.28), ("ess_bulk", "bulk", 0, 0.64), ("ess_tail", "tail", 0, 1.0))
"""Columns of numbers beside a forest plot: column of the summary, heading, decimals, and right edge."""
_FEWEST_RANKED, _MOST_RANKED = 20, 500


def plot_forest(
    traces: Mapping[str, xr.DataTree],
    summaries: Mapping[str, pd.DataFrame] | None = None,
    figure: Figure | None = None,
) -> style.AxesArray:
    """Plot every parameter's mean with 50 % and 90 % intervals for every sampler, with R-hat and ESS beside them.

    ArviZ's ``plot_forest`` is similar but requires runs of the same length. Each parameter has its own axes,
    because the units differ.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        Traces of the same posterior, keyed by the names of the rows.
    summaries : mapping of str to pandas.DataFrame, optional
        The result of ``fmu.summary(trace)`` for each trace, if already computed.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (ndim,)
    """
    tables = {name: summary(trace) for name, trace in traces.items()} if summaries is None else summaries
    first = next(iter(traces.values()))
    names = parameter_names(first)
    rows = _LINE * len(traces) + 0.55
    figure = figure or style.new_figure(style.NARROW, rows * len(names) + 0.3)
    axes = figure.subplots(len(names), 2, squeeze=False, width_ratios=(2.2, 1.15))
    y = np.arange(len(traces), dtype=float)
    for name, (axis, beside) in zip(names, axes, strict=True):
        unit = style.unit_of(first, name)
        for k, (label, trace) in enumerate(traces.items()):
            draws = array_of(trace, "posterior", name) / unit.factor
            low, lower, upper, high = np.quantile(draws, _INSIDE)
            shade = style.colour(str(trace.attrs["sampler"]))
            axis.hlines(y[k], low, high, color=shade, linewidth=1.3)
            axis.hlines(y[k], lower, upper, color=shade, linewidth=4.0)
            axis.plot([draws.mean()], [y[k]], marker="o", markersize=5, color=shade, markeredgecolor="white",
                      markeredgewidth=0.7)  # fmt: skip
            for column, _, places, x in _NUMBERS:
                beside.text(x, y[k], fixed(float(tables[label][column][name]), places), ha="right", va="center",
                            fontsize=style.FONT - 2)  # fmt: skip
        axis.set_yticks(y, [style.literal(label) for label in traces])
        axis.locator_params(axis="x", nbins=5)
        axis.set_title(style.literal(unit.label(name)), loc="left", fontsize=style.FONT)
        style.finish(axis)
        axis.tick_params(axis="y", length=0)
        beside.set_axis_off()
        beside.set_xlim(0.0, 1.0)
        for both in (axis, beside):
            both.set_ylim(len(traces) - 0.4, -0.6)
    for _, heading, _, x in _NUMBERS:
        axes[0, 1].text(x, -1.0, heading, ha="right", va="center", fontsize=style.FONT - 2, color=style.GREY)
    return np.asarray(axes[:, 0])


def plot_overlaid_marginals(traces: Mapping[str, xr.DataTree], figure: Figure | None = None) -> style.AxesArray:
    """Plot every parameter's posterior density for all samplers on the same axes.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        Traces of the same posterior, keyed by the names in the legend.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (ndim,)
    """
    first = next(iter(traces.values()))
    names = parameter_names(first)
    figure = figure or style.new_figure(style.NARROW, 1.25 * ((len(names) + 1) // 2) + 0.8)
    panels = style.grid_axes(len(names), figure)
    for name, axes in zip(names, panels, strict=True):
        unit = style.unit_of(first, name)
        draws = {
            label: array_of(trace, "posterior", name).ravel() / unit.factor for label, trace in traces.items()
        }
        low, high = np.min([x.min() for x in draws.values()]), np.max([x.max() for x in draws.values()])
        bins = np.linspace(low, high, _BINS + 1) if high > low else _BINS
        for label, x in draws.items():
            shade = style.colour(str(traces[label].attrs["sampler"]))
            density, edges = np.histogram(x, bins, density=True)
            axes.plot(0.5 * (edges[1:] + edges[:-1]), density, color=shade, linewidth=1.2, drawstyle="steps-mid",
                      label=style.literal(label))  # fmt: skip
        axes.set_ylim(bottom=0.0)
        axes.set_yticks([])
        axes.locator_params(axis="x", nbins=4)
        style.finish(axes, style.broken(unit.label(name), 0.5 * style.NARROW))
        axes.tick_params(labelsize=style.FONT - 2)
    style.legend_below(panels[0])
    return panels


def plot_ranks_of_samplers(
    traces: Mapping[str, xr.DataTree],
    summaries: Mapping[str, pd.DataFrame] | None = None,
    figure: Figure | None = None,
) -> style.AxesArray:
    """Plot the ranks of the samplers' draws with ArviZ. All curves are near zero if the distributions agree.

    The plots are the same as in `plot_ranks`, with samplers in place of chains. They include a test that assumes
    independent draws. The same number of draws is therefore taken from every sampler: half of the smallest
    effective sample size of all samplers, but at least 20 and at most 500. If an effective sample size is
    undefined, 20 draws are taken.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        At least two traces of the same posterior, keyed by the names in the legend.
    summaries : mapping of str to pandas.DataFrame, optional
        The result of ``fmu.summary(trace)`` for each trace, if already computed.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (ndim,)
    """
    import xarray as xr

    tables = {name: summary(trace) for name, trace in traces.items()} if summaries is None else summaries
    names = parameter_names(next(iter(traces.values())))
    independent = 0.5 * float(np.min([fewest(table) for table in tables.values()]))
    wanted = int(np.clip(np.nan_to_num(independent, nan=_FEWEST_RANKED), _FEWEST_RANKED, _MOST_RANKED))
    ranked = xr.Dataset(
        {name: (("chain", "draw"), [_evenly(trace, name, wanted) for trace in traces.values()]) for name in names},
        coords={"chain": np.arange(len(traces)), "draw": np.arange(wanted)},
    )
    axes = style.stack_axes(len(names), figure)
    shades = [style.colour(str(trace.attrs["sampler"])) for trace in traces.values()]
    draw_ranks(ranked, axes, shades)
    axes[-1].set_xlabel("rank among the draws of all samplers / their number", fontsize=style.FONT)
    for label, shade in zip(traces, shades, strict=True):
        axes[0].plot([], [], color=shade, label=style.literal(label))
    style.legend_below(axes[0])
    return axes


def _evenly(trace: xr.DataTree, name: str, wanted: int) -> FloatArray:
    """Return `wanted` draws of a parameter, evenly spaced over all chains, shape (wanted,)."""
    draws = array_of(trace, "posterior", name).ravel()
    return np.asarray(draws[np.linspace(0, len(draws) - 1, wanted).astype(int)])


def plot_growth(
    traces: Mapping[str, xr.DataTree],
    grown: Mapping[str, Growth] | None = None,
    search: float = 0.0,
    figure: Figure | None = None,
) -> Axes:
    """Plot how each run's smallest effective sample size grew with the number of model solves.

    A dot marks the point at which a run first met the convergence criterion.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        Traces of the same posterior, keyed by the names in the legend.
    grown : mapping of str to Growth, optional
        The result of ``growth(trace)`` for each trace, if already computed.
    search : float
        Number of model solves in the search for maxima, added to each run's solves.
    figure : Figure, optional

    Returns
    -------
    Axes
    """
    grown = {name: growth(trace) for name, trace in traces.items()} if grown is None else grown
    figure = figure or style.new_figure(style.NARROW, 3.6)
    axes = figure.subplots()
    needed = 0
    for label, trace in traces.items():
        shade, run, chains = (
            style.colour(str(trace.attrs["sampler"])),
            grown[label],
            trace["posterior"].sizes["chain"],
        )
        solves = search + run.solves
        axes.plot(solves, run.ess, color=shade, linewidth=1.6, label=style.literal(label))
        axes.update_datalim(np.column_stack([solves, solves]), updatey=False)  # ESS of a few draws is NaN
        met = [meets_criterion(*both, chains) for both in zip(run.excess, run.ess, strict=True)]
        if any(met):
            k = met.index(True)
            axes.plot(solves[[k]], run.ess[[k]], marker="o", markersize=6, color=shade,
                      markeredgecolor="white", markeredgewidth=0.8)  # fmt: skip
        needed = max(needed, required_ess(chains))
    axes.axhline(needed, color=style.GREY, linestyle="--", linewidth=0.9, label=f"{needed} needed")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.grid(color=style.PALE, linewidth=0.7)
    style.finish(axes, "model solves, everything counted", "smaller of bulk and tail ESS")
    style.legend_below(axes)
    return axes
