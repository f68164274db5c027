"""The page and the figure of the coverage study."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from fmu.numbers import significant
from fmu.report.plots.style import FONT, GREY, PALE, colour, new_figure, tint
from fmu.tables import markdown_table
from tests.validation import coverage, ten_storeys
from tests.validation.bands import UniformRanks

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write(study: coverage.Study, directory: Path) -> None:
    """Write ``coverage.md`` and ``coverage/coverage.png`` into the directory."""
    (directory / "coverage").mkdir(parents=True, exist_ok=True)
    figure(study).savefig(directory / "coverage" / "coverage.png", dpi=150)
    ess = [run.ess for run in study.runs]
    lowest, highest = study.band
    lost = 100 * (coverage.INTERVAL - study.expected)
    (directory / "coverage.md").write_text(
        PAGE.format(
            command=_command(study.replicates),
            verdict=verdict(study),
            minutes=sum(run.processor_s for run in study.runs) / 60.0,
            replicates=study.replicates,
            chains=coverage.CHAINS,
            warmup=coverage.WARMUP,
            draws=np.mean([run.draws for run in study.runs]),
            least=min(ess),
            median=np.median(ess),
            gate=coverage.LEAST_ESS,
            scatter=np.sqrt(0.5 / study.replicates),
            interval=100 * coverage.INTERVAL,
            lowest=lowest,
            highest=highest,
            gates=len(study.p_values),
            alarm=100 * coverage.FALSE_ALARM,
            lost=f"{lost.min():.2f} to {lost.max():.2f} %",
            ranked=coverage.RANKED,
            level=study.level,
            low=100 * lowest / study.replicates,
            high=100 * highest / study.replicates,
            chance=100 * (1.0 - 0.997 ** len(study.p_values)),
            table=_table(study),
        ),
        encoding="utf-8",
    )


def _command(replicates: int) -> str:
    """Return what writes the page, and where the replicates are fewer than they should be, that they are."""
    if replicates == coverage.REPLICATES:
        return "`make validate`"
    return (
        f"`python -m tests.validation.coverage results --replicates {replicates}`, with {replicates} of the "
        f"{coverage.REPLICATES} replicates that `make validate` runs,"
    )


def verdict(study: coverage.Study) -> str:
    """Return whether the gates pass, and every p-value that is small by itself, with what that means among all."""
    what, p, among = study.smallest
    count = len(study.p_values)
    small = {name: value for name, value in study.p_values.items() if value < coverage.DOUBTFUL}
    said = "**All gates pass.**"
    if study.failures:
        said = "**Gates that fail:**\n\n" + "\n".join(f"- {failure}" for failure in study.failures) + "\n\n"
    elif study.replicates < coverage.REPLICATES:
        said = f"**No gate fails, but {study.replicates} of {coverage.REPLICATES} replicates decide nothing yet.**"
    elif among < coverage.DOUBTFUL:
        said = f"**No gate fails, but {what} is doubtful; more replicates would decide.**"
    said += (
        f" The smallest of {count} p-values is {p:.2g}, {what}. If the sampler is right, the smallest of {count} "
        f"is no larger than that with a probability of {100 * among:.2g} %."
    )
    named = ", ".join(f"{name} ({value:.2g})" for name, value in small.items())
    expected = coverage.DOUBTFUL * count
    return (
        f"{said} By themselves {len(small)} of them are below {coverage.DOUBTFUL:g}, where {expected:.2g} are "
        f"expected{f': {named}' if named else ''}."
    )


def _table(study: coverage.Study) -> str:
    median, sigma = ten_storeys.prior()
    before = median * np.sqrt(np.expm1(sigma**2) * np.exp(sigma**2))
    told = np.median([run.sd for run in study.runs], axis=0) / before
    rows = []
    for k, name in enumerate(coverage.NAMES):
        interval = _interval(int(study.covered[k]), study.replicates)
        rows.append([
            name,
            f"{study.covered[k]}",
            f"{100 * study.covered[k] / study.replicates:.1f} %",
            "{:.1f} – {:.1f} %".format(*(100 * interval)),
            f"{100 * study.expected[k]:.1f} %",
            significant(study.coverage_p_values[k], 2),
            significant(study.rank_p_values[k], 2),
            f"{told[k]:.2f}",
            f"{study.spread_of_truths[k]:.2f}",
        ])  # fmt: skip
    rows.append(["log-likelihood", *["-"] * 5, significant(study.rank_p_values[-1], 2), "-", "-"])
    head = [
        "quantity", "truths held", "coverage", "its 95 % interval", "expected", "p of the coverage",
        "p of the ranks", "posterior sd / prior sd", "spread of truths",
    ]  # fmt: skip
    return markdown_table(head, rows).rstrip()


def _interval(count: int, n: int) -> NDArray[np.float64]:
    """Return the 95 % interval of Clopper and Pearson for a share of which `count` of `n` were seen."""
    ends = binomtest(count, n).proportion_ci(0.95)
    return np.array([ends.low, ends.high])


def figure(study: coverage.Study) -> Figure:
    """Draw the coverage of every parameter with its gate, and the ranks of all quantities with theirs."""
    drawn = new_figure(10.0, 4.2)
    left, right = drawn.subplots(1, 2, width_ratios=(1.25, 1.0))
    n = study.replicates
    lowest, highest = (100 * edge / n for edge in study.band)
    at = np.arange(len(coverage.NAMES))
    left.axhspan(lowest, highest, color=PALE, linewidth=0, label=f"gate, {study.level:.1e}")
    left.axhline(100 * study.expected.mean(), color=GREY, linewidth=0.8)
    held = study.covered / n
    reach = np.abs(np.array([_interval(int(count), n) for count in study.covered]).T - held)
    left.errorbar(
        at,
        100 * held,
        100 * reach,
        fmt="o",
        color=colour("hmc"),
        markersize=4,
        linewidth=1.0,
        label="95 % interval",
    )
    left.set_xticks(at, coverage.NAMES, rotation=45, ha="right", fontsize=FONT)
    left.set_ylabel(f"truths in the {100 * coverage.INTERVAL:g} % interval, %", fontsize=FONT)
    left.set_ylim(min(lowest - 3.0, 100 * float(np.min(held - reach[0])) - 1.0), 100.0)
    left.legend(fontsize=FONT - 1, frameon=False, loc="lower right")
    uniform = UniformRanks(n, coverage.RANKED)
    z = np.concatenate([[0.0], uniform.points, [1.0]])
    for level, shade, label in ((study.level, PALE, f"gate, {study.level:.1e}"), (0.05, tint(GREY, 0.7), "95 %")):
        edges = (np.concatenate([[0], edge, [n]]) / n - z for edge in uniform.simultaneous_band(level))
        right.fill_between(z, *edges, color=shade, linewidth=0, label=label)
    for k, ranks in enumerate(study.ranks.T):
        ecdf = np.concatenate([[0], uniform.counts(ranks), [n]]) / n
        label = {0: "stiffnesses", 10: "sizes of errors", 12: "log-likelihood"}.get(k)
        style = {10: "--", 11: "--", 12: ":"}.get(k, "-")
        right.plot(z, ecdf - z, style, color=colour("hmc"), linewidth=1.0 if k < 10 else 1.8, label=label)
    right.axhline(0.0, color=GREY, linewidth=0.6)
    right.set_xlim(0.0, 1.0)
    right.set_xlabel(f"rank of the truth among {coverage.RANKED} draws, as a fraction", fontsize=FONT)
    right.set_ylabel("ECDF of the ranks − uniform", fontsize=FONT)
    right.legend(fontsize=FONT - 1, frameon=False, ncols=2, loc="lower center")
    for panel in (left, right):
        panel.tick_params(labelsize=FONT)
    return drawn


PAGE = """# Do intervals hold the truth?

