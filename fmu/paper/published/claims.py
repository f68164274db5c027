"""The paper's statements on its samplers, held against effective draws per model solve."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from fmu.numbers import fixed, significant, whole
from fmu.paper.experiment import PAIRED_BY
from fmu.paper.plan import PAPER_SAMPLERS
from fmu.report.plots import TITLES

if TYPE_CHECKING:
    from fmu.paper.findings import Findings

CLAIMS = {
    "cantilever-young": (
        ("HMC converges faster than MH", "hmc", "mh"),
        ("HMC converges faster than slice sampling", "hmc", "slice"),
        ("MH converges faster than slice sampling", "mh", "slice"),
    ),
    "cantilever-section": (
        ("HMC converges faster than MH", "hmc", "mh"),
        ("HMC converges faster than slice sampling", "hmc", "slice"),
        ("MH gives better results than slice sampling", "mh", "slice"),
    ),
}
"""Sections 5.1, 5.2 and 6: which sampler is said to beat which."""


CLOSE = 1.25
"""Efficiencies whose ratio is smaller are not told apart: an estimated ESS scatters by a tenth or so."""
SEPARATED = (
    "The posterior has separated modes and each run reports the ones it fell into: results that differ between "
    "samplers here say nothing about the samplers. "
)


@dataclass(frozen=True)
class Judgement:
    """A statement of the paper and what became of it.

    `outcome` is ``"agrees"``, ``"disagrees"``, ``"too close to call"`` or ``"cannot be judged"``.
    """

    statement: str
    outcome: str
    evidence: str


def judge(findings: Findings) -> list[Judgement]:
    """DirectoryLock the paper's statements on one experiment against its long runs.

    A sampler whose long run did not converge has no efficiency to speak of; where the other one of the pair did
    converge, that decides.
    """
    return [Judgement(statement, *_decide(findings, a, b)) for statement, a, b in CLAIMS[findings.case]]


def _decide(findings: Findings, better: str, worse: str) -> tuple[str, str]:
    rate = {s: findings.value(s, "ess_per_solve") for s in (better, worse)}
    done = {s: findings.is_converged(s) for s in (better, worse)}
    if not any(done.values()):
        return "cannot be judged", "neither long run is converged"
    if not all(done.values()):
        winner = better if done[better] else worse
        loser = worse if done[better] else better
        spent = whole(findings.value(loser, "n_solves"))
        words = f"{TITLES[winner]} converged, {TITLES[loser]} did not in {spent} solves"
        return ("agrees" if winner == better else "disagrees"), words
    words = f"{significant(rate[better], 2)} against {significant(rate[worse], 2)} effective draws per solve"
    if max(rate.values()) < CLOSE * min(rate.values()):
        return "too close to call", words
    return ("agrees" if rate[better] > rate[worse] else "disagrees"), words


def statement(findings: Findings) -> str:
    """Return a paragraph: which sampler is best here, by how much, and whether the converged ones agree."""
    heading = f"**Section {findings.published.section}, paired {PAIRED_BY[findings.pairing]}.** "
    samplers = list(findings.comparison.index)
    ranked = sorted(filter(findings.is_converged, samplers), key=lambda s: -findings.value(s, "ess_per_solve"))
    if not ranked:
        words = heading + "No sampler converged; nothing here says which one is better. "
        return words + (SEPARATED if len(findings.separate_maxima) > 1 else "")
    rates = ", ".join(f"{TITLES[s]} {significant(findings.value(s, 'ess_per_solve'), 2)}" for s in ranked)
    first = [
        s
        for s in ranked
        if findings.value(s, "ess_per_solve") * CLOSE > findings.value(ranked[0], "ess_per_solve")
    ]
    words = heading + f"Best: {', '.join(TITLES[s] for s in first)}{' (too close to call)' if first[1:] else ''}. "
    words += f"Converged, with their effective draws per solve: {rates}. "
    if len(ranked) < len(samplers):
        words += f"Not converged: {', '.join(TITLES[s] for s in samplers if s not in ranked)}. "
    if "hmc" in ranked:
        words += _at_the_papers_price(findings, [s for s in PAPER_SAMPLERS if s in ranked and s != "hmc"])
    in_sd, in_mcse, names = findings.agreement
    if len(names) > 1:
        words += (
            f"The converged samplers give one answer: their means differ by at most {fixed(in_sd, 2)} posterior "
            f"sd, {fixed(in_mcse, 1)} standard errors of the difference. "
        )
    return words


def _at_the_papers_price(findings: Findings, rivals: list[str]) -> str:
    """Say what HMC would be worth if every gradient cost what a central difference does."""
    rate = findings.central_difference_rate
    words = (
        f"With the paper's central differences, {2 * findings.ndim} solves a gradient, HMC would have "
        f"{significant(rate, 2)}"
    )
    if rivals:
        leads = all(rate > findings.value(s, "ess_per_solve") for s in rivals)
        words += ", still the most" if leads else ", no longer the most"
        words += " of the paper's samplers"
    return words + ". "
