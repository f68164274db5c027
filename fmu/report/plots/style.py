"""What all figures share: a colour for each sampler (Okabe & Ito's colour-blind safe palette), sizes, units."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from fmu.numbers import Unit, shown
from fmu.samplers.registry import SAMPLERS, sampler_class

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


COLOURS = {name: sampler_class(name).colour for name in SAMPLERS}
TITLES = {name: sampler_class(name).title for name in SAMPLERS}
BLACK, GREY, PALE = "#000000", "#6E6E6E", "#E8E8E8"
VERMILLION = "#D55E00"
FONT = 10
DPI = 130
NARROW = 4.6
"""Width in inches of a figure whose labels are readable on a phone."""
_LEGEND_HANDLE, _LEGEND_LETTER = 0.6, 0.072
"""Width in inches of a legend handle, and of a letter of its label."""


def new_figure(width: float, height: float, layout: Literal["constrained"] | None = "constrained") -> Figure:
    """Return an empty figure that is not registered with pyplot.

    Parameters
    ----------
    width, height : float
        In inches.
    layout : {"constrained"}, optional
        None if the axes are arranged otherwise.

    Returns
    -------
    Figure
    """
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


def chain_colours(trace: xr.DataTree) -> list[tuple[float, float, float]]:
    """Return a tint of the sampler's colour for each chain, from dark to light."""
    base = colour(str(trace.attrs["sampler"]))
    return [tint(base, 0.18 * min(chain, 4)) for chain in range(trace["posterior"].sizes["chain"])]


def unit_of(trace: xr.DataTree, name: str) -> Unit:
    """Return the unit in which a parameter of a trace is shown."""
    return shown(trace["posterior"][name].attrs.get("units", ""))


def finish(axes: Axes, x: str = "", y: str = "") -> None:
    """Label axes, set the size of their ticks and remove the upper and right spines.

    Parameters
    ----------
    axes : Axes
    x, y : str
        Labels; where empty, the label is unchanged.
    """
    if x:
        axes.set_xlabel(x, fontsize=FONT)
    if y:
        axes.set_ylabel(y, fontsize=FONT)
    axes.tick_params(labelsize=FONT - 1)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def stacked(n: int, figure: Figure | None, height: float = 1.35, sharey: bool = False) -> NDArray[Any]:
    """Return `n` axes in a column with a common abscissa, on a narrow figure if none is given."""
    figure = figure or new_figure(NARROW, height * n + 0.5)
    return np.asarray(figure.subplots(n, 1, sharex=True, sharey=sharey, squeeze=False)[:, 0])


def legend_below(axes: Axes) -> None:
    """Add a legend of the axes below the figure, in as many columns as fit."""
    figure = axes.get_figure(root=True)
    if figure is None:
        raise ValueError("axes: must be on a figure")
    handles, labels = axes.get_legend_handles_labels()
    if labels:
        width = _LEGEND_HANDLE + _LEGEND_LETTER * max(map(len, labels))
        columns = min(len(labels), max(1, int(figure.get_figwidth() / width)))
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=FONT - 1, frameon=False)


def literal(text: str) -> str:
    """Escape dollar signs, which matplotlib would take for mathematics."""
    return text.replace("$", r"\$")
