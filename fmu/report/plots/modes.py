"""Plots of mode shapes before and after updating, and of their modal assurance criterion (MAC)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.trace.modal_states import GROUP, MEAN, MEASURED, START
from fmu.analysis.trace.reading import has
from fmu.numbers import hertz
from fmu.report.plots import style
from fmu.report.plots.correlation import plot_mac_matrix
from fmu.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_FLAT = 1e-6
_EXPANDED = "measured, expanded"
_SWING = 0.12
"""Largest displacement drawn, relative to the size of the structure."""
_MOST_STROKES = 300
"""Largest number of elements drawn as vector lines; larger structures are rasterised."""
_ONE_COLUMN = 6
"""Largest number of modes of a plane or spatial structure that are drawn in one column."""


def plot_mac(trace: xr.DataTree, state: str | None = None, figure: Figure | None = None) -> Axes:
    """Plot the modal assurance criterion (MAC) between the reference shapes and the model's mode shapes.

    The reference is the measured shapes or, if none were measured, the model's modes before updating. The MAC of
    two proportional shapes is 1.

    Parameters
    ----------
    trace : xarray.DataTree
        A trace with ``mac`` in its group ``modes`` (`fmu.analysis.trace.modal_states`).
    state : str, optional
        The state of the model; the posterior mean by default.
    figure : Figure, optional

    Returns
    -------
    Axes

    Raises
    ------
    ValueError
        If the trace has no MAC, or none for the given state.
    """
    state = MEAN if state is None else state
    modes = _modes(trace, "mac")
    if state not in modes["state"]:
        raise ValueError(f"state: must be one of {', '.join(map(str, modes['state'].to_numpy()))} (got {state!r})")
    values = modes["mac"].sel(state=state).transpose("reference_mode", "mode").to_numpy()
    rows, columns = (modes[name].to_numpy().astype(str).tolist() for name in ("reference_mode", "mode"))
    is_measured = modes["mac"].attrs["reference"] == MEASURED
    y = "measured shape" if is_measured else "mode of the model before updating"
    return plot_mac_matrix(values, rows, columns, figure, f"mode of the model, {style.literal(state)}", y)


def plot_mode_shapes(trace: xr.DataTree, figure: Figure | None = None) -> style.AxesArray:
    """Plot each mode shape before updating (dashed) and at the posterior mean, and the measured mode shape.

    For a straight structure, the displacement in the direction of largest motion is plotted, with its largest
    value before updating upwards. Any other structure is shown in its plane or in isometric projection, with
    scaled displacements, and in two columns if there are more than six modes. Without a geometry, the mode shape
    components are plotted. Diamonds mark the measured components, scaled to the posterior mean by least squares,
    and a dotted line shows the measured shape expanded to the mesh.

    Parameters
    ----------
    trace : xarray.DataTree
        A trace with ``displacement`` or ``component`` in its group ``modes`` (`fmu.analysis.trace.modal_states`).
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (modes,)

    Raises
    ------
    ValueError
        If the trace has no mode shapes.
    """
    is_placed = has(trace, GROUP, "displacement")
    modes = _modes(trace, "displacement" if is_placed else "component")
    labels, base = [str(label) for label in modes["mode"].to_numpy()], style.colour(str(trace.attrs["sampler"]))
    is_line = is_placed and np.sum(_is_wide(modes["coordinates"].to_numpy())) == 1
    draw = _draw_along if is_line else _draw_projected if is_placed else _draw_components
    if is_line or not is_placed or len(labels) <= _ONE_COLUMN:
        axes = style.stack_axes(len(labels), figure, 1.3 if is_line else 1.6 if not is_placed else 2.6)
    else:
        figure = figure or style.new_figure(2 * style.NARROW, 2.2 * ((len(labels) + 1) // 2) + 0.5)
        axes = style.grid_axes(len(labels), figure, shared=True)
    for label, axis in zip(labels, axes, strict=True):
        one = modes.sel(mode=label)
        below = draw(axis, one, base)
        before, after = (float(one["frequency"].sel(state=state)) for state in (START, MEAN))
        hz = hertz(before, after)
        axis.set_title(f"mode {style.literal(label)}: {hz[0]} Hz before, {hz[1]} Hz after",
                       fontsize=style.FONT, loc="left")  # fmt: skip
        style.finish(axis)
    axes[-1].set_xlabel(below, fontsize=style.FONT)
    style.legend_below(axes[0])
    axes[0].figure.align_ylabels(axes)
    return axes


def _modes(trace: xr.DataTree, needed: str) -> xr.Dataset:
    if not has(trace, GROUP, needed):
        raise ValueError(f"trace: must keep {needed} in its group {GROUP} (it has none)")
    return trace[GROUP].to_dataset()


def _is_wide(coordinates: FloatArray) -> BoolArray:
    """Return a mask, shape (3,), of the directions x, y, z in which a structure extends."""
    extent = np.ptp(coordinates, axis=0)
    return np.asarray(extent > _FLAT * extent.max())


def _styles(base: str) -> tuple[tuple[str, str, str, str], ...]:
    """Return the state, label, colour and line style for each mode shape in the plot."""
    return (START, "before updating", style.GREY, "--"), (MEAN, "posterior mean", base, "-")


def scaled_to_mean(one: xr.Dataset, of: str = "measured") -> FloatArray | None:
    """Return one mode's measured components, scaled to the posterior mean; NaN for unmeasured components.

    If `of` is "expanded", return the expanded displacements of all nodes, scaled by the same factor. Return None
    if the trace has no measured components or, for "expanded", no expanded displacements.
    """
    if of not in one:
        return None
    seen, computed = one["measured"].to_numpy(), one["component"].sel(state=MEAN).to_numpy()
    return np.asarray(one[of].to_numpy() * np.nansum(seen * computed) / np.nansum(seen**2))


def measured_at(one: xr.Dataset, unseen: float = 0.0) -> tuple[FloatArray, FloatArray] | None:
    """Return the sensor positions in m and the scaled measured displacements there, both of shape (places, 3).

    Displacements in directions without a sensor are `unseen`, and NaN where this mode was not measured. Return
    None if no shape was measured.
    """
    seen = scaled_to_mean(one)
    if seen is None:
        return None
    places, at = np.unique(one["site"].to_numpy(), axis=0, return_inverse=True)
    moved = np.full((len(places), 3), unseen)
    for k, label, value in zip(at, one["place"].to_numpy(), seen, strict=True):
        if str(label)[-2:] in (" x", " y", " z"):
            moved[k, "xyz".index(str(label)[-1])] = value
    return places, moved


def _mark(axis: Axes, points: FloatArray) -> None:
    """Add diamonds for measured values at `points`, shape (n, 2)."""
    axis.plot(*points.T, linestyle="none", marker="D", markersize=5, color=style.BLACK, markerfacecolor="white",
              label="measured", zorder=5)  # fmt: skip


def _draw_along(axis: Axes, one: xr.Dataset, base: str) -> str:
    """Plot a straight structure with the largest displacement upwards. Return the x-axis label."""
    coordinates, ends = one["coordinates"].to_numpy(), one["ends"].to_numpy()
    (along,) = np.flatnonzero(_is_wide(coordinates))
    first = one["displacement"].sel(state=START).to_numpy()
    direction = int(np.argmax(np.sum(first**2, axis=0)))
    upright = np.sign(first[np.argmax(np.abs(first[:, direction])), direction])
    axis.axhline(0.0, color=style.BLACK, linewidth=0.6, zorder=0)
    for state, words, shade, dashes in _styles(base):
        shape = one["displacement"].sel(state=state).to_numpy()
        points = np.stack([coordinates[:, along], upright * shape[:, direction]], axis=1)
        _lines(axis, points, ends, shade, dashes, words)
    if (whole := scaled_to_mean(one, "expanded")) is not None:
        points = np.stack([coordinates[:, along], upright * whole[:, direction]], axis=1)
        _lines(axis, points, ends, style.BLACK, ":", _EXPANDED, 1.2)
    if (seen := measured_at(one, np.nan)) is not None:  # no diamonds where this direction has no sensor
        _mark(axis, np.stack([seen[0][:, along], upright * seen[1][:, direction]], axis=1))
    largest = 1.15 * max(1.0, float(np.abs(axis.dataLim.intervaly).max()))
    axis.set_ylim(-largest, largest)
    axis.set_yticks([-1, 0, 1])
    axis.set_ylabel(f"{'xyz'[direction]} displ.\n/ largest", fontsize=style.FONT)
    return f"{'xyz'[along]} / m"


def _draw_projected(axis: Axes, one: xr.Dataset, base: str) -> str:
    """Plot a structure undeformed (thin lines) and deformed. Return the x-axis label, which is empty."""
    coordinates, ends = one["coordinates"].to_numpy(), one["ends"].to_numpy()
    swing = _SWING * float(np.max(np.ptp(coordinates, axis=0)))
    project = _projection(coordinates, one["displacement"].to_numpy())
    _lines(axis, coordinates @ project, ends, style.BLACK, "-", width=0.6)
    for state, words, shade, dashes in _styles(base):
        moved = coordinates + swing * one["displacement"].sel(state=state).to_numpy()
        _lines(axis, moved @ project, ends, shade, dashes, words)
    if (whole := scaled_to_mean(one, "expanded")) is not None:
        _lines(axis, (coordinates + swing * whole) @ project, ends, style.BLACK, ":", _EXPANDED, 1.2)
    if (seen := measured_at(one)) is not None:
        _mark(axis, (seen[0] + swing * seen[1]) @ project)
    axis.set_aspect("equal")
    axis.set_axis_off()
    return ""


def _draw_components(axis: Axes, one: xr.Dataset, base: str) -> str:
    """Plot the mode shape components of a structure without geometry. Return the x-axis label."""
    x, places = np.arange(one.sizes["place"]), [str(label) for label in one["place"].to_numpy()]
    directions = {place.rpartition(" ")[2] for place in places}
    if len(directions) == 1:
        places = [place.rpartition(" ")[0] for place in places]
    axis.axhline(0.0, color=style.BLACK, linewidth=0.6, zorder=0)
    for state, words, shade, dashes in _styles(base):
        axis.plot(x, one["component"].sel(state=state), color=shade, linestyle=dashes, marker="o", markersize=3,
                  linewidth=1.4, label=words)  # fmt: skip
    if (seen := scaled_to_mean(one)) is not None:
        _mark(axis, np.stack([x, seen], axis=1))
    axis.set_xticks(x, [style.literal(place) for place in places], **style.rotate_labels(places, style.NARROW))
    direction = f"{directions.pop()} " if len(directions) == 1 else ""
    axis.set_ylabel(f"{direction}displ.\n/ largest", fontsize=style.FONT)
    return "degree of freedom"


def _lines(
    axis: Axes, nodes: FloatArray, ends: IntArray, shade: str, dashes: str, words: str = "", width: float = 1.8
) -> None:
    """Plot all elements as one line, interrupted wherever successive elements do not share a node."""
    x, y = _strokes(nodes, ends).T
    axis.plot(x, y, color=shade, linestyle=dashes, linewidth=width, label=words or None,
              rasterized=len(ends) > _MOST_STROKES)  # fmt: skip


def _strokes(nodes: FloatArray, ends: IntArray) -> FloatArray:
    """Return the points on a line through all elements, shape (points, 2). NaN marks a gap in the line."""
    points: list[FloatArray] = []
    last = None
    for first, second in ends:
        if first != last:
            points += [np.full(2, np.nan), nodes[first]]
        points.append(nodes[second])
        last = second
    return np.array(points)


_ISOMETRIC = np.array([[np.cos(np.pi / 6), 0.5], [-np.cos(np.pi / 6), 0.5], [0.0, 1.0]])


def _projection(coordinates: FloatArray, displacement: FloatArray) -> FloatArray:
    """Return the projection matrix, shape (3, 2), for the plot of a structure.

    If the structure is plane and moves mainly in its plane, the projection is onto this plane. Otherwise it is
    isometric.
    """
    wide = np.flatnonzero(_is_wide(coordinates))
    in_plane = len(wide) == 2 and np.sum(displacement[..., wide] ** 2) > 0.5 * np.sum(displacement**2)
    return np.asarray(np.eye(3)[:, wide] if in_plane else _ISOMETRIC)


def plot_mode(
    coordinates: FloatArray, ends: IntArray, displacement: FloatArray, figure: Figure | None = None
) -> Axes:
    """Plot a structure and its deformed shape in one mode.

    For a straight structure, the displacement in the direction of largest motion is plotted against position. A
    plane structure that moves mainly in its plane is shown in this plane, any other structure in isometric
    projection.

    Parameters
    ----------
    coordinates : ndarray, shape (n_nodes, 3), m
    ends : ndarray of int, shape (n_elements, 2)
        Indices of each element's end nodes.
    displacement : ndarray, shape (n_nodes, 3)
        The mode shape, scaled to a largest displacement of 1.
    figure : Figure, optional

    Returns
    -------
    Axes
    """
    figure = figure or style.new_figure(style.NARROW, 2.3)
    axes = figure.subplots()
    wide, swing = np.flatnonzero(_is_wide(coordinates)), _SWING * float(np.ptp(coordinates, axis=0).max())
    if len(wide) == 1:
        across = int(np.argmax(np.sum(displacement**2, axis=0)))
        x, u = coordinates[:, wide[0]], displacement[:, across]
        undeformed, deformed = np.stack([x, 0.0 * x], axis=1), np.stack([x, u / np.max(np.abs(u))], axis=1)
        axes.set_ylim(-1.15, 1.15)
        axes.set_xlabel(f"{'xyz'[wide[0]]} / m", fontsize=style.FONT)
        axes.set_ylabel(f"{'xyz'[across]} displacement\n/ largest", fontsize=style.FONT)
    else:
        project = _projection(coordinates, displacement)
        undeformed, deformed = coordinates @ project, (coordinates + swing * displacement) @ project
        axes.set_aspect("equal")
        axes.set_axis_off()
    for points, shade, width in ((undeformed, style.GREY, 0.9), (deformed, style.COLOURS["hmc"], 2.0)):
        pieces = np.full((len(ends), 3, 2), np.nan)  # a gap after every element
        pieces[:, :2] = points[ends]
        axes.plot(*pieces.reshape(-1, 2).T, color=shade, linewidth=width, solid_capstyle="round")
    style.finish(axes)
    return axes
