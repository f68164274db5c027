"""The two verdicts that come first: has the sampler converged, and does the model fit."""

from __future__ import annotations

from fmu.analysis.model_fit import INTERVAL, fit_warnings
from fmu.report.document import Verdict
from fmu.report.run import Run

SOUND = (
    "Nothing speaks against it: the chains agree, there are enough effective draws of every parameter, and no "
    "place that is known to hold probability was left out."
)


def verdicts(run: Run) -> tuple[Verdict, Verdict]:
    """Return both verdicts on a run."""
    return convergence(run), model_fit(run)


def convergence(run: Run) -> Verdict:
    """Return the verdict on the sampler."""
    question = "Has the sampler converged?"
    if run.diagnosis.converged:
        return Verdict(question, "Converged", True, (SOUND,))
    return Verdict(question, "Not converged", False, run.diagnosis.reasons)


def model_fit(run: Run) -> Verdict:
    """Return the verdict on the model, which no convergence of a sampler tells."""
    question, per_cent = "Does the model fit the data?", f"{100 * INTERVAL:g} %"
    others = run.diagnosis.warnings
    provisional = () if run.diagnosis.converged else ("By draws that have not converged, and so provisional.",)
    if run.prediction is None or "noisy_sd" not in run.prediction:
        said = ("The run has no predictive distribution of measurements to hold against the data.", *others)
        return Verdict(question, "Cannot be said", None, said)
    missed, n = len(fit_warnings(run.trace)), len(run.prediction)
    if missed:
        answer = f"No: {missed} of {n} modes are not fitted" if missed > 1 else f"No: 1 of {n} modes is not fitted"
        return Verdict(question, answer, False, (*others, *provisional))
    within = f"Every measured frequency lies in the {per_cent} interval of its prediction, noise included."
    answer = "Yes, but see below" if others else "Yes"
    return Verdict(question, answer, True, (within, *others, *provisional))
