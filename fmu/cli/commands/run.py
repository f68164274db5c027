"""``fmu run``."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from fmu.cli.notes import warnings_as_notes
from fmu.cli.output import claimed, make_writable
from fmu.cli.sampled import Sampled, sampled, stopped, tell
from fmu.cli.source import source
from fmu.interruption import stoppable
from fmu.progress import Report, json_lines, progress_bars
from fmu.progress.phases import told_to
from fmu.sampling import INITS, MAX_FAILURE_RATE, SAMPLERS, default_sampler, most_draws

if TYPE_CHECKING:
    from fmu.config.kept import KeptProblem
    from fmu.posterior.problem import UpdatingProblem
    from fmu.runs.run_directory import RunDirectory

_FREE = {"resume", "workers", "cluster", "progress", "reports", "max_failure_rate"}
"""Options that may change when a run is resumed: the draws do not depend on them."""


@click.command("run")
@click.argument("case", required=False)
@click.option("--sampler", "samplers", multiple=True, type=click.Choice(SAMPLERS),
              help="Sampler. Repeat the option for several.  [default: hmc; mh for a Python function without "
                   "gradients]",
              )  # fmt: skip
@click.option("--pairing", type=click.Choice(("shape", "index", "soft")),
              help="How computed modes are paired with measured ones: by shape, by number in the spectrum, or "
                   "softly by shape (no jumps).  [default: as in the file]")  # fmt: skip
@click.option("--draws", type=click.IntRange(min=1), default=1000, show_default=True, help="Draws kept per chain.")
@click.option(
    "--warmup",
    type=click.IntRange(min=0),
    default=1000,
    show_default=True,
    help="Warm-up steps per chain, before the draws.",
)
@click.option(
    "--chains",
    type=click.IntRange(min=1),
    default=4,
    show_default=True,
    help="Number of chains (emcee: ensembles).",
)
@click.option("--groups", type=click.IntRange(min=1),
              help="Independent groups of chains, each with its own adaptation, for several workers. The "
                   "draws depend on this number.  [default: 1; emcee: one per ensemble]")  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option("--starts", type=click.IntRange(min=1),
              help="Optimiser starts for the MAP search before sampling. Fewer are faster but may miss a "
                   "maximum.  "
              "[default: 256; 16 for a Python function without gradients]")  # fmt: skip
@click.option("--init", type=click.Choice(INITS), default="maxima", show_default=True,
              help="Where the chains start: around the maxima, in proportion to their probability; at draws "
                   "from the prior; or at the start values.")  # fmt: skip
@click.option("--until-ess", type=click.FloatRange(min=0, min_open=True), metavar="N",
              help="Sample until the run has converged and every effective sample size is at least N. Exit "
                   "code 1 if --max-draws is reached first.")  # fmt: skip
@click.option("--max-draws", type=click.IntRange(min=1), help="Maximum number of draws per chain with --until-ess."
              "  [default: 32 times --draws]")  # fmt: skip
@click.option("--max-failure-rate", type=click.FloatRange(0, 1), default=MAX_FAILURE_RATE, show_default=True,
              help="Stop if more than this fraction of the solves fails.")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Output directory.  [default: runs/CASE-PAIRING]")
@click.option("--overwrite", is_flag=True, help="Replace the files of an earlier run in the output directory.")
@click.option("--resume", type=click.Path(path_type=Path, exists=True, file_okay=False), metavar="DIR",
              help="Resume the run in DIR.")  # fmt: skip
@click.option("--keep-draws", type=click.IntRange(min=1), default=1000, show_default=True,
              help="Steps between saves to disk.")  # fmt: skip
@click.option("--keep-seconds", type=click.FloatRange(min=0), default=30.0, show_default=True,
              help="Seconds between saves to disk. Work since the last save is lost if the run is "
                   "killed.")  # fmt: skip
@click.option("--workers", type=click.IntRange(min=1), default=1, show_default=True,
              help="Number of processes that advance the groups of chains, or evaluate a Python function at "
              "several points at once.")  # fmt: skip
@click.option("--cluster", metavar="ADDRESS",
              help="Run on a Dask cluster instead: tcp://HOST:PORT of its scheduler.")  # fmt: skip
@click.option("--progress", type=click.Choice(("bars", "json", "none")), default="bars", show_default=True,
              help="Progress bars on the terminal, or JSON lines on standard error.")  # fmt: skip
@click.option(
    "--report/--no-report", "reports", default=True, help="Also write the HTML report, as fmu report does."
)
@click.pass_context
def command(
    context: click.Context,
    case: str | None,
    resume: Path | None,
    out: Path | None,
    overwrite: bool,
    reports: bool,
    workers: int,
    cluster: str | None,
    progress: str,
    **orders: Any,
) -> int:
    """Sample the posterior of CASE: a built-in problem, or a TOML file.

    First searches for the posterior maxima (map.csv), to detect samplers that miss one. Writes a trace
    (SAMPLER.nc) and a summary (summary-SAMPLER.csv) for each sampler, comparison.csv, an HTML report
    (report/index.html), a list of failed solves if there are any (failures-SAMPLER.csv), and a copy of CASE
    (problem.toml, run.json). Draws are saved during the run. Ctrl-C stops it cleanly; --resume continues a run
    that was stopped or killed, bit for bit.
    """
    from fmu.config.kept import KeptProblem

    with ExitStack() as stack:
        stack.enter_context(stoppable())
        if resume is None:
            if case is None:
                raise click.MissingParameter(ctx=context, param_hint="'CASE'", param_type="argument")
            given = source(case, orders.pop("pairing"))
            most_draws(orders["draws"], orders["until_ess"], orders["max_draws"])  # whether they go together
            _check_groups(orders)
            asked, load = KeptProblem(given.path, given.path.parent, given.pairing, orders), given.load
            where = out or Path("runs") / f"{given.stem}-{given.pairing}"
            directory = stack.enter_context(claimed(where, overwrite))
        else:
            asked = _resumed(context, resume, orders)
            load, directory = asked.load, resume
            make_writable(resume)
        from fmu.engines import engine
        from fmu.runs.run_directory import RunDirectory

        stack.enter_context(warnings_as_notes())
        at_work = stack.enter_context(engine(workers, cluster))
        running = stack.enter_context(RunDirectory(directory))
        # what is there is replaced when the file has turned out not to be wrong, or is not known to be
        replaces = resume is None and overwrite
        if resume is None and not replaces:
            running.begin(asked)
        try:
            with _reporting(progress) as report, told_to(report, running.note):
                try:
                    problem = load(at_work)
                except (ValueError, OSError):
                    running.abandon()
                    raise
                if replaces:
                    running.begin(asked)
                    replaces = False
                asked = _with_sampler(asked, problem, running)
                if resume is None and progress != "json":  # whose stream is for programs
                    _tell_beforehand(problem, asked.orders, orders["samplers"], at_work.workers)
                outcome = sampled(problem, asked, running, at_work, report)
            if outcome.stopped:
                return stopped(directory, outcome.stopped)
            return _told(outcome, running, reports, progress)
        except KeyboardInterrupt:  # in any other phase than warm-up and draws, or a second time
            if replaces:
                running.begin(asked)
            return stopped(directory)


def _told(outcome: Sampled, running: RunDirectory, reports: bool, progress: str) -> int:
    """Print what came of a run, and write its report; return the exit code."""
    try:
        code = tell(outcome, running.path)
        if reports:
            from fmu.report.pages import publish

            with _reporting(progress) as report, told_to(report, running.note):
                index = publish(outcome.traces, running.path)
            click.echo(f"Report: {index}")
        return code
    finally:
        running.ended()


def _with_sampler(asked: KeptProblem, problem: UpdatingProblem, running: RunDirectory) -> KeptProblem:
    """Return what was asked for, with the sampler that the model calls for where none was named, and keep it."""
    if asked.orders["samplers"]:
        return asked
    asked = replace(asked, orders={**asked.orders, "samplers": [default_sampler(problem)]})
    running.keep(asked)
    return asked


def _tell_beforehand(
    problem: UpdatingProblem, orders: Mapping[str, Any], named: Sequence[str], workers: int
) -> None:
    """Say which sampler was chosen, if none was named, and what the run will cost."""
    from fmu.analysis.estimate import estimates, in_words
    from fmu.analysis.maxima.search import default_starts

    (first, *_) = orders["samplers"]
    if not named and first != "hmc":
        click.echo(
            f"The model has no gradients, so the sampler is {first} (choose another with --sampler).", err=True
        )
    parts = estimates(problem, orders, orders["starts"] or default_starts(problem), workers)
    if parts:
        click.echo(in_words(parts), err=True)


def _check_groups(orders: dict[str, Any]) -> None:
    """Raise ValueError, before hours are spent, if a sampler's chains cannot be divided as is asked."""
    if orders["groups"] is None:
        return
    from fmu.samplers import named
    from fmu.samplers.loop.run import n_groups

    for name in orders["samplers"] or ("mh",):
        if name != "emcee":  # whose ensembles are the groups
            n_groups(orders["groups"], orders["chains"], named(name))


