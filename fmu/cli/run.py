"""The command ``fmu run``: its options, and the run from the problem file to the report."""

from __future__ import annotations

import atexit
import gc
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, cast

import click
from click.core import ParameterSource

from fmu import config
from fmu.arguments import ArgumentError
from fmu.cli.messages import STOPPED, warnings_as_notes
from fmu.cli.output import claim_directory, make_writable
from fmu.cli.problems import build_problem, pairing_option, problem_of
from fmu.cli.sampled import sample_problem, tell
from fmu.cli.surrogate import MAX_SOLVES, NO_SURROGATE, of_its_surrogate, wants_surrogate, with_surrogate
from fmu.cli.tables import echo_models
from fmu.config.kept import ORIGIN, KeptProblem, Orders, read_saved
from fmu.config.mistakes import ConfigurationError
from fmu.config.variants import VARIANTS, with_discrepancy
from fmu.interruption import stoppable
from fmu.progress import Report, json_lines, progress_bars
from fmu.progress.phases import progress_lines, told_to
from fmu.runs import Checkpoint
from fmu.samplers.registry import COMPARED
from fmu.sampling import DEFAULT_SAMPLER, DEFAULTS, INITS, SAMPLERS, StoppedRun, default_sampler

if TYPE_CHECKING:
    from fmu.engines.base import Engine
    from fmu.posterior.problem import UpdatingProblem
    from fmu.runs.run_directory import RunDirectory

_FROM_1, _FROM_0 = click.IntRange(min=1), click.IntRange(min=0)
_FREE = {"resume", "workers", "cluster", "progress", "reports", "max_failure_rate", "max_solves"}
"""Options that may be changed when a run is resumed. The draws do not depend on them, except that a surrogate
may learn from more solves."""

ALL = "all"
"""Value of ``--sampler`` for all samplers that ``fmu compare`` runs, and of ``--discrepancy`` for all variants."""
_GARBAGE, _GARBAGE_OF_PAGES = 100_000, 1_000_000
"""Numbers of new objects after which Python collects garbage. Frequent collections would take a tenth of a short
run. When pages are written, nearly all new objects are small and in use."""


def _option[Command: Callable[..., object]](
    name: str, kind: click.ParamType | type | None, text: str, **more: Any
) -> Callable[[Command], Command]:
    """Return a decorator that adds an option.

    If `fmu.sample` has an argument of this name with a default, the option has the same default.
    """
    default = DEFAULTS.get(name.removeprefix("--").replace("-", "_"))
    if default is not None:
        more |= {"default": default, "show_default": True}
    return click.option(name, type=kind, help=text, **more)


@click.command()
@click.argument("case", required=False)
@click.option("--sampler", "samplers", multiple=True, type=click.Choice((*SAMPLERS, ALL)), help="Sampler. "
              "Repeat the option for several; all: those that fmu compare runs.  [default: mixture; gibbs where "
              "parameters scatter over tests]")  # fmt: skip
@pairing_option
@click.option("--discrepancy", "discrepancies", multiple=True, type=click.Choice((*VARIANTS, ALL)),
              help="Error of the model itself, in place of that in the file. Repeat the option for several; all: "
              "each in turn, in directories of their own, and a page that compares them.")  # fmt: skip
@click.option("--draws", type=_FROM_1, help="Draws kept per chain, whether that is enough or not. Without it, "
              "every sampler draws until it has converged.")  # fmt: skip
@click.option("--until-ess", type=click.FloatRange(min=0, min_open=True), metavar="N", help="Without --draws, "
              "also until every effective sample size is at least N. Convergence needs 400.")  # fmt: skip
@click.option("--max-solves", type=_FROM_1, metavar="N", default=MAX_SOLVES, show_default=True, help="Without "
              "--draws, about how many solves a sampler may take, warm-up included. One that needs more ends "
              "there, with exit code 1; with --resume and a larger number it goes on. With a surrogate, how many "
              "solves it may take.")  # fmt: skip
@click.option("--warmup", type=_FROM_0, help="Warm-up steps per chain, before the draws.  [default: 1000; "
              "without --draws 400 for mixture, 500 for hmc, 100 for emcee]")  # fmt: skip
@_option("--chains", _FROM_1, "Number of chains (emcee: ensembles).")
@_option("--groups", _FROM_1, "Number of independent groups of chains, each with its own adaptation, for several "
         "workers. The draws depend on this number.  [default: 1; emcee: one per ensemble]")  # fmt: skip
