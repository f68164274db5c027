"""Self-contained HTML pages: one a sampler, and an index that compares them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from fmu.progress.phases import Phase, phase
from fmu.report.document import Page
from fmu.report.pages import INDEX, file_names, index_page, sampler_page
from fmu.report.run import ReportedRun, runs_of

if TYPE_CHECKING:
    import xarray as xr

FOLDER = "report"


def write_report(run_directory: str | os.PathLike[str]) -> Path:
    """Write the report of a run from the traces in its directory, and nothing else.

    Parameters
    ----------
    run_directory : path-like
        What `fmu run` wrote: a trace a sampler, ``SAMPLER.nc``.

    Returns
    -------
    Path
        ``report/index.html`` in that directory. It appears with all its pages or not at all, and replaces nothing
        but an earlier report.

    Raises
    ------
    ValueError
        If it is no directory, contains no traces, or traces of different problems; or if files of other origin
        stand where the report shall be.
    """
    from fmu.analysis.trace.conversion import load_trace

    directory = Path(run_directory)
    if not directory.is_dir():
        raise ValueError(f"run_directory: must be a directory (got {directory})")
    paths = sorted(directory.glob("*.nc"))
    if not paths:
        raise ValueError(f"run_directory: {directory} contains no traces (*.nc)")
    return publish({path.stem: load_trace(path) for path in paths}, directory)


def publish(traces: Mapping[str, xr.DataTree], run_directory: str | os.PathLike[str]) -> Path:
    """Write the report of traces in memory as `write_report` does, and return its index."""
    from fmu.report.files import OutputDirectory

    output = OutputDirectory(Path(run_directory) / FOLDER)
    output.check([f"{INDEX}.html", *file_names(traces).values()])
    with output.staged() as stage:
        index = write_pages(traces, stage)
    return output.root / index.name


def write_pages(traces: Mapping[str, xr.DataTree], directory: str | os.PathLike[str]) -> Path:
    """Write the pages of traces in memory.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        Of several samplers on one problem, by the name of their page.
    directory : path-like
        Made if it does not exist. Files of the same name are replaced.

    Returns
    -------
    Path
        The index page.
    """
    directory = Path(directory)
    with phase("report", len(traces) + 2) as under_way:
        runs = runs_of(traces)
        under_way.advance()
        return _written(runs, directory, under_way)


def _written(runs: dict[str, ReportedRun], directory: Path, under_way: Phase) -> Path:
    """Write the pages of runs, and return the index."""
    files = file_names(runs)
    directory.mkdir(parents=True, exist_ok=True)
    for name, run in runs.items():
        (directory / files[name]).write_text(render(sampler_page(run, files, runs)), encoding="utf-8")
        under_way.advance()
    index = directory / f"{INDEX}.html"
    index.write_text(render(index_page(runs, files)), encoding="utf-8")
    under_way.advance()
    return index


def render(page: Page) -> str:
    """Return a page as HTML; every text in it is escaped."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("fmu.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html").render(page=page)
