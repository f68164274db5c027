"""Plots of how well test and model agree: MAC matrices, and each sensor's CoMAC and ECoMAC."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from fmu.numbers import fixed
from fmu.report.plots import style
from fmu.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

READABLE, FEW = 12, 6
"""Largest number of modes for which MAC values are written into the cells, and for which zeros are written too."""
_CELL = 0.42
"""The smallest width of a cell in inches."""
_SHORT = 3
"""Number of characters in the longest label that fits below a cell."""


def plot_mac_matrix(
    values: FloatArray,
    rows: Sequence[str],
    columns: Sequence[str],
    figure: Figure | None = None,
    x: str = "measured shape",
    y: str = "measured shape",
) -> Axes:
    """Plot a matrix of MAC values between mode shapes. The default axis labels suit an AutoMAC matrix.

    Values are written into the cells if there are at most 12 rows and at most 12 columns. If there are more than 6
    rows or columns, values below 0.005 are not written.

    Parameters
    ----------
    values : ndarray, shape (n_rows, n_columns)
    rows, columns : sequence of str
        Names of the mode shapes.
    figure : Figure, optional
    x, y : str
        Labels for the x-axis (columns) and the y-axis (rows).

    Returns
    -------
    Axes
    """
    n, m = values.shape
    labels = [style.literal(label) for label in columns]
    is_long = max(map(len, labels)) > _SHORT  # row labels then need space beside the cells
    side = max(0.75 * style.NARROW, _CELL * m)
    figure = figure or style.new_figure(
        side + (2.4 if is_long else 0.25 * style.NARROW), 0.6 + side * n / m + 0.8 * is_long
    )
    axes = figure.subplots()
    # a small matrix is not rasterised, so that its cells stay sharp in the SVG
    mesh = axes.pcolormesh(values, cmap="Blues", vmin=0.0, vmax=1.0, edgecolors="white", linewidth=1.0,
                           rasterized=max(n, m) > FEW)  # fmt: skip
    if max(n, m) <= READABLE:
        # most values of a large matrix are zeros, which are not written
        for i, j in np.argwhere(values >= (0.005 if max(n, m) > FEW else 0.0)).tolist():
            axes.text(j + 0.5, i + 0.5, fixed(values[i, j], 2), ha="center", va="center", fontsize=style.FONT - 1,
                      color=style.ON_DARK if values[i, j] > 0.6 else style.ON_PALE)  # fmt: skip
    axes.set_xticks(np.arange(m) + 0.5, style.thin_labels(labels), **style.rotate_labels(labels, side))
    axes.set_yticks(np.arange(n) + 0.5, style.thin_labels([style.literal(label) for label in rows]))
    axes.invert_yaxis()
    axes.set_aspect("equal")
    axes.set_xlabel(x, fontsize=style.FONT)
    axes.set_ylabel(y, fontsize=style.FONT)
    figure.colorbar(mesh, ax=axes, shrink=0.8, label="MAC")
    style.finish(axes)
    return axes


def plot_sensors(
    sensors: Sequence[str], states: Mapping[str, tuple[FloatArray, FloatArray]], figure: Figure | None = None
) -> NDArray[np.object_]:
    """Plot each sensor's CoMAC and ECoMAC (`fmu.fem.pairing.correlation`) for one or two states of the model.

    Parameters
    ----------
    sensors : sequence of str
        Names of the sensors.
    states : mapping of str to tuple (comac, ecomac), each of shape (n_sensors,)
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (2,)
    """
    figure = figure or style.new_figure(max(style.NARROW, min(2 * style.NARROW, 0.22 * len(sensors))), 3.8)
    both = style.stack_axes(2, figure)
    x = np.arange(len(sensors))
    shades = [style.PALETTE[0]] if len(states) == 1 else [style.GREY, style.PALETTE[0]]
    for axes, k, name in zip(both, (0, 1), ("CoMAC", "ECoMAC"), strict=True):
        for (state, values), shade, face in zip(states.items(), shades, ("white", shades[-1]), strict=False):
            face = shades[-1] if len(states) == 1 else face
            axes.vlines(x, 1 - k, values[k], color=shade, linewidth=1.0, zorder=1)
            axes.plot(x, values[k], linestyle="none", marker="o", markersize=5, color=shade, markerfacecolor=face,
                      label=style.literal(state))  # fmt: skip
        axes.axhline(1 - k, color=style.BLACK, linewidth=0.6, zorder=0)
        axes.set_ylim(*((-0.03, 1.03) if k == 0 else (-0.03 * axes.get_ylim()[1], max(0.2, axes.get_ylim()[1]))))
        style.finish(axes, y=name)
    labels = [style.literal(sensor) for sensor in sensors]
    both[1].set_xticks(
        x, style.thin_labels(labels), **style.rotate_labels(style.thin_labels(labels), figure.get_figwidth())
    )
    style.finish(both[1], "sensor")
    figure.align_ylabels(both)
    if len(states) > 1:
        style.legend_below(both[0])
    return both
