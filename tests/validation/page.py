"""The verdict of the validation, and the page that shows it."""

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
    """What was found, by the title of the sampler, and whether it passes."""

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
        """What is wrong, a sentence each."""
        calibration = [
            f"{title}: the ranks of {quantity} are not uniform (p = {p:.1g})"
            for title, values in self.p_values.items()
            for quantity, p in zip(QUANTITIES, values, strict=True)
            if not p > self.level
        ]
        return calibration + [
            f"{title}: {ratio.kind} ESS of {ratio.target}, coordinate {ratio.coordinate}: ratio {ratio.value:.2f}"
            for title, found in self.ratios.items()
            for ratio in found
            if not self.within(ratio)
        ]

    def within(self, ratio: Ratio) -> bool:
        """Say whether a ratio is within its limits; NaN is not."""
        lowest, highest = limits(ratio.freedom, self.level)
        return lowest <= ratio.value <= highest


def write(study: Study, directory: Path, processor_s: float) -> None:
    """Write ``validation.md`` and ``validation/sbc.png`` into the directory."""
    from tests.validation.figure import plot_calibration

    (directory / "validation").mkdir(parents=True, exist_ok=True)
    plot_calibration(study.calibrations, study.level).savefig(directory / "validation" / "sbc.png", dpi=150)
    replicates = min(len(found.ranks) for found in study.calibrations.values())
    shift, factor = detectable(UniformRanks(replicates, DRAWS), study.level)
    verdict = "**All gates pass.**"
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
    """Return the table of ranks."""
    rows = []
    for title, found in study.calibrations.items():
        least, median = np.quantile(found.ess, [0.0, 0.5])
        cells = [f"{len(found.ranks)}", f"{median:.0f}", f"{least:.0f}", f"{np.mean(found.draws):.0f}"]
        rows.append([title, *cells, *(significant(p, 2) for p in study.p_values[title])])
    head = ["sampler", "replicates", "median ESS", "smallest ESS", "draws a run"]
    return markdown_table([*head, *(f"p, {quantity}" for quantity in QUANTITIES)], rows)


def ratio_table(study: Study) -> str:
    """Return the table of errors over their prediction."""
    rows = []
    for title, found in study.ratios.items():
        for target, kind in dict.fromkeys((ratio.target, ratio.kind) for ratio in found):
            of_kind = [ratio for ratio in found if (ratio.target, ratio.kind) == (target, kind)]
            lowest, highest = limits(of_kind[0].freedom, study.level)
            rows.append([
                title, target, kind, f"{of_kind[0].runs}", ", ".join(f"{ratio.ess:.0f}" for ratio in of_kind),
                ", ".join(f"{ratio.value:.2f}" for ratio in of_kind), f"{lowest:.2f} – {highest:.2f}",
            ])  # fmt: skip
    head = ["sampler", "target", "ESS", "runs", "median ESS, by coordinate", "ratio, by coordinate", "gate"]
    return markdown_table(head, rows, words=(0, 1, 2))


PAGE = """# Validation of the samplers

Written by `make validate` in {minutes:.0f} minutes of processor time. {verdict}

There are {comparisons} gates. Together they fail a correct set of samplers with a probability of at most
{false_alarm:g} (Bonferroni): each works at the level {level:.1e}. All samplers run as a user gets them: what
they are not told, they learn in warm-up, anew in every calibration run.

## Simulation-based calibration

Truths from the truncated prior, data from the likelihood, a run of the sampler on each; the rank of the truth
among {draws} draws thinned by the effective sample size must be uniform (Talts et al. 2018), for every
parameter and for the log-likelihood (Modrák et al. 2023). The problem is a building of three storeys: the
stiffness of the first, that of the others and the mass of the top floor from two frequencies, a ridge that the
bounds cut off (`tests/validation/storeys.py`). This checks prior, likelihood, gradient, reflection at the
bounds, warm-up and sampler together.

![Simulation-based calibration](validation/sbc.png)

The bands are simultaneous over all ranks and exact (Säilynoja, Bürkner & Vehtari 2022): the dark one holds 95 %
of the panels of correct samplers, so that about one panel in twenty leaves it; the pale one is the gate. p is the
probability that the ranks of a correct sampler stray as far. With a probability of {power:.0f} % the gate finds a
posterior mean that is wrong by {shift:.2f} standard deviations, or draws that are too narrow by a factor of
{factor:.2f} (for a Gaussian posterior).

{calibration}
## Effective sample size

The squared error of the mean over many runs, divided by what the runs predict of it, var/ESS: 1 where the ESS
is right, above 1 where it promises too much. "mean" is the ESS behind the standard errors, against exact means;
"bulk" is that of the verdicts, on normal scores of the ranks, for which it is defined. The ratio times the
number of runs is χ²; the gates allow the estimators a bias of {bias:.0f} % on top.

{ratios}"""
