"""The verdict of the validation and its page, ``validation.md``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from fmu.numbers import significant
from fmu.tables import markdown_table
from tests.validation.bands import UniformRanks
from tests.validation.calibration import DRAWS, QUANTITIES, Calibration
from tests.validation.effective_size import BIAS, Ratio, limits
from tests.validation.power import POWER, detectable

FALSE_ALARM = 1e-3
"""The probability that a correct set of samplers fails anywhere."""


@dataclass(frozen=True)
class Study:
    """Results by title of the sampler, and whether they pass the gates."""

    calibrations: Mapping[str, Calibration]
    ratios: Mapping[str, Sequence[Ratio]]

    @property
    def comparisons(self) -> int:
        """Number of gates."""
        return len(self.calibrations) * len(QUANTITIES) + sum(len(found) for found in self.ratios.values())

    @property
    def level(self) -> float:
        """The probability that one gate raises a false alarm (Bonferroni)."""
        return FALSE_ALARM / self.comparisons

    @cached_property
    def p_values(self) -> dict[str, list[float]]:
        """P-value of the ranks of each quantity, by sampler."""
        return {
            title: [UniformRanks(len(found.ranks), DRAWS).p_value(ranks) for ranks in found.ranks.T]
            for title, found in self.calibrations.items()
        }

    @cached_property
    def failures(self) -> list[str]:
        """Gates that fail, one sentence each."""
        calibration = [
            f"{title}: the ranks of {quantity} are not uniform (p = {p:.1g})"
            for title, values in self.p_values.items()
            for quantity, p in zip(QUANTITIES, values, strict=True)
            if not p > self.level
        ]
        return calibration + [
            f"{title}: ESS ({ratio.kind}) on the target {ratio.target}, coordinate {ratio.coordinate + 1}: the "
            f"squared error is {ratio.value:.2f} times its prediction"
            for title, found in self.ratios.items()
            for ratio in found
            if not self.within(ratio)
        ]

    def within(self, ratio: Ratio) -> bool:
        """Return whether a ratio is within its limits; False for NaN."""
        lowest, highest = limits(ratio.freedom, self.level)
        return lowest <= ratio.value <= highest


def write(study: Study, directory: Path, processor_s: float) -> None:
    """Write ``validation.md`` and ``validation/sbc.png`` into the directory."""
    from tests.validation.figure import plot_calibration

    (directory / "validation").mkdir(parents=True, exist_ok=True)
    plot_calibration(study.calibrations, study.level).savefig(directory / "validation" / "sbc.png", dpi=150)
    replicates = min(len(found.ranks) for found in study.calibrations.values())
    shift, factor = detectable(UniformRanks(replicates, DRAWS), study.level)
    verdict = f"**All {study.comparisons} gates pass.**"
    if study.failures:
        verdict = "**Gates that fail:**\n\n" + "\n".join(f"- {failure}" for failure in study.failures)
    (directory / "validation.md").write_text(
        PAGE.format(
            verdict=verdict,
            comparisons=study.comparisons,
            false_alarm=FALSE_ALARM,
            level=study.level,
            minutes=processor_s / 60.0,
            draws=DRAWS,
            shift=shift,
            factor=factor,
            power=100 * POWER,
            calibration=calibration_table(study),
            bias=100 * BIAS,
            ratios=ratio_table(study),
        )
    )


def calibration_table(study: Study) -> str:
    """Return the table of the calibration."""
    rows = []
    for title, found in study.calibrations.items():
        least, median = np.quantile(found.ess, [0.0, 0.5])
        cells = [f"{len(found.ranks)}", f"{median:.0f}", f"{least:.0f}", f"{np.mean(found.draws):.0f}"]
        rows.append([title, *cells, *(significant(p, 2) for p in study.p_values[title])])
    head = ["sampler", "replicates", "median ESS", "smallest ESS", "draws per run"]
    return markdown_table([*head, *(f"p, {quantity}" for quantity in QUANTITIES)], rows)


def ratio_table(study: Study) -> str:
    """Return the table of actual errors over predicted errors."""
    rows = []
    for title, found in study.ratios.items():
        for target, kind in dict.fromkeys((ratio.target, ratio.kind) for ratio in found):
            of_kind = [ratio for ratio in found if (ratio.target, ratio.kind) == (target, kind)]
            lowest, highest = limits(of_kind[0].freedom, study.level)
            rows.append([
                title, target, kind, f"{of_kind[0].runs}", ", ".join(f"{ratio.ess:.0f}" for ratio in of_kind),
                ", ".join(f"{ratio.value:.2f}" for ratio in of_kind), f"{lowest:.2f} – {highest:.2f}",
            ])  # fmt: skip
    head = ["sampler", "target", "kind", "runs", "median ESS, by coordinate", "ratio, by coordinate", "gate"]
    return markdown_table(head, rows, words=(0, 1, 2))


PAGE = """# Validation of the samplers

Do the samplers draw from the correct posterior, and are their effective sample sizes (ESS) accurate?

{verdict}

The first question is answered by simulation-based calibration, the second by the actual errors of many runs. Each
of the {comparisons} gates has a significance level of {level:.1e}, so that together they reject a correct set of
samplers with a probability of at most {false_alarm:g} (Bonferroni). The samplers tune their scales and step sizes
in warm-up, separately in every calibration run. The study took {minutes:.0f} minutes of processor time.

## Simulation-based calibration

In each replicate, true parameters are drawn from the truncated prior, data are simulated from the likelihood, and
the sampler runs on these data until its ESS is at least {draws}. Its draws are thinned to {draws}. If everything
is correct, the rank of the true value among these draws is uniform (Talts et al. 2018), for every parameter and
for the log-likelihood (Modrák et al. 2023). The problem is a building of three storeys with two measured
frequencies (`tests/validation/storeys.py`). The stiffness of the first storey (k1), the stiffness of the other
storeys (k2) and the mass of the top floor (m3) are unknown. The posterior is a ridge truncated by the bounds. The
test covers prior, likelihood, gradient, reflection at the bounds, warm-up and sampler together.

![Simulation-based calibration](validation/sbc.png)

The figure shows the empirical distribution function of the ranks minus the uniform one. The bands are simultaneous
over all ranks and exact (Säilynoja, Bürkner & Vehtari 2022). With a probability of 95 % the curve of a correct
sampler stays within the dark band, so about one panel in twenty leaves it. The pale band is the gate. With a
probability of {power:.0f} % the gate detects a posterior mean that is wrong by {shift:.2f} standard deviations, or
draws that are too narrow by a factor of {factor:.2f} (for a Gaussian posterior).

In the table, p is the probability that the ranks of a correct sampler deviate at least as far from uniformity. The
ESS of a replicate is the smallest of its four quantities.

{calibration}
## Effective sample size

The squared error of a posterior mean, averaged over many runs, is divided by its prediction, var/ESS. The ratio is
1 if the ESS is correct, and above 1 if the ESS is too large. *mean* is the ESS behind the Monte-Carlo standard
errors; the error is taken against the exact mean. *bulk* is the bulk ESS behind the convergence verdicts, which is
defined for the normal scores of the ranks. For a correct ESS, the ratio times its degrees of freedom follows a χ²
distribution; the gates allow for a further bias of {bias:.0f} % in the estimate of the ESS. The target *truncated*
is a correlated Gaussian cut off by bounds; *gumbel* is correlated and skewed, without bounds.

{ratios}"""
