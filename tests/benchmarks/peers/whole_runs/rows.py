"""The whole runs of one contender on one posterior, and whether they are right."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fmu.numbers import whole
from tests.benchmarks.peers.whole_runs.runs import FMU, WholeRun

FAR = 4.0
NEAR_ENOUGH = 0.05
"""Of a log-evidence: nautilus gives no error, and that of its weights alone is too small."""
KNOWN = {
    "cantilever-young, pairing by shape": (-28.325, 0.005),
    "cantilever-section, pairing by number": (-117.165, 0.006),
}
"""Log-evidences with their errors: by nautilus with 46 000 effective draws, and of results/evidence.md."""


@dataclass(frozen=True)
class WholeRow:
    """One contender on one posterior: medians over its runs.

    Attributes
    ----------
    posterior, whose, label : str
    runs : list of WholeRun
    """

    posterior: str
    whose: str
    label: str
    runs: list[WholeRun]

    @classmethod
    def read(cls, row: dict[str, Any]) -> WholeRow:
        """Return the row that `measured` returned."""
        return cls(**{**row, "runs": [WholeRun.read(run) for run in row["runs"]]})

    @property
    def ours(self) -> bool:
        """Whether it is one of fmu's samplers."""
        return self.whose == FMU

    @property
    def name(self) -> str:
        """Name for readers."""
        return f"fmu {self.label}" if self.ours else self.label

    @property
    def ended(self) -> bool:
        """Whether all runs have ended by themselves."""
        return all(run.ended for run in self.runs)

    def ess(self) -> float:
        """Return the effective draws of a run."""
        return float(np.median([run.ess for run in self.runs]))

    def spent(self, part: str) -> float:
        """Return the evaluations of a part of a run, or of all of it: ``"cost"``."""
        return float(np.median([getattr(run, part).evaluations for run in self.runs]))

    def after_warmup(self) -> float:
        """Return ESS per evaluation of the draws."""
        return float(np.median([run.ess / run.draws.evaluations for run in self.runs]))

    def per_evaluation(self) -> float:
        """Return ESS per evaluation, everything counted."""
        return float(np.median([run.ess / run.cost.evaluations for run in self.runs]))

    def per_second(self) -> float:
        """Return ESS per processor second, everything counted."""
        return float(np.median([run.ess / run.cost.cpu_s for run in self.runs]))

    def needed(self, ess: float) -> float:
        """Return the evaluations of a run to so many effective draws, in proportion to those of the draws."""
        return self.spent("search") + self.spent("warmup") + ess / self.after_warmup()

    def mean(self) -> tuple[Any, Any]:
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


def reference(rows: list[WholeRow]) -> WholeRow:
    """Return the peer with most effective draws of those that have ended by themselves, or of all."""
    peers = [row for row in rows if not row.ours]
    return max([row for row in peers if row.ended] or peers, key=WholeRow.ess)


def deviation(row: WholeRow, rows: list[WholeRow]) -> float:
    """Return how far a row's means are from those of the reference, in standard errors, at most."""
    (other, error), (mean, own) = reference(rows).mean(), row.mean()
    return float(np.max(np.abs(mean - other) / np.sqrt(own**2 + error**2)))


def evidence_of_reference(rows: list[WholeRow]) -> tuple[float, float]:
    """Return the log-evidence that is known, or the reference's, and its error."""
    found = reference(rows).evidence()
    assert found is not None  # every peer of these has one
    return KNOWN.get(rows[0].posterior, found)


def doubts(row: WholeRow, rows: list[WholeRow]) -> list[str]:
    """Return why a row is not right."""
    found = []
    if not row.ended:
        found.append(
            "its verdict is not good" if row.ours else f"not at an end after {whole(row.spent('cost'))} calls"
        )
    if row is not reference(rows) and not deviation(row, rows) < FAR:
        found.append("its means are off")
    evidence = row.evidence()
    if evidence is not None:
        value, error = evidence_of_reference(rows)
        if not abs(evidence[0] - value) < max(NEAR_ENOUGH, FAR * float(np.hypot(error, evidence[1]))):
            found.append("its log-evidence is off")
    return found


def by_posterior(rows: list[WholeRow]) -> dict[str, list[WholeRow]]:
    """Return the rows of each posterior, most ESS per evaluation first."""
    names = dict.fromkeys(row.posterior for row in rows)
    ordered = sorted(rows, key=WholeRow.per_evaluation, reverse=True)
    return {name: [row for row in ordered if row.posterior == name] for name in names}
