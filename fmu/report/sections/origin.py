"""Cost and origin of a run: cost, certificate, settings, versions."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from fmu.analysis.certificate import exact_in_words, surrogate_in_words
from fmu.analysis.trace.reading import is_imported
from fmu.numbers import MISSING, apart, fixed, given, share, significant, whole
from fmu.posterior.assumptions import ERRORS_HEADER, Assumptions
from fmu.posterior.assumptions import assumptions as assumed
from fmu.posterior.train_reduced import Tolerance
from fmu.report.document import Details, Items, Omitted, PageSection, PageTable, Part, Text
from fmu.report.run import ReportedRun

_LONG = 60
"""Letters of a setting in a table."""


def cost(run: ReportedRun) -> PageSection:
    """Return the section of the cost: solves and seconds, per effective draw too."""
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
    """Return the section on the error of the reduced model at the draws."""
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
    """Return the section on the error of the surrogate of a slow model at draws of the posterior."""
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
    """Return the assumptions behind the verdicts on a run; nothing for a density that is no updating problem."""
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
    before, after = dict(_flat(given)), dict(_flat(learnt))
    rows = tuple((name, before.get(name, MISSING), after.get(name, MISSING)) for name in {**before, **after})
    header = ("setting", "given", "after warm-up")
    known: tuple[str, ...] = ("chains", "walkers", "draws", "warmup")
    title = "What is known of the run"
    if not is_imported(run.trace):
        known, title = ("seed", *known, "init"), "Everything that determines the draws"
    about = [(name, str(attrs[name])) for name in known]
    about += [(f"version of {name}", version) for name, version in json.loads(str(attrs["versions"])).items()]
    about.append(("configuration hash (SHA-256)", str(attrs["configuration_hash"])))
    configuration = tuple(_flat(json.loads(str(attrs["configuration"]))))
    caption = f"{title}. The trace has it in full, with all matrices: attributes configuration, settings, learnt"
    everything = PageTable(caption, ("key", "value"), configuration, (1,))
    parts: tuple[Part, ...] = (
        PageTable("Settings of the sampler; those tuned in warm-up are fixed afterwards", header, rows, (1, 2)),
        PageTable("The run", ("quantity", "value"), tuple(about), (1,)),
        everything if everything.is_long else Details(title, (everything,)),
    )
    return PageSection("settings", "Settings, seed and versions", parts)


def _flat(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """Yield the entries of nested settings as names and words; long lists are told by their size and range."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from _flat(inner, f"{name}, {_plain(key)}" if name else _plain(key))
    elif isinstance(value, list) and any(isinstance(one, dict) for one in value):
        for k, one in enumerate(value, 1):
            yield from _flat(one, f"{name} {k}")
    else:
        yield name, _in_words(value)


def _plain(key: str) -> str:
    return key.replace("_", " ")


def _in_words(value: Any) -> str:
    """Return a setting as text for a cell of a table."""
    if value is None or value in ({}, []):
        return MISSING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return significant(value)
    if not isinstance(value, list):
        return str(value)
    if all(isinstance(row, list) for row in value):
        shape = f"{len(value)} × {len(value[0])} matrix"
        return shape if len({len(row) for row in value}) == 1 else f"{len(value)} lists"
    text = ", ".join(map(_in_words, value))
    if len(text) <= _LONG:
        return text
    numbers = [x for x in value if isinstance(x, int | float)]
    if len(numbers) < len(value) or isinstance(value[0], bool):
        return f"{len(value)} values: {text[: _LONG - 1]}…"
    return f"{len(value)} values, {significant(min(numbers))} to {significant(max(numbers))}"
