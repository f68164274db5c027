"""Report sections on a run's computational cost, accuracy certificate, assumptions, settings and versions."""

from __future__ import annotations

import json
from collections.abc import Iterator

from fmu.analysis.certificate import exact_in_words
from fmu.analysis.trace.reading import is_imported
from fmu.fem.certificates import ReductionCertificate, SurrogateCertificate
from fmu.fem.frf.confirming import FRFCertificate
from fmu.numbers import MISSING, apart, fixed, given, share, significant, whole
from fmu.plain_data import list_in, mapping_in, number_in
from fmu.posterior.assumptions import ERRORS_HEADER, Assumptions
from fmu.posterior.assumptions import assumptions as assumed
from fmu.report.document import Details, Items, Omitted, PageSection, PageTable, Part, Text
from fmu.report.run import ReportedRun

_LONG = 60
"""Largest number of characters of a list of settings in a table cell."""


def cost(run: ReportedRun) -> PageSection:
    """Return the section on the run's cost: model solves, time in s, and efficiency."""
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
    gained = PageTable(
        "Efficiency: ESS of the worst parameter, warm-up included; an exact gradient counts as its time in solves",
        ("quantity", "value"),
        rows,
    )
    return PageSection("cost", "Cost", (spent, gained))


def certificate(run: ReportedRun) -> PageSection | Omitted:
    """Return the section on the error of the reduced models or the surrogate at the draws.

    Return `Omitted` if the run used neither.
    """
    title, attrs = "Certificate of the reduced model", run.trace.attrs
    of_surrogate = SurrogateCertificate.from_trace(attrs)
    if of_surrogate is not None:
        return _of_surrogate(of_surrogate, exact_in_words(attrs))
    found, of_frfs = ReductionCertificate.from_trace(attrs), FRFCertificate.from_trace(attrs)
    more = () if of_frfs is None else (Text(of_frfs.sentence()),)
    if found is None:
        return PageSection("certificate", title, more) if more else Omitted(title, "no reduced model was used")
    said = f"{found.draws} of the draws were solved again with the full model"
    bounds: tuple[tuple[str, str, str], ...] = ()
    if found.bound is not None and found.bound_median is not None:  # traces of earlier versions have no bounds
        said = (
            f"At {found.bound_draws} of the draws the errors of the frequencies were bounded by their residuals. "
            f"{said}, those with the largest bounds among them"
        )
        bounds = (
            ("largest bound of a frequency's relative error", *_beside(found.bound, found.frequency_tolerance)),
            ("the largest of each draw, median", *_beside(found.bound_median, found.frequency_tolerance)),
            ("solved draws at which an error is above its bound", str(found.bound_exceeded), "0"),
        )
    said += f". Reduced-model error {found.what_fails or 'within tolerance'}."
    by_full: tuple[tuple[str, str, str], ...] = ()
    if found.full_share is not None:
        by_full = (("share of the draws answered by the full model", share(found.full_share), MISSING),)
    full_solves = "full solves during the run, outside the reduced model's box"
    rows = (
        *bounds,
        ("largest relative error of a frequency", *_beside(found.frequency_error, found.frequency_tolerance)),
        ("largest error of the log-probability", *_beside(found.log_prob_error, found.log_prob_tolerance)),
        ("draws at which the pairing changed", str(found.pairing_changes), "0"),
        (full_solves, whole(found.full_solves), MISSING),
        *by_full,
    )
    table = PageTable("Reduced against full model", ("quantity", "found", "allowed"), rows)
    return PageSection("certificate", title, (Text(said), table, *more))


