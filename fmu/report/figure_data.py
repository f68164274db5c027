"""Extract the numbers plotted in a Matplotlib figure, to show values at the pointer, zoom and export CSV files.

Matplotlib is the only renderer. The page shows its SVG, and the script works on this SVG, so that print and
screen show the same numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.trace.reading import array_of, has, mode_names
from fmu.report.plots.style import STEM, AxesArray, unit_of
from fmu.types import AnyArray

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.typing import ColorType

MOST_ORDINATES = 7_000
"""Approximate largest number of path points stored per figure; if there are more, every k-th is stored."""
_MOST_DRAWN = 12_000
"""Approximate largest number of values (draws of parameters and frequencies) stored for linked pair plots."""
_POINTS = 72.0


def figure_data(figure: Figure, most: int = MOST_ORDINATES) -> dict[str, object]:
    """Return a dict of a figure's panels and the numbers plotted in them.

    Parameters
    ----------
    figure : Figure
        A figure whose layout is final.
    most : int
        Approximate upper limit on the number of path points to return.

    Returns
    -------
    dict
        ``panels``: a list with a dict for each panel that contains series. Its keys are ``box`` (left, top, width
        and height in points from the upper left corner), ``title``, ``x`` and ``y`` (for each axis the range, the
        label, whether it is logarithmic, and the names of named ticks) and ``series``. Each series has ``label``,
        ``colour``, ``kind`` (``"path"``, ``"points"``, ``"spans"`` or ``"cells"``), ``x`` and ``y``; spans also
        have ``high``, and cells ``values``.
        ``every``: the thinning interval k; every k-th path point is returned.
    """
    from matplotlib.colors import to_hex
    from matplotlib.lines import Line2D

    names = {
        to_hex(handle.get_color()): plain(text.get_text())
        for legend in figure.legends
        for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=False)
        if isinstance(handle, Line2D)
    }
    n = sum(len(np.asarray(line.get_xdata())) for axes in figure.axes for line in _paths(axes))
    every = max(1, -(-n // most))
    found = (
        (axes, _series(axes, names, every))
        for axes in figure.axes
        if axes.axison and axes.get_label() != "<colorbar>"  # matplotlib's own label
    )  # axes that are switched off show drawings without numbers
    return {"every": every, "panels": [_panel(axes) | {"series": series} for axes, series in found if series]}


def linked_draws(axes: AxesArray, trace: xr.DataTree, names: Sequence[str]) -> dict[str, object]:
    """Return a dict of the draws in a corner plot and the model frequencies at these draws.

    Parameters
    ----------
    axes : ndarray of Axes, shape (n, n)
        The result of `plot_corner`.
    trace : xarray.DataTree
    names : sequence of str
        The n parameters in the plot.

    Returns
    -------
    dict
        The only key is ``pairs``. Its value is a dict with these items:

        - ``panels``: a list of the n² panels, as in `figure_data` but without series;
        - ``names`` and ``units``: the parameters' names, and the units in which they are shown;
        - ``columns``: a list with each parameter's draws in this unit;
        - ``modes``: a list with a dict for each mode. It contains the ``label``, the computed frequencies ``hz``
          at the draws and the ``measured`` frequency, in Hz. The list is empty if the trace lacks computed or
          measured frequencies.

        Only every k-th draw is returned, so that there are at most about 12 000 values in total.
    """
    units = [unit_of(trace, name) for name in names]
    draws = [
        trace["posterior"][name].to_numpy().ravel() / unit.factor for name, unit in zip(names, units, strict=True)
    ]
    has_hz = has(trace, "posterior_predictive", "model_frequency") and has(trace, "observed_data", "frequency")
    hz = array_of(trace, "posterior_predictive", "model_frequency") if has_hz else np.zeros((1, len(draws[0]), 0))
    hz = hz.reshape(len(draws[0]), -1)
    every = -(-len(hz) * (len(names) + hz.shape[1]) // _MOST_DRAWN)
    measured = np.asarray(trace["observed_data"]["frequency"]) if has_hz else np.zeros(0)
    modes = [
        {"label": label, "hz": of_mode, "measured": float(value)}
        for label, of_mode, value in zip(mode_names(trace) if has_hz else (), hz[::every].T, measured, strict=True)
    ]
    return {
        "pairs": {
            "panels": [_panel(one) for one in axes.ravel()],
            "names": list(names),
            "units": [unit.name for unit in units],
            "columns": [column[::every] for column in draws],
            "modes": modes,
        }
    }


def _panel(axes: Axes) -> dict[str, object]:
    """Return a dict of a panel's position, its title and both its axes.

    Raise ValueError if `axes` do not belong to a figure.
    """
    figure = axes.get_figure(root=True)
    if figure is None:
        raise ValueError("axes: must be on a figure")
    place, (width, height) = axes.get_position(), _POINTS * figure.get_size_inches()
    return {
        "box": (place.x0 * width, (1.0 - place.y1) * height, place.width * width, place.height * height),
        "title": plain(axes.get_title() or axes.get_title("left")),
        "x": _axis(axes.xaxis, axes.get_xlim(), _below(axes)),
        "y": _axis(axes.yaxis, axes.get_ylim(), axes.get_ylabel()),
    }


def plain(text: str) -> str:
    r"""Return a label as a single line, with ``\$`` replaced by ``$``."""
    return " ".join(text.replace(r"\\$", "$").replace(r"\$", "$").split())


def _below(axes: Axes) -> str:
    """Return the label of the x-axis. If it is empty, return the label of a panel that shares the axis."""
    together = axes.get_shared_x_axes().get_siblings(axes)
    return axes.get_xlabel() or next((other.get_xlabel() for other in together if other.get_xlabel()), "")


def _axis(axis: Axis, limits: tuple[float, float], label: str) -> dict[str, object]:
    from matplotlib.ticker import FixedLocator, FuncFormatter

    named, written = {}, axis.get_major_formatter()
    if isinstance(axis.get_major_locator(), FixedLocator) and isinstance(
        written, FuncFormatter
    ):  # the ticks are named positions, not values
        named = {f"{place:g}": plain(name) for place in axis.get_majorticklocs() if (name := written(place))}
    return {
        "range": [float(x) for x in limits],
        "label": plain(label),
        "log": axis.get_scale() == "log",
        "named": named,
    }


def _paths(axes: Axes) -> list[Line2D]:
    """Return the lines in `axes` that show data. Reference lines that cross the whole axes are left out."""
    return [
        line for line in axes.lines if line.get_transform() == axes.transData and len(np.asarray(line.get_xdata()))
    ]


def _series(axes: Axes, names: dict[str, str], every: int) -> list[dict[str, object]]:
    from matplotlib.collections import LineCollection, QuadMesh
    from matplotlib.colors import to_hex

    found: list[dict[str, object]] = []

    def add(artist: Artist, kind: str, shade: ColorType, **numbers: AnyArray) -> None:
        colour = to_hex(shade)
        label = str(artist.get_label())
        label = names.get(colour, "") if label.startswith("_") else plain(label)
        found.append({"label": label, "colour": colour, "kind": kind, **numbers})

    for line in _paths(axes):
        x, y = (np.asarray(values, dtype=float) for values in line.get_data())
        is_path = line.get_linestyle() != "None"
        step = every if is_path else 1
        add(line, "path" if is_path else "points", line.get_color(), x=x[::step], y=y[::step])
    for one in axes.collections:
        if one.get_label() == STEM:
            continue
        if isinstance(one, LineCollection) and (segments := [s for s in one.get_segments() if len(s) == 2]):
            ends = np.array(segments)
            add(one, "spans", np.asarray(one.get_color())[0], x=ends[:, 0, 0], y=ends[:, 0, 1], high=ends[:, 1, 1])
        elif isinstance(one, QuadMesh):
            values = np.ma.filled(np.ma.asarray(one.get_array(), dtype=float), np.nan)
            at = np.asarray(one.get_coordinates())  # of the corners
            x, y = (0.25 * (at[:-1, :-1] + at[1:, :-1] + at[:-1, 1:] + at[1:, 1:])).reshape(-1, 2).T
            add(one, "cells", "#000000", x=x, y=y, values=values.ravel())
    return found + _bars(axes)


def _bars(axes: Axes) -> list[dict[str, object]]:
    """Return one series for each group of bars: the ends of horizontal bars or the tops of vertical bars."""
    from matplotlib.colors import to_hex
    from matplotlib.container import BarContainer

    found = []
    for bars in axes.containers:
        if isinstance(bars, BarContainer) and len(bars.patches):
            boxes = np.array(
                [(bar.get_x(), bar.get_y(), bar.get_width(), bar.get_height()) for bar in bars.patches]
            )
            x, y, width, height = boxes.T
            is_lying = bars.orientation == "horizontal"
            label = str(bars.get_label())
            found.append(
                {
                    "label": "" if label.startswith("_") else plain(label),
                    "colour": to_hex(bars.patches[0].get_edgecolor()),
                    "kind": "points",
                    "x": x + width if is_lying else x + 0.5 * width,
                    "y": y + 0.5 * height if is_lying else y + height,
                }
            )
    return found
