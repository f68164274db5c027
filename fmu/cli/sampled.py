"""What ``fmu run`` does with a problem: search, sample, write, tell."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from fmu.cli.errors import STOPPED
from fmu.cli.output import write_csv
from fmu.cli.tables import echo_comparison, echo_evidences, summary_text
from fmu.interruption import shielded
from fmu.numbers import typed
from fmu.progress import Report, labelled
from fmu.progress.lines import JSONLines
from fmu.sampling import StoppedRun

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.analysis.convergence.diagnosis import Diagnosis
    from fmu.analysis.maxima.results import Maxima
    from fmu.config.kept import KeptProblem
    from fmu.engines.base import Engine
    from fmu.posterior.problem import UpdatingProblem
    from fmu.runs.run_directory import RunDirectory

_OF_THE_RUN = ("draws", "warmup", "chains", "groups", "seed", "init", "until_ess", "max_draws", "max_failure_rate")


class Sampled(NamedTuple):
    """What a run came to.

    Attributes
    ----------
    problem : UpdatingProblem
    orders : mapping of str to JSON value
        What was asked for.
    maxima : Maxima
    traces : dict of str to DataTree
    summaries : dict of str to DataFrame
    stopped : str
        What was stopped and where, in words; empty if nothing was.
    """

    problem: UpdatingProblem
    orders: Mapping[str, Any]
    maxima: Maxima
    traces: dict[str, xr.DataTree]
    summaries: dict[str, pd.DataFrame]
    stopped: str = ""


def sampled(
    problem: UpdatingProblem, asked: KeptProblem, running: RunDirectory, engine: Engine, report: Report | None
) -> Sampled:
    """Sample a problem with all samplers asked for, but for those that are done, and write what comes of each."""
    from fmu.analysis.maxima.search import STARTS, default_starts, find_map

    orders = asked.orders
    starts = orders["starts"] or default_starts(problem)

    def search() -> Maxima:
        may_take_long = sys.stderr.isatty() or starts != STARTS
        if may_take_long and not isinstance(report, JSONLines):  # whose stream is for programs
            click.echo(f"Searching for posterior maxima from {starts} starts …", err=True)
        return find_map(problem, starts)

    with _explained(problem), _spread(problem, engine, orders["groups"]) as of_groups:
        try:
            outcome = Sampled(problem, orders, running.maxima(search), {}, {})
            stopped = _all(outcome, asked, running, of_groups, report)
        except ValueError:
            running.abandon()
            raise
    if stopped:
        return outcome._replace(stopped=stopped)
    write_csv(outcome.maxima.table(), running.path / "map.csv")
    return outcome


def tell(outcome: Sampled, directory: Path) -> int:
    """Print the tables and verdicts of a run, and write the comparison; return the exit code."""
    from fmu.analysis.convergence.diagnosis import diagnose_all, side_by_side
    from fmu.analysis.evidence import found_evidences

    traces, summaries = outcome.traces, outcome.summaries
    verdicts = diagnose_all(traces, summaries=summaries)
    comparison = side_by_side(traces, summaries, verdicts)
    write_csv(comparison, directory / "comparison.csv")
    click.echo(f"Posterior maxima\n{outcome.maxima}\n")
    for name, table in summaries.items():
        click.echo(f"{name}\n{summary_text(table, _updated(traces[name]))}\n")
        _echo_failed_points(name, traces[name], directory, outcome.problem)
    echo_comparison(comparison, verdicts)
    echo_evidences(found_evidences(traces, verdicts, outcome.maxima))
    until_ess = outcome.orders["until_ess"]
    short = _short_of(until_ess, summaries, verdicts)
    if short:
        click.echo(f"\n--max-draws reached before --until-ess {typed(until_ess)}: {', '.join(short)}")
    click.echo(f"\nWritten to {directory}")
    return 1 if short else 0


def _updated(trace: xr.DataTree) -> list[str] | None:
    """Return a column that says which parameters the data updated, None where that cannot be said."""
    from fmu.analysis.information import COMBINED, DATA, PRIOR, information

    words = {DATA: "yes", PRIOR: "no", COMBINED: "combined"}
    found = information(trace)
    return None if found is None else [words[basis] for basis in found.basis]


def stopped(directory: Path, where: str = "") -> int:
    """Say where a run was stopped, in words, and how to go on with it; return the exit code."""
    click.echo(f"Stopped{where and f': {where}'}. To resume: fmu run --resume {directory}", err=True)
    return STOPPED


def _all(
    outcome: Sampled, asked: KeptProblem, running: RunDirectory, engine: Engine, report: Report | None
) -> str:
    """Put the traces of all samplers into the outcome; return in words where the run was stopped, if it was."""
    for name in dict.fromkeys(outcome.orders["samplers"]):
        stopped = _one(name, outcome, asked, running, engine, report)
        if stopped:
            return stopped
        asked = replace(asked, finished=(*dict.fromkeys((*asked.finished, name)),))
        with shielded():
            running.finished(name, asked)
    return ""


def _one(
    name: str,
    outcome: Sampled,
    asked: KeptProblem,
    running: RunDirectory,
    engine: Engine,
    report: Report | None,
) -> str:
    """Put the trace of one sampler into the outcome; return in words where it was stopped, if it was."""
    from fmu.analysis.convergence.diagnostics import summary
    from fmu.analysis.trace.conversion import load_trace, save_trace

    path = running.path / f"{name}.nc"
    if name in asked.finished:
        trace, stopped = load_trace(path), ""
    else:
        drawn, stopped = _drawn(name, outcome, running, engine, report)
        if drawn is None:
            return stopped
        trace = drawn
        try:
            save_trace(trace, path)
        except OSError as error:
            raise OSError(f"{error}. The draws are saved. To resume: fmu run --resume {running.path}") from error
    if stopped:
        return stopped
    outcome.traces[name], outcome.summaries[name] = trace, summary(trace)
    write_csv(outcome.summaries[name], running.path / f"summary-{name}.csv")
    return ""


def _drawn(
    name: str, outcome: Sampled, running: RunDirectory, engine: Engine, report: Report | None
) -> tuple[xr.DataTree | None, str]:
    """Return the trace of one sampler, and in words where it was stopped, if it was."""
    from fmu.runs import Checkpoint
    from fmu.samplers.loop.run import TooManyFailuresError
    from fmu.sampling import sample

    ledger, orders = running.path / f"failures-{name}.csv", outcome.orders
    try:
        trace = sample(
            outcome.problem,
            name,
            **{key: orders[key] for key in _OF_THE_RUN if not (key == "groups" and name == "emcee")},
            maxima=outcome.maxima,
            checkpoint=Checkpoint(running.of_sampler(name), orders["keep_draws"], orders["keep_seconds"]),
            workers=engine,
            progress=report and labelled(report, name),
        )
    except StoppedRun as stop:
        return stop.trace, f"{name} {stop.where}"
    except TooManyFailuresError as error:
        raise TooManyFailuresError(
            f"{name}: {error}. See {ledger}; to continue regardless: fmu run --resume {running.path} "
            "--max-failure-rate 1",
            error.result,
        ) from None
    except OSError as error:
        raise OSError(f"{error}. To resume: fmu run --resume {running.path}") from error
    finally:
        with suppress(OSError):  # it is with what is kept, anyhow
            running.take_ledger(name, ledger)
    return trace, ""


@contextmanager
def _spread(problem: UpdatingProblem, engine: Engine, groups: int | None) -> Iterator[Engine]:
    """Give the engine that advances groups of chains.

    A Python function is expensive: its single evaluations are spread over the workers, unless groups of chains are
    asked for; and then the chains advance in this process.
    """
    from fmu.engines.base import InProcess

    function = problem.model.black_box
    if engine.workers > 1 and groups is None and function is not None:
        with function.spread_over(engine):
            yield InProcess()
    else:
        yield engine


def _short_of(
    until_ess: float | None, summaries: Mapping[str, pd.DataFrame], verdicts: Mapping[str, Diagnosis]
) -> list[str]:
    """Return the samplers that did not come to the effective sample size with a good verdict."""
    if until_ess is None:
        return []
    from fmu.analysis.convergence.diagnosis import is_enough

    return [name for name, found in verdicts.items() if not is_enough(found, summaries[name], until_ess)]


def _echo_failed_points(name: str, trace: xr.DataTree, directory: Path, problem: UpdatingProblem) -> None:
    """Say how many points inside the bounds had no finite log-probability, if there were any."""
    groups = (trace[group] for group in ("warmup_sample_stats", "sample_stats"))
    failed = sum(int(stats["n_nonfinite"].sum()) for stats in groups if "n_nonfinite" in stats)
    if failed:
        where = f"see {directory / f'failures-{name}.csv'}"
        click.echo(
            f"{name}: {failed} points inside the bounds had no finite log-probability; {where}{_why(problem)}\n",
            err=True,
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
    reasons = problem.model.reasons
    return f"; the function first failed at {reasons[0].theta.tolist()}: {reasons[0].reason}" if reasons else ""
