"""Plots of the chains: traces, ranks, autocorrelation, energies, running means and running R-hat."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from fmu.analysis.convergence.diagnostics import RHAT_LIMIT, summary
from fmu.analysis.convergence.effective import (
    apart,
    autocorrelation,
    ess_bulk,
    lengths,
    running_means,
    running_rhat,
)
from fmu.analysis.trace.reading import array_of, constant, has, parameter_draws, parameter_names, walkers_of
from fmu.numbers import given
from fmu.report.plots import style

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_MAX_POINTS = 1500


def plot_traces(
    traces: Mapping[str, xr.DataTree], published: ArrayLike | None = None, figure: Figure | None = None
) -> style.AxesArray:
    """Plot the chains against step number, one row per parameter and one column per trace, with warm-up shaded.

    One walker of each ensemble is shown. The axis limits fit the draws after warm-up and the published values, so
    the warm-up may extend beyond them. Dashed lines are bounds, dotted lines are published values.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        Traces, keyed by the titles of their columns.
    published : array_like, shape (parameters,), optional
        Published values to compare with the first trace, SI units.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (parameters, traces)
    """
    names = parameter_names(next(iter(traces.values())))
    row = 1.15 * style.height_of_row(len(names))
    figure = figure or style.new_figure(5.2 * len(traces) + 0.4, row * len(names) + 0.8)
    room = (figure.get_figheight() - 0.8) / len(names)
    axes = figure.subplots(len(names), len(traces), sharex="col", squeeze=False)
    for j, (title, trace) in enumerate(traces.items()):
        walkers = int(trace.attrs["walkers"])
        for i, name in enumerate(names):
            _plot_path(axes[i, j], trace, name, room)
        if trace["warmup_posterior"].sizes["draw"]:
            _say_above(axes[0, j], 0.5 * trace["warmup_posterior"].sizes["draw"] / walkers, "warm-up")
        axes[0, j].set_title(style.literal(title), fontsize=style.FONT + 1)
        axes[-1, j].set_xlabel(
            "step" if walkers == 1 else "step (one walker of each ensemble)", fontsize=style.FONT
        )
    if published is not None:
        for axis, name, value in zip(axes[:, 0], names, np.asarray(published, dtype=float), strict=True):
            _compare(axis, value / style.unit_of(next(iter(traces.values())), name).factor)
        _say_above(axes[0, 0], axes[0, 0].get_xlim()[1], "dotted: published", "right")
    style.legend_of_chains(figure, next(iter(traces.values())))
    figure.align_ylabels(axes)
    return axes


def _say_above(axes: Axes, x: float, words: str, side: Literal["center", "right"] = "center") -> None:
    axes.text(x, 1.0, words, transform=axes.get_xaxis_transform(), ha=side, va="bottom", fontsize=style.FONT - 2,
              color=style.GREY)  # fmt: skip


def _compare(axes: Axes, value: float) -> None:
    """Add a dotted line at a reference value and extend the axes to include it."""
    low, high = axes.get_ylim()
    axes.axhline(value, color=style.BLACK, linestyle=":", linewidth=1.3)
    axes.set_ylim(min(low, value - 0.05 * (high - low)), max(high, value + 0.05 * (high - low)))


def _plot_path(axes: Axes, trace: xr.DataTree, name: str, room: float) -> None:
    """Plot all chains for one parameter, with an axis label that fits in `room` inches."""
    unit = style.unit_of(trace, name)
    walkers = int(trace.attrs["walkers"])
    warm, kept = (
        array_of(trace, group, name)[:, ::walkers] / unit.factor for group in ("warmup_posterior", "posterior")
    )
    paths = np.concatenate([warm, kept], axis=1)
    every = max(1, paths.shape[1] // _MAX_POINTS)
    steps = np.arange(1, paths.shape[1] + 1)[::every]
    for path, shade in reversed(list(zip(paths, style.chain_colours(trace), strict=True))):
        axes.plot(steps, path[::every], color=shade, linewidth=0.7, rasterized=True, antialiased=False)
    if warm.shape[1]:
        axes.axvspan(0, warm.shape[1], color=style.PALE, zorder=0, linewidth=0)
    low, high = kept.min(), kept.max()
    margin = 0.08 * (high - low) or 0.01 * abs(high)
    axes.set_ylim(low - margin, high + margin)
    axes.set_xlim(0, paths.shape[1])
    for bound in ("lower", "upper"):
        value = constant(trace, bound, name) / unit.factor
        if low - margin < value < high + margin:
            axes.axhline(value, color=style.BLACK, linestyle="--", linewidth=0.8)
    style.finish(axes, y=style.broken(unit.label(name), room))


_RANKED = (20, 500)
_LAGS = 100


def plot_ranks(trace: xr.DataTree, figure: Figure | None = None) -> style.AxesArray:
    """Plot the ranks of each chain's draws with ArviZ, one row per parameter.

    The plot shows how far the distribution of a chain's ranks among all draws differs from the uniform
    distribution. Chains with the same distribution stay near zero. Each plot states the p-value of a multi-chain
    test of uniformity. If it is below 1 %, the deviating ranks are marked. Because the test assumes independent
    draws, the chains are thinned to their effective sample size, within limits of 20 and 500 draws per chain, or
    to 500 draws per chain if the effective sample size is undefined.

    Parameters
    ----------
    trace : xarray.DataTree
        A trace with at least two chains.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (parameters,)

    Raises
    ------
    ValueError
        If there is only one chain.
    """
    walkers = walkers_of(trace)
    posterior = trace["posterior"].to_dataset()
    if posterior.sizes["chain"] < 2:
        raise ValueError("trace: must have at least two chains to rank (got 1)")
    axes = style.stack_axes(len(parameter_names(trace)), figure)
    ranked = _independent(trace) / posterior.sizes["chain"]
    most = int(np.clip(ranked, *_RANKED)) if np.isfinite(ranked) else _RANKED[1]
    thinned = posterior.isel(draw=slice(None, None, apart(posterior.sizes["draw"], most, walkers)))
    draw_ranks(thinned, axes, style.chain_colours(trace))
    axes[-1].set_xlabel("rank among the draws of all chains / their number", fontsize=style.FONT)
    style.legend_of_chains(axes[0].figure, trace)
    return axes


def draw_ranks(thinned: xr.Dataset, axes: style.AxesArray, colours: list[str]) -> None:
    """Plot the ranks of independent draws (chain, draw) with ArviZ. Each axes shows one parameter."""
    import xarray as xr
    from arviz_plots import plot_rank
    from arviz_plots.plot_collection import PlotCollection

    names = [str(name) for name in thinned.data_vars]
    panels = {name: xr.DataArray(np.array(axis, dtype=object)) for name, axis in zip(names, axes, strict=True)}
    drawn_on = {"figure": xr.DataArray(np.array(axes[0].figure, dtype=object))}
    collection = PlotCollection(
        thinned,
        xr.DataTree.from_dict({"/": xr.Dataset(drawn_on), "plot": xr.Dataset(panels)}),
        aes={"color": ["chain"], "overlay": ["chain"]},
        backend="matplotlib",
        color=colours,
    )
    plot_rank(
        thinned,
        envelope_prob=0.99,
        plot_collection=collection,
        visuals={"xlabel": False, "title": False, "remove_axis": False},
    )
    for name, axis in zip(names, axes, strict=True):
        for path in (*axis.lines, *axis.collections):
            path.set_rasterized(True)
        axis.axhline(0.0, color=style.GREY, linewidth=0.8, zorder=0)
        style.finish(axis, y=style.broken(name, style.height_of_row(len(names))))
    axes[0].figure.supylabel("Δ ECDF of the ranks", fontsize=style.FONT)
    axes[0].figure.align_ylabels(axes)


def _independent(trace: xr.DataTree) -> float:
    """Return the smallest bulk ESS over the parameters, or NaN if any parameter's ESS is undefined."""
    return float(np.min([ess_bulk(x, walkers_of(trace)) for x in np.moveaxis(parameter_draws(trace), -1, 0)]))


