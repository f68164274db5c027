"""How well the chains mix: ranks, autocorrelation, energies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fmu.report.plots.style import (
    BLACK,
    FONT,
    GREY,
    NARROW,
    chain_colours,
    colour,
    finish,
    legend_below,
    literal,
    new_figure,
    stacked,
)

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_RANKED = (20, 500)
_LAGS = 100


def plot_ranks(trace: xr.DataTree, figure: Figure | None = None) -> NDArray[Any]:
    """Draw ArviZ's rank plots, one row a parameter: chains of one distribution stay near zero.

    The difference between the distribution of a chain's ranks among all draws, and the uniform one. The p-value is
    that of a multi-chain test of uniformity; where it is below 1 % the ranks at fault are marked. The test takes
    draws for independent: every k-th is ranked, so many as are effective, at least 20 and at most 500 a chain.

    Parameters
    ----------
    trace : xarray.DataTree
        Of at least two chains.
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (parameters,)

    Raises
    ------
    ValueError
        If there is one chain only: it has nothing to be ranked among.
    """
    import xarray as xr
    from arviz_plots import plot_rank
    from arviz_plots.plot_collection import PlotCollection

    from fmu.analysis.convergence.diagnostics import parameter_names, walkers_of
    from fmu.analysis.convergence.effective import apart

    names, walkers = parameter_names(trace), walkers_of(trace)
    posterior = trace["posterior"].to_dataset()
    if posterior.sizes["chain"] < 2:
        raise ValueError("trace: must have at least two chains to rank (got 1)")
    axes = stacked(len(names), figure)
    ranked = _independent(trace) / posterior.sizes["chain"]
    most = int(np.clip(ranked, *_RANKED)) if np.isfinite(ranked) else _RANKED[1]
    thinned = posterior.isel(draw=slice(None, None, apart(posterior.sizes["draw"], most, walkers)))
    panels = {name: xr.DataArray(np.array(axis, dtype=object)) for name, axis in zip(names, axes, strict=True)}
    drawn_on = {"figure": xr.DataArray(np.array(axes[0].figure, dtype=object))}
    collection = PlotCollection(
        thinned,
        xr.DataTree.from_dict({"/": xr.Dataset(drawn_on), "plot": xr.Dataset(panels)}),
        aes={"color": ["chain"], "overlay": ["chain"]},
        backend="matplotlib",
        color=chain_colours(trace),
    )
    visuals: Any = {"xlabel": False, "title": False, "remove_axis": False}
    plot_rank(thinned, envelope_prob=0.99, plot_collection=collection, visuals=visuals)
    for name, axis in zip(names, axes, strict=True):
        for path in (*axis.lines, *axis.collections):
            path.set_rasterized(True)
        axis.axhline(0.0, color=GREY, linewidth=0.8, zorder=0)
        axis.set_ylabel(f"Δ ECDF of\n{literal(name)}", fontsize=FONT)
        finish(axis)
    axes[-1].set_xlabel("rank among the draws of all chains / their number", fontsize=FONT)
    axes[0].figure.align_ylabels(axes)
    return axes


def _independent(trace: xr.DataTree) -> float:
    """Return the smallest effective sample size of a parameter, NaN where one has none."""
    from fmu.analysis.convergence.diagnostics import parameter_draws, walkers_of
    from fmu.analysis.convergence.effective import ess_bulk

    return float(np.min([ess_bulk(x, walkers_of(trace)) for x in np.moveaxis(parameter_draws(trace), -1, 0)]))


def plot_autocorrelation(trace: xr.DataTree, figure: Figure | None = None) -> NDArray[Any]:
    """Draw the autocorrelation of each chain, one row a parameter, out to a hundred steps.

    Of an ensemble the average over its walkers, about their common mean, from which its effective sample size is
    estimated.

    Parameters
    ----------
    trace : xarray.DataTree
    figure : Figure, optional

    Returns
    -------
    ndarray of Axes, shape (parameters,)
    """
    from fmu.analysis.convergence.diagnostics import parameter_draws, parameter_names, walkers_of
    from fmu.analysis.convergence.effective import autocorrelation

    names, walkers = parameter_names(trace), walkers_of(trace)
    draws = parameter_draws(trace)
    axes = stacked(len(names), figure, sharey=True)
    for i, (name, axis) in enumerate(zip(names, axes, strict=True)):
        for values, shade in zip(autocorrelation(draws[..., i], walkers), chain_colours(trace), strict=True):
            axis.plot(values[: _LAGS + 1], color=shade, linewidth=1.2)
        axis.axhline(0.0, color=GREY, linewidth=0.8, zorder=0)
        axis.set_ylabel(f"autocorrelation\nof {literal(name)}", fontsize=FONT)
        finish(axis)
    axes[-1].set_xlabel("lag / steps", fontsize=FONT)
    axes[-1].set_xlim(0, min(_LAGS, draws.shape[1] // walkers - 1) or 1)
    return axes


def plot_energy(trace: xr.DataTree, figure: Figure | None = None) -> Axes:
    """Draw the energies of Hamiltonian trajectories and their changes from one to the next, both about zero.

    Where the changes are much narrower than the energies themselves, new momenta cannot carry the chain through
    the posterior (Betancourt 2016, arXiv:1604.00695, section 2).

    Parameters
    ----------
    trace : xarray.DataTree
        With ``energy`` in its sample_stats.
    figure : Figure, optional

    Returns
    -------
    Axes

    Raises
    ------
    ValueError
        If the sampler has no energies.
    """
    if "energy" not in trace["sample_stats"]:
        raise ValueError(f"trace: must have energies (the sampler {trace.attrs['sampler']} has none)")
    energy = trace["sample_stats"]["energy"].transpose("chain", "draw").to_numpy()
    figure = figure or new_figure(NARROW, 3.0)
    axes = figure.subplots()
    about, changes = (energy - energy.mean()).ravel(), np.diff(energy, axis=1).ravel()
    ends = np.quantile(np.concatenate([about, changes]), [0.0005, 0.9995])
    bins = np.linspace(ends[0], ends[1], 50).tolist()
    axes.hist(
        about, bins, density=True, color=colour(str(trace.attrs["sampler"])), alpha=0.45, label="energy − mean"
    )
    axes.hist(changes, bins, density=True, histtype="step", color=BLACK, linewidth=1.3,
              label="change from draw to draw")  # fmt: skip
    axes.set_xlabel("energy (−log-probability + kinetic), nats", fontsize=FONT)
    axes.set_ylabel("density / nat⁻¹", fontsize=FONT)
    finish(axes)
    legend_below(axes)
    return axes
