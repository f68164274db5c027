"""Common plot style: colours of samplers and chains (the palette of Okabe & Ito), sizes and units."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray

from fmu.analysis.trace.reading import walkers_of
from fmu.fem.frame import drawing
from fmu.numbers import Unit, customary_unit
from fmu.samplers.registry import SAMPLERS, sampler_class

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


AxesArray = NDArray[np.object_]
"""An array of the axes of a figure."""

COLOURS = {name: sampler_class(name).colour for name in SAMPLERS}
TITLES = {name: sampler_class(name).title for name in SAMPLERS}
PALETTE = drawing.COLOURS
BLACK, GREY, PALE = "#000000", "#6E6E6E", "#E8E8E8"
ON_PALE, ON_DARK = "#111111", "#FAFAFA"
"""Text colours on pale and dark cells; unlike `BLACK` and white, they do not change with the page's scheme."""
VERMILLION = "#D55E00"
FONT = 10
DPI = 130
NARROW = 4.6
"""Width in inches of a figure whose labels are readable on a phone."""
STEM = "_stem"
"""Label of lines that lead from an axis to a point: they are not in the legend, and are not data."""
_LEGEND_HANDLE, _LEGEND_LETTER = 0.6, 0.072
"""Width in inches of a legend handle, and of a character of its label."""
_LABEL_LETTER = 0.085
"""Width in inches of a character of an axis label."""
_TICK_LETTER = 0.1
"""Width in inches of a character of a tick label, including its share of the gaps."""
MOST_LABELS = 16
"""Largest number of tick labels side by side on a figure of the usual width."""


def new_figure(width: float, height: float, layout: Literal["constrained"] | None = "constrained") -> Figure:
    """Return an empty figure that is not registered with pyplot.

    Parameters
    ----------
    width, height : float
        Size in inches.
    layout : {"constrained"}, optional
        The layout engine; None if the caller arranges the axes.

    Returns
    -------
    Figure
    """
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout=layout)


def colour(sampler: str) -> str:
    """Return a sampler's colour, or grey for an unknown sampler."""
    return COLOURS.get(sampler, GREY)


def tint(base: str, share: float) -> tuple[float, float, float]:
    """Mix a colour with white and return its RGB values; `share` is the fraction of white, from 0 to 1."""
    from matplotlib.colors import to_rgb

    red, green, blue = (share + (1.0 - share) * channel for channel in to_rgb(base))
    return red, green, blue


def chain_colours(trace: xr.DataTree) -> list[str]:
    """Return a colour for each chain. The colours repeat after the end of `PALETTE`."""
    return [PALETTE[chain % len(PALETTE)] for chain in range(trace["posterior"].sizes["chain"])]


def legend_of_chains(figure: Figure, trace: xr.DataTree) -> None:
    """Add a legend of the chains below the figure, if there are several chains with different colours."""
    from matplotlib.lines import Line2D

    shades = chain_colours(trace)
    if 1 < len(shades) <= len(PALETTE):
        kind = "chain" if walkers_of(trace) == 1 else "ensemble"
        handles = [Line2D([], [], color=shade, label=f"{kind} {k}") for k, shade in enumerate(shades, 1)]
        columns = max(1, int(figure.get_figwidth() / (_LEGEND_HANDLE + _LEGEND_LETTER * len(f"{kind} 1"))))
        figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=FONT - 1, frameon=False)


def unit_of(trace: xr.DataTree, name: str) -> Unit:
    """Return the customary unit in which a parameter of a trace is shown."""
    return customary_unit(trace["posterior"][name].attrs.get("units", ""))


def finish(axes: Axes, x: str = "", y: str = "") -> None:
    """Label the axes, set the tick label size and hide the top and right spines.

    Parameters
    ----------
    axes : Axes
    x, y : str
        Axis labels; an empty string leaves the label unchanged.
    """
    if x:
        axes.set_xlabel(x, fontsize=FONT)
    if y:
        axes.set_ylabel(y, fontsize=FONT)
    axes.tick_params(labelsize=FONT - 1)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def height_of_row(n: int) -> float:
    """Return the height in inches of each of `n` axes in a column. It is smaller if there are more than eight."""
    return 1.35 if n <= 8 else 1.1


def stack_axes(n: int, figure: Figure | None, height: float | None = None, sharey: bool = False) -> AxesArray:
    """Return `n` axes in a column with a shared x-axis, on `figure` or, if it is None, on a new narrow figure."""
    height = height_of_row(n) if height is None else height
    figure = figure or new_figure(NARROW, height * n + 0.5)
    return np.asarray(figure.subplots(n, 1, sharex=True, sharey=sharey, squeeze=False)[:, 0])


def grid_axes(n: int, figure: Figure, shared: bool = False) -> AxesArray:
    """Return `n` axes in two columns, as an array (n,). They share x- and y-axes if `shared` is True."""
    axes = figure.subplots((n + 1) // 2, 2, sharex=shared, sharey=shared, squeeze=False).ravel()
    for spare in axes[n:]:
        spare.remove()
    return np.asarray(axes[:n])


def broken(label: str, room: float) -> str:
    """Return a label, broken into at most three lines if it is wider than `room` inches.

    If the label has a unit, the unit is then on the last line. Text that does not fit is replaced by "…". Dollar
    signs are escaped.
    """
    most = max(6, int(room / _LABEL_LETTER))
    quantity, slash, unit = label.rpartition(" / ")
    if not slash or len(label) <= most:
        quantity, unit = label, ""
    lines = textwrap.wrap(quantity, most, max_lines=2 if unit else 3, placeholder="…") or [label]
    return literal("\n".join([*lines, f"/ {unit}"] if unit else lines))


def legend_below(axes: Axes) -> None:
    """Add a legend for the labelled items in `axes` below the figure, in as many columns as fit.

    No legend is added if nothing has a label. Raise ValueError if `axes` do not belong to a figure.
    """
    figure = axes.get_figure(root=True)
    if figure is None:
        raise ValueError("axes: must be on a figure")
    handles, labels = axes.get_legend_handles_labels()
    if labels:
        most = int((figure.get_figwidth() - _LEGEND_HANDLE) / _LEGEND_LETTER)
        labels = [textwrap.fill(label, most) for label in labels]
        width = _LEGEND_HANDLE + _LEGEND_LETTER * max(map(len, labels))
        columns = min(len(labels), max(1, int(figure.get_figwidth() / width)))
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=FONT - 1, frameon=False)


def literal(text: str) -> str:
    """Escape dollar signs, which Matplotlib would interpret as mathematics."""
    return text.replace("$", r"\$")


def thin_labels(labels: Sequence[str]) -> list[str]:
    """Return the tick labels, with some replaced by empty strings if there are more than `MOST_LABELS`.

    The remaining labels are evenly spaced, beginning with the first.
    """
    every = -(-len(labels) // MOST_LABELS)
    return [label if k % every == 0 else "" for k, label in enumerate(labels)]


class RotatedLabels(TypedDict, total=False):
    """Matplotlib options for rotated tick labels."""

    rotation: float
    ha: Literal["right"]
    rotation_mode: Literal["anchor"]


def rotate_labels(labels: Sequence[str], width: float) -> RotatedLabels:
    """Return options that rotate the tick labels, or no options if they fit side by side in `width` inches."""
    if max(map(len, labels)) * _TICK_LETTER <= width / len(labels):
        return {}
    return {"rotation": 45, "ha": "right", "rotation_mode": "anchor"}
