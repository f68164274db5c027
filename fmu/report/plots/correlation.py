"""Agreement of test and model: MAC matrices, and CoMAC and ECoMAC along the sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from fmu.numbers import fixed
from fmu.report.plots.style import (
    BLACK,
    FONT,
    GREY,
    NARROW,
    ON_DARK,
    ON_PALE,
    PALETTE,
    finish,
    legend_below,
    literal,
    new_figure,
    rotate_labels,
    stack_axes,
    thin_labels,
)
from fmu.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

READABLE, FEW = 12, 6
"""With at most so many modes the MAC is written into each cell; with more than a few, zeros are left out."""
_CELL = 0.42
"""The least width of a cell, inches."""
_SHORT = 3
"""Letters of the longest label that fits below a cell."""


def plot_mac_matrix(
    values: FloatArray,
    rows: Sequence[str],
    columns: Sequence[str],
    figure: Figure | None = None,
    x: str = "measured shape",
    y: str = "measured shape",
) -> Axes:
    """Draw a matrix of MAC values between shapes, the AutoMAC of a measurement if nothing else is said.

    Parameters
    ----------
    values : ndarray, shape (n_rows, n_columns)
    rows, columns : sequence of str
        Names of the shapes.
    figure : Figure, optional
    x, y : str
        What the columns and the rows are.

    Returns
    -------
    Axes
    """
    n, m = values.shape
    labels = [literal(label) for label in columns]
    is_long = max(map(len, labels)) > _SHORT  # those of the rows need room beside the cells
    side = max(0.75 * NARROW, _CELL * m)
    figure = figure or new_figure(side + (2.4 if is_long else 0.25 * NARROW), 0.6 + side * n / m + 0.8 * is_long)
    axes = figure.subplots()
    # few cells are drawn one by one, to stay sharp in an SVG
    mesh = axes.pcolormesh(values, cmap="Blues", vmin=0.0, vmax=1.0, edgecolors="white", linewidth=1.0,
                           rasterized=max(n, m) > FEW)  # fmt: skip
    if max(n, m) <= READABLE:
        # of many modes most are zeros, which are left out
        for i, j in np.argwhere(values >= (0.005 if max(n, m) > FEW else 0.0)).tolist():
            axes.text(j + 0.5, i + 0.5, fixed(values[i, j], 2), ha="center", va="center", fontsize=FONT - 1,
                      color=ON_DARK if values[i, j] > 0.6 else ON_PALE)  # fmt: skip
    axes.set_xticks(np.arange(m) + 0.5, thin_labels(labels), **rotate_labels(labels, side))
    axes.set_yticks(np.arange(n) + 0.5, thin_labels([literal(label) for label in rows]))
    axes.invert_yaxis()
    axes.set_aspect("equal")
    axes.set_xlabel(x, fontsize=FONT)
    axes.set_ylabel(y, fontsize=FONT)
    figure.colorbar(mesh, ax=axes, shrink=0.8, label="MAC")
    finish(axes)
    return axes


def plot_sensors(
    sensors: Sequence[str], states: Mapping[str, tuple[FloatArray, FloatArray]], figure: Figure | None = None
) -> NDArray[np.object_]:
    """Draw CoMAC and ECoMAC of each sensor (`fmu.fem.pairing.correlation`) in one state of the model or in two.

    Parameters
    ----------
    sensors : sequence of str
    states : mapping of str to tuple (comac, ecomac), each of shape (n_sensors,)
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (2,)
    """
    figure = figure or new_figure(max(NARROW, min(2 * NARROW, 0.22 * len(sensors))), 3.8)
    both = stack_axes(2, figure)
    x = np.arange(len(sensors))
    shades = [PALETTE[0]] if len(states) == 1 else [GREY, PALETTE[0]]
    for axes, k, name in zip(both, (0, 1), ("CoMAC", "ECoMAC"), strict=True):
        for (state, values), shade, face in zip(states.items(), shades, ("white", shades[-1]), strict=False):
            face = shades[-1] if len(states) == 1 else face
            axes.vlines(x, 1 - k, values[k], color=shade, linewidth=1.0, zorder=1)
            axes.plot(x, values[k], linestyle="none", marker="o", markersize=5, color=shade, markerfacecolor=face,
                      label=literal(state))  # fmt: skip
        axes.axhline(1 - k, color=BLACK, linewidth=0.6, zorder=0)
        axes.set_ylim(*((-0.03, 1.03) if k == 0 else (-0.03 * axes.get_ylim()[1], max(0.2, axes.get_ylim()[1]))))
        finish(axes, y=name)
    labels = [literal(sensor) for sensor in sensors]
    both[1].set_xticks(x, thin_labels(labels), **rotate_labels(thin_labels(labels), figure.get_figwidth()))
    finish(both[1], "sensor")
    figure.align_ylabels(both)
    if len(states) > 1:
        legend_below(both[0])
    return both
