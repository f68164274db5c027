"""Report sections on the chains: reliability, traces, ranks, autocorrelation, running means, pairs, energies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence.diagnostics import RHAT_LIMIT
from fmu.analysis.convergence.effective import energy_fraction
from fmu.analysis.convergence.remedies import MCSE_OF_ENDS, rhat_limits, without_scores
from fmu.analysis.trace.reading import array_of, has, parameter_draws
from fmu.numbers import decimals, fixed, given, interval, significant
from fmu.report.document import Omitted, PageSection, PageTable, Part, Picture, Pictures, Text, picture
from fmu.report.figure_data import linked_draws
from fmu.report.plots.chains import (
    plot_autocorrelation,
    plot_energy,
    plot_ranks,
    plot_running_means,
    plot_running_rhat,
    plot_traces,
)
from fmu.report.plots.corner import plot_corner
from fmu.report.plots.style import NARROW, height_of_row, new_figure
from fmu.report.run import ReportedRun

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FEWEST = 50
LOOK_AT_PATHS = (
    "Paths of the chains. Shaded: warm-up. Dashed: bounds. Look for chains that stay apart, drift, or stand still."
)
LOOK_AT_RANKS = (
    "Ranks of each chain's draws among all draws: difference of their distribution from a uniform one, with the "
    "p-value of a multi-chain test. Look for p below 0.01: chains that do not draw from the same distribution."
)
LOOK_AT_AUTOCORRELATION = (
    "Autocorrelation of each chain. Look for curves that stay above zero: draws so far apart repeat each other."
)
LOOK_AT_MEANS = (
    "Mean of each chain's first draws. Band: the mean of all, ± 2 standard errors. Look for chains that end "
    "outside."
)
LOOK_AT_RHAT = "R-hat of each parameter while the run grew. Look for curves that end above the limit, or rise."
LOOK_AT_ENERGIES = (
    "Energies of the trajectories, and their change from draw to draw. Look for changes much narrower than the "
    "energies: momenta that explore the posterior poorly."
)
TOO_FEW = "there are too few draws"


def reliability(run: ReportedRun) -> PageSection:
    """Return the section with each parameter's R-hat, effective sample sizes and Monte Carlo errors."""
    rows = []
    for name in run.names:
        rhat, bulk, tail, error, sd = (
            float(run.summary[column][name]) for column in ("rhat", "ess_bulk", "ess_tail", "mcse_mean", "sd")
        )
        of_mean, *of_ends = (run.value(name, column) for column in ("mcse_mean", *MCSE_OF_ENDS))
        rows.append(
            (
                name, run.unit(name).name, fixed(rhat, 4), fixed(bulk, 0), fixed(tail, 0),
                fixed(of_mean, decimals(of_mean)), significant(error / sd if sd else np.nan, 2),
                *(fixed(of_end, decimals(of_end)) for of_end in of_ends),
            )
        )  # fmt: skip
    header = (
        "parameter", "unit", "R-hat", "bulk ESS", "tail ESS", "MCSE of the mean", "MCSE/sd",
        "MCSE of the 5 % end", "MCSE of the 95 % end",
    )  # fmt: skip
    caption = f"Accuracy of the posterior estimates: {run.chains_in_words}."
    return PageSection(
        "reliability", "Reliability of the draws", (PageTable(caption, header, tuple(rows), words=(1,)),)
    )


def paths(run: ReportedRun) -> PageSection:
    """Return the section with trace plots and, if there are several chains, rank plots."""
    ranges = []
    for name in run.names:
        unit, n = run.unit(name), decimals(run.value(name, "sd"))
        draws = run.trace["posterior"][name].to_numpy() / unit.factor
        ranges.append(f"{name} {interval(draws.min(), draws.max(), n)} {unit.name}".rstrip())
    worst = run.summary["rhat"].max()
    alt = f"Paths of the chains, warm-up shaded. Draws kept: {'; '.join(ranges)}. R-hat at most {fixed(worst, 4)}."
    caption = LOOK_AT_PATHS
    figure = new_figure(NARROW, height_of_row(len(run.names)) * len(run.names) + 0.9)
    drawings = [picture(plot_traces({"": run.trace}, figure=figure), "paths", alt, caption)]
    if _has_several_chains(run):
        axes = plot_ranks(run.trace)
        far = [f"{name} {fixed(_furthest(axis), 2)}" for name, axis in zip(run.names, axes, strict=True)]
        alt = f"Rank plots. Largest distance from uniform ranks: {', '.join(far)}."
        caption = LOOK_AT_RANKS
        drawings.append(picture(axes, "ranks", alt, caption))
    return PageSection("paths", "Trace plots and rank plots", (Text(_agreement(run)), Pictures(tuple(drawings))))


