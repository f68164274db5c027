"""Corner plot of a posterior: the marginal of each parameter, and each pair of parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from fmu.analysis.information import not_informed
from fmu.analysis.trace.reading import columns_of, constant, parameter_draws, parameter_names
from fmu.report.plots import style
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEVELS = (0.5, 0.9)
_MAX_DRAWS = 40_000
_BINS, _SMOOTH = 36, 0.9
"""Bins of a histogram along each axis, and standard deviation in bins by which those of pairs are smoothed."""
_SHEARED = 0.7
"""Absolute correlation above which the bins of a pair follow the regression line, as the ridge is narrow."""
_ROUNDING = 1e-9
"""Width of a pair's regression residuals, relative to that of the draws, below which they are rounding errors."""
_ROOM, _CLEAR = 0.06, 0.09
_MOST_TICKED = 5
"""Largest number of parameters with four ticks per axis; with more parameters the panels have three."""
_WIDTH, _SIDE, _EDGE, _LINE = 10.0, (1.25, 2.0), 0.75, 0.2
"""Sizes in inches: width of all panels, smallest and largest side of a panel, space for ticks and a label, and
space for each further line of a label."""


def plot_corner(
    trace: xr.DataTree,
    maximum: ArrayLike | None = None,
    figure: Figure | None = None,
    names: Sequence[str] | None = None,
) -> style.AxesArray:
    """Plot all marginals and all parameter pairs of a posterior; mark starting point, bounds and maximum.

    Contours enclose 50 % and 90 % of the draws. Parameters that the data did not inform have grey names.

    Parameters
    ----------
    trace : xarray.DataTree
    maximum : array_like, shape (ndim,), optional
        The parameters at the posterior maximum, SI units.
    figure : Figure, optional
    names : sequence of str, optional
        The n parameters shown. Defaults to all parameters.

    Returns
    -------
    ndarray of Axes, shape (n, n)

    Raises
    ------
    ValueError
        If there are fewer draws than parameters, or `names` has an unknown parameter.
    """
    import corner

    known = parameter_names(trace)
    names = known if names is None else tuple(names)
    columns = columns_of(trace, names)
    units = [style.unit_of(trace, name) for name in names]
    factor = np.array([unit.factor for unit in units])
    draws = parameter_draws(trace).reshape(-1, len(known))[:, columns] / factor
    if len(draws) < len(names):
        raise ValueError(f"trace: must have more draws than parameters (got {len(draws)} of {len(names)})")
    draws = draws[:: max(1, len(draws) // _MAX_DRAWS)]
    bounds = [_point(trace, names, which) / factor for which in ("lower", "upper")]
    base = style.colour(str(trace.attrs["sampler"]))
    side = float(np.clip(_WIDTH / len(names), *_SIDE))
    left, frames = not_informed(trace), _frames(draws, *bounds)
    named = (f"{name}, prior" if name in left else name for name in names)
    labels = [style.broken(unit.label(name), side) for name, unit in zip(named, units, strict=True)]
    edge = _EDGE + _LINE * max(label.count("\n") for label in labels)
    size = side * len(names) + edge + 0.2
    figure = figure or style.new_figure(size, size, layout=None)  # corner arranges the panels
    corner.corner(
        draws,
        fig=figure,
        labels=labels,
        label_kwargs={"fontsize": style.FONT + 1},
        range=frames,
        bins=_BINS,
        color=base,
        plot_datapoints=False,
        plot_density=False,
        plot_contours=False,
        hist_kwargs={"linewidth": 1.4},
        quiet=True,
    )
    axes = np.array(figure.axes).reshape(len(names), len(names))
    for i, j in zip(*np.tril_indices(len(names), -1), strict=True):
        _draw_regions(axes[i, j], draws[:, [j, i]], [frames[j], frames[i]], base)
    figure.subplots_adjust(left=edge / size, bottom=edge / size, right=1 - 0.1 / size, top=1 - 0.1 / size)
    for name, x, y in zip(names, axes[-1], axes[:, 0], strict=True):
        for label in (x.xaxis.label, y.yaxis.label):
            label.set_color(style.GREY if name in left else style.BLACK)
        x.xaxis.set_label_coords(0.5, -0.3 / side)
        y.yaxis.set_label_coords(-0.45 / side, 0.5)
    for region in (region for panel in figure.axes for region in panel.collections):
        region.set_rasterized(True)
    marks = {"start": _point(trace, names, "start") / factor}
    if maximum is not None:
        marks["maximum"] = np.asarray(maximum, dtype=float)[columns] / factor
    _mark(axes, {name: point for name, point in marks.items() if np.all(np.isfinite(point))}, bounds)
    return axes


def _frames(draws: FloatArray, lower: FloatArray, upper: FloatArray) -> list[tuple[float, float]]:
    """Return the range of each axis: the central 99.9 % of the draws with a margin, but within the bounds.

    Beyond a bound, histogram smoothing would show draws that do not exist.
    """
    low, high = np.quantile(draws, (0.0005, 0.9995), axis=0)
    room = np.where(high > low, _ROOM * (high - low), np.fmax(1e-3 * np.abs(high), np.finfo(float).tiny))
    ends = np.fmax(low - room, lower), np.fmin(high + room, upper)
    return list(zip(*(end.tolist() for end in ends), strict=True))


def _draw_regions(panel: Axes, pair: FloatArray, frame: list[tuple[float, float]], base: str) -> None:
    """Draw the smoothed density of two parameters, `pair` (n, 2), with contours around `LEVELS` of the draws.

    A contour's level is a quantile of the density at the draws. A region with a given part of the smoothed density
    would be too large. If the correlation is strong, y − b x is binned instead of y, with the regression slope b.
    """
    from scipy.interpolate import RegularGridInterpolator
    from scipy.ndimage import gaussian_filter

    C = np.cov(pair.T)
    b = C[0, 1] / C[0, 0] if abs(C[0, 1]) > _SHEARED * np.sqrt(C[0, 0] * C[1, 1]) else 0.0
    sheared = pair - b * pair[:, [0]] * [0.0, 1.0]
    if np.ptp(sheared[:, 1]) <= _ROUNDING * np.ptp(pair[:, 1]):  # one parameter determines the other
        b, sheared = 0.0, pair
    if b:
        frame = [frame[0], *_frames(sheared[:, [1]], np.array([-np.inf]), np.array([np.inf]))]
    H, *edges = np.histogram2d(sheared[:, 0], sheared[:, 1], bins=_BINS, range=np.array(frame))
    H = gaussian_filter(H, _SMOOTH)
    H = np.pad(np.pad(H, 1, "edge"), 1, constant_values=H.min())  # contours are closed beyond the frame
    u, w = (e[0] + (np.arange(-2, _BINS + 2) + 0.5) * (e[1] - e[0]) for e in edges)
    density = RegularGridInterpolator((u, w), H, bounds_error=False, fill_value=0.0)(sheared)
    levels = np.quantile(density, 1.0 - np.array(LEVELS[::-1]))
    levels[0] = min(levels[0], (1.0 - 1e-4) * levels[1])
    grid = u[:, None] + 0.0 * w, w + b * u[:, None]
    limits, shades = panel.axis(), ("white", style.tint(base, 0.65), style.tint(base, 0.2))
    panel.contourf(*grid, H, [0.0, *levels, 1.001 * H.max()], colors=shades, antialiased=False)
    panel.contour(*grid, H, levels, colors=base, linewidths=0.8)
    panel.axis(limits)


def _point(trace: xr.DataTree, names: Sequence[str], which: str) -> FloatArray:
    return np.array([constant(trace, which, name) for name in names])


class _Mark(TypedDict, total=False):
    color: str
    marker: str
    markeredgecolor: str
    markeredgewidth: float


def _mark(axes: style.AxesArray, marks: dict[str, FloatArray], bounds: list[FloatArray]) -> None:
    """Mark the points and bounds that lie inside the axes. The legend says which points lie outside."""
    from matplotlib.lines import Line2D

    styles: dict[str, _Mark] = {
        "start": {"color": style.BLACK, "marker": "x", "markeredgewidth": 1.8},
        "maximum": {
            "color": style.VERMILLION,
            "marker": "*",
            "markeredgecolor": style.BLACK,
            "markeredgewidth": 0.5,
        },
    }
    n = len(axes)
    for i in range(n):
        axes[i, i].set_xlim(axes[-1, i].get_xlim())
        for j in range(i + 1):
            panel = axes[i, j]
            _arrange_ticks(panel, 4 if n <= _MOST_TICKED else 3)
            frame = panel.get_xlim(), panel.get_ylim()
            for bound in bounds:
                _line_within(panel.axvline, bound[j], frame[0])
                if i != j:
                    _line_within(panel.axhline, bound[i], frame[1])
            for name, point in marks.items():
                seen = [
                    low <= value <= high for value, (low, high) in zip((point[j], point[i]), frame, strict=True)
                ]
                if i != j and all(seen):
                    panel.plot(point[j], point[i], linestyle="none", markersize=9, zorder=9, clip_on=False,
                               **styles[name])  # fmt: skip
                elif i == j and seen[0]:
                    panel.axvline(point[j], color=styles[name]["color"], linewidth=1.2)
            panel.set(xlim=frame[0], ylim=frame[1])
    handles = [Line2D([], [], color=style.BLACK, linestyle="--", linewidth=1.6, label="bound")]
    for name, point in marks.items():
        limits = [axes[-1, j].get_xlim() for j in range(n)]
        hidden = any(not low <= value <= high for value, (low, high) in zip(point, limits, strict=True))
        label = f"{name} (outside the frame)" if hidden else name
        handles.append(Line2D([], [], linestyle="none", markersize=9, label=label, **styles[name]))
    axes[0, -1].figure.legend(handles=handles, loc="upper right", bbox_to_anchor=(0.98, 0.93), frameon=False,
                              fontsize=style.FONT + 1)  # fmt: skip


def _arrange_ticks(panel: Axes, most: int) -> None:
    """Place about `most` ticks on each axis, away from the corners, where adjacent panels' labels overlap."""
    from matplotlib.ticker import FixedLocator, MaxNLocator

    for axis in (panel.xaxis, panel.yaxis):
        if len(axis.get_ticklocs()):
            low, high = axis.get_view_interval()
            ticks = np.asarray(MaxNLocator(most).tick_values(low, high))
            margin = _CLEAR * (high - low)
            axis.set_major_locator(
                FixedLocator(ticks[(ticks >= low + margin) & (ticks <= high - margin)].tolist())
            )
    panel.tick_params(labelsize=style.FONT - 2, labelrotation=0)


def _line_within(draw: Callable[..., object], value: float, limits: tuple[float, float]) -> None:
    """Add a line at a bound if it is between the limits or at one of them."""
    if limits[0] <= value <= limits[1]:
        draw(value, color=style.BLACK, linestyle="--", linewidth=1.6, clip_on=False, zorder=8)