@_option("--seed", _FROM_0, "Seed of the random numbers.")
@_option("--starts", _FROM_1, "Optimiser starts for the MAP search before sampling. Fewer starts are faster but "
         "may miss a maximum.  [default: 256; 16 for a Python function without gradients]")  # fmt: skip
@_option("--init", click.Choice(INITS), "Where the chains start: around the maxima, in proportion to their "
         "probability; at draws from the prior; or at the start values.")  # fmt: skip
@click.option("--surrogate/--no-surrogate", default=None, help="Whether Gaussian processes stand for a Python "
              "function or a command, with a certificate from further solves.  [default: if a solve takes 0.05 s "
              "or longer]")  # fmt: skip
@_option("--exact", None, "With a surrogate: accept or reject its draws by solves of the model itself (delayed "
         "acceptance), so that the posterior is exact. Takes some 500 solves more.", is_flag=True)  # fmt: skip
@_option("--max-failure-rate", click.FloatRange(0, 1), "Stop if more than this fraction of the solves fails.")
@_option("--out", click.Path(path_type=Path), "Output directory.  [default: runs/CASE-PAIRING]")
@_option("--overwrite", None, "Replace the files of an earlier run in the output directory.", is_flag=True)
@_option(
    "--resume", click.Path(path_type=Path, exists=True, file_okay=False), "Resume the run in DIR.", metavar="DIR"
)
@_option("--keep-draws", _FROM_1, "Steps between saves to disk.", default=Checkpoint.draws, show_default=True)
@_option("--keep-seconds", click.FloatRange(min=0), "Seconds between saves to disk. Work since the last save is "
         "lost if the run is killed.", default=Checkpoint.seconds, show_default=True)  # fmt: skip
@_option("--workers", _FROM_1, "Number of processes that advance the groups of chains, or evaluate a Python "
         "function at several points at once.")  # fmt: skip
@_option("--cluster", str, "Run on a Dask cluster instead: tcp://HOST:PORT of its scheduler.", metavar="ADDRESS")
@click.option("--progress", type=click.Choice(("bars", "json", "none")), default="bars", show_default=True,
              help="Progress bars on the terminal, or JSON lines on standard error.")  # fmt: skip
@click.option("--report/--no-report", "reports", default=True,
              help="Also write the HTML report, as fmu report does.")  # fmt: skip
@click.pass_context
def run(
    context: click.Context,
    case: str | None,
    pairing: str | None,
    resume: Path | None,
    out: Path | None,
    overwrite: bool,
    discrepancies: tuple[str, ...],
    **options: Any,
) -> int:
    """Sample the posterior of CASE: a built-in problem, or a TOML file.

    First searches for the posterior maxima (map.csv), to detect samplers that miss one. Writes a trace
    (SAMPLER.nc) and a summary (summary-SAMPLER.csv) for each sampler, comparison.csv, an HTML report
    (report/index.html), a list of failed solves if there are any (failures-SAMPLER.csv), and a copy of CASE
    (problem.toml, run.json). Draws are saved during the run. Ctrl-C stops the run cleanly, with exit code 130.
    --resume continues a stopped or killed run; the draws are then the same as without the interruption. The exit
    code is 1 if a sampler has not converged or not reached --until-ess, or if a surrogate has not reached its
    tolerance, unless --draws was given.
    """
    gc.set_threshold(_GARBAGE)
    atexit.register(gc.freeze)  # or Python would collect garbage once more when the process ends
    orders = cast("Orders", {key: options.pop(key) for key in list(options) if key in Orders.__annotations__})
    if resume is not None:
        return _run_once(_read_resumed(context, resume, orders), resume, new=False, overwrite=False, **options)
    asked = _read_order(context, case, pairing, orders)
    kinds = tuple(name for name in VARIANTS if name in discrepancies or ALL in discrepancies)
    directory = out or Path("runs") / "-".join([asked.file.stem, str(asked.pairing), *kinds[: len(kinds) == 1]])
    if not kinds:
        return _run_once(asked, directory, new=True, overwrite=overwrite, **options)
    codes, several = [], len(kinds) > 1
    for k, kind in enumerate(kinds, 1):
        where = directory / kind if several else directory
        try:
            with TemporaryDirectory() as folder:
                changed = _with_discrepancy(asked, kind, Path(folder))
                if several:
                    click.echo(f"Discrepancy {k} of {len(kinds)}: {VARIANTS[kind].title}", err=True)
                codes.append(_run_once(changed, where, new=True, overwrite=overwrite, **options))
        except (ArgumentError, ConfigurationError) as error:  # "all" means all that suit the problem
            if ALL not in discrepancies:
                raise
            click.echo(f"Left out, as it does not suit the problem: {error}", err=True)
            continue
        if several and codes[-1] == STOPPED:
            click.echo(f"Then fmu compare {directory} compares the discrepancies that have run.", err=True)
            return STOPPED
    if len(codes) > 1:
        click.echo()
        echo_models(directory, options["reports"])
    return max(codes)


