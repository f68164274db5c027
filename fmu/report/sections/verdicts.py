"""Verdicts on the first screen: losses, parameter changes, undetermined parameters, the fit, convergence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fmu.analysis.certificate import exact_in_words
from fmu.analysis.convergence.diagnostics import RHAT_LIMIT
from fmu.analysis.convergence.remedies import required_ess, without_scores
from fmu.analysis.fit.model_fit import CONTRADICTED
from fmu.analysis.information import DATA, information, not_informed, why_unknown
from fmu.analysis.prediction import at_bounds, pinned_parameters
from fmu.analysis.trace.reading import LOSSES, VALUE_KINDS, constant, has, is_loss, mode_names, roles_of
from fmu.numbers import change, decimals, fixed, given, interval, names_in_words, share, with_sd
from fmu.report.document import Verdict
from fmu.report.plots.frequencies import frequencies_before
from fmu.report.plots.parameters import error_parameters
from fmu.report.run import ReportedRun
from fmu.report.sections.fit import model_fit
from fmu.report.sections.tests import lost

SOUND = "The chains agree, and every parameter has enough effective draws."
COVERED = "All maxima found that hold at least 1 % of the probability were visited."
ASSUMED = "Assumes a model that the data reject."
_FEW = 3
"""Largest number of parameters named in one line."""


def verdicts(run: ReportedRun) -> tuple[Verdict, ...]:
    """Return the verdicts on the first screen, in the order in which an engineer would ask for them.

    If the trace has losses, the verdicts on the losses come first.
    """
    *what, fit = of_the_model(run)
    if not has(run.trace, LOSSES):
        return *what, judge_data(run), fit, convergence(run)
    *losses, reference, sure = what
    return *losses, fit, reference, sure, judge_data(run), convergence(run)


def of_the_model(run: ReportedRun) -> tuple[Verdict, ...]:
    """Return the verdicts on losses, other parameter changes, their certainty, and the model's fit."""
    names, losses = _most_changed(run), lost(run)
    what = judge_change(run, names)
    if losses:
        what = replace(what, question="How was the reference state corrected?")
    return *losses, what, certainty(run, names), model_fit(run)


def _most_changed(run: ReportedRun) -> tuple[str, ...]:
    """Return the names of the model parameters that the data informed. The largest change comes first.

    Losses in later states are left out because they have their own verdicts. Inferred error parameters, such as
    standard deviations, do not belong to the model and are left out too. With several tests, only values of
    structural parameters and losses since an unknown date count as changes; standard deviations of populations,
    scores, dates, slopes and the like do not.
    """
    left, roles = error_parameters(run.trace).union(not_informed(run.trace)), roles_of(run.trace)
    left |= {name for name, (kind, *_) in roles.items() if kind not in (*VALUE_KINDS, "loss")}
    names = [name for name in run.names if name not in left and not is_loss(run.trace, name)]
    return tuple(sorted(names, key=lambda name: -abs(_change(run, name))))


def _change(run: ReportedRun, name: str) -> float:
    """Return the posterior mean's change relative to the start value, or 0 if the start value is 0 or unknown."""
    start = constant(run.trace, "start", name)
    ratio = float(run.summary["mean"][name]) / start - 1.0 if start else 0.0
    return ratio if np.isfinite(ratio) else 0.0


def judge_change(run: ReportedRun, names: tuple[str, ...]) -> Verdict:
    """Return the verdict on the changes of the first three parameters in `names`.

    If `names` is empty, the verdict says that the data determine no change.
    """
    question = "What changed?"
    if not names:
        return Verdict(question, "Nothing that the data determine", None, said=_errors(run))
    words = []
    for name in names[:_FEW]:
        start, mean, n = (
            constant(run.trace, "start", name) / run.unit(name).factor,
            run.value(name, "mean"),
            decimals(run.value(name, "sd")),
        )
        told = change(mean / start - 1) if start and np.isfinite(start) else f"to {fixed(mean, n)}"
        words.append(f"{name} {told}")
    most = "" if len(names) <= _FEW else f"The largest changes of {len(names)} parameters. "
    return Verdict(question, ", ".join(words), None, said=most + _errors(run))


def _errors(run: ReportedRun) -> str:
    """Return a sentence with the largest frequency error before and after updating.

    The error before updating is left out if a frequency is unknown. The sentence is empty if the run has no
    prediction of frequencies.
    """
    if run.prediction is None:
        return ""
    measured, after = (run.prediction[column].to_numpy() for column in ("measured", "mean"))
    labels, before = mode_names(run.trace), frequencies_before(run.trace)
    said = []
    for words, hz in (("before", before), ("after", after)):
        if hz is not None and np.isfinite(hz).all():
            error = hz / measured - 1.0
            k = int(np.argmax(np.abs(error)))
            said.append(f"{change(float(error[k]))} {words} (mode {labels[k]})")
    return f"Largest frequency error: {', '.join(said)}." if said else ""


