"""Figures. One colour a sampler everywhere (Okabe & Ito's colour-blind safe palette), units on every axis.

Functions take traces and draw on a matplotlib Figure of their own or one that is handed in; they return its Axes
and touch no global state of matplotlib.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fmu.report.units import Unit, shown

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]

COLOURS = {"mh": "#E69F00", "slice": "#009E73", "hmc": "#0072B2", "emcee": "#CC79A7"}
TITLES = {
    "mh": "Metropolis–Hastings",
    "slice": "Slice sampling",
    "hmc": "Hamiltonian Monte Carlo",
    "emcee": "emcee ensemble",
}
BLACK, GREY, PALE = "#000000", "#6E6E6E", "#E8E8E8"
FONT = 10
DPI = 130
_MAX_POINTS = 1500


def new_figure(width: float, height: float, layout: Literal["constrained"] | None = "constrained") -> Figure:
    """Return an empty figure of the given size in inches, unknown to pyplot."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout=layout)


def colour(sampler: str) -> str:
    """Return the colour of a sampler; grey for one that has none."""
    return COLOURS.get(sampler, GREY)


def tint(base: str, share: float) -> tuple[float, float, float]:
    """Return a colour mixed with white; `share` of white between 0 and 1."""
    from matplotlib.colors import to_rgb

    red, green, blue = (share + (1.0 - share) * channel for channel in to_rgb(base))
    return red, green, blue


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
    from fmu.analysis.diagnostics import parameter_names

    names = parameter_names(next(iter(traces.values())))
    figure = figure or new_figure(5.2 * len(traces) + 0.4, 1.55 * len(names) + 0.8)
    axes = figure.subplots(len(names), len(traces), sharex="col", squeeze=False)
    for j, (title, trace) in enumerate(traces.items()):
        walkers = int(trace.attrs["walkers"])
        for i, name in enumerate(names):
            _plot_path(axes[i, j], trace, name)
        if trace["warmup_posterior"].sizes["draw"]:
            _say_above(axes[0, j], 0.5 * trace["warmup_posterior"].sizes["draw"] / walkers, "warm-up")
        axes[0, j].set_title(title, fontsize=FONT + 1)
        axes[-1, j].set_xlabel("step" if walkers == 1 else "step (one walker of each ensemble)", fontsize=FONT)
    if published is not None:
        for axis, name, value in zip(axes[:, 0], names, np.asarray(published, dtype=float), strict=True):
            _compare(axis, value / _unit(next(iter(traces.values())), name).factor)
        _say_above(axes[0, 0], axes[0, 0].get_xlim()[1], "dotted: published", "right")
    figure.align_ylabels(axes)
    return axes


def _unit(trace: xr.DataTree, name: str) -> Unit:
    return shown(trace["posterior"][name].attrs.get("units", ""))


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
    unit = _unit(trace, name)
    walkers = int(trace.attrs["walkers"])
    warm, kept = (
        trace[group][name].transpose("chain", "draw").to_numpy()[:, ::walkers] / unit.factor
        for group in ("warmup_posterior", "posterior")
    )
    paths = np.concatenate([warm, kept], axis=1)
    every = max(1, paths.shape[1] // _MAX_POINTS)
    steps = np.arange(1, paths.shape[1] + 1)[::every]
    base = colour(str(trace.attrs["sampler"]))
    for chain, path in reversed(list(enumerate(paths))):
        axes.plot(steps, path[::every], color=tint(base, 0.18 * min(chain, 4)), linewidth=0.7)
    if warm.shape[1]:
        axes.axvspan(0, warm.shape[1], color=PALE, zorder=0, linewidth=0)
    low, high = kept.min(), kept.max()
    margin = 0.08 * (high - low) or 0.01 * abs(high)
    axes.set_ylim(low - margin, high + margin)
    axes.set_xlim(0, paths.shape[1])
    for bound in ("lower", "upper"):
        value = _constant(trace, bound, name) / unit.factor
        if low - margin < value < high + margin:
            axes.axhline(value, color=BLACK, linestyle="--", linewidth=0.8)
    axes.set_ylabel(unit.label(name), fontsize=FONT)
    _finish(axes)


@dataclass(frozen=True)
class Frequencies:
    """A set of frequencies to compare with the measured ones.

    Attributes
    ----------
    label : str
    hz : array_like, shape (n_modes,)
    colour : str
    filled : bool
        Whether its markers are filled.
    interval_hz : array_like, shape (2, n_modes), optional
    """

    label: str
    hz: ArrayLike
    colour: str
    filled: bool = True
    interval_hz: ArrayLike | None = None


def plot_frequency_errors(
    measured_hz: ArrayLike, series: Sequence[Frequencies], labels: Sequence[str], figure: Figure | None = None
) -> Axes:
    """Draw how far sets of frequencies lie from the measured ones, in % and with their sign.

    Parameters
    ----------
    measured_hz : array_like, shape (n_modes,)
    series : sequence of Frequencies
        Side by side within each mode, in this order.
    labels : sequence of str
        Of the modes.
    """
    measured = np.asarray(measured_hz, dtype=float)
    figure = figure or new_figure(7.2, 4.4)
    axes = figure.subplots()
    centre = np.arange(len(measured), dtype=float)
    for k in range(1, len(measured)):
        axes.axvline(k - 0.5, color=PALE, linewidth=1.0, zorder=0)
    axes.axhline(0.0, color=BLACK, linewidth=1.0, zorder=1)
    for k, entry in enumerate(series):
        x = centre + 0.7 * ((k + 0.5) / len(series) - 0.5)
        error = 100.0 * (np.asarray(entry.hz) / measured - 1.0)
        axes.vlines(x, 0.0, error, color=entry.colour, linewidth=1.4, alpha=0.55, zorder=2)
        if entry.interval_hz is not None:
            low, high = 100.0 * (np.asarray(entry.interval_hz) / measured - 1.0)
            axes.vlines(x, low, high, color=entry.colour, linewidth=4.5, alpha=0.45, zorder=2)
        axes.plot(
            x, error, linestyle="none", marker="o", markersize=7, color=entry.colour, label=entry.label, zorder=3,
            markerfacecolor=entry.colour if entry.filled else "white", markeredgewidth=1.5,
        )  # fmt: skip
    axes.set_xticks(centre, [f"{label}\n{hz:g} Hz" for label, hz in zip(labels, measured, strict=True)])
    axes.set_xlim(-0.5, len(measured) - 0.5)
    axes.set_xlabel("mode, measured frequency", fontsize=FONT)
    axes.set_ylabel("(computed − measured)/measured, %", fontsize=FONT)
    _finish(axes)
    figure.legend(loc="outside lower center", ncols=2, fontsize=FONT - 1, frameon=False)
    return axes


def _constant(trace: xr.DataTree, which: str, name: str) -> float:
    """Return a bound or the start of one parameter, SI units; NaN if the trace does not know it."""
    constants = trace["constant_data"]
    return float(constants[which].sel(parameter=name)) if which in constants else np.nan


def _finish(axes: Axes) -> None:
    """Set what all axes have in common."""
    axes.tick_params(labelsize=FONT - 1)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