def plot_autocorrelation(trace: xr.DataTree, figure: Figure | None = None) -> style.AxesArray:
    """Plot each chain's autocorrelation up to a lag of 100 steps, one row per parameter.

    For an ensemble, the autocorrelation is taken about the common mean of all walkers and averaged over the
    walkers, as for the effective sample size.

    Parameters
    ----------
    trace : xarray.DataTree
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (parameters,)
    """
    names, walkers = parameter_names(trace), walkers_of(trace)
    draws = parameter_draws(trace)
    axes = style.stack_axes(len(names), figure, sharey=True)
    for i, (name, axis) in enumerate(zip(names, axes, strict=True)):
        for values, shade in zip(autocorrelation(draws[..., i], walkers), style.chain_colours(trace), strict=True):
            axis.plot(values[: _LAGS + 1], color=shade, linewidth=1.2)
        axis.axhline(0.0, color=style.GREY, linewidth=0.8, zorder=0)
        style.finish(axis, y=style.broken(name, style.height_of_row(len(names))))
    axes[0].figure.supylabel("autocorrelation", fontsize=style.FONT)
    axes[-1].set_xlabel("lag / steps", fontsize=style.FONT)
    axes[-1].set_xlim(0, min(_LAGS, draws.shape[1] // walkers - 1) or 1)
    style.legend_of_chains(axes[0].figure, trace)
    return axes


def plot_energy(trace: xr.DataTree, figure: Figure | None = None) -> Axes:
    """Plot the centred energies of Hamiltonian trajectories, and the energy changes between successive draws.

    If the changes have a much narrower distribution than the energies, new momenta explore the posterior poorly
    (Betancourt 2016, arXiv:1604.00695, section 2).

    Parameters
    ----------
    trace : xarray.DataTree
        A trace with ``energy`` in its sample_stats.
    figure : Figure, optional

    Returns
    -------
    Axes

    Raises
    ------
    ValueError
        If the trace has no energies.
    """
    if not has(trace, "sample_stats", "energy"):
        raise ValueError(f"trace: must have energies (the sampler {trace.attrs['sampler']} has none)")
    energy = array_of(trace, "sample_stats", "energy")
    figure = figure or style.new_figure(style.NARROW, 3.0)
    axes = figure.subplots()
    about, changes = (energy - energy.mean()).ravel(), np.diff(energy, axis=1).ravel()
    ends = np.quantile(np.concatenate([about, changes]), [0.0005, 0.9995])
    bins = np.linspace(ends[0], ends[1], 50).tolist()
    axes.hist(
        about,
        bins,
        density=True,
        color=style.colour(str(trace.attrs["sampler"])),
        alpha=0.45,
        label="energy − mean",
    )
    axes.hist(changes, bins, density=True, histtype="step", color=style.BLACK, linewidth=1.3,
              label="change from draw to draw")  # fmt: skip
    style.finish(axes, "energy (−log-probability + kinetic), nats", "density / nat⁻¹")
    style.legend_below(axes)
    return axes


_DASHES = ("-", "--", "-.", ":")
_BACKED = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
_FLOOR = 1e-3
"""Smallest value of R-hat − 1 that is drawn; smaller values are drawn at this value."""


def plot_running_means(
    trace: xr.DataTree, table: pd.DataFrame | None = None, figure: Figure | None = None
) -> style.AxesArray:
    """Plot each chain's running mean, one row per parameter.

    A line marks the mean of all draws, and a band marks ± 2 standard errors of this mean. The band is omitted if
    the standard error is unknown.

    Parameters
    ----------
    trace : xarray.DataTree
    table : pandas.DataFrame, optional
        The result of ``fmu.summary(trace)``, if already computed.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (parameters,)
    """
    names = parameter_names(trace)
    table = summary(trace) if table is None else table
    axes = style.stack_axes(len(names), figure)
    steps = trace["posterior"].sizes["draw"] // walkers_of(trace)
    at, means = running_means(trace, lengths(steps, 60))
    for i, (name, axis) in enumerate(zip(names, axes, strict=True)):
        unit = style.unit_of(trace, name)
        mean, error = (float(table[column][name]) / unit.factor for column in ("mean", "mcse_mean"))
        if np.isfinite(error):
            axis.axhspan(mean - 2 * error, mean + 2 * error, color=style.PALE, linewidth=0, zorder=0)
        axis.axhline(mean, color=style.GREY, linewidth=0.8, zorder=1)
        for chain, shade in enumerate(style.chain_colours(trace)):
            axis.plot(at, means[:, chain, i] / unit.factor, color=shade, linewidth=1.2)
        style.finish(axis, y=style.broken(unit.label(name), style.height_of_row(len(names))))
    _logarithmic_steps(axes[-1])
    style.legend_of_chains(axes[0].figure, trace)
    axes[0].figure.align_ylabels(axes)
    return axes


def _logarithmic_steps(axes: Axes) -> None:
    """Make the step axis logarithmic, with tick labels in decimal notation."""
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("steps kept", fontsize=style.FONT)


def plot_running_rhat(trace: xr.DataTree, figure: Figure | None = None) -> Axes:
    """Plot each parameter's running R-hat, and the limit that the convergence verdict uses.

    The axis shows R-hat − 1 on a logarithmic scale. Values below 0.001 are drawn at 0.001.

    Parameters
    ----------
    trace : xarray.DataTree
    figure : Figure, optional

    Returns
    -------
    Axes
    """
    names = parameter_names(trace)
    figure = figure or style.new_figure(style.NARROW, 3.0 + 0.1 * len(names))
    axes = figure.subplots()
    at, rhat = running_rhat(trace)
    for i, name in enumerate(names):
        shade, dashes = style.PALETTE[i % len(style.PALETTE)], _DASHES[i // len(style.PALETTE) % len(_DASHES)]
        above = np.maximum(rhat[:, i] - 1.0, _FLOOR)
        axes.plot(at, above, label=style.literal(name), color=shade, linestyle=dashes, linewidth=1.6)
    axes.plot(at[[0, -1]], [RHAT_LIMIT - 1.0] * 2, color=style.BLACK, linewidth=1.0)
    axes.annotate(f"limit {given(RHAT_LIMIT)}", (at[-1], RHAT_LIMIT - 1.0), (0, 3), textcoords="offset points",
                  ha="right", fontsize=style.FONT - 2, bbox=_BACKED)  # fmt: skip
    finite = rhat[np.isfinite(rhat)] - 1.0
    axes.set_ylim(_FLOOR, max(3.0 * (RHAT_LIMIT - 1.0), 1.3 * finite.max(initial=0.0)))
    axes.set_yscale("log")
    axes.minorticks_off()
    _logarithmic_steps(axes)
    style.finish(axes, y=f"R-hat − 1\n(at least {given(_FLOOR)})")
    style.legend_below(axes)
    return axes
