"""Plots of the frequencies: measured, before updating and after updating."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fmu.analysis.held_out.modes import leave_one_out
from fmu.analysis.prediction import as_replicates, measured_tests, measurement_in_words, predict_frequencies
from fmu.analysis.trace.modal_states import GROUP, START
from fmu.analysis.trace.reading import has, mode_names, modes_are_data, used_modes
from fmu.numbers import given
from fmu.report.plots import style
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_OF_A_MODE = 0.28
"""Smallest figure width per mode, in inches."""


@dataclass(frozen=True)
class Frequencies:
    """A set of frequencies to compare with the measured frequencies.

    Attributes
    ----------
    label : str
    hz : array_like, shape (n_modes,)
        Frequencies in Hz.
    colour : str
    filled : bool
        Whether the markers are filled.
    interval_hz : array_like, shape (2, n_modes), optional
        Lower and upper ends of each frequency's interval in Hz.
    """

    label: str
    hz: ArrayLike
    colour: str
    filled: bool = True
    interval_hz: ArrayLike | None = None


def plot_frequency_errors(
    measured_hz: ArrayLike, series: Sequence[Frequencies], labels: Sequence[str], figure: Figure | None = None
) -> Axes:
    """Plot the errors, in %, of several frequency sets relative to the measured frequencies.

    Parameters
    ----------
    measured_hz : array_like, shape (n_modes,)
    series : sequence of Frequencies
        The frequency sets, plotted side by side for each mode in this order.
    labels : sequence of str
        Labels of the modes.
    figure : Figure, optional

    Returns
    -------
    Axes
    """
    measured = np.asarray(measured_hz, dtype=float)
    figure = figure or style.new_figure(7.2, 4.4)
    axes = figure.subplots()
    centre = np.arange(len(measured), dtype=float)
    for k in range(1, len(measured)):
        axes.axvline(k - 0.5, color=style.PALE, linewidth=1.0, zorder=0)
    axes.axhline(0.0, color=style.BLACK, linewidth=1.0, zorder=1)
    dot, bar = (7.0, 4.5) if len(measured) <= style.MOST_LABELS else (4.0, 2.0)
    for k, entry in enumerate(series):
        x = centre + 0.7 * ((k + 0.5) / len(series) - 0.5)
        error = 100.0 * (np.asarray(entry.hz) / measured - 1.0)
        axes.vlines(x, 0.0, error, color=entry.colour, linewidth=1.4, alpha=0.55, zorder=2, label=style.STEM)
        if entry.interval_hz is not None:
            low, high = 100.0 * (np.asarray(entry.interval_hz) / measured - 1.0)
            axes.vlines(
                x,
                low,
                high,
                color=entry.colour,
                linewidth=bar,
                alpha=0.45,
                zorder=2,
            )
        axes.plot(
            x, error, linestyle="none", marker="o", markersize=dot, color=entry.colour, label=entry.label,
            markerfacecolor=entry.colour if entry.filled else "white", markeredgewidth=1.5, zorder=3,
        )  # fmt: skip
    frequencies = [f"{given(hz)} Hz" for hz in measured]
    options = style.rotate_labels([*labels, *frequencies], 2.0 * figure.get_figwidth())
    between = ", " if options else "\n"
    names = [f"{label}{between}{hz}" for label, hz in zip(labels, frequencies, strict=True)]
    axes.set_xticks(centre, style.thin_labels(names), **options)
    axes.set_xlim(-0.5, len(measured) - 0.5)
    style.finish(axes, "mode, measured frequency", "(computed − measured)/measured, %")
    style.legend_below(axes)
    return axes


def plot_frequency_updates(trace: xr.DataTree, figure: Figure | None = None) -> Axes:
    """Plot the model's frequency errors before and after updating.

    The frequencies before updating are shown if the trace stores them. The frequencies after updating are the
    posterior means, with the 90 % interval of a new measurement. For repeated tests, a new measurement is the mean
    of the same number of tests, and the 90 % interval of one more test is shown beside it. If no noise is
    modelled, or if only frequency response functions are used in updating, the interval is for the
    model's frequency without noise.

    Parameters
    ----------
    trace : xarray.DataTree
        A trace with ``posterior_predictive`` and ``observed_data``.
    figure : Figure, optional

    Returns
    -------
    Axes

    Raises
    ------
    ValueError
        If the trace has no frequencies.
    """
    table, tests = predict_frequencies(trace), measured_tests(trace)
    series = []
    before = frequencies_before(trace)
    if before is not None:
        series.append(Frequencies("before updating", before, style.GREY, filled=False))
    is_noisy = "noisy_sd" in table and modes_are_data(trace)
    prefix, kind = ("noisy_", "with") if is_noisy else ("", "without")
    ends = table[[f"{prefix}eti90_lb", f"{prefix}eti90_ub"]].to_numpy().T
    label = f"after: mean, 90 % interval {kind} measurement noise"
    if tests is not None and is_noisy:
        label = f"after: mean, 90 % interval for {measurement_in_words(tests)}"
    series.append(Frequencies(label, table["mean"], style.colour(str(trace.attrs["sampler"])), interval_hz=ends))
    if is_noisy and "test_eti90_lb" in table:
        ends = table[["test_eti90_lb", "test_eti90_ub"]].to_numpy().T
        series.append(
            Frequencies("the same for one more test", table["mean"], style.BLACK, filled=False, interval_hz=ends)
        )
    labels = [style.literal(name) for name in mode_names(trace)]
    figure = figure or _new_figure(labels)
    return plot_frequency_errors(table["measured"], series, labels, figure)


def _new_figure(labels: Sequence[str]) -> Figure:
    """Return an empty figure whose width grows with the number of modes."""
    width = max(style.NARROW, _OF_A_MODE * len(labels))
    return style.new_figure(width, 5.2 if style.rotate_labels(labels, width) else 4.2)


def plot_left_out(trace: xr.DataTree, figure: Figure | None = None) -> Axes:
    """Plot the prediction error, in %, of each measured frequency when it is predicted from the other modes.

    Parameters
    ----------
    trace : xarray.DataTree
    figure : Figure, optional

    Returns
    -------
    Axes

    Raises
    ------
    ValueError
        See `fmu.leave_one_out`.
    """
    table = leave_one_out(trace)
    ends = table[["eti90_lb", "eti90_ub"]].to_numpy().T
    label = "predicted by the other modes: mean, 90 % interval with measurement noise"
    found = Frequencies(label, table["mean"], style.colour(str(trace.attrs["sampler"])), interval_hz=ends)
    labels = [style.literal(name) for name in mode_names(trace)]
    figure = figure or _new_figure(labels)
    axes = plot_frequency_errors(table["measured"], [found], labels, figure)
    axes.set_ylabel("(predicted − measured)/measured, %")
    return axes


def frequencies_before(trace: xr.DataTree) -> FloatArray | None:
    """Return the model's frequencies before updating in Hz, (n_modes,), or None if the trace lacks them."""
    if has(trace, GROUP):
        return np.asarray(trace[GROUP]["frequency"].sel(state=START), dtype=float)
    if has(trace, "maxima"):
        return np.asarray(trace["maxima"]["before"], dtype=float)
    return None


