"""Plots that show how informative the data are: prior and posterior densities, and frequency sensitivities."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fmu.analysis.identifiability import kept_identifiability
from fmu.analysis.trace.reading import constant, has, parameter_names
from fmu.numbers import significant
from fmu.report.plots import style
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BINS = 28
MOST_MEASURED, _WRITTEN = 40, 12
"""Largest number of measured quantities drawn, and of rows and columns with numbers written into the cells."""


def plot_marginals(
    trace: xr.DataTree, maximum: ArrayLike | None = None, figure: Figure | None = None
) -> style.AxesArray:
    """Plot each parameter's density before and after updating, with the starting point and the maximum.

    Parameters
    ----------
    trace : xarray.DataTree
        A trace with draws from the prior.
    maximum : array_like, shape (ndim,), optional
        The parameters at the posterior maximum, SI units.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (ndim,)

    Raises
    ------
    ValueError
        If the trace has no draws from the prior.
    """
    if not has(trace, "prior"):
        raise ValueError("trace: must have draws from the prior (it has none)")
    names, base = parameter_names(trace), style.colour(str(trace.attrs["sampler"]))
    figure = figure or style.new_figure(style.NARROW, 1.25 * ((len(names) + 1) // 2) + 0.6)
    panels = style.grid_axes(len(names), figure)
    for k, (name, axes) in enumerate(zip(names, panels, strict=True)):
        unit = style.unit_of(trace, name)
        before, after = (trace[group][name].to_numpy().ravel() / unit.factor for group in ("prior", "posterior"))
        x, density = _density(before)
        axes.fill_between(x, density, step="mid", color=style.PALE, linewidth=0, rasterized=True)
        axes.plot(x, density, color=style.GREY, linewidth=1.0, drawstyle="steps-mid", label="prior")
        axes.plot(*_density(after), color=base, linewidth=1.4, drawstyle="steps-mid", label="posterior")
        start = constant(trace, "start", name) / unit.factor
        if np.isfinite(start):
            axes.plot([start], [0.0], linestyle="none", marker="|", markersize=14, markeredgewidth=1.6,
                      color=style.BLACK, label="start", clip_on=False)  # fmt: skip
        if maximum is not None:
            axes.plot(np.asarray(maximum)[[k]] / unit.factor, [0.0], linestyle="none", marker="*", markersize=9,
                      color=style.VERMILLION, markeredgecolor=style.BLACK, markeredgewidth=0.5, label="maximum",
                      clip_on=False, zorder=5)  # fmt: skip
        axes.set_ylim(bottom=0.0)
        axes.set_yticks([])
        axes.locator_params(axis="x", nbins=4)
        style.finish(axes, style.broken(unit.label(name), 0.5 * style.NARROW))
        axes.tick_params(labelsize=style.FONT - 2)
        axes.spines["left"].set_visible(False)
    style.legend_below(panels[0])
    return panels


def _density(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a histogram's bin centres and densities, with an empty bin on either side."""
    low, high = x.min(), x.max()
    spread = high - low or max(1e-9 * abs(high), np.finfo(float).tiny)
    room = (
        1.001 * spread / (_BINS - 2)
    )  # slightly more than a bin, so that the last bin does not contain the largest value
    density, edges = np.histogram(x, _BINS, (low - room, high + room), density=True)
    return 0.5 * (edges[:-1] + edges[1:]), density


def plot_sensitivity(trace: xr.DataTree, figure: Figure | None = None) -> Axes:
    """Plot the sensitivity matrix of the frequencies with respect to the parameters.

    An entry is the frequency change, in error standard deviations, for a parameter change of one prior standard
    deviation. The model is linearised at the highest maximum, or at the starting point if no maximum was searched
    for. Other measured quantities are shown only if there are no frequencies. At most 40 quantities are shown. If
    the matrix has at most 12 rows and columns, entries of at least 3 % of the largest are also written as numbers.

    Parameters
    ----------
    trace : xarray.DataTree
        A trace with the linearised model (`fmu.analysis.identifiability`).
    figure : Figure, optional

    Returns
    -------
    Axes

    Raises
    ------
    ValueError
        If the trace has no linearised model.
    """
    kept = kept_identifiability(trace)
    if not kept:
        raise ValueError("trace: must have a linearised model (it has none)")
    found = list(kept.values())[-1]
    rows = [k for k, label in enumerate(found.labels) if label.endswith("frequency")] or range(len(found.labels))
    rows = list(rows)[:MOST_MEASURED]
    S, n = found.sensitivity[rows], len(found.names)
    labels = [style.literal(found.labels[k].removesuffix(", frequency")) for k in rows]
    names = [style.literal(name) for name in found.names]
    side = max(style.NARROW - 1.0, 0.42 * n)
    figure = figure or style.new_figure(side + 1.2, max(1.5, 0.28 * len(rows)) + 1.6)
    axes = figure.subplots()
    largest = float(np.max(np.abs(S))) or 1.0
    edges = [np.arange(size + 1) - 0.5 for size in (n, len(rows))]
    mesh = axes.pcolormesh(*edges, S, cmap="RdBu", vmin=-largest, vmax=largest, rasterized=True)
    if max(S.shape) <= _WRITTEN:
        for i, j in np.ndindex(*S.shape):
            if abs(S[i, j]) >= 0.03 * largest:
                axes.text(j, i, significant(float(S[i, j]), 2), ha="center", va="center", fontsize=style.FONT - 1,
                          color=style.ON_DARK if abs(S[i, j]) > 0.6 * largest else style.ON_PALE)  # fmt: skip
    axes.set_xticks(np.arange(n), style.thin_labels(names), **style.rotate_labels(names, side))
    axes.set_yticks(np.arange(len(rows)), style.thin_labels(labels))
    axes.invert_yaxis()
    figure.colorbar(mesh, ax=axes, label="sd / prior sd")
    style.finish(axes, "parameter", "mode")
    return axes
