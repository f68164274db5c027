"""The gates and the page of the study of populations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import binom

from fmu.numbers import significant
from fmu.tables import markdown_table
from fmu.types import IntArray
from tests.validation.bands import UniformRanks

if TYPE_CHECKING:
    from tests.validation.populations import SetOfTests

INTERVAL, RANKED = 0.9, 19
"""Probability of the intervals; number of posterior draws that a truth is ranked among."""
KINDS = ("medians", "standard deviations", "partial correlations", "frequencies of the next test")
CONVERGED = 0.95
FALSE_ALARM = 0.01
"""Probability that correct intervals and ranks fail any gate (Bonferroni)."""


@dataclass(frozen=True)
class Study:
    """All sets of tests, and the gates.

    Quantities of one set depend on each other. The gates therefore use one quantity of each kind per set: in set
    i, quantity number i modulo the number of quantities of that kind.
    """

    sets: Sequence[SetOfTests]

    def held(self, kind: str) -> tuple[int, int]:
        """Return how many intervals of the chosen quantities hold the truth, and the number of intervals."""
        chosen = [one.inside[kind][one.number % len(one.inside[kind])] for one in self.sets if one.inside[kind]]
        return sum(chosen), len(chosen)

    def share_of_all(self, kind: str) -> tuple[float, int]:
        """Return the share of all intervals of a kind that hold the truth, and their number."""
        every = [inside for one in self.sets for inside in one.inside[kind]]
        return float(np.mean(every)) if every else np.nan, len(every)

    def band(self, n: int) -> tuple[int, int]:
        """Return the smallest and the largest numbers of `n` correct intervals that pass."""
        tail = 0.5 * self.level
        return int(binom.ppf(tail, n, INTERVAL)), int(binom.isf(tail, n, INTERVAL))

    def ranks(self, kind: str) -> IntArray:
        """Return the ranks of the chosen quantities."""
        return np.array(
            [one.ranks[kind][one.number % len(one.ranks[kind])] for one in self.sets if one.ranks[kind]]
        )

    def p_of_ranks(self, kind: str) -> float:
        """Return the probability that uniform ranks stray as far as the ranks of a kind, exact for any number."""
        ranks = self.ranks(kind)
        return UniformRanks(len(ranks), RANKED).p_value(ranks)

    @property
    def level(self) -> float:
        """Probability that correct intervals or ranks fail one gate."""
        return FALSE_ALARM / (2 * len(KINDS))

    @property
    def failures(self) -> list[str]:
        """Gates that fail, one sentence each."""
        found = []
        for kind in KINDS:
            count, n = self.held(kind)
            low, high = self.band(n)
            if not low <= count <= high:
                found.append(f"{count} of {n} intervals of {kind} hold the truth; {low} to {high} are allowed.")
            if not (p := self.p_of_ranks(kind)) > self.level:
                found.append(f"The ranks of {kind} are not uniform: p = {p:.1g}.")
        converged = sum(one.converged for one in self.sets)
        if converged < CONVERGED * len(self.sets):
            found.append(f"{converged} of {len(self.sets)} runs converged; at least {CONVERGED:.0%} must.")
        return found


def page(study: Study, replicates: int, settings: str) -> str:
    """Return the page; `replicates` is the number of sets that `make validate` runs."""
    n = len(study.sets)
    failures = study.failures
    verdict = (
        "**All gates pass.**"
        if not failures
        else "**Gates that fail:**\n\n" + "\n".join(f"- {failure}" for failure in failures)
    )
    if n < replicates and not failures:
        verdict = f"**No gate fails, but {n} of the {replicates} sets of `make validate` decide nothing yet.**"
    seconds = np.array([one.processor_s for one in study.sets])
    return PAGE.format(
        verdict=verdict,
        n=n,
        settings=settings,
        interval=INTERVAL,
        ranked=RANKED,
        alarm=FALSE_ALARM,
        level=significant(study.level, 2),
        coverage=_coverage(study),
        pooled=_pooled(study),
        converged=sum(one.converged for one in study.sets),
        share=sum(one.converged for one in study.sets) / n,
        needed=CONVERGED,
        median=np.median(seconds),
        high=np.quantile(seconds, 0.9),
        most=seconds.max(),
        hours=seconds.sum() / 3600.0,
        solves=np.median([one.solves for one in study.sets]),
        sizes=_sizes(study),
        slowest=_slowest(study),
        failed=_failed(study),
    )


def _coverage(study: Study) -> str:
    rows = []
    for kind in KINDS:
        (count, n), p = study.held(kind), study.p_of_ranks(kind)
        low, high = study.band(n)
        rows.append([kind, f"{n}", f"{count}", f"{low} – {high}", f"{count / n:.1%}", significant(p, 2)])
    head = ["one quantity per set", "intervals", "hold the truth", "band", "share", "p of the ranks"]
    return markdown_table(head, rows, (0,))


def _pooled(study: Study) -> str:
    return "; ".join(
        f"{kind} {share:.1%} of {count}" for kind in KINDS for share, count in [study.share_of_all(kind)]
    )


def _sizes(study: Study) -> str:
    rows = []
    for low, high in ((5, 13), (14, 27), (28, 40)):
        for is_correlated in (False, True):
            of = [one for one in study.sets if low <= one.tests <= high and one.correlated == is_correlated]
            if of:
                seconds = [one.processor_s for one in of]
                rows.append([
                    f"{low} – {high}", "correlated" if is_correlated else "independent", f"{len(of)}",
                    f"{sum(one.converged for one in of)}", f"{np.median(seconds):.1f}", f"{max(seconds):.1f}",
                    f"{np.median([one.draws for one in of]):.0f}",
                ])  # fmt: skip
    head = ["tests", "populations", "sets", "converged", "median CPU, s", "largest, s", "median draws"]
    return markdown_table(head, rows, (0, 1))


def _slowest(study: Study) -> str:
    """Return which kinds of parameters had the smallest ESS, by the number of sets."""
    kinds = Counter(
        "medians" if name.endswith("median") else "standard deviations" if name.endswith("log sd")
        else "partial correlations" if " correlation" in name else "scores"
        for one in study.sets for name in one.ess
    )  # fmt: skip
    return ", ".join(f"{kind} in {count}" for kind, count in kinds.most_common())


def _failed(study: Study) -> str:
    rows = [
        [
            f"{one.number}", f"{one.storeys}", f"{one.tests}", "yes" if one.correlated else "no",
            "yes" if one.with_shapes else "no", f"{one.draws}",
            ", ".join(f"{name}: {ess:.0f}" for name, ess in one.ess.items()),
        ]
        for one in study.sets if not one.converged
    ]  # fmt: skip
    if not rows:
        return ""
    head = ["set", "storeys", "tests", "correlated", "shapes", "draws", "smallest ESS"]
    return "Runs that did not converge:\n\n" + markdown_table(head, rows, (3, 4, 6))


PAGE = """# Populations over several tests: coverage and convergence

Written by `python -m tests.validation.populations results`, whose first lines say what is simulated, in
{hours:.2f} hours of processor time.

{verdict}

{n} sets of tests are simulated and sampled by default runs ({settings}). Runs that did not converge are counted in
every figure.

## Coverage and ranks

{interval:.0%} intervals must hold the truth as often as the binomial distribution allows, and the ranks of the
truth among {ranked} thinned draws must be uniform: p is the exact probability that uniform ranks stray as far
(Säilynoja, Bürkner & Vehtari 2022). Quantities of one set depend on each other, so one of each kind is taken per
set. Each gate works at the level {level}; together they fail correct
intervals and ranks with a probability of at most {alarm:g}.

{coverage}
All quantities of all sets, which are not independent of each other: {pooled}.

## Convergence and time

{converged} of {n} runs converged ({share:.1%}; the gate is {needed:.0%}): every parameter passes the verdict of
`fmu.diagnose` and has the bulk and tail ESS asked for. A run takes {median:.1f} s of processor time in the median,
{high:.1f} s in the slowest tenth and {most:.1f} s at most; the median number of solves of all tests is
{solves:.0f}. The smallest ESS is that of {slowest} of the sets.

{sizes}
{failed}"""