def _with_discrepancy(asked: KeptProblem, kind: str, folder: Path) -> KeptProblem:
    """Return the problem with another discrepancy, after writing its file to a folder.

    Raise ConfigurationError if the new file is invalid. Whether the discrepancy suits the problem is checked only
    when the problem is built.
    """
    file = folder / asked.file.name
    text = with_discrepancy(asked.file.read_text(encoding="utf-8-sig"), kind)
    file.write_text(text, encoding="utf-8")
    config.read(file)
    return replace(asked, file=file)


def _run_once(
    asked: KeptProblem,
    directory: Path,
    *,
    new: bool,
    overwrite: bool,
    reports: bool,
    workers: int,
    cluster: str | None,
    progress: str,
) -> int:
    """Start or resume a run in a directory, and return the exit code.

    Raise UsageError if a surrogate is requested but impossible, or if --exact is given without a surrogate.
    """
    gc.set_threshold(_GARBAGE)
    with ExitStack() as stack:
        stack.enter_context(stoppable())
        if new:
            stack.enter_context(claim_directory(directory, overwrite))
        else:
            make_writable(directory)
        speaks = progress != "json"  # JSON lines on standard error are for programs
        if speaks and sys.stderr.isatty():  # the next steps print nothing for a second or more
            click.echo(f"{asked.file.stem}, paired by {asked.pairing}: results go to {directory}", err=True)
        import arviz_base  # noqa: F401  # it inspects the source of all functions on the call stack: few here

        from fmu.engines import engine
        from fmu.runs.run_directory import RunDirectory

        stack.enter_context(warnings_as_notes())
        at_work = stack.enter_context(engine(workers, cluster))
        running = stack.enter_context(RunDirectory(directory))
        try:
            with _reporting(progress, running) as report:
                problem, takes = _begin_run(asked, running, at_work, new=new, overwrite=overwrite)
                samplers = asked.orders["samplers"] or (default_sampler(problem),)
                asked = replace(asked, orders={**asked.orders, "samplers": samplers, "surrogate": takes})
                if takes:
                    asked.save(running.folder)  # the decision does not depend on the clock when the run is resumed
                    problem = with_surrogate(problem, asked.orders, at_work, speaks)
                    asked = of_its_surrogate(asked, problem, running)
                if new and speaks:
                    _echo_estimate(problem, asked.orders, at_work.workers)
                outcome = sample_problem(problem, asked, running, at_work, report, speaks)
            try:
                code = tell(outcome, problem, directory, asked.orders)
                if reports:
                    from fmu.report.pages import publish

                    gc.set_threshold(_GARBAGE_OF_PAGES)
                    with _reporting(progress, running):
                        index = publish(outcome.traces, directory)
                    click.echo(f"Report: {index}")
            finally:
                if not outcome.limited:
                    running.end_run()
        except StoppedRun as stop:
            return _tell_stop(directory, f": {stop.where}")
        except KeyboardInterrupt:
            return _tell_stop(directory)
        return code


def _tell_stop(directory: Path, where: str = "") -> int:
    click.echo(f"Stopped{where}. To resume: fmu run --resume {directory}", err=True)
    return STOPPED


