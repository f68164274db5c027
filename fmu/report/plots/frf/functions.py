"""Plots of frequency response functions: measured, predicted, and their difference as a normal score."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fmu.analysis.frf.predictions import GROUP
from fmu.analysis.start.measured_frfs import MeasuredInTest
from fmu.numbers import given
from fmu.posterior.data.held_out_lines import held_out
from fmu.report.plots import style
from fmu.report.plots.style import AxesArray
from fmu.types import BoolArray, ComplexArray, FloatArray, IntArray

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

UNITS = {"receptance": "m/N", "mobility": "m/s/N", "accelerance": "m/s²/N"}
HELD = style.VERMILLION
LARGE = 3.03
"""The normal score that 1 % of complex values exceed because of noise."""
_WIDTH, _HEIGHTS = 9.2, (3.0, 1.6, 1.3)
_MOST_LINES = 1200
_EVEN = 1e-3
"""Largest spread of the ratios of successive lines for which the axis is logarithmic."""
_LEAST = 1e-9
"""Smallest amplitude that is drawn, relative to the largest."""


class Curve(NamedTuple):
    """The amplitude or the phase of a predicted FRF: the middle curve and the two ends of its band.

    Each has shape (n_lines,) and is NaN at lines without a prediction. Phases are in degrees.
    """

    low: FloatArray
    middle: FloatArray
    high: FloatArray


class Shown(NamedTuple):
    """A measured FRF at some of its frequency lines.

    Attributes
    ----------
    name, unit : str
    lines : ndarray, shape (n_lines,), Hz
        Frequencies of the lines.
    measured : ndarray of complex, shape (n_lines,)
    used, held_out : ndarray of bool, shape (n_lines,)
        Whether a line is used in updating, and whether it is held out to test the updated model.
    """

    name: str
    unit: str
    lines: FloatArray
    measured: ComplexArray
    used: BoolArray
    held_out: BoolArray

    def at(self, some: IntArray) -> Shown:
        """Return the FRF at the frequency lines with the indices `some`."""
        parts = self.lines[some], self.measured[some], self.used[some], self.held_out[some]
        return Shown(self.name, self.unit, *parts)


def plot_frf(trace: xr.DataTree, frf: str | None = None, figure: Figure | None = None) -> AxesArray:
    """Plot a measured frequency response function and its posterior predictive distribution.

    The three axes show, from top to bottom, the amplitude, the phase, and the distance between the measurement and
    the model's mean as a normal score, which is in standard deviations if the errors are Gaussian. Values not used
    in updating are grey, or red if they test the updated model; the grey values have no distance. If there are
    more than 1200 lines, only those with locally extreme amplitudes are drawn.

    Parameters
    ----------
    trace : xarray.DataTree
        A trace with the group ``frfs``.
    frf : str, optional
        The response and the drive, such as ``"tip z / root y"``; if there are several tests, the test comes first.
        Defaults to the first function.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (3,)

    Raises
    ------
    ValueError
        If the trace has no frequency response functions, or none with this name.
    """
    names = frf_names(trace)
    if not names:
        raise ValueError("trace: must have frequency response functions (it has none)")
    if frf is not None and frf not in names:
        raise ValueError(f"frf: must be one of {', '.join(names)} (got {frf!r})")
    group = trace[GROUP].to_dataset().sel(frf=frf or names[0])
    group = group.isel(line=np.flatnonzero(group["in_spectrum"].to_numpy()))
    group = group.isel(line=_chosen_lines(group["measured"].to_numpy()))
    parts = group["measured"].to_numpy()
    shown = Shown(
        style.literal(frf or names[0]),
        UNITS[str(group["response"].item())],
        group["line"].to_numpy(),
        parts[:, 0] + 1j * parts[:, 1],
        group["used"].to_numpy().astype(bool),
        group["held_out"].to_numpy().astype(bool),
    )
    of = group.sel(kind="measurement")
    amplitude, phase = (
        Curve(*of[name].transpose("quantile", "line").to_numpy()) for name in ("amplitude", "phase")
    )
    colour = style.colour(str(trace.attrs["sampler"]))
    figure = figure or style.new_figure(_WIDTH, sum(_HEIGHTS) + 0.5)
    axes = np.asarray(figure.subplots(3, 1, sharex=True, height_ratios=_HEIGHTS))
    label = "predicted: 90 % of further measurements"
    _draw_curves(axes[:2], shown, {label: (colour, amplitude, phase)})
    distance = group["distance"].to_numpy()
    for where, shade in ((shown.used, style.BLACK), (shown.held_out, HELD)):
        axes[2].plot(
            shown.lines[where], distance[where], linestyle="none", marker=".", markersize=3.5, color=shade
        )
    axes[2].axhline(LARGE, color=style.GREY, linewidth=0.8, linestyle="--", zorder=0)
    axes[2].set_ylim(bottom=0.0)
    style.finish(axes[2], "frequency / Hz", "distance,\nnormal score")
    style.legend_below(axes[0])
    return axes


def plot_frf_at_start(shown: Shown, computed: ComplexArray, figure: Figure | None = None) -> AxesArray:
    """Plot a measured frequency response function and the model's function before updating.

    Parameters
    ----------
    shown : Shown
    computed : ndarray of complex, shape (n_lines,)
        The model's function; NaN where it was not computed.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (2,)
    """
    some = _chosen_lines(np.stack([shown.measured.real, shown.measured.imag], axis=1))
    shown, computed = shown.at(some), computed[some]
    figure = figure or style.new_figure(_WIDTH, sum(_HEIGHTS[:2]) + 0.5)
    axes = np.asarray(figure.subplots(2, 1, sharex=True, height_ratios=_HEIGHTS[:2]))
    size, angle = np.abs(computed), np.degrees(np.angle(computed))
    curves = {"the model before updating": (style.PALETTE[0], Curve(size, size, size), Curve(angle, angle, angle))}
    _draw_curves(axes, shown, curves)
    style.finish(axes[1], "frequency / Hz")
    style.legend_below(axes[0])
    return axes


def shown_frfs(measured: MeasuredInTest) -> list[Shown]:
    """Return a test's measured frequency response functions at all frequency lines."""
    data = measured.data
    lines, rows = (
        np.asarray(data.frequencies_hz),
        zip(np.asarray(data.values), data.used, held_out(data), strict=True),
    )
    names = [style.literal(f"{measured.of_test}{label}") for label in data.labels]
    return [Shown(name, UNITS[data.kind], lines, *row) for name, row in zip(names, rows, strict=True)]


