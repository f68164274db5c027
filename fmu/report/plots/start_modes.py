"""A structure deformed in one of its modes, before anything is updated."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fmu.report.plots.style import COLOURS, FONT, GREY, NARROW, finish, new_figure
from fmu.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_FLAT = 1e-6
_SWING = 0.12
_ISOMETRIC = np.array([[np.cos(np.pi / 6), 0.5], [-np.cos(np.pi / 6), 0.5], [0.0, 1.0]])


def plot_mode(
    coordinates: FloatArray, ends: NDArray[np.int64], displacement: FloatArray, figure: Figure | None = None
) -> Axes:
    """Draw a structure and its deformed shape.

    Along a line: the largest displacement over the position. In a plane that the mode stays in: face on. Else in
    isometric projection.

    Parameters
    ----------
    coordinates : ndarray, shape (n_nodes, 3), m
    ends : ndarray of int, shape (n_elements, 2)
    displacement : ndarray, shape (n_nodes, 3)
        The largest being 1.
    figure : Figure, optional

    Returns
    -------
    Axes
    """
    figure = figure or new_figure(NARROW, 2.3)
    axes = figure.subplots()
    extent = np.ptp(coordinates, axis=0)
    wide = np.flatnonzero(extent > _FLAT * extent.max())
    swing = _SWING * float(extent.max())
    if len(wide) == 1:
        across = int(np.argmax(np.sum(displacement**2, axis=0)))
        x, u = coordinates[:, wide[0]], displacement[:, across]
        undeformed, deformed = np.stack([x, 0.0 * x], axis=1), np.stack([x, u / np.max(np.abs(u))], axis=1)
        axes.set_ylim(-1.15, 1.15)
        axes.set_xlabel(f"{'xyz'[wide[0]]} / m", fontsize=FONT)
        axes.set_ylabel(f"{'xyz'[across]} displacement\n/ largest", fontsize=FONT)
    else:
        in_plane = len(wide) == 2 and np.sum(displacement[:, wide] ** 2) > 0.5 * np.sum(displacement**2)
        project = np.eye(3)[:, wide] if in_plane else _ISOMETRIC
        undeformed, deformed = coordinates @ project, (coordinates + swing * displacement) @ project
        axes.set_aspect("equal")
        axes.set_axis_off()
    for points, colour, width in ((undeformed, GREY, 0.9), (deformed, COLOURS["hmc"], 2.0)):
        pieces = np.full((len(ends), 3, 2), np.nan)  # a gap after every element
        pieces[:, :2] = points[ends]
        axes.plot(*pieces.reshape(-1, 2).T, color=colour, linewidth=width, solid_capstyle="round")
    finish(axes)
    return axes
