"""``fmu run``."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fmu.cli.output import claimed, write_csv
from fmu.cli.source import source
from fmu.cli.tables import echo_comparison, text
from fmu.progress import labelled, progress_bars
from fmu.sampling import SAMPLERS

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.analysis.diagnosis import Diagnosis
    from fmu.posterior.problem import UpdatingProblem


@click.command("run")
@click.argument("case")
@click.option("--sampler", "samplers", multiple=True, type=click.Choice(SAMPLERS), default=("hmc",),
              show_default=True, help="May be given several times.")  # fmt: skip
@click.option("--pairing", type=click.Choice(("shape", "index", "soft")),
              help="Pair computed with measured modes by shape, by number in the spectrum, or softly by shape, "
              "without jumps.  [default: what the file says]")  # fmt: skip
@click.option("--draws", type=click.IntRange(min=1), default=1000, show_default=True, help="Steps kept.")
@click.option("--warmup", type=click.IntRange(min=0), default=1000, show_default=True, help="Steps before them.")
@click.option("--chains", type=click.IntRange(min=1), default=4, show_default=True, help="Chains or ensembles.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option("--starts", type=click.IntRange(min=1),
              help="Climbs of the search for maxima before sampling; fewer are faster and may miss one.  "
              "[default: 256; 16 for a Python function without gradients]")  # fmt: skip
@click.option("--init", type=click.Choice(("prior", "start")), default="prior", show_default=True,
              help="Where the chains start.")  # fmt: skip
@click.option("--until-ess", type=click.FloatRange(min=0, min_open=True), metavar="N",
              help="Go on until the verdict is good and every effective sample size is at least N; exit code 1 if "
              "--max-draws are reached before.")  # fmt: skip
@click.option("--max-draws", type=click.IntRange(min=1), help="The most steps kept with --until-ess."
              "  [default: 32 times --draws]")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Directory to write.  [default: runs/CASE-PAIRING]")
@click.option("--overwrite", is_flag=True, help="Replace the files of an earlier run in the directory.")
@click.option("--report/--no-report", "reports", default=True, help="Write HTML pages too, as fmu report does.")
def command(
    case: str,
    samplers: tuple[str, ...],
    pairing: str | None,
    out: Path | None,
    overwrite: bool,
    reports: bool,
    starts: int | None,
    **steps: Any,
) -> int:
    """Sample CASE: a built-in problem, or one that a TOML file describes.

    Searches for the maxima of the posterior first (map.csv), so that a sampler that misses one is found out.
    Writes a trace (SAMPLER.nc) and a summary (summary-SAMPLER.csv) for each sampler, comparison.csv, and pages to
    read (report/index.html); keeps CASE (problem.toml, run.json).
    """
    given = source(case, pairing)
    with claimed(out or Path("runs") / f"{given.stem}-{given.pairing}", overwrite) as directory:
        from fmu.analysis.comparison import side_by_side
        from fmu.analysis.diagnosis import diagnose_all
        from fmu.analysis.diagnostics import summary
        from fmu.analysis.search import STARTS, default_starts, find_map
        from fmu.analysis.trace import save_trace
        from fmu.config.kept import keep
        from fmu.sampling import sample

        problem = given.load()
        starts = starts or default_starts(problem)
        if sys.stderr.isatty() or starts != STARTS:  # it may take long
            click.echo(f"Searching for the maxima of the posterior from {starts} starts …", err=True)
        traces, summaries = {}, {}
        with _explained(problem), progress_bars() as report:
            maxima = steps["maxima"] = find_map(problem, starts)
            for name in dict.fromkeys(samplers):
                traces[name] = sample(problem, name, progress=report and labelled(report, name), **steps)
                keep(given.path, directory, given.pairing)
                save_trace(traces[name], directory / f"{name}.nc")
                summaries[name] = summary(traces[name])
                write_csv(summaries[name], directory / f"summary-{name}.csv")
        write_csv(maxima.table(), directory / "map.csv")
        verdicts = diagnose_all(traces, summaries=summaries)
        comparison = side_by_side(traces, summaries, verdicts)
        write_csv(comparison, directory / "comparison.csv")
    click.echo(f"Maxima of the posterior\n{maxima}\n")
    for name, table in summaries.items():
        click.echo(f"{name}\n{text(table.assign(unit=table.attrs['units']))}\n")
        _echo_failed_points(name, traces[name], problem)
    echo_comparison(comparison, verdicts)
    short = _short_of(steps["until_ess"], summaries, verdicts)
    if short:
        click.echo(f"\nStopped at the most draws, short of --until-ess {steps['until_ess']:g}: {', '.join(short)}")
    click.echo(f"\nWritten to {directory}")
    if reports:
        from fmu.report.html import publish

        click.echo(f"Report: {publish(traces, directory)}")
    return 1 if short else 0


def _short_of(
    until_ess: float | None, summaries: Mapping[str, pd.DataFrame], verdicts: Mapping[str, Diagnosis]
) -> list[str]:
    """Return the samplers that did not come to the effective sample size with a good verdict."""
    if until_ess is None:
        return []
    from fmu.analysis.diagnosis import is_enough

    return [name for name, found in verdicts.items() if not is_enough(found, summaries[name], until_ess)]


def _echo_failed_points(name: str, trace: xr.DataTree, problem: UpdatingProblem) -> None:
    """Say how many points inside the bounds had no finite log-probability, if there were any."""
    groups = (trace[group] for group in ("warmup_sample_stats", "sample_stats"))
    failed = sum(int(stats["n_nonfinite"].sum()) for stats in groups if "n_nonfinite" in stats)
    if failed:
        click.echo(
            f"{name}: {failed} points inside the bounds had no finite log-probability{_why(problem)}\n", err=True
        )


@contextmanager
def _explained(problem: UpdatingProblem) -> Iterator[None]:
    """Add to an error why the user's function failed, where it did."""
    try:
        yield
    except ValueError as error:
        why = _why(problem)
        if not why:
            raise
        raise ValueError(f"{error}{why}") from error


def _why(problem: UpdatingProblem) -> str:
    """Return the first reason why the function of a black-box model failed; empty if it never did."""
    reasons = getattr(problem.model, "reasons", ())
    return f"; the function failed first at {reasons[0].theta.tolist()}: {reasons[0].reason}" if reasons else ""