def _resumed(context: click.Context, directory: Path, orders: dict[str, Any]) -> KeptProblem:
    """Return the problem of a run and what was asked for; BadParameter if something else is asked now."""
    from fmu.config.kept import ORIGIN, kept
    from fmu.runs.run_directory import unfinished

    said = [p for p in context.command.params if _is_said(context, p)]
    changed = [p for p in said if p.name not in _FREE]
    if changed:
        what = "CASE" if changed[0].name == "case" else changed[0].opts[0]
        raise click.BadParameter(
            f"{what} cannot be changed when the run in {directory} is resumed: leave it out.",
            param_hint="'--resume'",
        )
    where = unfinished(directory)
    found = kept(where) if (where / ORIGIN).is_file() else None
    if found is None or not found.orders:
        raise click.BadParameter(f"{directory} contains no run that can be resumed.", param_hint="'--resume'")
    anew = {str(p.name): orders[str(p.name)] for p in said if p.name in found.orders}
    return replace(found, orders={**found.orders, **anew})


def _is_said(context: click.Context, parameter: click.Parameter) -> bool:
    return context.get_parameter_source(str(parameter.name)) is not ParameterSource.DEFAULT


@contextmanager
def _reporting(progress: str) -> Iterator[Report | None]:
    """Give what shows the progress."""
    if progress == "json":
        with json_lines(sys.stderr) as lines:
            yield lines
    elif progress == "bars":
        with progress_bars() as bars:
            yield bars
    else:
        yield None
