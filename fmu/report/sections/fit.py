"""The verdict on the model's fit to the data, and the section on the checks behind it."""

from __future__ import annotations

import numpy as np

from fmu.analysis.fit.check import failed_checks, level_of, p_value, probability
from fmu.analysis.fit.measured_shapes import paired_mac, shape_warnings
from fmu.analysis.fit.model_fit import ALLOWED, CONTRADICTED, NOT_CONTRADICTED, NOT_TESTABLE, UNKNOWN, ModelFit
from fmu.analysis.held_out.modes import left_out_warnings
from fmu.analysis.information import information_warnings
from fmu.numbers import MISSING, fixed, share
from fmu.report.document import Omitted, PageSection, PageTable, Text, Verdict
from fmu.report.run import ReportedRun

_IS_GOOD = {CONTRADICTED: False, NOT_CONTRADICTED: True, NOT_TESTABLE: None, UNKNOWN: None, ALLOWED: None}
_BECAUSE = {
    CONTRADICTED: "What contradicts the model",
    NOT_CONTRADICTED: "What could have contradicted the model, and did not",
    NOT_TESTABLE: "Why the data do not test the model",
    UNKNOWN: "Why this is unknown",
    ALLOWED: "By how much the model is wrong, and what could have contradicted it",
}


def model_fit(run: ReportedRun) -> Verdict:
    """Return the verdict on the model's fit. A converged run does not imply a good fit."""
    fit = run.diagnosis.fit
    # warnings that appear elsewhere: in `judge_data`, as failed checks, or as checks that were not done
    elsewhere = {*information_warnings(run.trace), *fit.against, *left_out_warnings(run.trace)}
    found = tuple(warning for warning in run.diagnosis.warnings if warning not in elsewhere)
    answer = fit.answer[0].upper() + fit.answer[1:]
    if fit.verdict in (NOT_CONTRADICTED, ALLOWED) and found:
        answer += ", with reservations"
    if not run.diagnosis.converged:
        found = (*found, "These statements are provisional, because the draws have not converged.")
    question, because = "Does the model fit the data?", _BECAUSE[fit.verdict]
    notes = (*fit.notes, *_shapes(run), *found)
    return Verdict(question, answer, _IS_GOOD[fit.verdict], because, fit.reasons, _strongest_evidence(fit), notes)


def _strongest_evidence(fit: ModelFit) -> str:
    """Return a sentence on the strongest evidence against the model or, if no check failed, on the passed checks.

    Return an empty string if no check failed and the fit is unknown or cannot be tested.
    """
    against = failed_checks(fit.checks)
    if against:
        p = f" ({probability(against[0].p, 2)})" if np.isfinite(against[0].p) else ""
        return f"Strongest evidence: {against[0].of}{p}."
    if fit.verdict not in (NOT_CONTRADICTED, ALLOWED):
        return ""
    n = len(fit.able)
    return f"{n} check{'' if n == 1 else 's'} could have contradicted it and did not."


def _shapes(run: ReportedRun) -> tuple[str, ...]:
    """Return a one-element tuple with a sentence if every mode matches its measured shape, otherwise ()."""
    alike = paired_mac(run.trace)
    if not alike or shape_warnings(run.trace):
        return ()
    least = min(after for *_, after in alike)
    return (f"Every mode matches its measured shape: MAC at least {fixed(least, 2)}.",)


def checks(run: ReportedRun) -> PageSection | Omitted:
    """Return the section on the model checks: each check's result, and the errors that it could have detected.

    Return `Omitted` if there are no checks.
    """
    title, fit = "Checks of the model", run.diagnosis.fit
    if not fit.checks:
        return Omitted(title, fit.reasons[0][0].lower() + fit.reasons[0][1:].removesuffix("."))
    rows = tuple(
        (check.of, check.kind, check.found, check.limit,
         p_value(check.p, 2) if np.isfinite(check.p) else MISSING,
         "fails" if check.failed else check.why_not or "passes", check.shows)
        for check in fit.checks
    )  # fmt: skip
    header = (
        "of", "check", "found", "fails beyond", "p", "result", "errors that would have been found",
    )  # fmt: skip
    caption = (
        "p is the probability of what was found, or of worse, if the model is right; such a model fails any of "
        f"the checks with a probability of at most {share(level_of(fit.checks))}."
    )
    silent = tuple(i for i, check in enumerate(fit.checks) if not check.could_fail)
    said = (
        "A model can only be contradicted. A check that passes would have found the errors in the last column, "
        "and no smaller ones; what is greyed could have found none, and counts as no check."
    )
    table = PageTable(caption, header, rows, words=(1, 2, 3, 5, 6), greyed=silent)
    return PageSection("checks", title, (Text(said), table))