def _agreement(run: ReportedRun) -> str:
    """Return a sentence that says whether the chains agree, and names the parameter with the worst R-hat.

    The worst R-hat is the highest one relative to its parameter's limit. If a parameter's R-hat is NaN or
    infinite, the sentence says that the agreement is unknown.
    """
    rhat = run.summary["rhat"].fillna(np.inf)
    limits = rhat_limits(rhat.index, run.summary.attrs.get("scores", []))
    k = int(np.argmax((rhat.to_numpy() - 1.0) / (limits - 1.0)))
    name, worst, limit = str(rhat.index[k]), float(rhat.iloc[k]), float(limits[k])
    if not np.isfinite(worst):
        return f"Whether the chains agree is unknown: {name} has no R-hat."
    agree = "The chains agree" if worst < limit else "The chains do not agree"
    return f"{agree}: the worst R-hat is {fixed(worst, 4)}, in {name}; below {given(limit)} is needed."


def _slowest(run: ReportedRun) -> str:
    """Return a sentence on the parameter with the smallest bulk ESS, or on parameters whose ESS is undefined."""
    ess = without_scores(run.summary)["ess_bulk"]
    if ess.isna().any():
        return "The draws of some parameters do not move."
    posterior, name = run.trace["posterior"], str(ess.idxmin())
    draws = posterior.sizes["chain"] * posterior.sizes["draw"]
    return f"Slowest: {name}, whose {draws} draws are worth {fixed(float(ess[name]), 0)} independent ones."


def _has_several_chains(run: ReportedRun) -> bool:
    return bool(run.trace["posterior"].sizes["chain"] > 1)


def _has_few_draws(run: ReportedRun) -> bool:
    return bool(run.trace["posterior"].sizes["chain"] * run.trace["posterior"].sizes["draw"] < _FEWEST)


def _furthest(axis: Axes) -> float:
    """Return the largest absolute y-value among the plotted lines."""
    return max(float(np.max(np.abs(line.get_ydata()))) for line in axis.lines)


def settling(run: ReportedRun) -> PageSection:
    """Return the section on autocorrelation and running means and, if there are several chains, running R-hat."""
    drawings = [_autocorrelation(run), _running_means(run)]
    if _has_several_chains(run):
        drawings.append(_running_rhat(run))
    return PageSection(
        "settling",
        "Autocorrelation and running means",
        (Text(_slowest(run)), Pictures(tuple(drawings))),
    )


def _autocorrelation(run: ReportedRun) -> Picture:
    axes = plot_autocorrelation(run.trace)
    k = int(np.argmin(run.summary.loc[list(run.names), "ess_bulk"].to_numpy()))
    *chains, _ = axes[k].lines  # the last line marks zero
    mean = np.mean([line.get_ydata() for line in chains], axis=0)
    values = ", ".join(f"{fixed(mean[lag], 2)} at lag {lag}" for lag in (1, 10, 50) if lag < len(mean))
    alt = f"Autocorrelation of each parameter; of {run.names[k]}, the slowest, {values}."
    return picture(axes, "acf", alt, LOOK_AT_AUTOCORRELATION)


def _running_means(run: ReportedRun) -> Picture:
    draws = parameter_draws(run.trace)
    sd = draws.std(axis=(0, 1))
    apart = np.ptp(draws.mean(axis=1), axis=0) / np.where(sd > 0, sd, np.inf)
    far = ", ".join(f"{name} {fixed(x, 2)}" for name, x in zip(run.names, apart, strict=True))
    alt = f"Running means of the chains. Differences at the end, in posterior standard deviations: {far}."
    return picture(plot_running_means(run.trace, run.summary), "means", alt, LOOK_AT_MEANS)


