"""Mode shapes before and after updating, and their MAC."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fmu.analysis.trace.modal_states import GROUP, MEAN, START
from fmu.analysis.trace.reading import has
from fmu.numbers import fixed, hertz
from fmu.report.plots.style import (
    BLACK,
    COLOURS,
    FONT,
    GREY,
    NARROW,
    colour,
    finish,
    legend_below,
    literal,
    new_figure,
    stacked,
)
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_FLAT = 1e-6
_SWING = 0.12
"""Largest displacement drawn, relative to the size of the structure."""
_READABLE = 12
"""With at most so many modes, the MAC is written into each cell."""
_CELL = 0.42
"""The least width of a cell, inches."""
_SHORT = 3
"""Letters of the longest label that fits below a cell."""
_ONE_COLUMN = 6
"""At most so many modes of a structure in space are drawn in one column."""


def plot_mac(trace: xr.DataTree, state: str | None = None, figure: Figure | None = None) -> Axes:
    """Draw the modal assurance criterion between reference shapes and the model's, 1 where they are the same.

    Parameters
    ----------
    trace : xarray.DataTree
        With ``mac`` in its group ``modes`` (`fmu.analysis.trace.modal_states`).
    state : str, optional
        The state drawn; the posterior mean if not given.
    figure : Figure, optional

    Returns
    -------
    Axes

    Raises
    ------
    ValueError
        If the trace has no MAC, or none of that state.
    """
    state = MEAN if state is None else state
    modes = _modes(trace, "mac")
    if state not in modes["state"]:
        raise ValueError(f"state: must be one of {', '.join(map(str, modes['state'].to_numpy()))} (got {state!r})")
    values = modes["mac"].sel(state=state).transpose("reference_mode", "mode").to_numpy()
    n, m = values.shape
    labels = [literal(str(label)) for label in modes["mode"].to_numpy()]
    is_long = max(map(len, labels)) > _SHORT
    side = max(0.75 * NARROW, _CELL * m)
    figure = figure or new_figure(side + (2.4 if is_long else 0.25 * NARROW), 0.6 + side * n / m + 0.8 * is_long)
    axes = figure.subplots()
    # drawn cell by cell, to stay sharp in an SVG
    mesh = axes.pcolormesh(values, cmap="Blues", vmin=0.0, vmax=1.0, edgecolors="white", linewidth=1.0)
    if max(n, m) <= _READABLE:
        # of many modes most are zeros, which are left out
        for i, j in np.argwhere(values >= (0.005 if max(n, m) > _ONE_COLUMN else 0.0)).tolist():
            axes.text(j + 0.5, i + 0.5, fixed(values[i, j], 2), ha="center", va="center", fontsize=FONT - 1,
                      color="white" if values[i, j] > 0.6 else BLACK)  # fmt: skip
    turned: dict[str, Any] = {"rotation": 45, "ha": "right", "rotation_mode": "anchor"} if is_long else {}
    axes.set_xticks(np.arange(m) + 0.5, labels, **turned)
    axes.set_yticks(np.arange(n) + 0.5, [literal(str(label)) for label in modes["reference_mode"].to_numpy()])
    axes.invert_yaxis()
    axes.set_aspect("equal")
    axes.set_xlabel(f"mode of the model, {literal(state)}", fontsize=FONT)
    axes.set_ylabel("mode of the reference", fontsize=FONT)
    figure.colorbar(mesh, ax=axes, shrink=0.8, label="MAC")
    finish(axes)
    return axes


def plot_mode_shapes(trace: xr.DataTree, figure: Figure | None = None) -> NDArray[Any]:
    """Draw the structure deformed in each mode, before updating (dashed) and at the posterior mean.

    A straight structure is drawn with its largest displacement upwards; any other one in isometric projection with
    scaled displacements, many modes in two columns.

    Parameters
    ----------
    trace : xarray.DataTree
        With ``displacement`` in its group ``modes`` (`fmu.analysis.trace.modal_states`).
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (modes,)

    Raises
    ------
    ValueError
        If the trace has no shapes.
    """
    modes = _modes(trace, "displacement")
    coordinates, ends = modes["coordinates"].to_numpy(), modes["ends"].to_numpy()
    labels = [str(label) for label in modes["mode"].to_numpy()]
    base = colour(str(trace.attrs["sampler"]))
    is_line = np.linalg.matrix_rank(coordinates - coordinates[0], tol=_FLAT * np.ptp(coordinates)) <= 1
    draw = _draw_along if is_line else _draw_isometric
    if is_line or len(labels) <= _ONE_COLUMN:
        axes = stacked(len(labels), figure, 1.3 if is_line else 2.6)
    else:
        axes = _in_pairs(len(labels), figure)
    states = ((START, GREY, "--"), (MEAN, base, "-"))
    for label, axis in zip(labels, axes, strict=True):
        one = modes.sel(mode=label)
        shapes = [one["displacement"].sel(state=state).to_numpy() for state, *_ in states]
        draw(axis, coordinates, ends, shapes, [(shade, dashes) for _, shade, dashes in states])
        for line, words in zip(axis.lines[-2:], ("before updating", "posterior mean"), strict=True):
            line.set_label(words)
        before, after = (float(one["frequency"].sel(state=state)) for state, *_ in states)
        hz = hertz(before, after)
        axis.set_title(f"mode {literal(label)}: {hz[0]} Hz before, {hz[1]} Hz after",
                       fontsize=FONT, loc="left")  # fmt: skip
        finish(axis)
        if not axis.get_subplotspec().is_first_col():
            axis.set_ylabel("")
    for axis in axes[-2:] if len(axes) > 1 and axes[-2].get_subplotspec().is_last_row() else axes[-1:]:
        axis.set_xlabel("position along the structure / m" if is_line else "projected position / m", fontsize=FONT)
    legend_below(axes[0])
    axes[0].figure.align_ylabels(axes)
    return axes


def _in_pairs(n: int, figure: Figure | None) -> NDArray[Any]:
    """Return `n` axes in two columns with common ordinate and abscissa, shape (n,)."""
    rows = (n + 1) // 2
    figure = figure or new_figure(2 * NARROW, 2.8 * rows + 0.5)
    axes = figure.subplots(rows, 2, sharex=True, sharey=True).ravel()
    for spare in axes[n:]:
        spare.remove()
    return np.asarray(axes[:n])


def _modes(trace: xr.DataTree, needed: str) -> xr.Dataset:
    if not has(trace, GROUP, needed):
        raise ValueError(f"trace: must keep {needed} in its group {GROUP} (it has none)")
    return trace[GROUP].to_dataset()


def _draw_along(
    axis: Axes, coordinates: FloatArray, ends: Any, shapes: list[FloatArray], styles: list[tuple[str, str]]
) -> None:
    """Draw a straight structure: position to the right, the largest displacement upwards."""
    centred = coordinates - coordinates[0]
    along = centred[np.argmax(np.linalg.norm(centred, axis=1))]
    x = centred @ (along / np.linalg.norm(along))
    direction = int(np.argmax(np.sum(shapes[0] ** 2, axis=0)))
    axis.axhline(0.0, color=BLACK, linewidth=0.6, zorder=0)
    upright = np.sign(shapes[0][np.argmax(np.abs(shapes[0][:, direction])), direction])
    for shape, style in zip(shapes, styles, strict=True):
        _lines(axis, np.stack([x, upright * shape[:, direction]], axis=1), ends, *style)
    axis.set_ylim(-1.15, 1.15)
    axis.set_yticks([-1, 0, 1])
    axis.set_ylabel(f"{'xyz'[direction]} displ.\n/ largest", fontsize=FONT)


def _draw_isometric(
    axis: Axes, coordinates: FloatArray, ends: Any, shapes: list[FloatArray], styles: list[tuple[str, str]]
) -> None:
    """Draw a structure in space, undeformed in thin lines and deformed."""
    project = np.array([[np.cos(np.pi / 6), 0.5], [-np.cos(np.pi / 6), 0.5], [0.0, 1.0]])
    swing = _SWING * float(np.max(np.ptp(coordinates, axis=0)))
    _lines(axis, coordinates @ project, ends, BLACK, "-", 0.6)
    for shape, style in zip(shapes, styles, strict=True):
        _lines(axis, (coordinates + swing * shape) @ project, ends, *style)
    axis.set_aspect("equal")
    axis.set_ylabel("projected\nheight / m", fontsize=FONT)


def _lines(axis: Axes, nodes: FloatArray, ends: Any, shade: str, dashes: str, width: float = 1.8) -> None:
    """Draw all elements as one line, with gaps between elements that are not connected in sequence."""
    x, y = _strokes(nodes, ends).T
    axis.plot(x, y, color=shade, linestyle=dashes, linewidth=width)


def _strokes(nodes: FloatArray, ends: Any) -> FloatArray:
    """Return the points of a line through all elements, NaN at its gaps, shape (points, 2)."""
    points: list[FloatArray] = []
    last = None
    for first, second in ends:
        if first != last:
            points += [np.full(2, np.nan), nodes[first]]
        points.append(nodes[second])
        last = second
    return np.array(points)


_ISOMETRIC = np.array([[np.cos(np.pi / 6), 0.5], [-np.cos(np.pi / 6), 0.5], [0.0, 1.0]])


def plot_mode(
    coordinates: FloatArray, ends: NDArray[np.int64], displacement: FloatArray, figure: Figure | None = None
) -> Axes:
    """Draw a structure and its deformed shape in one mode.

    A straight structure: the largest displacement over the position. A plane structure with motion in its plane:
    in that plane. Any other: in isometric projection.

    Parameters
    ----------
    coordinates : ndarray, shape (n_nodes, 3), m
    ends : ndarray of int, shape (n_elements, 2)
    displacement : ndarray, shape (n_nodes, 3)
        Scaled to a largest one of 1.
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
    for points, shade, width in ((undeformed, GREY, 0.9), (deformed, COLOURS["hmc"], 2.0)):
        pieces = np.full((len(ends), 3, 2), np.nan)  # a gap after every element
        pieces[:, :2] = points[ends]
        axes.plot(*pieces.reshape(-1, 2).T, color=shade, linewidth=width, solid_capstyle="round")
    finish(axes)
    return axes
