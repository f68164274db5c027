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
            level=significant(study.level, 2),
            low=100 * lowest / study.replicates,
            high=100 * highest / study.replicates,
            chance=100 * (1.0 - 0.997 ** len(study.p_values)),
            table=_table(study),
        ),
        encoding="utf-8",
    )


def verdict(study: coverage.Study) -> str:
    """Return whether the gates pass, the probability of the smallest p-value among as many, and small p-values."""
    what, p, among = study.smallest
    count = len(study.p_values)
    small = {name: value for name, value in study.p_values.items() if value < coverage.DOUBTFUL}
    said = "**Yes: all gates pass.**"
    if study.failures:
        said = "**Some gates fail:**\n\n" + "\n".join(f"- {failure}" for failure in study.failures)
    elif study.replicates < coverage.REPLICATES:
        few = f"{study.replicates} of {coverage.REPLICATES} replicates"
        said = f"**No gate fails, but {few} are too few to decide.**"
    elif among < coverage.DOUBTFUL:
        said = f"**No gate fails, but {what} is doubtful; more replicates would decide.**"
    said += "\n\n" if study.failures else " "
    said += (
        f"The smallest of the {count} p-values is {p:.2g} ({what}). With a correct sampler, the smallest of "
        f"{count} independent p-values is at most this large with a probability of {100 * among:.2g} %."
    )
    named = ", ".join(f"{name} ({value:.2g})" for name, value in small.items())
    expected = coverage.DOUBTFUL * count
    return (
        f"{said} {len(small)} of the p-values are below {coverage.DOUBTFUL:g}{f': {named}' if named else ''}; "
        f"{expected:.2g} are expected."
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
        "quantity", "true values covered", "coverage", "95 % interval of the coverage", "expected coverage",
        "p of the coverage", "p of the ranks", "posterior sd / prior sd", "spread of true values",
    ]  # fmt: skip
    return markdown_table(head, rows).rstrip()


def _interval(count: int, n: int) -> NDArray[np.float64]:
    """Return the 95 % interval of a proportion by Clopper and Pearson, from `count` of `n`."""
    ends = binomtest(count, n).proportion_ci(0.95)
    return np.array([ends.low, ends.high])


def figure(study: coverage.Study) -> Figure:
    """Draw the coverage of every parameter and the ranks of all quantities, with their gates."""
    drawn = new_figure(10.0, 4.2)
    left, right = drawn.subplots(1, 2, width_ratios=(1.25, 1.0))
    n = study.replicates
    lowest, highest = (100 * edge / n for edge in study.band)
    at = np.arange(len(coverage.NAMES))
    left.axhspan(lowest, highest, color=PALE, linewidth=0, label=f"gate, p = {significant(study.level, 2)}")
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
    left.set_ylabel(f"coverage of the {100 * coverage.INTERVAL:g} % interval, %", fontsize=FONT)
    left.set_ylim(min(lowest - 3.0, 100 * float(np.min(held - reach[0])) - 1.0), 100.0)
    left.legend(fontsize=FONT - 1, frameon=False, loc="lower right")
    uniform = UniformRanks(n, coverage.RANKED)
    z = np.concatenate([[0.0], uniform.points, [1.0]])
    for level, shade, label in (
        (study.level, PALE, f"gate, p = {significant(study.level, 2)}"),
        (0.05, tint(GREY, 0.7), "95 % band"),
    ):
        edges = (np.concatenate([[0], edge, [n]]) / n - z for edge in uniform.simultaneous_band(level))
        right.fill_between(z, *edges, color=shade, linewidth=0, label=label)
    for k, ranks in enumerate(study.ranks.T):
        ecdf = np.concatenate([[0], uniform.counts(ranks), [n]]) / n
        label = {0: "stiffnesses", 10: "sd of errors", 12: "log-likelihood"}.get(k)
        style = {10: "--", 11: "--", 12: ":"}.get(k, "-")
        right.plot(z, ecdf - z, style, color=colour("hmc"), linewidth=1.0 if k < 10 else 1.8, label=label)
    right.axhline(0.0, color=GREY, linewidth=0.6)
    right.set_xlim(0.0, 1.0)
    right.set_xlabel(f"rank of the true value among {coverage.RANKED} draws, as a fraction", fontsize=FONT)
    right.set_ylabel("ECDF of the ranks − uniform CDF", fontsize=FONT)
    right.legend(fontsize=FONT - 1, frameon=False, ncols=2, loc="lower center")
    for panel in (left, right):
        panel.tick_params(labelsize=FONT)
    return drawn


PAGE = """# Coverage of credible intervals

Do {interval:g} % credible intervals contain the true value as often as they should, if the noise is inferred as
well? {verdict}

The study has {replicates} replicates of the case `shear-10dof` and took {minutes:.0f} minutes of processor time.
In each, ten storey stiffnesses and the standard deviations of frequency and shape errors are drawn from their
priors, and a measurement is simulated: five frequencies, and shapes at four of ten floors. HMC ({chains} chains
from the prior, {warmup} steps of warm-up) samples the posterior of all twelve parameters, the two standard
deviations included.

- **Coverage.** An equal-tailed {interval:g} % interval of the posterior should contain the true value in
  {interval:g} % of the runs. The expected coverage is {lost} lower, because the ends of the interval are
  quantiles of a few hundred effective draws. p is the two-sided probability of a count at least as far out.
- **Ranks.** The rank of the true value among {ranked} thinned draws should be uniform (Talts et al. 2018) for
  every parameter and for the log-likelihood. p is the probability that the ranks of a correct sampler deviate as
  far.

Each of the {gates} p-values is a gate at {level}, so that a correct sampler fails any of them with a
probability of at most {alarm:g} % (Bonferroni). For a coverage, the gate is {lowest} to {highest} of {replicates}
true values, {low:.1f} to {high:.1f} %. Smaller deviations cannot be told from chance with {replicates}
replicates: for example, at least one of {gates} p-values is below 0.003 with a probability of {chance:.0f} %.

![Coverage and ranks](coverage/coverage.png)

{table}

- **Posterior sd / prior sd** is a median over the runs. At 1, the measurement does not inform the parameter.
- **Spread of true values** is the root mean square of their normal scores under the prior, 1 ± {scatter:.2f}. If
  a measurement informs a parameter little and the true values happen to spread widely, the coverage is lower.
- **Effective sample size.** A run has {draws:.0f} draws of all chains on average. The smallest effective sample
  size of all quantities is at least {least:.0f}, with a median of {median:.0f}. Runs below {gate} were extended.

The true values and the posterior draws are exchangeable, except for two small effects. Errors of frequencies are
relative to the measured frequency: the density of f/(1 + ε) is the likelihood times f/f_measured for every mode.
This shifts the posterior mean of a parameter by its covariance with Σ ln f, which is at most the standard
deviation of Σ ln f (about √5 times 1 % = 0.02) in standard deviations of the parameter. The coverage changes by
less than 0.01 %. Shapes are scaled to unit length, which changes their density by terms of the order of the
squared standard deviation, 1e-3. Modes are paired by number, which is correct for every shear building; the case
itself pairs them by measured shapes.
"""
