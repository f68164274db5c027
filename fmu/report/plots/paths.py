"""The paths of the chains."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fmu.report.plots.style import (
    BLACK,
    FONT,
    GREY,
    PALE,
    chain_colours,
    constant,
    finish,
    literal,
    new_figure,
    unit_of,
)

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MAX_POINTS = 1500


def plot_traces(
    traces: Mapping[str, xr.DataTree], published: ArrayLike | None = None, figure: Figure | None = None
) -> NDArray[Any]:
    """Draw the paths of the chains, one row a parameter and one column a trace, warm-up shaded.

    Of an ensemble one walker is shown. The frames fit the draws kept: what precedes them may leave the frame.
    Dashed lines are bounds.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        By the title of the column.
    published : array_like, shape (parameters,), optional
        Values to compare the first trace with, SI units.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (parameters, traces)
    """
    from fmu.analysis.convergence.diagnostics import parameter_names

    names = parameter_names(next(iter(traces.values())))
    figure = figure or new_figure(5.2 * len(traces) + 0.4, 1.55 * len(names) + 0.8)
    axes = figure.subplots(len(names), len(traces), sharex="col", squeeze=False)
    for j, (title, trace) in enumerate(traces.items()):
        walkers = int(trace.attrs["walkers"])
        for i, name in enumerate(names):
            _plot_path(axes[i, j], trace, name)
        if trace["warmup_posterior"].sizes["draw"]:
            _say_above(axes[0, j], 0.5 * trace["warmup_posterior"].sizes["draw"] / walkers, "warm-up")
        axes[0, j].set_title(literal(title), fontsize=FONT + 1)
        axes[-1, j].set_xlabel("step" if walkers == 1 else "step (one walker of each ensemble)", fontsize=FONT)
    if published is not None:
        for axis, name, value in zip(axes[:, 0], names, np.asarray(published, dtype=float), strict=True):
            _compare(axis, value / unit_of(next(iter(traces.values())), name).factor)
        _say_above(axes[0, 0], axes[0, 0].get_xlim()[1], "dotted: published", "right")
    figure.align_ylabels(axes)
    return axes


def _say_above(axes: Axes, x: float, words: str, side: Literal["center", "right"] = "center") -> None:
    """Write small words on top of the frame."""
    axes.text(x, 1.0, words, transform=axes.get_xaxis_transform(), ha=side, va="bottom", fontsize=FONT - 2,
              color=GREY)  # fmt: skip


def _compare(axes: Axes, value: float) -> None:
    """Draw a value to compare with, making room for it."""
    low, high = axes.get_ylim()
    axes.axhline(value, color=BLACK, linestyle=":", linewidth=1.3)
    axes.set_ylim(min(low, value - 0.05 * (high - low)), max(high, value + 0.05 * (high - low)))


def _plot_path(axes: Axes, trace: xr.DataTree, name: str) -> None:
    """Draw the paths of all chains in one parameter."""
    unit = unit_of(trace, name)
    walkers = int(trace.attrs["walkers"])
    warm, kept = (
        trace[group][name].transpose("chain", "draw").to_numpy()[:, ::walkers] / unit.factor
        for group in ("warmup_posterior", "posterior")
    )
    paths = np.concatenate([warm, kept], axis=1)
    every = max(1, paths.shape[1] // _MAX_POINTS)
    steps = np.arange(1, paths.shape[1] + 1)[::every]
    for path, shade in reversed(list(zip(paths, chain_colours(trace), strict=True))):
        axes.plot(steps, path[::every], color=shade, linewidth=0.7, rasterized=True)
    if warm.shape[1]:
        axes.axvspan(0, warm.shape[1], color=PALE, zorder=0, linewidth=0)
    low, high = kept.min(), kept.max()
    margin = 0.08 * (high - low) or 0.01 * abs(high)
    axes.set_ylim(low - margin, high + margin)
    axes.set_xlim(0, paths.shape[1])
    for bound in ("lower", "upper"):
        value = constant(trace, bound, name) / unit.factor
        if low - margin < value < high + margin:
            axes.axhline(value, color=BLACK, linestyle="--", linewidth=0.8)
    axes.set_ylabel(literal(unit.label(name)), fontsize=FONT)
    finish(axes)
