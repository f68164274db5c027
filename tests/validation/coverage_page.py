"""The page and the figure of the coverage study."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

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
    verdict = "**All gates pass.**"
    if study.failures:
        verdict = "**Gates that fail:**\n\n" + "\n".join(f"- {failure}" for failure in study.failures)
    ess = [run.ess for run in study.runs]
    lowest, highest = study.band
    (directory / "coverage.md").write_text(
        PAGE.format(
            verdict=verdict,
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
            band=100 * coverage.BAND,
            names=len(coverage.NAMES),
            alarm=100 * (1.0 - coverage.BAND ** len(coverage.NAMES)),
            ranked=coverage.RANKED,
            level=study.level,
            table=_table(study),
        ),
        encoding="utf-8",
    )


def _table(study: coverage.Study) -> str:
    median, sigma = ten_storeys.prior()
    before = median * np.sqrt(np.expm1(sigma**2) * np.exp(sigma**2))
    told = np.median([run.sd for run in study.runs], axis=0) / before
    rows = [
        [
            name,
            f"{count}",
            f"{100 * count / study.replicates:.1f} %",
            significant(p, 2),
            f"{left:.2f}",
            f"{spread:.2f}",
        ]
        for name, count, p, left, spread in zip(
            coverage.NAMES, study.covered, study.p_values[:-1], told, study.spread_of_truths, strict=True
        )
    ]
    rows.append(["log-likelihood", "-", "-", significant(study.p_values[-1], 2), "-", "-"])
    head = ["quantity", "truths held", "coverage", "p of the ranks", "posterior sd / prior sd", "spread of truths"]
    return markdown_table(head, rows).rstrip()


def figure(study: coverage.Study) -> Figure:
    """Draw the coverage of every parameter with its gate, and the ranks of all quantities with theirs."""
    drawn = new_figure(10.0, 4.2)
    left, right = drawn.subplots(1, 2, width_ratios=(1.25, 1.0))
    n = study.replicates
    lowest, highest = (100 * edge / n for edge in study.band)
    at = np.arange(len(coverage.NAMES))
    left.axhspan(lowest, highest, color=PALE, linewidth=0, label=f"gate, {100 * coverage.BAND:g} %")
    left.axhline(100 * coverage.INTERVAL, color=GREY, linewidth=0.8)
    left.plot(at, 100 * study.covered / n, "o", color=colour("hmc"), markersize=5)
    left.set_xticks(at, coverage.NAMES, rotation=45, ha="right", fontsize=FONT)
    left.set_ylabel(f"truths in the {100 * coverage.INTERVAL:g} % interval, %", fontsize=FONT)
    left.set_ylim(lowest - 3.0, 100.0)
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

Written by `make validate` in {minutes:.0f} minutes of processor time. {verdict}

{replicates} synthetic measurements of the case `shear-10dof`: five frequencies, and shapes at four of ten floors.
Ten storey stiffnesses, the standard deviation of the frequencies' errors and that of the shapes' are drawn from
their priors, then the measurement given these; HMC, as a user gets it ({chains} chains from the prior, {warmup}
steps of warm-up), samples the posterior of all twelve. How large the errors are is not told to it.

- **Coverage.** An equal-tailed {interval:g} % interval of the posterior must hold the truth in {interval:g} % of
  the runs. The gate is the {band:g} % band of the binomial distribution, {lowest} to {highest} of {replicates}: a
  correct sampler leaves it at one of the {names} parameters with a probability of up to {alarm:.1f} %.
- **Ranks.** The rank of the truth among {ranked} thinned draws must be uniform (Talts et al. 2018), of every
  parameter and of the log-likelihood: p is the probability that the ranks of a correct sampler stray as far, and
  must be above {level:.1e}.

![Coverage and ranks](coverage/coverage.png)

{table}

The ratio of standard deviations is what a measurement tells, as a median over the runs: 1 is nothing. The spread
of the truths is the root mean square of their normal scores under the prior, 1 ± {scatter:.2f}: where a
measurement tells little, truths that happen to lie far apart are held less often.

A run has {draws:.0f} draws on average, all chains together; the smallest effective sample size of all
quantities is {least:.0f} at the least and {median:.0f} in the median. Runs that have less than {gate} are
drawn on.

The likelihood is a density of the measurement up to terms of the order of the squared standard deviations (about
1e-3): shapes are scaled to unit length, and errors of frequencies are relative to what was measured. Modes are
paired by number, which is right for every shear building; in the case itself they are paired by measured shapes.
"""