def _read_order(context: click.Context, case: str | None, pairing: str | None, orders: Orders) -> KeptProblem:
    """Return a new run's problem and options.

    Raise UsageError, FileNotFoundError or ValueError if there is no such problem, its file is invalid, or options
    conflict.
    """
    if case is None:
        raise click.MissingParameter(ctx=context, param_hint="'CASE'", param_type="argument")
    problem = problem_of(case, pairing)
    wanted = {*orders["samplers"], *(COMPARED if ALL in orders["samplers"] else ())}
    orders["samplers"] = tuple(name for name in SAMPLERS if name in wanted)  # as `load_traces` orders them
    if orders["draws"] is not None:
        for name in ("until_ess", "max_solves"):
            if context.get_parameter_source(name) is not ParameterSource.DEFAULT:
                raise click.UsageError(
                    f"--draws {orders['draws']} fixes the number of draws: leave out --{name.replace('_', '-')}."
                )
        if orders["exact"]:
            raise click.UsageError(
                f"--exact solves as many draws as converge: leave out --draws {orders['draws']}, or --exact."
            )
    if orders["exact"] and orders["surrogate"] is False:
        raise click.UsageError("--exact is for the draws of a surrogate: leave out --no-surrogate, or --exact.")
    if orders["groups"] is not None:
        from fmu.samplers.loop.run import n_groups
        from fmu.samplers.registry import make_sampler

        for sampler in map(make_sampler, orders["samplers"] or (DEFAULT_SAMPLER,)):
            if sampler.walkers == 1:  # each ensemble is a group
                n_groups(orders["groups"], orders["chains"], sampler)
    return replace(problem, orders=orders)


def _read_resumed(context: click.Context, directory: Path, orders: Orders) -> KeptProblem:
    """Return the problem and options of the run in a directory.

    If the command gives new limits on solves or failures, they replace the saved ones. Raise BadParameter if an
    option that must not change is given, or there is no run that can be resumed. Raise ValueError if the saved
    options cannot be read.
    """
    from fmu.runs.run_directory import folder_of_order

    default = ParameterSource.DEFAULT
    given = [p for p in context.command.params if context.get_parameter_source(str(p.name)) is not default]
    changed = [p for p in given if p.name not in _FREE]
    if changed:
        what = "CASE" if changed[0].name == "case" else changed[0].opts[0]
        raise click.BadParameter(
            f"{what} cannot be changed when the run in {directory} is resumed: leave it out.",
            param_hint="'--resume'",
        )
    where = folder_of_order(directory)
    found = read_saved(where) if (where / ORIGIN).is_file() else None
    if found is None or not found.orders:
        raise click.BadParameter(f"{directory} contains no run that can be resumed.", param_hint="'--resume'")
    anew, names = found.orders.copy(), {p.name for p in given}
    if "max_solves" in names:
        anew["max_solves"] = orders["max_solves"]
    if "max_failure_rate" in names:
        anew["max_failure_rate"] = orders["max_failure_rate"]
    return replace(found, orders=anew)


def _begin_run(
    asked: KeptProblem, running: RunDirectory, engine: Engine, *, new: bool, overwrite: bool
) -> tuple[UpdatingProblem, bool]:
    """Build the problem; return it, and whether a surrogate will replace its model.

    A new run's options are saved, so that the run can be resumed. With --overwrite, they are saved only after the
    problem is built, so an earlier run survives if the problem cannot be built. If Ctrl-C interrupts the building,
    the options are saved as well. Raise UsageError if a surrogate is requested but impossible, or if --exact is
    given without a surrogate.
    """
    if new and not overwrite:
        running.begin(asked)
    try:
        problem = build_problem(asked, engine)
        takes = wants_surrogate(problem, asked.orders.get("surrogate", False))
        if asked.orders.get("exact") and not takes:
            raise click.UsageError(NO_SURROGATE)
    except (OSError, click.UsageError):  # for example, if a file cannot be read
        running.abandon()
        raise
    except KeyboardInterrupt:
        if new and overwrite:
            running.begin(asked)
        raise
    if new and overwrite:
        running.begin(asked)
    return problem, takes


def _echo_estimate(problem: UpdatingProblem, orders: Orders, workers: int) -> None:
    """Print how much time and how many solves the run is expected to take, if this can be estimated."""
    from fmu.analysis.estimate import estimates, estimates_in_words
    from fmu.analysis.maxima.search import default_starts

    parts = estimates(problem, orders, orders["starts"] or default_starts(problem), workers)
    if parts:
        click.echo(estimates_in_words(parts), err=True)


@contextmanager
def _reporting(progress: str, running: RunDirectory) -> Iterator[Report | None]:
    """Yield the progress callback that `progress` selects, or None. Keep a note of the phase in the directory."""
    with ExitStack() as stack:
        report: Report | None = None
        if progress == "json":
            report = stack.enter_context(json_lines(sys.stderr))
        elif progress == "bars":
            report = stack.enter_context(progress_bars())
            report = report or stack.enter_context(progress_lines("preparing"))
        stack.enter_context(told_to(report, running.note))
        yield report