def frf_names(trace: xr.DataTree) -> list[str]:
    """Return the names of the frequency response functions, or an empty list if the trace has none."""
    return [str(name) for name in trace[GROUP]["frf"].to_numpy()] if GROUP in trace.children else []


def _draw_curves(axes: AxesArray, shown: Shown, curves: Mapping[str, tuple[str, Curve, Curve]]) -> None:
    """Plot the measured amplitudes and phases on two axes, together with the labelled `curves`."""
    above, below = axes
    lines, size = shown.lines, np.abs(shown.measured)
    for label, (colour, amplitude, phase) in curves.items():
        for one, curve in ((above, amplitude), (below, _unwrap_phase(phase))):
            there = np.isfinite(curve.middle)
            if not np.array_equal(curve.low, curve.high, equal_nan=True):
                one.fill_between(
                    lines, curve.low, curve.high, where=there, color=colour, alpha=0.35, linewidth=0.0
                )
            one.plot(lines, curve.middle, color=colour, linewidth=1.1, label=label)
    middle = next(_unwrap_phase(phase).middle for _, _, phase in curves.values())
    degrees = _turn_phase(np.degrees(np.angle(shown.measured)), middle)
    kinds = (
        ("measured", shown.used, style.BLACK),
        ("measured, not used: tests the updated model", shown.held_out, HELD),
        ("measured, not used", ~shown.used & ~shown.held_out & np.isfinite(size), style.GREY),
    )
    for label, where, colour in kinds:
        for one, values in ((above, size), (below, degrees)):
            if where.any():
                one.plot(
                    lines[where], values[where], linestyle="none", marker=".", markersize=3.5, color=colour,
                    label=label if one is above else None, zorder=3,
                )  # fmt: skip
    above.set_yscale("log")
    seen = size[np.isfinite(size) & (size > _LEAST * np.nanmax(size))]
    above.set_ylim(0.5 * seen.min(), 2.0 * seen.max())
    if _is_geometric(lines):
        above.set_xscale("log")
        _name_decades(above)
    above.set_xlim(lines[0], lines[-1])
    above.set_title(shown.name, fontsize=style.FONT, loc="left")
    style.finish(above, y=f"|H| / {shown.unit}")
    style.finish(below, y="phase / °")


def _name_decades(axes: Axes) -> None:
    """Label the ticks of a logarithmic frequency axis with plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: given(x)))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _is_geometric(lines: FloatArray) -> bool:
    ratios = lines[1:] / lines[:-1]
    return len(lines) > 2 and bool(ratios[0] > 1.0 + _EVEN and np.ptp(ratios) < _EVEN)


def _unwrap_phase(phase: Curve) -> Curve:
    """Return the phase curve without jumps of 360° between adjacent lines.

    The curve is shifted by a multiple of 360° so that its median lies between −180° and 180°.
    """
    there = np.isfinite(phase.middle)
    shift = np.zeros(len(phase.middle))
    shift[there] = np.degrees(np.unwrap(np.radians(phase.middle[there]))) - phase.middle[there]
    shift[there] -= 360.0 * np.round(np.median((phase.middle + shift)[there]) / 360.0) if there.any() else 0.0
    return Curve(*(part + shift for part in phase))


def _turn_phase(degrees: FloatArray, middle: FloatArray) -> FloatArray:
    """Shift phases in degrees by multiples of 360° so that they lie near the curve `middle`.

    NaNs in the curve are interpolated. If the whole curve is NaN, the phases are returned unchanged.
    """
    there = np.isfinite(middle)
    if not there.any():
        return degrees
    near = np.interp(np.arange(len(middle)), np.flatnonzero(there), middle[there])
    return np.asarray(degrees - 360.0 * np.round((degrees - near) / 360.0))


def _chosen_lines(measured: FloatArray) -> IntArray:
    """Return the indices of the frequency lines to draw.

    These are all lines if there are at most `_MOST_LINES`. Otherwise the lines are divided into intervals, and
    only the lines with the smallest and the largest amplitude of each interval are drawn.
    """
    n = len(measured)
    if n <= _MOST_LINES:
        return np.arange(n)
    size = np.nan_to_num(np.hypot(*measured.T))
    groups = np.array_split(np.arange(n), _MOST_LINES // 2)
    ends: list[Any] = [(part[np.argmin(size[part])], part[np.argmax(size[part])]) for part in groups]
    return np.unique(ends)
