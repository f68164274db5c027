"""The shell's face of the package: arguments, progress and files; the work is done elsewhere.

A mistake of the user gives one line on standard error and exit code 2. Nothing heavy is imported before a command
needs it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fmu.progress import labelled, progress_bars
from fmu.sampling import SAMPLERS

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.analysis.diagnosis import Diagnosis
    from fmu.posterior.problem import UpdatingProblem

_BAD_INPUT = 2
_FORMATS = {"rhat": ".4f", "rhat_max": ".4f", "ess_bulk": ".0f", "ess_tail": ".0f"}


class _Commands(click.Group):
    """Commands whose errors are one line."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run, and turn an error in what the user gave into a line, or one a mistake of a file, and code 2."""
        try:
            code = super().main(*args, **{**kwargs, "standalone_mode": False})
        except click.exceptions.NoArgsIsHelpError as error:
            error.show()
            sys.exit(_BAD_INPUT)
        except click.ClickException as error:
            _stop(error.format_message())
        except click.Abort:
            click.echo("Stopped.", err=True)
            sys.exit(1)
        except (ValueError, OSError) as error:
            _stop(
                str(error.args[0]) if hasattr(error, "mistakes") else str(error), *getattr(error, "mistakes", ())
            )
        sys.exit(code if isinstance(code, int) else 0)


def _stop(message: str, *mistakes: object) -> None:
    """Print one line, and one more for each mistake in a file."""
    for line in (f"Error: {message}", *(f"  {mistake}" for mistake in mistakes)):
        indent = "  " if line.startswith("  ") else ""
        click.echo(indent + " ".join(line.split()), err=True)
    sys.exit(_BAD_INPUT)


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="fmu")
def main() -> None:
    """Bayesian finite-element model updating."""


@main.command()
def cases() -> None:
    """List the built-in problems."""
    from fmu import cases as builtin

    width = max(map(len, builtin.names()))
    for name in builtin.names():
        click.echo(f"{name:{width}}  {builtin.describe(name)}")


@main.command()
@click.argument("case")
@click.option("--sampler", "samplers", multiple=True, type=click.Choice(SAMPLERS), default=("hmc",),
              show_default=True, help="May be given several times.")  # fmt: skip
@click.option("--pairing", type=click.Choice(("shape", "index")),
              help="Pair computed with measured modes by shape, or by number in the spectrum.  [default: what the "
              "file says; shape]")  # fmt: skip
