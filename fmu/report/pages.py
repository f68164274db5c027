"""Write the HTML pages on a run: one for each sampler, and an index page that compares samplers or models."""

from __future__ import annotations

import base64
import hashlib
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from markupsafe import Markup, escape

from fmu.analysis.convergence.diagnosis import choose_run
from fmu.analysis.trace.conversion import load_traces
from fmu.arguments import ArgumentError, check_arguments
from fmu.progress.phases import Phase, phase
from fmu.report.document import Items, Link, Omitted, Page, PageSection, Verdict
from fmu.report.files import OutputDirectory
from fmu.report.run import ReportedRun, runs_of
from fmu.report.sections import comparison, models, of_a_sampler, origin, updating
from fmu.report.sections.structure import structure_drawing
from fmu.report.sections.tests import damage_drawing
from fmu.report.sections.verdicts import of_the_model, verdicts
from fmu.runs.words import why_no_traces

if TYPE_CHECKING:
    import xarray as xr

    from fmu.analysis.models.comparison import ModelComparison


INDEX = "index"
_LEADING = ("damage", "frequencies")
"""Ids of the sections of a sampler's page that are placed below the verdicts, before the reasons for them."""
_SCRIPTS = ("data.js", "structure.js", "figures.js", "pairs.js", "tables.js", "start.js")


def file_names(names: Iterable[str]) -> dict[str, str]:
    """Return the file name of each run's page, keyed by run name. The names are valid in file systems and URLs.

    If there is only one run, its page is ``index.html``.
    """
    names = tuple(names)
    if len(names) == 1:
        return {names[0]: f"{INDEX}.html"}
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
    """Return the report page for one run.

    `files` maps run names to the file names of the pages. `runs` are all runs in the report.
    """
    others = [Link("All samplers", f"{INDEX}.html")] if len(runs) > 1 else []
    others += [Link(other.title, files[name]) for name, other in runs.items() if name != run.name]
    sections = _without_omissions(of_a_sampler(run))
    leading = tuple(one for one in sections if one.id in _LEADING)
    subtitle = run.title if run.title == run.sampler else f"{run.title}, by {run.sampler}"
    lead = f"{run.chains_in_words[0].upper()}{run.chains_in_words[1:]}.{_dates([run])}"
    return Page(
        str(run.trace.attrs["problem"]),
        subtitle,
        lead,
        verdicts(run),
        tuple(one for one in sections if one not in leading),
        tuple(others),
        _footer(run),
        origin.assumptions(run),
        damage_drawing(run.trace) or structure_drawing(run.trace),
        leading,
    )


def _dates(runs: Iterable[ReportedRun]) -> str:
    """Return a sentence with the first and last sampling date, or an empty string if no trace records its date."""
    days = sorted({str(run.trace.attrs["created_at"])[:10] for run in runs if "created_at" in run.trace.attrs})
    return f" Sampled on {' to '.join(dict.fromkeys((days[0], days[-1])))}." if days else ""


def _without_omissions(found: Iterable[PageSection | Omitted]) -> tuple[PageSection, ...]:
    """Return the sections to show, followed by a section with the reason for each omitted section, if any."""
    found = tuple(found)
    sections = tuple(section for part in found for section in part.shown)
    omitted = tuple(sentence for part in found for sentence in part.omissions)
    return (*sections, PageSection("omitted", "Not on this page", (Items(omitted),))) if omitted else sections


def index_page(runs: Mapping[str, ReportedRun], files: Mapping[str, str]) -> Page:
    """Return the index page, which compares the runs."""
    compared = comparison.Compared.of(runs)
    found = (
        comparison.posterior(compared),
        comparison.costs(compared, files),
        comparison.marginals(compared),
        comparison.paths(compared),
        updating.maxima(_judged_run(runs)),
        updating.evidences(runs),
    )
    first = next(iter(runs.values()))
    links = tuple(Link(run.title, files[name]) for name, run in runs.items())
    return Page(
        str(first.trace.attrs["problem"]),
        f"Bayesian model updating by {len(runs)} sampler{'s' if len(runs) > 1 else ''}",
        _dates(runs.values()).strip(),
        _common_verdicts(compared),
        _without_omissions(found),
        links,
        _footer(first),
        (),
        structure_drawing(first.trace),
    )


def _judged_run(runs: Mapping[str, ReportedRun]) -> ReportedRun:
    """Return the run, selected by `choose_run`, whose draws are the basis for the verdicts on the model."""
    verdicts = {name: run.diagnosis for name, run in runs.items()}
    return runs[choose_run(verdicts, {name: run.summary for name, run in runs.items()})]


def _common_verdicts(compared: comparison.Compared) -> tuple[Verdict, ...]:
    """Return the verdicts on the samplers, then the verdicts on the model, which use the selected run's draws.

    The reasons for the model verdicts are given only on the selected run's page.
    """
    told = _judged_run(compared.runs)
    first, *others = (replace(one, reasons=(), notes=()) for one in of_the_model(told))
    by = f"This and the rest by the draws of {told.title}."
    first = replace(first, said=f"{first.said} {by}".strip())
    return *comparison.verdicts_on_samplers(compared), first, *others


def _footer(run: ReportedRun) -> str:
    return f"Written by fmu from the traces. Configuration {run.trace.attrs['configuration_hash']}."


FOLDER = "report"


