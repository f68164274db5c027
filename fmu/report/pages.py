"""Which sections make up a page."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace

from fmu.report.document import Items, Link, Omitted, Page, PageSection, Verdict
from fmu.report.run import ReportedRun
from fmu.report.sections import chains, comparison, evidence, origin, prediction, structure, updating
from fmu.report.sections.verdicts import verdicts

INDEX = "index"


def file_names(names: Iterable[str]) -> dict[str, str]:
    """Return the file of each run's page: its name, of letters that any file system and address takes."""
    taken, files = {INDEX}, {}
    for name in names:
        stem = plain = re.sub(r"[^A-Za-z0-9_-]+", "-", name).strip("-") or "run"
        k = 1
        while stem.lower() in taken:
            k += 1
            stem = f"{plain}-{k}"
        taken.add(stem.lower())
        files[name] = f"{stem}.html"
    return files


def sampler_page(run: ReportedRun, files: Mapping[str, str], runs: Mapping[str, ReportedRun]) -> Page:
    """Return the page of one run."""
    found: list[PageSection | Omitted] = [
        updating.parameters(run),
        updating.frequencies(run),
        updating.maxima(run),
        evidence.evidences({run.name: run}),
        structure.identifiability(run),
        structure.mac(run),
        structure.pairing(run),
        structure.shapes(run),
        prediction.predictive(run),
        prediction.left_out(run),
        chains.reliability(run),
        chains.paths(run),
        chains.settling(run),
        chains.pairs(run),
        chains.energies(run),
        origin.cost(run),
        origin.certificate(run),
        origin.settings(run),
    ]
    others = [Link("All samplers", f"{INDEX}.html")]
    others += [Link(other.title, files[name]) for name, other in runs.items() if name != run.name]
    lead = f"{run.trace.attrs['problem']}: {run.chains_in_words}."
    if run.title != run.sampler:
        lead = f"{run.sampler}, {lead}"
    return Page(run.title, lead, verdicts(run), _without_omissions(found), tuple(others), _footer(run))


def _without_omissions(found: Iterable[PageSection | Omitted]) -> tuple[PageSection, ...]:
    """Return the sections, and at the end one that says which are missing, and why."""
    found = tuple(found)
    sections = [part for part in found if isinstance(part, PageSection)]
    omitted = [part for part in found if isinstance(part, Omitted)]
    if omitted:
        said = Items(tuple(f"{part.title}: {part.reason}." for part in omitted))
        sections.append(PageSection("omitted", "Not on this page", (said,)))
    return tuple(sections)


def index_page(runs: Mapping[str, ReportedRun], files: Mapping[str, str]) -> Page:
    """Return the page that compares the runs."""
    found = (
        comparison.overview(runs, files),
        comparison.efficiency(runs),
        comparison.agreement(runs),
        updating.maxima(_told(runs)),
        evidence.evidences(runs),
    )
    first = next(iter(runs.values()))
    links = tuple(Link(run.title, files[name]) for name, run in runs.items())
    lead = f"Bayesian model updating by {len(runs)} sampler{'s' if len(runs) > 1 else ''}."
    return Page(
        str(first.trace.attrs["problem"]),
        lead,
        _common_verdicts(runs),
        _without_omissions(found),
        links,
        _footer(first),
    )


def _told(runs: Mapping[str, ReportedRun]) -> ReportedRun:
    """Return the run whose draws speak for the model: a converged one, if there is any."""
    return next((run for run in runs.values() if run.diagnosis.converged), next(iter(runs.values())))


def _common_verdicts(runs: Mapping[str, ReportedRun]) -> tuple[Verdict, ...]:
    """Return the verdicts on all runs together: how many converged, and what one that did says of the model."""
    failed = [run for run in runs.values() if not run.diagnosis.converged]
    good = len(runs) - len(failed)
    answer = "All converged" if not failed else f"{good} of {len(runs)} converged" if good else "None converged"
    reasons = tuple(f"{run.title}: {run.diagnosis.verdict}" for run in runs.values())
    told = _told(runs)
    others = verdicts(told)[1:]
    by = f"From the draws of {told.title}."
    return (
        Verdict("Have the samplers converged?", answer, not failed, "Verdict on each sampler", reasons),
        *(replace(verdict, reasons=(by, *verdict.reasons)) for verdict in others),
    )


def _footer(run: ReportedRun) -> str:
    return f"Written by fmu from the traces. Configuration {run.trace.attrs['configuration_hash']}."