def _running_rhat(run: ReportedRun) -> Picture:
    axes = plot_running_rhat(run.trace)
    seen = []
    for name, line in zip(run.names, axes.lines, strict=False):  # the last line is the limit
        above = np.asarray(line.get_ydata(), dtype=float)
        seen.append(f"{name} {fixed(1 + above[len(above) // 2], 3)}, then {fixed(1 + above[-1], 3)}")
    at = np.asarray(axes.lines[0].get_xdata())
    alt = (
        f"R-hat after {at[len(at) // 2]} steps and after {at[-1]}: {'; '.join(seen)}. Limit: {given(RHAT_LIMIT)}."
    )
    return picture(axes, "rhat", alt, LOOK_AT_RHAT)


def pairs(run: ReportedRun, most: int = 8) -> PageSection | Omitted:
    """Return the section on parameter pairs, or `Omitted` if there are fewer than 50 draws.

    It shows at most `most` parameters: the most strongly correlated ones.
    """
    title = "Pairs of parameters"
    if _has_few_draws(run):
        return Omitted(title, TOO_FEW)
    names, words = _strongest_correlations(run, most)
    parts: list[Part] = []
    if left := [name for name in run.names if name not in names]:
        parts.append(
            Text(
                f"The {len(names)} of {len(run.names)} parameters with the strongest correlations. "
                f"Left out: {', '.join(left)}."
            )
        )
    axes = plot_corner(run.trace, run.maxima[0].theta if run.maxima else None, names=names)
    drawing = picture(
        axes,
        "corner",
        f"Marginals and pairs of {', '.join(names)}. {words}",
        f"Regions with 50 % and 90 % of the draws. {words}".strip(),
        linked_draws(axes, run.trace, names),
    )
    return PageSection("pairs", title, (*parts, drawing))


def _strongest_correlations(run: ReportedRun, most: int) -> tuple[tuple[str, ...], str]:
    """Return at most `most` parameters with the strongest correlations, and a sentence on the strongest one.

    If fewer than two parameters vary, return the first `most` parameters and an empty sentence.
    """
    draws, n = parameter_draws(run.trace).reshape(-1, len(run.names)), len(run.names)
    moving = np.flatnonzero(np.ptp(draws, axis=0) > 0)
    if len(moving) < 2:
        return run.names[:most], ""
    correlation = np.zeros((n, n))
    correlation[np.ix_(moving, moving)] = np.corrcoef(draws[:, moving].T)
    np.fill_diagonal(correlation, 0.0)
    strength = np.abs(correlation).max(axis=0)
    shown = np.sort(np.argsort(-strength, kind="stable")[:most])
    i, j = np.unravel_index(np.argmax(np.triu(np.abs(correlation))), correlation.shape)
    r = fixed(float(correlation[i, j]), 2)
    words = f"Strongest correlation: {r}, of {run.names[i]} and {run.names[j]}."
    return tuple(run.names[k] for k in shown), words


def energies(run: ReportedRun) -> PageSection | Omitted:
    """Return the section on the energies of Hamiltonian trajectories.

    Return `Omitted` if the sampler records no energies, or if there are fewer than 50 draws.
    """
    title = "Energies of the trajectories"
    if not has(run.trace, "sample_stats", "energy"):
        return Omitted(title, "this sampler has none")
    if _has_few_draws(run):
        return Omitted(title, TOO_FEW)
    energy = array_of(run.trace, "sample_stats", "energy")
    is_known = has(run.trace, "sample_stats", "diverging")
    diverged = int(array_of(run.trace, "sample_stats", "diverging").sum()) if is_known else 0
    fraction = energy_fraction(energy)
    values = ", ".join(fixed(x, 2) for x in fraction)
    said = (
        f"E-BFMI of the chains: {values} (below 0.3: poor exploration). "
        f"{diverged} of {energy.size} trajectories diverged."
    )
    drawing = picture(plot_energy(run.trace), "energy", f"Energies and their changes. {said}", LOOK_AT_ENERGIES)
    return PageSection("energies", title, (Text(said), Pictures((drawing,))))