@click.option("--draws", type=click.IntRange(min=1), default=1000, show_default=True, help="Steps kept.")
@click.option("--warmup", type=click.IntRange(min=0), default=1000, show_default=True, help="Steps before them.")
@click.option("--chains", type=click.IntRange(min=1), default=4, show_default=True, help="Chains or ensembles.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
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
def run(
    case: str,
    samplers: tuple[str, ...],
    pairing: str | None,
    out: Path | None,
    overwrite: bool,
    reports: bool,
    **steps: Any,
) -> int:
    """Sample CASE: a built-in problem, or one that a TOML file describes.

    Searches for the maxima of the posterior first (map.csv), so that a sampler that misses one is found out.
    Writes a trace (SAMPLER.nc) and a summary (summary-SAMPLER.csv) for each sampler, comparison.csv, and pages to
    read (report/index.html).
    """
    load, name, pairing = _source(case, pairing)
    with _claimed(out or Path("runs") / f"{name}-{pairing}", overwrite) as directory:
        from fmu.analysis.comparison import side_by_side
        from fmu.analysis.diagnosis import diagnose_all
        from fmu.analysis.diagnostics import summary
        from fmu.analysis.search import find_map
        from fmu.analysis.trace import save_trace
        from fmu.sampling import sample

        problem = load(pairing=pairing)
        maxima = steps["maxima"] = find_map(problem)
        traces, summaries = {}, {}
        with progress_bars() as report:
            for name in dict.fromkeys(samplers):
                traces[name] = sample(problem, name, progress=report and labelled(report, name), **steps)
                save_trace(traces[name], directory / f"{name}.nc")
                summaries[name] = summary(traces[name])
                _write_csv(summaries[name], directory / f"summary-{name}.csv")
        _write_csv(maxima.table(), directory / "map.csv")
        verdicts = diagnose_all(traces, summaries=summaries)
        comparison = side_by_side(traces, summaries, verdicts)
        _write_csv(comparison, directory / "comparison.csv")
    click.echo(f"Maxima of the posterior\n{maxima}\n")
    for name, table in summaries.items():
        click.echo(f"{name}\n{_text(table.assign(unit=table.attrs['units']))}\n")
        _echo_failed_points(name, traces[name])
    _echo_comparison(comparison, verdicts)
    short = _short_of(steps["until_ess"], summaries, verdicts)
    if short:
        click.echo(f"\nStopped at the most draws, short of --until-ess {steps['until_ess']:g}: {', '.join(short)}")
    click.echo(f"\nWritten to {directory}")
    if reports:
        from fmu.report.html import publish

        click.echo(f"Report: {publish(traces, directory)}")
    return 1 if short else 0


@main.command()
@click.argument("directory", type=click.Path(path_type=Path, exists=True, file_okay=False))
def compare(directory: Path) -> None:
    """Compare the samplers of the run in DIRECTORY."""
    paths = sorted(directory.glob("*.nc"))
    if not paths:
        raise click.BadParameter(f"{directory} holds no traces (*.nc).", param_hint="'DIRECTORY'")
    from fmu.analysis.comparison import side_by_side
    from fmu.analysis.diagnosis import diagnose_all
    from fmu.analysis.diagnostics import summary
    from fmu.analysis.trace import load_trace

    traces = {path.stem: load_trace(path) for path in paths}
    problems = {trace.attrs["problem"] for trace in traces.values()}
    if len(problems) > 1:
        raise click.BadParameter(f"{directory} mixes problems: {', '.join(sorted(problems))}.",
                                 param_hint="'DIRECTORY'")  # fmt: skip
    summaries = {name: summary(trace) for name, trace in traces.items()}
    verdicts = diagnose_all(traces, summaries=summaries)
    _echo_comparison(side_by_side(traces, summaries, verdicts), verdicts)


@main.command()
@click.argument("directory", type=click.Path(path_type=Path, exists=True, file_okay=False))
def report(directory: Path) -> None:
    """Write HTML pages on the run in DIRECTORY: report/index.html and a page a sampler."""
    from fmu.report.html import write_report

    click.echo(f"Written to {write_report(directory)}")


@main.command()
@click.option("--out", type=click.Path(path_type=Path), default=Path("results"), show_default=True)
def paper(out: Path) -> None:
    """Repeat both experiments of the paper with every sampler."""
    from fmu.report.paper import run_paper

    with progress_bars() as report:
        run_paper(out, report)
    click.echo(f"Written to {out}")


def _source(case: str, pairing: str | None) -> tuple[Callable[..., UpdatingProblem], str, str]:
    """Return what loads a problem, what its directory is called after, and how its modes are paired."""
    if case.endswith(".toml"):
        from fmu import config

        path = Path(case)
        described = config.read(path)
        return partial(described.build, path.name, path.parent), path.stem, pairing or described.pairing
    from fmu import cases as builtin

    if case not in builtin.names():
        known = ", ".join(builtin.names())
        raise click.BadParameter(f"{case!r} is neither one of {known} nor a .toml file.", param_hint="'CASE'")
    return partial(builtin.load, case), case, pairing or "shape"


@contextmanager
def _claimed(directory: Path, overwrite: bool) -> Iterator[Path]:
    """Make the output directory before hours are spent; take it away again if nothing came to be in it."""
    if os.path.lexists(directory) and not overwrite:
        raise ValueError(f"--out: {directory} exists; choose another directory or add --overwrite")
    made = [path for path in (directory, *directory.parents) if not path.exists()]
    try:
        directory.mkdir(parents=True, exist_ok=True)
        if not os.access(directory, os.W_OK):
            raise PermissionError(f"no permission to write in {directory}")
        yield directory
    except BaseException:
        for path in made:
            with suppress(OSError):  # it holds results
                path.rmdir()
        raise


def _write_csv(table: pd.DataFrame, path: Path) -> None:
    """Write a table so that the file appears complete or not at all."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        table.to_csv(unfinished)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _text(table: pd.DataFrame) -> str:
    """Return a table as text, with as many digits as mean something."""
    formats: dict[Any, Any] = {
        name: f"{{:{_FORMATS.get(name, '.4g')}}}".format for name in table.select_dtypes("float").columns
    }
    return table.rename_axis(None).to_string(formatters=formats)


def _echo_comparison(table: pd.DataFrame, verdicts: Mapping[str, Diagnosis]) -> None:
    """Print the numbers with a column a sampler, then the verdicts and what speaks against the model, in words."""
    numbers = table.drop(columns="verdict").astype(object).T
    text = numbers.apply(lambda row: row.map(partial(_number, _FORMATS.get(row.name, ".4g"))), axis=1)
    click.echo(text.rename_axis(None, axis=1).to_string())
    click.echo()
    width = max(map(len, table.index))
    for name, found in verdicts.items():
        click.echo(f"{name:{width}}  {found.verdict}")
        for remark in found.remarks[not found.converged :]:  # the verdict has the first reason
            click.echo(f"{'':{width}}  - {remark}")
    told = next((name for name, found in verdicts.items() if found.converged), next(iter(verdicts)))
    if verdicts[told].warnings:
        doubt = "" if verdicts[told].converged else ", which has not converged"
        click.echo(f"\nThe model, by the draws of {told}{doubt}")
        for warning in verdicts[told].warnings:
            click.echo(f"  - {warning}")


def _short_of(
    until_ess: float | None, summaries: Mapping[str, pd.DataFrame], verdicts: Mapping[str, Diagnosis]
) -> list[str]:
    """Return the samplers that did not come to the effective sample size with a good verdict."""
    if until_ess is None:
        return []
    from fmu.analysis.diagnosis import is_enough

    return [name for name, found in verdicts.items() if not is_enough(found, summaries[name], until_ess)]


def _number(style: str, value: Any) -> str:
    """Format a number: whole ones in full, what does not apply as a dash."""
    if str(value) == "<NA>":
        return "-"
    return format(value, style) if isinstance(value, float) else str(value)


def _echo_failed_points(name: str, trace: xr.DataTree) -> None:
    """Say how many points inside the bounds had no finite log-probability, if there were any."""
    groups = (trace[group] for group in ("warmup_sample_stats", "sample_stats"))
    failed = sum(int(stats["n_nonfinite"].sum()) for stats in groups if "n_nonfinite" in stats)
    if failed:
        click.echo(f"{name}: {failed} points inside the bounds had no finite log-probability\n", err=True)
