"""Plot the parameters before and after updating."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fmu.analysis.convergence.diagnostics import summary
from fmu.analysis.information import not_informed
from fmu.analysis.trace.reading import VALUE_KINDS, constant, parameter_names, problem_of, roles_of
from fmu.report.plots import style

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_EACH = 0.26
"""Width in inches for a parameter whose name is rotated."""
_LEFT = "prior: not informed"
_ENDS = ("mean", "eti90_lb", "eti90_ub")


def plot_parameter_updates(
    traces: Mapping[str, xr.DataTree],
    *,
    published: Mapping[str, ArrayLike] | None = None,
    maximum: ArrayLike | None = None,
    summaries: Mapping[str, pd.DataFrame] | None = None,
    figure: Figure | None = None,
) -> style.AxesArray:
    """Plot the parameters' posterior means and 90 % intervals, with bounds, start, maximum and published values.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        Traces, keyed by their label in the legend. They are plotted side by side for each parameter.
    published : mapping of str to array_like, shape (ndim,), optional
        Published values in SI units, keyed by the label of the trace that they are compared with.
    maximum : array_like, shape (ndim,), optional
        The parameters at the posterior maximum, SI units.
    summaries : mapping of str to pandas.DataFrame, optional
        The result of ``fmu.summary(trace)`` for each trace, if already computed.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (groups,)
        One axes for the parameters of each unit. Inferred error parameters have axes of their own, and so has each
        kind of parameter that describes differences between tests, such as the standard deviations of populations.
    """
    first = next(iter(traces.values()))
    names = parameter_names(first)
    kinds = {name: "value" if kind in VALUE_KINDS else kind for name, (kind, *_) in roles_of(first).items()}
    kinds |= dict.fromkeys(error_parameters(first), "error parameter")
    groups: dict[tuple[str, str], list[str]] = {}
    for name in names:
        groups.setdefault((style.unit_of(first, name).name, kinds.get(name, "value")), []).append(name)
    tables = {label: summary(trace) for label, trace in traces.items()} if summaries is None else summaries
    tilted = sum(bool(style.rotate_labels(members, style.NARROW)) for members in groups.values())
    width = max(style.NARROW, _EACH * max(map(len, groups.values())))
    figure = figure or style.new_figure(width, 2.5 * len(groups) + 0.6 * tilted + 0.6)
    axes = figure.subplots(len(groups), 1, squeeze=False)[:, 0]
    points = {} if maximum is None else {"maximum": dict(zip(names, np.asarray(maximum), strict=True))}
    values = {key: dict(zip(names, np.asarray(v), strict=True)) for key, v in (published or {}).items()}
    for axis, ((unit, what), members) in zip(axes, groups.items(), strict=True):
        _frame(axis, first, members)
        for k, (label, trace) in enumerate(traces.items()):
            x = np.arange(len(members)) + 0.6 * ((k + 0.5) / len(traces) - 0.5)
            _intervals(axis, x, trace, tables[label], members, label)
            if label in values:
                y = [values[label][name] / style.unit_of(trace, name).factor for name in members]
                axis.plot(x, y, linestyle="none", marker="D", markersize=6, markerfacecolor="white",
                          color=style.colour(str(trace.attrs["sampler"])),
                          label=f"{style.literal(label)}, published")  # fmt: skip
        for label, point in points.items():
            y = [point[name] / style.unit_of(first, name).factor for name in members]
            axis.plot(x + 0.3, y, linestyle="none", marker="*", markersize=8, color=style.VERMILLION,
                      markeredgecolor=style.BLACK, markeredgewidth=0.5, label=label, zorder=4)  # fmt: skip
        axis.set_ylabel(f"{what} / {style.literal(unit)}" if unit else what, fontsize=style.FONT)
    axes[0].set_title("mean and 90 % interval", fontsize=style.FONT - 1, color=style.GREY, loc="right")
    axes[-1].set_xlabel("parameter", fontsize=style.FONT)
    is_told = _LEFT in axes[0].get_legend_handles_labels()[1]
    if not is_told and any(not_informed(trace) for trace in traces.values()):
        axes[0].plot([], [], linestyle="none", marker="o", markersize=5, color=style.GREY, label=_LEFT)
    style.legend_below(axes[0])
    return axes


def error_parameters(trace: xr.DataTree) -> frozenset[str]:
    """Return the names of the inferred parameters that describe errors of modes or of FRFs.

    They are standard deviations, the parameters of a model discrepancy, gains and delays of channels and, with
    `fmu.StudentErrors`, degrees of freedom. Damping is not among them. The set is empty if no such parameter is
    inferred, or if the run sampled a density other than an `UpdatingProblem`.
    """
    likelihood = problem_of(trace).get("likelihood") or {}
    damping = _texts([one["damping"] for one in likelihood.get("responses", ())])
    return frozenset(likelihood.get("noise", ())).union(likelihood.get("inferred", ())).difference(damping)


def _texts(value: object) -> Iterator[str]:
    """Yield all texts in nested lists and in the values of mappings."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, list | dict):
        for one in value.values() if isinstance(value, dict) else value:
            yield from _texts(one)


def _frame(axis: Axes, trace: xr.DataTree, members: list[str]) -> None:
    """Plot the ranges between the bounds, and the start values, and label the axis.

    If any bound is not finite, no range is drawn. If any start value is not finite, no start value is drawn.
    """
    x = np.arange(len(members))
    lower, upper, start = (
        np.array([constant(trace, which, name) / style.unit_of(trace, name).factor for name in members])
        for which in ("lower", "upper", "start")
    )
    if np.all(np.isfinite([lower, upper])):
        axis.bar(x, upper - lower, 0.8, lower, color=style.PALE, label="between the bounds", zorder=0)
    if np.all(np.isfinite(start)):
        length = 24.0 if len(x) <= style.MOST_LABELS else 12.0
        axis.plot(x, start, linestyle="none", marker="_", markersize=length, markeredgewidth=1.8,
                  color=style.BLACK, label="start", zorder=1)  # fmt: skip
    axis.set_xticks(x, [style.literal(name) for name in members], **style.rotate_labels(members, style.NARROW))
    axis.set_xlim(-0.6, len(members) - 0.4)
    axis.use_sticky_edges = False
    axis.margins(y=0.06)
    style.finish(axis)


def _intervals(
    axis: Axes, x: NDArray[np.floating], trace: xr.DataTree, table: pd.DataFrame, members: list[str], label: str
) -> None:
    """Plot means with intervals at the positions `x`. Parameters that the data did not inform are grey."""
    factor = np.array([style.unit_of(trace, name).factor for name in members])
    mean, low, high = (table.loc[members, column].to_numpy() / factor for column in _ENDS)
    left = not_informed(trace)
    is_told = np.array([name not in left for name in members])
    for of, shade, words in (
        (is_told, style.colour(str(trace.attrs["sampler"])), style.TITLES.get(label, style.literal(label))),
        (~is_told, style.GREY, _LEFT),
    ):
        if of.any():
            axis.vlines(x[of], low[of], high[of], color=shade, linewidth=4.5, alpha=0.5, zorder=2)
            axis.plot(
                x[of], mean[of], linestyle="none", marker="o", markersize=5, color=shade, label=words, zorder=3
            )
