"""Plots for a planned test: sensors on the structure, information with its bound, and expected accuracy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.plan.result import PLANNED, Plan
from fmu.fem.frame.drawing import axis_of, is_rotation, view_of
from fmu.fem.modes.separable import SeparableModel
from fmu.report.plots import style
from fmu.sampling.simulated_updates import SimulatedTests

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ARROW = 0.06  # length of an arrow, relative to the structure
_MOST_NAMES = 40


def plot_sensors_on_structure(plan: Plan, structure: SeparableModel) -> Axes:
    """Plot a view of the structure with its sensors, numbered in plan order. Sensors already mounted are grey.

    Parameters
    ----------
    plan : Plan
        A plan with the coordinates of its candidate sensors.
    structure : SeparableModel
        A model with a geometry.

    Returns
    -------
    Axes

    Raises
    ------
    ValueError
        If the plan has no coordinates or the structure has no geometry.
    """
    geometry, places = structure.geometry, plan.places
    if geometry is None or places is None:
        raise ValueError("plan: must have the coordinates of its candidates to be drawn (it has none)")
    nodes, ends = np.asarray(geometry.nodes), np.asarray(geometry.elements)
    size = float(np.max(np.ptp(nodes, axis=0)))
    view = view_of(nodes)
    flat = nodes @ view.T
    width, height = np.ptp(flat, axis=0) + 2.5 * _ARROW * size
    scale = min(6.4 / width, 6.4 / height)
    axes = style.new_figure(max(scale * width, 2.5), max(scale * height, 1.8)).subplots()
    lines = flat[ends]
    x, y = (np.append(lines[:, :, k], np.full((len(lines), 1), np.nan), axis=1).ravel() for k in range(2))
    axes.plot(x, y, color=style.GREY, linewidth=0.7, rasterized=len(lines) > 300)
    for number, k in enumerate(plan.every, 1):
        colour = style.GREY if k in plan.limits.mounted else style.VERMILLION
        at = places[k]
        for row in plan.design.candidates.rows([k]):
            direction = plan.design.candidates.sensors[row][1]
            axis = axis_of(direction)
            start, end = at @ view.T, (at + _ARROW * size * axis) @ view.T
            axes.plot(*zip(start, end, strict=True), color=colour, linewidth=1.8)
            if not is_rotation(direction):
                axes.plot([end[0]], [end[1]], marker="o", markersize=3, color=colour)
            elif np.allclose(start, end):  # by the right-hand rule
                turn = "left" if np.cross(*view) @ axis > 0 else "right"
                curved = rf"$\circlearrow{turn}$"
                axes.plot(*start[:, None], marker=curved, markersize=14, markeredgewidth=0, color=colour)
            else:
                angle = np.degrees(np.arctan2(*(end - start)[::-1])) - 90.0
                for head in (end, 0.3 * start + 0.7 * end):
                    axes.plot(*head[:, None], marker=(3, 0, angle), markersize=7, color=colour)
        left, up = at @ view.T
        axes.annotate(str(number), (left, up), xytext=(4, 4), textcoords="offset points", fontsize=style.FONT)
    axes.set_aspect("equal")
    axes.axis("off")
    return axes


def plot_information(plan: Plan) -> Axes:
    """Plot the expected information against the number of sensors.

    The plot also shows upper bounds, where known, and up to five customary choices of sensors.
    """
    curve = plan.with_bounds()
    axes = style.new_figure(style.NARROW, 3.4).subplots()
    axes.plot(curve.index, curve["information"], marker="o", markersize=4, color=style.VERMILLION, label=PLANNED)
    known = curve["bound"].notna()
    if known.any():
        axes.plot(
            curve.index[known], curve["bound"][known], linestyle="--", color=style.BLACK, label="upper bound"
        )
    marks = ("s", "^", "D", "v", "P")
    for mark, (name, one) in zip(marks, plan.choices.drop(PLANNED)["information"].items(), strict=False):
        number = len(plan.usual.get(str(name), plan.chosen))
        axes.plot([number], [one], linestyle="none", marker=mark, color=style.GREY, label=str(name))
    style.finish(axes, "sensors chosen", "expected information / nats")
    style.legend_below(axes)
    return axes


def plot_expected_sds(plan: Plan) -> Axes:
    """Plot each parameter's expected standard deviation after the test, relative to its value before the test.

    Tests of frequencies alone, and of frequencies and shapes, are compared. At most the first 40 parameters are
    plotted.
    """
    table = plan.parameters()
    names = [style.literal(str(name)) for name in table.index[:_MOST_NAMES]]
    axes = style.new_figure(style.NARROW, 0.9 + 0.28 * len(names)).subplots()
    rows = np.arange(len(names))
    for column, colour, mark, label in (
        ("frequencies", style.GREY, "s", "frequencies alone"),
        ("after", style.VERMILLION, "o", "frequencies and shapes"),
    ):
        ratio = (table[column] / table["before"]).to_numpy()[: len(names)]
        axes.plot(ratio, rows, linestyle="none", marker=mark, color=colour, label=label)
    axes.set_yticks(rows, names)
    axes.invert_yaxis()
    axes.axvline(1.0, color=style.BLACK, linewidth=0.8)
    axes.set_xlim(left=0.0)
    style.finish(axes, "expected sd / sd before the test")
    style.legend_below(axes)
    return axes


def plot_simulated(found: SimulatedTests, choices: Sequence[str] | None = None) -> Axes:
    """Plot actual against expected standard deviations in simulated tests, for the first three of `choices`.

    Actual and expected values are divided by the standard deviations expected for the plan. By default, `choices`
    are all choices of sensors that were simulated.
    """
    axes = style.new_figure(style.NARROW, 3.6).subplots()
    unit = found.expected[PLANNED]
    colours = (style.VERMILLION, style.GREY, style.BLACK)
    for colour, name in zip(colours, choices or list(found.updates), strict=False):
        real = found.updates[name].real / unit
        expected = np.broadcast_to(found.expected[name] / unit, real.shape)
        axes.plot(expected.ravel(), real.ravel(), linestyle="none", marker=".", color=colour,
                  label=name, alpha=0.6)  # fmt: skip
    ends = axes.get_xlim()
    axes.plot(ends, ends, color=style.BLACK, linewidth=0.8)
    style.finish(axes, "expected sd (this plan: 1)", "real sd of simulated tests")
    style.legend_below(axes)
    return axes
