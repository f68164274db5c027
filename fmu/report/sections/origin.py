"""What a run cost and where it comes from: cost, certificate, settings, versions."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from fmu.analysis.certificate import exact_in_words, surrogate_in_words
from fmu.analysis.trace.reading import is_imported
from fmu.numbers import MISSING, apart, fixed, given, share, significant, whole
from fmu.posterior.assumptions import ERRORS_HEADER, Assumptions
from fmu.posterior.assumptions import assumptions as assumed
from fmu.posterior.train_reduced import Tolerance
from fmu.report.document import Code, Details, Items, Omitted, PageSection, PageTable, Part, Text
from fmu.report.run import ReportedRun

_LONG = 60
_INNERMOST = re.compile(r"\[\n([^\[\]{}\"]*)\]")
"""A list of numbers in JSON, which is written on one line."""


def cost(run: ReportedRun) -> PageSection:
    """Return what the run cost, and what it gave for that."""
    attrs, costs = run.trace.attrs, run.costs
    counts = []
    for words, name in (("model solves", "n_solves"), ("of which gradients", "n_gradients")):
        before, kept = int(attrs[f"warmup_{name}"]), int(attrs[name])
        counts.append((words, whole(before), whole(kept), whole(before + kept)))
    warmup_s, wall_s = float(attrs["warmup_wall_s"]), float(attrs["wall_s"])
    counts.append(("time, s", fixed(warmup_s, 1), fixed(wall_s - warmup_s, 1), fixed(wall_s, 1)))
    spent = PageTable("Computational cost", ("quantity", "warm-up", "draws kept", "both"), tuple(counts))
    rows = (
        ("smallest bulk ESS", fixed(float(costs["ess_bulk_min"]), 0)),
        ("time of an exact gradient, in solves", significant(float(costs["gradient_cost"]), 2)),
        ("effective draws per 1000 solves", significant(1000 * float(costs["ess_per_solve"]))),
        ("effective draws per second", significant(float(costs["ess_per_s"]))),
        ("share of draws that moved", share(float(costs["accept_rate"]))),
        ("divergences", whole(costs["divergences"])),
    )
    gained = PageTable("Efficiency: ESS of the worst parameter, warm-up included", ("quantity", "value"), rows)
    return PageSection("cost", "Cost", (spent, gained))


def certificate(run: ReportedRun) -> PageSection | Omitted:
    """Return how far the reduced model is from the full one at the draws."""
    title, attrs = "Certificate of the reduced model", run.trace.attrs
    if "surrogate_solves" in attrs:
        return _of_surrogate(attrs)
    if "certificate_draws" not in attrs:
        return Omitted(title, "no reduced model was used")
    frequency, log_prob = (float(attrs[f"certificate_{name}_error"]) for name in ("frequency", "log_prob"))
    changes = int(attrs["certificate_pairing_changes"])
    usual = Tolerance()
    allowed = Tolerance(
        float(attrs.get("certificate_frequency_tolerance", usual.frequency)),
        float(attrs.get("certificate_log_prob_tolerance", usual.log_prob)),
    )
    is_kept = frequency <= allowed.frequency and log_prob <= allowed.log_prob and not changes
    said = f"{attrs['certificate_draws']} of the draws were solved again with the full model"
    bounds: tuple[tuple[str, str, str], ...] = ()
    if "certificate_bound" in attrs:  # a trace of an earlier version has none
        bound, exceeded = float(attrs["certificate_bound"]), int(attrs["certificate_bound_exceeded"])
        is_kept = is_kept and not exceeded
        n_bounded = int(attrs["certificate_bound_draws"])
        said = (
            f"At {n_bounded} of the draws the errors of the frequencies were bounded by their residuals. "
            f"{said}, those with the largest bounds among them"
        )
        bounds = (
            ("largest bound of a frequency's relative error", *_beside(bound, allowed.frequency)),
            (
                "the largest of each draw, median",
                *_beside(float(attrs["certificate_bound_median"]), allowed.frequency),
            ),
            ("solved draws at which an error is above its bound", str(exceeded), "0"),
        )
    said += ". Reduced-model error " + ("within tolerance." if is_kept else "above tolerance.")
    by_full: tuple[tuple[str, str, str], ...] = ()
    if "certificate_full_share" in attrs:
        by_full = (
            ("share of the draws answered by the full model", share(attrs["certificate_full_share"]), MISSING),
        )
    rows = (
        *bounds,
        ("largest relative error of a frequency", *_beside(frequency, allowed.frequency)),
        ("largest error of the log-probability", *_beside(log_prob, allowed.log_prob)),
        ("draws at which the pairing changed", str(changes), "0"),
        (
            "full solves during the run, outside the reduced model's box",
            whole(attrs["certificate_full_solves"]),
            MISSING,
        ),
        *by_full,
    )
    table = PageTable("Reduced against full model", ("quantity", "found", "allowed"), rows)
    return PageSection("certificate", title, (Text(said), table))


def _of_surrogate(attrs: Mapping[Any, Any]) -> PageSection:
    """Return how far the surrogate of a slow model is from it at draws of the posterior."""
    shift, allowed = float(attrs["certificate_shift"]), float(attrs["certificate_shift_tolerance"])
    exact = exact_in_words(attrs)
    if exact:
        exact.append("The rest of this section is about the surrogate; its errors are not those of the draws.")
    sentences = exact + surrogate_in_words(attrs)
    failed = int(attrs["surrogate_failed"])
    scatter = float(attrs["surrogate_scatter"])
    log_prob_sd, frequency = (float(attrs[f"certificate_{name}"]) for name in ("log_prob_sd", "frequency_error"))
    rows = (
        ("posterior means may be off by, in posterior sd", *_beside(shift, allowed)),
        ("posterior sds may be off by, relative", *_beside(shift, allowed)),
        ("standard deviation of the log-probability's error", significant(log_prob_sd, 2), MISSING),
        ("largest relative error of a frequency", significant(frequency, 2), MISSING),
        ("solves from which the surrogate was learnt", whole(attrs["surrogate_design"]), MISSING),
        ("solves in all", whole(attrs["surrogate_solves"]), MISSING),
        ("solves that failed", whole(failed), MISSING),
        ("scatter of the solver's frequencies, relative, as estimated", significant(scatter, 2), MISSING),
    )
    table = PageTable("Surrogate against model", ("quantity", "found", "allowed"), rows)
    return PageSection("certificate", "Certificate of the surrogate", (Items(tuple(sentences)), table))


def _beside(found: float, allowed: float) -> tuple[str, str]:
    """Return an error and the largest that is allowed."""
    text = significant(found, 2)
    return apart(found, allowed, digits=2)[0] if text == significant(allowed, 2) else text, given(allowed)


def assumptions(run: ReportedRun) -> tuple[Part, ...]:
    """Return what the verdicts on a run rest on; nothing for a density that is not an updating problem."""
    attrs, mean = run.trace.attrs, run.summary["mean"]
    is_reduced = "certificate_draws" in attrs and "surrogate_solves" not in attrs
    allowed = float(attrs.get("certificate_frequency_tolerance", Tolerance().frequency)) if is_reduced else None
    error = float(attrs["certificate_frequency_error"]) if is_reduced else None
    away = attrs.get("certificate_frequency_elsewhere")
    noise = run.problem.get("likelihood", {}).get("noise", ())
    inferred = {name: (float(mean[name]), float(run.summary["sd"][name])) for name in noise}
    found = assumed(run.problem, allowed, inferred, error, None if away is None else float(away))
    return () if found is None else assumption_parts(found, "σ at the posterior mean where it is inferred.")


def assumption_parts(found: Assumptions, inferred: str) -> tuple[Part, ...]:
    """Return assumptions as a list and the table of the errors; `inferred` says what an inferred σ stands at."""
    if not found.errors:
        return (Items(found.sentences),)
    caption = (
        f"Errors of the measured frequencies. {inferred}"
        if found.has_inferred
        else "Errors of the measured frequencies"
    )
    return Items(found.sentences), PageTable(caption, ERRORS_HEADER, found.errors)


def settings(run: ReportedRun) -> PageSection:
    """Return settings, seed, versions and the hash of the configuration."""
    attrs = run.trace.attrs
    given, learnt = (json.loads(str(attrs[name])) for name in ("settings", "learnt"))
    names = dict.fromkeys((*given, *learnt))
    rows = tuple((name, _short(given.get(name)), _short(learnt.get(name))) for name in names)
    header = ("setting", "given", "after warm-up")
    parts: list[Part] = [
        PageTable("Settings of the sampler; those tuned in warm-up are fixed afterwards", header, rows, (1, 2))
    ]
    known: tuple[str, ...] = ("chains", "walkers", "draws", "warmup")
    title = "What is known of the run, as JSON"
    if not is_imported(run.trace):
        known, title = ("seed", *known, "init"), "Everything that determines the draws, as JSON"
    about = [(name, str(attrs[name])) for name in known]
    about += [(f"version of {name}", version) for name, version in json.loads(str(attrs["versions"])).items()]
    about.append(("configuration hash (SHA-256)", str(attrs["configuration_hash"])))
    parts.append(PageTable("The run", ("quantity", "value"), tuple(about), (1,)))
    long = {name: value for name, value in learnt.items() if len(_text(value)) > _LONG}
    if long:
        parts.append(Details("Tuned settings in full", (Code(_pretty(long)),)))
    configuration = Code(_pretty(json.loads(str(attrs["configuration"]))))
    parts.append(Details(title, (configuration,)))
    return PageSection("settings", "Settings, seed and versions", tuple(parts))


def _short(value: Any) -> str:
    """Return a setting in a table's cell."""
    if value is None:
        return MISSING
    text = _text(value)
    if len(text) > _LONG:
        return f"{len(value)} × {len(value)} matrix" if _is_square(value) else f"{text[: _LONG - 1]}…"
    return given(value) if isinstance(value, float) else text


def _is_square(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(row, list) and len(row) == len(value) for row in value)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def _pretty(value: Any) -> str:
    text = json.dumps(value, indent=1, ensure_ascii=False)
    return _INNERMOST.sub(lambda found: f"[{' '.join(found[1].split())}]", text)
