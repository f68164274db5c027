"""Plot the figures for one experiment in the paper."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from fmu.numbers import share
from fmu.paper.convergence import Curve
from fmu.paper.experiment import CI_PROB, PAIRED_BY, Result, posterior_mean
from fmu.report.plots import (
    BLACK,
    COLOURS,
    DPI,
    FONT,
    GREY,
    PALE,
    TITLES,
    Frequencies,
    finish,
    new_figure,
    plot_frequency_errors,
    plot_traces,
)
from fmu.report.plots.corner import plot_corner

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ENOUGH = 0.05
"""1/√400, the error of 400 independent draws; convergence requires an effective sample size of 400."""


def write_figures(result: Result, frequencies: pd.DataFrame, directory: Path) -> None:
    """Write all figures for an experiment to `directory` as PNG files."""
    heading = f"Section {result.published.section}, paired {PAIRED_BY[result.pairing]}"
    for name, trace in result.long.items():
        columns, published = {"long run": trace}, None
        if name in result.paper:
            columns = {"the paper's protocol": result.paper[name], **columns}
            published = result.published.columns[name].printed_theta
        paths = plot_traces(columns, published)[0, 0]
        _save(paths, f"{TITLES[name]}. {heading}", directory / f"trace-{name}.png")
        pairs = plot_corner(trace, result.maxima[0].theta)[0, 0]
        _save(pairs, f"{TITLES[name]}. {heading}", directory / f"corner-{name}.png", x=0.98, ha="right")
        series = frequency_series(result, frequencies, name)
        labels = [f"{label}" for label in frequencies.index]
        errors = plot_frequency_errors(frequencies["measured_hz"], series, labels)
        _save(errors, f"{TITLES[name]}. {heading}", directory / f"frequencies-{name}.png")
    _save(plot_convergence(result), f"Convergence. {heading}", directory / "convergence.png")


def frequency_series(result: Result, table: pd.DataFrame, name: str) -> list[Frequencies]:
    """Return the sets of frequencies that are plotted for a sampler.

    The first set is computed before updating, the last one at the posterior mean of the long run. For a sampler
    that the paper uses, the sets between them are the published frequencies, and those at the posterior mean of
    our run with the paper's protocol.
    """
    start = result.problem.frequencies(result.problem.start)
    series = [Frequencies("before updating", start, GREY, filled=False)]
    if name in result.paper:
        at_mean = result.problem.frequencies(posterior_mean(result.paper[name]))
        series += [
            Frequencies("published", table[f"published_{name}_hz"], BLACK, filled=False),
            Frequencies("the paper's protocol, ours", at_mean, COLOURS[name], filled=False),
        ]
    ends = table.filter(regex=f"^long_{name}_predictive_").to_numpy().T
    label = f"long run, with its {share(CI_PROB)} predictive interval"
    return [*series, Frequencies(label, table[f"long_{name}_hz"], COLOURS[name], interval_hz=ends)]


def plot_convergence(result: Result, figure: Figure | None = None) -> Axes:
    """Plot the error of the running mean against the number of model solves for every sampler.

    A solid line is the median over the long run's chains (or ensembles), and the band is their range. A dotted
    line is the paper's protocol. A dot marks the length that the long run needed to pass the convergence checks.
    The shaded area is below the reference's own error, and the dashed line is the error of 400 independent draws.
    """
    figure = figure or new_figure(8.0, 5.4)
    axes = figure.subplots()
    for name, (long, *paper) in result.curves.items():
        _band(axes, long, COLOURS[name], TITLES[name])
        for curve in paper:
            axes.plot(curve.solves, curve.error[0], color=COLOURS[name], linestyle=":", linewidth=1.8)
        needed = result.needed[name].solves
        if needed is not None:
            x = needed / len(long.error)
            y = np.exp(np.interp(np.log(x), np.log(long.solves), np.log(np.median(long.error, axis=0))))
            axes.plot(x, y, marker="o", markersize=9, color=COLOURS[name], markeredgecolor=BLACK, zorder=5)
    axes.set(xscale="log", yscale="log")
    low, high = axes.get_ylim()
    resolution = result.reference.resolution
    low = min(low, 0.5 * min(resolution, ENOUGH))
    axes.axhspan(low, resolution, color=PALE, zorder=0, linewidth=0)
    axes.axhline(ENOUGH, color=GREY, linestyle="--", linewidth=1.0, zorder=1)
    axes.set_ylim(low, high)
    axes.set_title(f"Error against: {result.reference.origin}", fontsize=FONT - 1, color=GREY)
    finish(
        axes,
        "model solves of one chain (one ensemble), warm-up counted",
        "error of the running mean / posterior sd",
    )
    _legend(figure, result)
    return axes


def _band(axes: Axes, curve: Curve, colour: str, label: str) -> None:
    axes.fill_between(curve.solves, curve.error.min(axis=0), curve.error.max(axis=0), color=colour, alpha=0.18,
                      linewidth=0)  # fmt: skip
    axes.plot(curve.solves, np.median(curve.error, axis=0), color=colour, linewidth=2.0, label=label)


def _legend(figure: Figure, result: Result) -> None:
    """Add a legend of colours and line styles below the figure."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    colours: list[Line2D | Patch] = [
        Line2D([], [], color=COLOURS[s], linewidth=2.0, label=TITLES[s]) for s in result.curves
    ]
    styles: list[Line2D | Patch] = [
        Line2D([], [], color=BLACK, linewidth=2.0, label="long run: median of its chains, and all"),
        Line2D([], [], color=BLACK, linewidth=1.8, linestyle=":", label="the paper's protocol, ours"),
        Line2D(
            [], [], color="white", marker="o", markersize=9, markeredgecolor=BLACK, label="passes for converged"
        ),
        Line2D([], [], color=GREY, linewidth=1.0, linestyle="--", label="error of 400 independent draws"),
    ]
    styles.append(Patch(color=PALE, label="below the reference's own error"))
    figure.legend(
        handles=[*colours, *styles], loc="outside lower center", ncols=3, fontsize=FONT - 1, frameon=False
    )


def _save(axes: Axes, title: str, path: Path, x: float = 0.5, ha: Literal["center", "right"] = "center") -> None:
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.suptitle(title, fontsize=FONT + 2, x=x, ha=ha)
    figure.savefig(path, dpi=DPI)