def certainty(run: ReportedRun, names: tuple[str, ...]) -> Verdict:
    """Return the verdict on how certain the changes are: the means and sds of the first three of `names`.

    The verdict also gives the 90 % interval of the parameter in `names` with the largest ratio of sd to mean. If
    `names` is empty, the verdict says that the priors alone decide.
    """
    question = "How sure is that?"
    if not names:
        return Verdict(question, "The priors alone decide", None)
    words = []
    for name in names[:_FEW]:
        mean, sd = run.value(name, "mean"), run.value(name, "sd")
        told = with_sd(mean, sd) if sd > 0 else given(mean)
        words.append(f"{name} {told} {run.unit(name).name}".rstrip())
    spread = {name: run.value(name, "sd") / (abs(run.value(name, "mean")) or np.inf) for name in names}
    least = max(spread, key=lambda name: spread[name])
    low, high, sd = (run.value(least, column) for column in ("eti90_lb", "eti90_ub", "sd"))
    ends = f"{interval(low, high, decimals(sd))} {run.unit(least).name}".rstrip()
    said = f"{ASSUMED} " if run.diagnosis.fit.verdict == CONTRADICTED else ""
    said += f"Mean ± sd. Least certain: {least}, 90 % interval {ends}."
    if stopped := [one.name for one in at_bounds(run.trace)]:
        said += (
            f" {names_in_words(stopped)} {'lie' if len(stopped) > 1 else 'lies'} at the bounds, which narrow it."
        )
    if not run.diagnosis.converged:
        said += " Provisional."
    return Verdict(question, ", ".join(words), None, said=said)


def judge_data(run: ReportedRun) -> Verdict:
    """Return the verdict on which parameters the data leave undetermined.

    The answer is "Unknown" if the trace has no draws from the prior, or all posterior draws are the same.
    """
    question = "Anything left undetermined?"
    found = information(run.trace)
    if found is None:
        nothing = f"Posterior and prior cannot be compared: {why_unknown(run.trace)}."
        return Verdict(question, "Unknown", None, "Why this is unknown", (nothing,))
    if not found.uninformed:
        narrowed = "The data narrowed every combination of the parameters."
        said = f"The least informed direction keeps {share(float(found.remaining_sd[0]))} of its prior sd."
        answer, why = "No", "Why we say the data determine the parameters"
        stopped = pinned_parameters(run.trace)
        if stopped:
            few = names_in_words(stopped) if len(stopped) <= _FEW else f"{len(stopped)} parameters"
            answer, why = f"Yes, beyond the bounds: {few}", "What data and bounds determine"
            said = f"The data ask for values that the bounds exclude. {said}"
            narrowed = "The data narrowed every combination of the parameters, up to the bounds."
        elif run.diagnosis.fit.verdict == CONTRADICTED:
            answer, why = "Not within this model", "What the data determine in a model that they reject"
        return Verdict(question, answer, True if answer == "No" else None, why, (narrowed,), said)
    left = [name for name, basis in zip(found.names, found.basis, strict=True) if basis != DATA]
    few = ", ".join(left[:_FEW]) + (f" and {len(left) - _FEW} more" if len(left) > _FEW else "")
    said = f"The data updated {len(found.names) - len(left)} of {len(found.names)} parameters."
    if not left:
        few, said = "Not every combination", "The data updated each parameter, but not every combination of them."
    return Verdict(question, few, False, "What is left undetermined", tuple(found.warnings()), said)


def convergence(run: ReportedRun) -> Verdict:
    """Return the verdict on the run's convergence.

    A converged run counts only as locally converged if it may have missed maxima.
    """
    question = "Can the run be trusted?"
    table, needed = without_scores(run.summary), required_ess(run.trace["posterior"].sizes["chain"])
    rhat, ess = float(table["rhat"].max()), float(table[["ess_bulk", "ess_tail"]].min().min())
    said = (
        f"R-hat at most {fixed(rhat, 4)} (below {given(RHAT_LIMIT)} needed), at least {fixed(ess, 0)} effective "
        f"draws ({given(needed)} needed)."
    )
    said += "".join(f" {sentence}" for sentence in exact_in_words(run.trace.attrs)[:1])
    if run.diagnosis.converged and not run.diagnosis.searched:
        why = "What the chains alone cannot tell"
        return Verdict(question, "Converged locally", None, why, (SOUND, *run.diagnosis.remarks), said)
    if run.diagnosis.converged:
        beside = run.diagnosis.remarks or (COVERED,)
        why = "Why the run counts as converged"
        return Verdict(question, "Yes, converged", True, why, (SOUND, *beside), said)
    return Verdict(question, "Not converged", False, "Why the run has not converged", run.diagnosis.remarks, said)