def _of_surrogate(found: SurrogateCertificate, exact: list[str]) -> PageSection:
    """Return the section on the surrogate's error at posterior draws.

    The sentences in `exact` say which draws are exact. If the list is not empty, a sentence is appended to it.
    """
    if exact:
        exact.append("The rest of this section is about the surrogate; its errors are not those of the draws.")
    rows = (
        ("posterior means may be off by, in posterior sd", *_beside(found.shift, found.shift_tolerance)),
        ("posterior sds may be off by, relative", *_beside(found.shift, found.shift_tolerance)),
        ("standard deviation of the log-probability's error", significant(found.log_prob_sd, 2), MISSING),
        ("largest relative error of a frequency", significant(found.frequency_error, 2), MISSING),
        ("solves from which the surrogate was learnt", whole(found.design), MISSING),
        ("solves in all", whole(found.solves), MISSING),
        ("solves that failed", whole(found.failed), MISSING),
        ("scatter of the solver's frequencies, relative, as estimated", significant(found.scatter, 2), MISSING),
    )
    table = PageTable("Surrogate against model", ("quantity", "found", "allowed"), rows)
    return PageSection("certificate", "Certificate of the surrogate", (Items((*exact, *found.sentences())), table))


def _beside(found: float, allowed: float) -> tuple[str, str]:
    """Return an error and its limit as texts, with enough digits to tell them apart."""
    text = significant(found, 2)
    return apart(found, allowed, digits=2)[0] if text == significant(allowed, 2) else text, given(allowed)


def assumptions(run: ReportedRun) -> tuple[Part, ...]:
    """Return the assumptions behind the verdicts, or () for a density that is not an updating problem."""
    attrs, mean = run.trace.attrs, run.summary["mean"]
    reduced = ReductionCertificate.from_trace(attrs)
    noise = run.problem.get("likelihood", {}).get("noise", ())
    inferred = {name: (float(mean[name]), float(run.summary["sd"][name])) for name in noise}
    if reduced is None:
        found = assumed(run.problem, None, inferred)
    else:
        of_frequency = reduced.frequency_error, reduced.frequency_elsewhere
        found = assumed(
            run.problem, reduced.frequency_tolerance, inferred, *of_frequency, reduced.log_prob_tolerance
        )
    return () if found is None else assumption_parts(found, "σ at the posterior mean where it is inferred.")


def assumption_parts(found: Assumptions, inferred: str) -> tuple[Part, ...]:
    """Return the list of assumptions and, if known, the table of the errors of the measured frequencies.

    The sentence `inferred` says at which value an inferred error sd σ is shown. It is added to the table's caption
    if the table contains such a σ.
    """
    if not found.errors:
        return (Items(found.sentences),)
    caption = (
        f"Errors of the measured frequencies. {inferred}"
        if found.has_inferred
        else "Errors of the measured frequencies"
    )
    return Items(found.sentences), PageTable(caption, ERRORS_HEADER, found.errors)


def settings(run: ReportedRun) -> PageSection:
    """Return the section on settings, seed (unless the run was imported), versions, hash and configuration."""
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


def _flat(value: object, name: str = "") -> Iterator[tuple[str, str]]:
    """Yield the name and text of each setting, including nested ones. Long lists are shortened."""
    table, several = mapping_in(value), list_in(value) or []
    if table:
        for key, inner in table.items():
            yield from _flat(inner, f"{name}, {_plain(key)}" if name else _plain(key))
    elif any(mapping_in(one) is not None for one in several):
        for k, one in enumerate(several, 1):
            yield from _flat(one, f"{name} {k}")
    else:
        yield name, _in_words(value)


def _plain(key: str) -> str:
    return key.replace("_", " ")


def _in_words(value: object) -> str:
    """Return a setting as text for a table cell."""
    if value is None or value in ({}, []):
        return MISSING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return significant(value)
    several = list_in(value)
    if several is None:
        return str(value)
    rows = [row for row in map(list_in, several) if row is not None]
    if len(rows) == len(several):
        shape = f"{len(rows)} × {len(rows[0])} matrix"
        return shape if len({len(row) for row in rows}) == 1 else f"{len(rows)} lists"
    text = ", ".join(map(_in_words, several))
    if len(text) <= _LONG:
        return text
    numbers = [x for x in map(number_in, several) if x is not None]
    if len(numbers) < len(several) or isinstance(several[0], bool):
        return f"{len(several)} values: {text[: _LONG - 1]}…"
    return f"{len(several)} values, {significant(min(numbers))} to {significant(max(numbers))}"
