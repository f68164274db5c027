"""The runs of one sampler on one posterior, and whether they are right."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fmu.numbers import whole
from tests.benchmarks.peers.contenders import ENOUGH, FMU
from tests.benchmarks.peers.run import Run

FAR = 4.0
NEAR_ENOUGH = 0.05
"""Allowed difference of a log-evidence: nautilus reports no error, and the weights underestimate it."""
GOOD = 1.05
"""Largest R-hat of chains that agree."""


@dataclass(frozen=True)
class Row:
    """One sampler on a posterior: medians over its runs.

    Attributes
    ----------
    whose, label : str
    runs : tuple of Run
    """

    whose: str
    label: str
    runs: tuple[Run, ...]

    @property
    def ours(self) -> bool:
        """Whether it is a sampler of fmu."""
        return self.whose == FMU

    @property
    def name(self) -> str:
        """Name on the page."""
        return f"fmu {self.label}" if self.ours else self.label

    @property
    def ended(self) -> bool:
        """Whether all runs have finished, instead of reaching a limit."""
        return all(run.ended for run in self.runs)

    @property
    def rhat(self) -> float:
        """Largest R-hat of all runs; NaN of weighted draws."""
        return max(run.rhat for run in self.runs)

    def median(self, figure: Callable[[Run], float]) -> float:
        """Return the median of a figure over the runs."""
        return float(np.median([figure(run) for run in self.runs]))

    def ess(self) -> float:
        """Return the effective draws of a run."""
        return self.median(lambda run: run.ess)

    def spent(self, part: str) -> float:
        """Return the number of evaluations in a part of a run."""
        return self.median(lambda run: getattr(run, part).evaluations)

    def per(self, unit: str, whole_run: bool) -> float:
        """Return effective draws per evaluation or second: of the draws alone, or of a whole run to `ENOUGH`.

        Parameters
        ----------
        unit : {"evaluations", "cpu_s"}
        whole_run : bool
            Whether search and warm-up count too, with the draws in proportion. A nested sampler cannot stop
            earlier: its whole run counts, with at most `ENOUGH` effective draws.
        """

        def figure(run: Run) -> float:
            draws, before = getattr(run.draws, unit), getattr(run.search + run.warmup, unit)
            if not whole_run:
                return run.ess / draws
            return ENOUGH / (before + draws * ENOUGH / run.ess) if before else min(run.ess, ENOUGH) / draws

        return self.median(figure)

    def mean(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the posterior means over all runs and their standard errors, shape (ndim,)."""
        errors = np.array([run.mcse for run in self.runs])
        return np.mean([run.mean for run in self.runs], axis=0), np.sqrt(np.sum(errors**2, axis=0)) / len(errors)

    def evidence(self) -> tuple[float, float] | None:
        """Return the log-evidence over all runs and its standard error; None if it has none."""
        found = [run.evidence for run in self.runs if run.evidence is not None]
        if not found:
            return None
        value, error = np.array(found).T
        return float(value.mean()), float(np.sqrt(np.sum(error**2)) / len(error))


def reference(rows: Sequence[Row]) -> Row:
    """Return the peer whose means agree with most other peers, among those that finished and whose chains agree.

    Ties are decided by a log-evidence, and then by the effective draws. These alone would not do: emcee's snooker
    move has many effective draws, and wrong means where all others agree.
    """
    peers = [row for row in rows if not row.ours] or rows  # where no peer has run yet
    good = [row for row in peers if row.ended and not row.rhat > GOOD] or peers

    def support(row: Row) -> tuple[int, bool, float]:
        agreeing = sum(_distance(row, other) < FAR for other in good)
        return agreeing, row.evidence() is not None, sum(run.ess for run in row.runs)

    return max(good, key=support)


def deviation(row: Row, rows: Sequence[Row]) -> float:
    """Return the largest difference between the means of a row and of the reference, in standard errors."""
    return _distance(row, reference(rows))


def _distance(row: Row, other: Row) -> float:
    (mean, error), (others, of_others) = row.mean(), other.mean()
    return float(np.max(np.abs(mean - others) / np.sqrt(error**2 + of_others**2)))


def evidence_of_reference(rows: Sequence[Row]) -> tuple[float, float] | None:
    """Return the log-evidence of the peer with most effective draws, among those with right means."""
    having = [row for row in rows if row.evidence() is not None and deviation(row, rows) < FAR]
    peers = [row for row in having if not row.ours and row.ended]
    return max(peers, key=Row.ess).evidence() if peers else None


def doubts(row: Row, rows: list[Row]) -> list[str]:
    """Return why a row is not right."""
    found = []
    if not row.ended:
        calls = whole(row.median(lambda run: run.cost.evaluations))
        found.append("its verdict is not good" if row.ours else f"not finished after {calls} evaluations")
    if row.rhat > GOOD:
        found.append("its chains disagree")
    if row is not reference(rows) and deviation(row, rows) >= FAR:
        found.append("its means are wrong")
    evidence, known = row.evidence(), evidence_of_reference(rows)
    if evidence is not None and known is not None:
        allowed = max(NEAR_ENOUGH, FAR * float(np.hypot(known[1], evidence[1])))
        found += ["its log-evidence is wrong"] * (not abs(evidence[0] - known[0]) < allowed)
    return found
