"""The verdicts that come first: has the sampler converged, does the model fit, were the parameters updated."""

from __future__ import annotations

import numpy as np

from fmu.analysis.data.information import DATA, information, information_warnings
from fmu.analysis.data.model_fit import INTERVAL, fit_warnings, measured_mac, shape_warnings
from fmu.analysis.data.prediction import measured_tests, measurement_in_words
from fmu.analysis.trace.modal_states import MEAN
from fmu.numbers import fixed, share
from fmu.report.document import Verdict
from fmu.report.run import ReportedRun

SOUND = "The chains agree, and every parameter has enough effective draws."
COVERED = "All maxima found that hold at least 1 % of the probability were visited."


def verdicts(run: ReportedRun) -> tuple[Verdict, Verdict, Verdict]:
    """Return the verdicts on a run."""
    return convergence(run), model_fit(run), updated(run)


def convergence(run: ReportedRun) -> Verdict:
    """Return the verdict on the sampler."""
    question = "Has the sampler converged?"
    if run.diagnosis.converged:
        beside = run.diagnosis.remarks or (COVERED,)
        return Verdict(question, "Converged", True, "Why the run counts as converged", (SOUND, *beside))
    return Verdict(question, "Not converged", False, "Why the run has not converged", run.diagnosis.remarks)


def model_fit(run: ReportedRun) -> Verdict:
    """Return the verdict on the model, which no convergence of a sampler tells."""
    question = "Does the model fit the data?"
    untold = information_warnings(run.trace)  # which `updated` is about
    found = warnings = tuple(warning for warning in run.diagnosis.warnings if warning not in untold)
    if not run.diagnosis.converged:
        found = (*found, "These statements are provisional, because the draws have not converged.")
    if run.prediction is None or "noisy_sd" not in run.prediction:
        nothing = "The run has no predictive distribution of measurements to compare with the data."
        return Verdict(question, "Unknown", None, "Why this is unknown", (nothing, *found))
    missed, n = len(fit_warnings(run.trace)), len(run.prediction)
    if missed:
        answer = f"No: {missed} of {n} measured modes {'is' if missed == 1 else 'are'} not fitted"
        return Verdict(question, answer, False, "Findings against the model", found)
    tests = measured_tests(run.trace)
    kind = "" if tests is None else f", {measurement_in_words(tests)},"
    within = (
        f"Every measured frequency{kind} lies in the {share(INTERVAL)} interval of its prediction, measurement "
        "noise included."
    )
    answer = "Yes, with reservations" if warnings else "Yes"
    return Verdict(question, answer, True, "Findings for and against the model", (within, *_shapes(run), *found))


def updated(run: ReportedRun) -> Verdict:
    """Return the verdict on the data: whether they updated every parameter."""
    question = "Did the data update the parameters?"
    found = information(run.trace)
    if found is None:
        nothing = "The trace has no draws from the prior to compare the posterior with."
        return Verdict(question, "Unknown", None, "Why this is unknown", (nothing,))
    n, left = len(found.names), sum(basis != DATA for basis in found.basis)
    if not found.uninformed:
        narrowed = "In every direction of the parameter space the posterior is narrower than the prior."
        return Verdict(question, "Yes", True, "Why the parameters count as updated", (narrowed,))
    answer = f"{n - left} of {n}" if left else "All, but not every combination"
    return Verdict(question, answer, False, "What the data did not update", tuple(found.warnings()))


def _shapes(run: ReportedRun) -> tuple[str, ...]:
    """Say that the shapes fit too, where they were measured and do."""
    alike = measured_mac(run.trace)
    if alike is None or shape_warnings(run.trace):
        return ()
    least = float(np.diag(alike.sel(state=MEAN)).min())
    return (f"Every mode matches its measured shape: MAC at least {fixed(least, 2)}.",)