Written by {command} in {minutes:.0f} minutes of processor time.

{verdict}

{replicates} synthetic measurements of the case `shear-10dof`: five frequencies, and shapes at four of ten floors.
Ten storey stiffnesses, the standard deviation of the frequencies' errors and that of the shapes' are drawn from
their priors, then the measurement given these; HMC, as a user gets it ({chains} chains from the prior, {warmup}
steps of warm-up), samples the posterior of all twelve. How large the errors are is not told to it.

- **Coverage.** An equal-tailed {interval:g} % interval of the posterior must hold the truth in {interval:g} % of
  the runs, less what is lost because its ends are quantiles of a few hundred effective draws: {lost} here, by the
  effective sample sizes at the ends ("expected"). p is the two-sided probability of a count as far out.
- **Ranks.** The rank of the truth among {ranked} thinned draws must be uniform (Talts et al. 2018), of every
  parameter and of the log-likelihood: p is the probability that the ranks of a correct sampler stray as far.

The {gates} p-values are {gates} gates. Among so many a small one is to be expected: p = 0.003 by itself turns up
in one of {gates} with a probability of {chance:.0f} %. So each gate is set at {level:.1e}, and a correct sampler
fails anywhere with a probability of at most {alarm:g} % (Bonferroni). For a coverage that is {lowest} to
{highest} of {replicates} truths, {low:.1f} to {high:.1f} %: what is further off is found, and what is nearer
cannot be told from chance by {replicates} replicates.

![Coverage and ranks](coverage/coverage.png)

{table}

The ratio of standard deviations is what a measurement tells, as a median over the runs: 1 is nothing. The spread
of the truths is the root mean square of their normal scores under the prior, 1 ± {scatter:.2f}: where a
measurement tells little, truths that happen to lie far apart are held less often.

A run has {draws:.0f} draws on average, all chains together; the smallest effective sample size of all
quantities is {least:.0f} at the least and {median:.0f} in the median. Runs that have less than {gate} are
drawn on.

Truths and posterior are exchangeable but for little. Errors of frequencies are relative to what was measured:
the density of f/(1 + ε) is the likelihood times f/f_measured, for every mode. That shifts the posterior mean of
a parameter by its covariance with Σ ln f: by at most the standard deviation of Σ ln f, about √5 times 1 % =
0.02, in standard deviations of the parameter, and so the coverage by less than 0.01 %. Shapes are scaled to unit
length, which changes their density by terms of the order of the squared standard deviation, 1e-3. Modes are
paired by number, which is right for every shear building; in the case itself they are paired by measured shapes.
"""