@check_arguments
def write_report(run_directory: str | os.PathLike[str]) -> Path:
    """Write the report on a run from the traces in its directory.

    Parameters
    ----------
    run_directory : path-like
        A directory that `fmu run` wrote, with a trace for each sampler, ``SAMPLER.nc``.

    Returns
    -------
    Path
        Path to ``report/index.html`` in that directory. Either all pages of the report are published, or none.
        Only an earlier report is overwritten.

    Raises
    ------
    ValueError
        If `run_directory` is not a directory, or contains no traces, an invalid trace or traces of different
        problems; or if ``report`` is a file or has an invalid manifest, or files that fmu did not write would be
        overwritten.
    """
    directory = Path(run_directory)
    if not directory.is_dir():
        raise ArgumentError("run_directory", "must be a directory", directory)
    traces = load_traces(directory)
    if not traces:
        raise ArgumentError("run_directory", f"{why_no_traces(Path(directory))}")
    return publish(traces, directory)


def publish(traces: Mapping[str, xr.DataTree], run_directory: str | os.PathLike[str]) -> Path:
    """Write the report on traces in memory, as `write_report` does; return the path to its index page.

    Raise ValueError if ``report`` is a file or has an invalid manifest, if files that fmu did not write would be
    overwritten, or if `runs_of` rejects the traces.
    """
    output = OutputDirectory(Path(run_directory) / FOLDER)
    output.check([f"{INDEX}.html", *file_names(traces).values()])
    with output.stage_files() as stage:
        index = write_pages(traces, stage)
    return output.root / index.name


def write_pages(traces: Mapping[str, xr.DataTree], directory: str | os.PathLike[str]) -> Path:
    """Write the report pages for traces that are in memory.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        Traces from one or more samplers on the same problem, keyed by run name.
    directory : path-like
        Output directory, created if it does not exist. Files with the same name are overwritten.

    Returns
    -------
    Path
        Path to the index page; with a single run, this is the run's own page.

    Raises
    ------
    ValueError
        If `traces` is empty, or contains objects that are not traces, or traces of different problems.
    """
    directory = Path(directory)
    with phase("report", len(traces) + 2) as under_way:
        runs = runs_of(traces)
        under_way.advance()
        return _write_pages(runs, directory, under_way)


def _write_pages(runs: dict[str, ReportedRun], directory: Path, under_way: Phase) -> Path:
    """Write the pages for all runs, and return the path to the index page."""
    files = file_names(runs)
    directory.mkdir(parents=True, exist_ok=True)
    index = directory / f"{INDEX}.html"
    for name, run in runs.items():
        (directory / files[name]).write_text(render(sampler_page(run, files, runs)), encoding="utf-8")
        under_way.advance()
    if len(runs) > 1:
        index.write_text(render(index_page(runs, files)), encoding="utf-8")
    under_way.advance()
    return index


def publish_models(
    traces: Mapping[str, xr.DataTree],
    found: ModelComparison,
    run_directory: str | os.PathLike[str],
    others: Mapping[str, str],
) -> Path:
    """Write the page that compares models of the same data, and return its path.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        One trace per model, keyed by model name, with the reference model first.
    found : ModelComparison
    run_directory : path-like
        The page is ``report/index.html`` in this directory.
    others : mapping of str to str
        Addresses of the models' own pages, relative to this page.

    Raises
    ------
    ValueError
        If ``report`` is a file or has an invalid manifest, or the page would overwrite a file that fmu did not
        write.
    """
    first = next(iter(traces.values()))
    sections = (models.comparison(found), models.held_out(traces), models.misfit(traces), models.intervals(traces))
    page = Page(
        str(first.attrs["problem"]),
        f"{len(traces)} models of the same data",
        "They differ in what they say of errors of the model itself.",
        models.verdicts(found, traces),
        _without_omissions(sections),
        tuple(Link(name, address) for name, address in others.items()),
        "Written by fmu from the traces.",
        (),
        structure_drawing(first),
    )
    output = OutputDirectory(Path(run_directory) / FOLDER)
    output.check([f"{INDEX}.html"])
    with output.stage_files() as stage:
        (stage / f"{INDEX}.html").write_text(render(page), encoding="utf-8")
    return output.root / f"{INDEX}.html"


def render(page: Page) -> str:
    """Return a page as HTML. All text in it is escaped, except `Markup`."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("fmu.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["prose"] = prose
    script, script_hash = _script()
    return environment.get_template("page.html").render(page=page, script=script, script_hash=script_hash)


def prose(text: str) -> Markup:
    """Return a text as escaped HTML. Words between backticks are formatted as code if all backticks are paired."""
    parts = str(text).split("`")
    if len(parts) % 2 == 0:  # an unpaired backtick is part of a name
        return escape(text)
    return Markup("").join(
        Markup("<code>{}</code>").format(x) if k % 2 else escape(x) for k, x in enumerate(parts)
    )


@cache
def _script() -> tuple[Markup, str]:
    """Return the script used on all pages, and its hash. Browsers run only the script with this hash."""
    files = resources.files("fmu.report") / "templates"
    parts = [(files / name).read_text(encoding="utf-8") for name in _SCRIPTS]
    text = re.sub(r"^\s+|^//.*\n", "", f'"use strict";\n{"".join(parts)}', flags=re.MULTILINE)
    return Markup(text), f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
