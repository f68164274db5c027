"""Plots for several tests of one structure: parameter values in each test, and losses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.trace.damage import ANY, BY_TEST, damage, damage_by_test, probably
from fmu.analysis.trace.reading import LOSSES, problem_of, roles_of, sds_of_population
from fmu.report.plots import style
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDE = 7.2
_FEW_LABELS = 16
_BAR = {"elinewidth": 1.6, "capsize": 0, "marker": "o", "markersize": 3.5, "linestyle": "none"}


def plot_values(trace: xr.DataTree, figure: Figure | None = None) -> style.AxesArray:
    """Plot each population together with its parameter's value in every test.

    The band is the population's mean ± sd (of the logarithm, for a log-normal population). It shows how much the
    structure varies. The bars are the central 90 % intervals of the values. They show how uncertain the estimates
    are.

    Parameters
    ----------
    trace : xarray.DataTree
        A trace of a hierarchical `fmu.JointProblem`.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, one per parameter
    """
    values, posterior = trace["tests"].to_dataset(), trace["posterior"].to_dataset()
    names = [
        name for name in map(str, values.data_vars) if f"{name} mean" in posterior or f"{name} median" in posterior
    ]
    tests = values["test"].to_numpy().astype(str)
    figure = figure or style.new_figure(WIDE, 1.5 * len(names) + 0.8)
    axes = np.asarray(figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0])
    x = np.arange(1, len(tests) + 1)
    for axis, name in zip(axes, names, strict=True):
        of_logarithm = f"{name} median" in posterior
        centre = f"{name} {'median' if of_logarithm else 'mean'}"
        unit = style.unit_of(trace, centre)
        middle = posterior[centre].to_numpy().mean()
        width = _sd_in_tests(trace, name)
        low, high = (middle * np.exp(s * width) if of_logarithm else middle + s * width for s in (-1, 1))
        ends = np.append(x, len(tests) + 1) - 0.5
        axis.stairs(
            high / unit.factor, ends, baseline=low / unit.factor, fill=True, color=style.PALE, zorder=0,
            label=f"population: {'median and relative scatter' if of_logarithm else 'mean ± sd'}",
        )  # fmt: skip
        axis.axhline(middle / unit.factor, color=style.GREY, linewidth=1, zorder=1)
        draws = values[name].to_numpy().reshape(-1, len(tests)) / unit.factor
        ends, mean = np.quantile(draws, (0.05, 0.95), axis=0), draws.mean(axis=0)
        axis.errorbar(
            x, mean, yerr=np.abs(ends - mean), color=style.PALETTE[0], label="each test: 90 % interval", **_BAR
        )
        label = style.literal(name) + (f" / {style.literal(unit.name)}" if unit.name else "")
        style.finish(axis, y=label)
    if len(tests) <= _FEW_LABELS:
        axes[-1].set_xticks(
            x, [style.literal(test) for test in tests], rotation=45 if len("".join(tests)) > 60 else 0
        )
        style.finish(axes[-1], "test")
    else:
        axes[-1].xaxis.get_major_locator().set_params(integer=True)
        style.finish(axes[-1], f"number of the test, {style.literal(tests[0])} to {style.literal(tests[-1])}")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2, fontsize=style.FONT - 1, frameon=False)
    return axes


def _sd_in_tests(trace: xr.DataTree, name: str) -> FloatArray:
    """Return the population sd of `name` in each test, averaged over the posterior, shape (n_tests,)."""
    means = {group: float(trace["posterior"][k].mean()) for group, k in sds_of_population(trace, name).items()}
    groups = [str(test["group"]) for test in problem_of(trace)["tests"]]
    return np.array([means.get(group, next(iter(means.values()))) for group in groups])


def plot_losses(trace: xr.DataTree, beyond: float = 0.05, figure: Figure | None = None) -> style.AxesArray:
    """Plot every parameter's loss in each later state, with the probability that it is larger than `beyond`.

    If the tests contradict a parameter's law, the probabilities are replaced by the word "withheld"
    (`fmu.damage`).

    Parameters
    ----------
    trace : xarray.DataTree
        A trace with losses, as `fmu.damage` requires.
    beyond : float
        The loss threshold as a fraction.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, one per state

    Raises
    ------
    ValueError
        If the trace has no losses, or `beyond` is below 0, or is 1 or more.
    """
    table, losses = damage(trace, (beyond,)), trace[LOSSES].to_dataset()
    states = losses["state"].to_numpy().astype(str).tolist()
    names = [str(name) for name in losses.data_vars]
    figure = figure or style.new_figure(max(style.NARROW, 1.4 + 0.5 * len(names)), 2.4 * len(states) + 0.6)
    axes = np.asarray(figure.subplots(len(states), 1, sharex=True, sharey=True, squeeze=False)[:, 0])
    for axis, state in zip(axes, states, strict=True):
        draws = np.stack([losses[name].sel(state=state).to_numpy().ravel() for name in names], axis=1)
        _state(axis, 100.0 * draws, table.loc[state].drop(ANY).iloc[:, -1].to_numpy(), beyond)
        axis.set_title(style.literal(state), fontsize=style.FONT, loc="left", pad=18)  # above the probabilities
        style.finish(axis, y="loss / %")
    turned = len("".join(names)) > 10 * figure.get_figwidth()
    axes[-1].set_xticks(
        np.arange(len(names)), [style.literal(name) for name in names], rotation=45 if turned else 0
    )
    axes[0].set_title(
        f"below: {table.columns[-1]}", fontsize=style.FONT - 1, color=style.GREY, loc="right", pad=18
    )
    return axes


def plot_damage_by_test(trace: xr.DataTree, beyond: float = 0.05, figure: Figure | None = None) -> style.AxesArray:
    """Plot the losses, and the probability that they are larger than `beyond`, against time.

    The band around a loss is its central 90 % interval. Vertical bands are the dates' central 90 % intervals. If
    the tests contradict a parameter's law, no probabilities are drawn (`fmu.damage`).

    Parameters
    ----------
    trace : xarray.DataTree
        A trace with damage at an unknown date (`fmu.UndatedDamage`).
    beyond : float
        The loss threshold as a fraction.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes
        One axes for the probability, and one for the losses.

    Raises
    ------
    ValueError
        If the trace has no damage at an unknown date, or `beyond` is below 0, or is 1 or more.
    """
    table, names = damage_by_test(trace, (beyond,)), list(map(str, trace[BY_TEST].data_vars))
    figure = figure or style.new_figure(WIDE, 4.2)
    axes = np.asarray(figure.subplots(2, 1, sharex=True, squeeze=False)[:, 0])
    dates = [name for name, (kind, *_) in roles_of(trace).items() if kind == "date"]
    for name in dates:
        low, high = np.quantile(trace["posterior"][name].to_numpy(), (0.05, 0.95))
        for axis in axes:
            axis.axvspan(low, high, color=style.PALE, zorder=0, label=f"{style.literal(name)}: 90 %")
    for k, name in enumerate(names):
        x = times_of_tests(trace, name)
        order = np.argsort(x, kind="stable")
        of_one = table.xs(name, level="parameter").to_numpy()[order]
        x, colour, label = x[order], style.PALETTE[k % len(style.PALETTE)], style.literal(name)
        axes[0].plot(x, of_one[:, 4], color=colour, marker="o", markersize=3, linewidth=1.2, label=label)
        axes[1].fill_between(x, 100.0 * of_one[:, 2], 100.0 * of_one[:, 3], color=colour, alpha=0.25, linewidth=0)
        axes[1].plot(x, 100.0 * of_one[:, 0], color=colour, linewidth=1.2)
    axes[0].set_ylim(-0.03, 1.03)
    axes[1].axhline(100.0 * beyond, color=style.GREY, linewidth=1, linestyle="--", zorder=0)
    style.finish(axes[0], y=str(table.columns[-1]))
    units = dict.fromkeys(_time_of(trace, name) or "number of the test" for name in names)
    style.finish(axes[1], style.literal(", ".join(units)), "loss / %")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3, fontsize=style.FONT - 1, frameon=False)
    return axes


def _time_of(trace: xr.DataTree, name: str) -> str:
    """Return the covariate that serves as time for the damage of the parameter `name`.

    Return an empty string if the tests are numbered instead.
    """
    return str(problem_of(trace)["by_date"][name])


def times_of_tests(trace: xr.DataTree, name: str) -> FloatArray:
    """Return the time of each test, shape (n_tests,), for the damage of the parameter `name`.

    The time is the value of a covariate or, if no covariate serves as time, the test's number, starting at 1.
    """
    tests, by = problem_of(trace)["tests"], _time_of(trace, name)
    return np.array([test["covariates"][by] if by else t + 1.0 for t, test in enumerate(tests)])


def _state(axis: Axes, draws: FloatArray, exceeded: FloatArray, beyond: float) -> None:
    x = np.arange(draws.shape[1])
    quantiles = np.quantile(draws, (0.05, 0.25, 0.5, 0.75, 0.95), axis=0)
    axis.axhline(0.0, color=style.GREY, linewidth=1, zorder=0)
    axis.axhline(100.0 * beyond, color=style.GREY, linewidth=1, linestyle="--", zorder=0)
    for k, p in enumerate(exceeded):
        shade = style.VERMILLION if p > 0.5 else style.BLACK
        axis.plot([k, k], quantiles[[0, 4], k], color=shade, linewidth=1.5)
        axis.plot([k, k], quantiles[[1, 3], k], color=shade, linewidth=5, solid_capstyle="butt")
        axis.plot(k, quantiles[2, k], marker="o", markersize=5, color="white", markeredgecolor=shade)
        axis.annotate(
            probably(float(p)),
            (k, 1.0),
            xycoords=axis.get_xaxis_transform(),  # above the axes, where no lines cross
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=style.FONT - 2,
            color=shade,
        )
    axis.set_xlim(-0.6, len(x) - 0.4)