def plot_predictive_check(trace: xr.DataTree, figure: Figure | None = None) -> Axes:
    """Plot each measured frequency with its posterior predictive distribution.

    The distribution is eq. (10) of Boulkaibet et al. (`fmu.paper.published`). For repeated tests, it is the
    distribution of the mean of the tests. The single tests and the predictive interval for one more test are shown
    too. With a discrepancy, the measurements of modes in use are compared with those of a similar structure
    (`fmu.analysis.prediction.as_replicates`).

    Parameters
    ----------
    trace : xarray.DataTree
        A trace with ``posterior_predictive`` frequencies that include measurement noise.
    figure : Figure, optional

    Returns
    -------
    Axes

    Raises
    ------
    ValueError
        If the trace has no frequencies, or no predictive distribution for measurements.
    """
    tables = [predict_frequencies(trace, p) for p in (0.9, 0.99)]
    of = " of a similar structure" if "similar_sd" in tables[0] else ""
    narrow, wide = (as_replicates(table, used_modes(trace)) for table in tables)
    if "noisy_sd" not in narrow:
        raise ValueError("trace: must have a predictive distribution of measurements (it has none)")
    base, labels = style.colour(str(trace.attrs["sampler"])), [style.literal(name) for name in mode_names(trace)]
    figure = figure or _new_figure(labels)
    axes = figure.subplots()
    x = np.arange(len(narrow), dtype=float)

    def scale(column: pd.Series | FloatArray) -> FloatArray:
        return np.asarray((column - narrow["mean"]) / narrow["noisy_sd"])

    tests = measured_tests(trace)
    new = f"of new measurements{of}, noise included" if tests is None else f"for {measurement_in_words(tests)}{of}"
    for table, ends, width, alpha, words in (
        (wide, ("noisy_eti99_lb", "noisy_eti99_ub"), 5.0, 0.25, f"99 % {new}"),
        (
            narrow,
            ("noisy_eti90_lb", "noisy_eti90_ub"),
            5.0,
            0.45,
            f"90 % {new}" if tests is not None else "90 % of them",
        ),
        (narrow, ("eti90_lb", "eti90_ub"), 14.0, 0.8, "90 % of the model's frequencies, without noise"),
    ):
        low, high = (scale(table[end]) for end in ends)
        axes.vlines(x, low, high, color=base, linewidth=width, alpha=alpha, label=words)
    measured = scale(narrow["measured"])
    axes.plot(x, measured, linestyle="none", marker="D", color=style.BLACK, markersize=6, label="measured")
    if tests is not None:
        low, high = (scale(narrow[f"test_eti90_{end}"]) for end in ("lb", "ub"))
        beside = x + 0.25
        axes.vlines(beside, low, high, color=style.GREY, linewidth=5.0, alpha=0.45, label="90 % of one more test")
        axes.plot(beside, np.transpose([scale(test) for test in tests]), linestyle="none", marker="_",
                  color=style.BLACK, alpha=0.6)  # fmt: skip
        axes.plot([], [], linestyle="none", marker="_", color=style.BLACK, label="the tests")
    axes.axhline(0.0, color=style.GREY, linewidth=0.8, zorder=0)
    axes.set_xticks(x, style.thin_labels(labels), **style.rotate_labels(labels, figure.get_figwidth()))
    axes.set_xlim(-0.5, len(x) - 0.5)
    style.finish(axes, "mode", "(frequency − predicted mean)\n/ predictive sd")
    style.legend_below(axes)
    return axes
