"""The evidences that runs and maxima give: what they rest on, and whether they are reliable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.evidence.estimate import GROUP, evidence
from fmu.analysis.maxima.text import NEGLIGIBLE, RELIABLE
from fmu.numbers import significant, with_sd

if TYPE_CHECKING:
    import xarray as xr

    from fmu.analysis.convergence.diagnosis import Diagnosis
    from fmu.analysis.maxima.results import Maxima

_APART = 4.0
PSEUDO = "the modal residual is a pseudo-likelihood and has no evidence"
WHAT = (
    "The evidence is the probability density of the data under the model and its prior. Of several models "
    "with the same measured data and errors of the same kind, the one with the largest evidence is the most "
    "probable."
)


@dataclass(frozen=True)
class FoundEvidence:
    """A log-evidence with where it comes from.

    Attributes
    ----------
    log_evidence, error : float
        Natural logarithm, and its standard error; NaN where it is not known.
    basis : str
        What it rests on.
    doubts : tuple of str
        Why it is not reliable, half a sentence each; empty if it is.
    """

    log_evidence: float
    error: float
    basis: str
    doubts: tuple[str, ...]

    @property
    def value(self) -> str:
        """The log-evidence with its error."""
        return with_sd(self.log_evidence, self.error)

    @property
    def is_reliable(self) -> str:
        """Whether it is, in a word, and if not, why."""
        return f"not reliable: {'; '.join(self.doubts)}" if self.doubts else "reliable"

    def __str__(self) -> str:
        return f"log-evidence {self.value}, from {self.basis}: {self.is_reliable}"


def found_evidences(
    traces: Mapping[str, xr.DataTree], verdicts: Mapping[str, Diagnosis], maxima: Maxima | None
) -> list[FoundEvidence]:
    """Return the evidences that runs of parallel tempering and the masses of the maxima give.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        Of one problem.
    verdicts : mapping of str to Diagnosis
        On each of them.
    maxima : Maxima or None

    Returns
    -------
    list of FoundEvidence
        Empty for a pseudo-likelihood, and where there is neither a run of parallel tempering nor a maximum.
    """
    if any(is_pseudo(trace) for trace in traces.values()):
        return []
    found = [
        _of_tempering(name, trace, verdicts[name]) for name, trace in traces.items() if GROUP in trace.children
    ]
    if maxima is not None:
        reached = max(float(trace["sample_stats"]["lp"].max()) for trace in traces.values())
        found.append(_of_maxima(maxima, reached))
    return _compared(found)


def is_pseudo(trace: xr.DataTree) -> bool:
    """Say whether a trace is of the modal residual, whose pseudo-likelihood is no density of the data."""
    return "log_likelihood" in trace.children and "residual" in trace["log_likelihood"]


def _of_tempering(name: str, trace: xr.DataTree, verdict: Diagnosis) -> FoundEvidence:
    found = evidence(trace)
    doubts = list(found.warnings)
    if not verdict.converged:
        doubts.append("the run has not converged")
    basis = f"parallel tempering over {len(found.table)} rungs" + ("" if name == "tempering" else f" ({name})")
    return FoundEvidence(found.log_evidence, found.error, basis, tuple(doubts))


def _of_maxima(maxima: Maxima, reached: float) -> FoundEvidence:
    """Return the sum of the masses of the maxima, and what speaks against it."""
    matter = [m for m in maxima if m.share > NEGLIGIBLE]
    fewest = min(m.effective_draws for m in matter)
    count = "one maximum" if len(maxima) == 1 else f"{len(maxima)} maxima"
    doubts = []
    if fewest == 0.0:
        basis = f"the Laplace approximation at {count}"
        doubts.append("the posterior may not be Gaussian around them, and no draws have checked it")
    else:
        basis = f"importance sampling around {count}, worth {significant(_worth(maxima))} independent draws"
        if fewest < RELIABLE:
            doubts.append(
                f"around one of them it is worth {significant(fewest, 2)} draws; {significant(RELIABLE)} are "
                f"needed"
            )
    if reached > max(m.log_prob for m in maxima) + 1e-3:
        doubts.append("a draw lies above all maxima, so one was missed")
    return FoundEvidence(maxima.log_evidence, maxima.log_evidence_error, basis, tuple(doubts))


def _worth(maxima: Maxima) -> float:
    """Return how many independent draws the sum of the masses is worth."""
    return 1.0 / maxima.log_evidence_error**2


def _compared(found: list[FoundEvidence]) -> list[FoundEvidence]:
    """Return the evidences, each with the doubt that another, reliable one casts on it."""
    reliable = [one for one in found if not one.doubts]
    compared = []
    for one in found:
        doubts = [
            f"it disagrees with {other.value} from {other.basis}"
            for other in reliable
            if other is not one
            and not abs(one.log_evidence - other.log_evidence) <= _APART * np.hypot(one.error, other.error)
        ]
        compared.append(FoundEvidence(one.log_evidence, one.error, one.basis, (*one.doubts, *doubts)))
    return compared
