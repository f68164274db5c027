"""The steps of ``fmu run``: search for maxima, draw with each sampler, then write and print the results."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from fmu import sampling
from fmu.cli.messages import FAILED
from fmu.cli.surrogate import MAX_SOLVES, exact_draws, may_learn_more
from fmu.cli.tables import echo_comparison, echo_evidences, echo_maxima, echo_summary, echo_verdict
from fmu.durable_files import write_durably
from fmu.interruption import shielded
from fmu.numbers import typed
from fmu.progress import Report, add_label, end_bars
from fmu.runs import Checkpoint

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.analysis.maxima.results import Maxima
    from fmu.config.kept import KeptProblem, Orders
    from fmu.engines.base import Engine
    from fmu.posterior.problem import UpdatingProblem
    from fmu.runs.run_directory import RunDirectory


class Sampled(NamedTuple):
    """A run's results: the maxima, and each sampler's trace with its summary."""

    maxima: Maxima | None
    traces: dict[str, xr.DataTree]
    summaries: dict[str, pd.DataFrame]

    @property
    def limited(self) -> list[str]:
        """Names of the samplers that reached their limit on solves, and can be resumed with a higher limit."""
        return [name for name, trace in self.traces.items() if "limit" in trace.attrs]


def sample_problem(
    problem: UpdatingProblem,
    asked: KeptProblem,
    running: RunDirectory,
    engine: Engine,
    report: Report | None,
    speaks: bool,
) -> Sampled:
    """Sample a problem with every requested sampler, and write each sampler's results.

    A sampler that has already finished is not run again; its trace is read. The maxima are printed as soon as they
    are found, and a sampler's table and verdict as soon as its draws are complete. Certificates and predictions of
    left-out modes need further solves and follow later. If the draws of a surrogate are made exact, the model's
    maxima are printed at the end.

    Raises
    ------
    StoppedRun
        If Ctrl-C or SIGTERM stopped a sampler. The draws made until then are written too.
    TooManyFailuresError
        If a larger fraction of a sampler's solves failed than allowed.
    OSError
        If a file cannot be read or written.
    """
    from fmu.analysis.convergence.diagnosis import maxima_of
    from fmu.analysis.maxima.search import STARTS, default_starts, find_map, is_searchable
    from fmu.analysis.trace.conversion import load_trace
    from fmu.runs.maxima import keep_maxima, kept_maxima
    from fmu.samplers.registry import plan_steps

    with _explain_failure(problem), _spread(problem, engine, asked.orders["groups"]) as workers:
        maxima = kept_maxima(running.folder)  # of another posterior perhaps; the checkpoints then reject it
        if maxima is None and is_searchable(problem):
            starts = asked.orders["starts"] or default_starts(problem)
            if speaks and (sys.stderr.isatty() or starts != STARTS):  # it may take long
                click.echo(f"Searching for posterior maxima from {starts} starts …", err=True)
            maxima = find_map(problem, starts)
            keep_maxima(running.folder, maxima, problem)
        if maxima is not None and not asked.orders.get("exact"):  # the maxima of the model are not known yet
            end_bars(report)
            echo_maxima(maxima)
        outcome = Sampled(maxima, {}, {})
        arguments = _until(asked.orders) | {"maxima": maxima, "workers": workers}
        every = asked.orders["keep_draws"], asked.orders["keep_seconds"]
        draw = sampling.sample
        if asked.orders.get("exact"):
            most = asked.orders["max_solves"]
            draw = partial(exact_draws, most=None if most == MAX_SOLVES else most)
        for name in dict.fromkeys(asked.orders["samplers"]):
            tell_draws = partial(_tell_draws, name, outcome, problem, running, asked.orders, report)
            if name in asked.finished:
                trace = load_trace(running.path / f"{name}.nc")
                tell_draws(trace)
            else:
                checkpoint = Checkpoint(running.of_sampler(name), *every)
                progress = report and add_label(report, name)
                warmup, draws = plan_steps(name, asked.orders["warmup"], asked.orders["draws"])
                arguments |= {"warmup": warmup, "draws": draws, "checkpoint": checkpoint, "progress": progress}
                trace = _draw_trace(draw, name, problem, running, on_draws=tell_draws, **arguments)
            outcome.traces[name] = trace
            if name in outcome.limited:
                asked.save(running.path)
            elif name not in asked.finished:
                asked = replace(asked, finished=(*asked.finished, name))
                with shielded():
                    running.finish_sampler(name, asked)
    end_bars(report)
    if asked.orders.get("exact"):  # the model's maxima, not the surrogate's
        outcome = outcome._replace(maxima=maxima_of(next(iter(outcome.traces.values()))))
        if outcome.maxima is not None:
            echo_maxima(outcome.maxima)
    if outcome.maxima is not None:
        _write_csv(outcome.maxima.table(), running.path / "map.csv")
    return outcome


def _tell_draws(
    name: str,
    outcome: Sampled,
    problem: UpdatingProblem,
    running: RunDirectory,
    orders: Orders,
    report: Report | None,
    trace: xr.DataTree,
) -> None:
    """Print and write the summary of a sampler's draws, and print its verdict.

    If a limit ended the sampler, also print how to continue, unless the surrogate must learn from more solves
    first. The verdict does not yet include a comparison with samplers that have not finished.
    """
    from fmu.analysis.convergence.diagnosis import diagnose_all
    from fmu.analysis.convergence.diagnostics import summary

    table = outcome.summaries[name] = summary(trace)
    _write_csv(table, running.path / f"summary-{name}.csv")
    end_bars(report)
    echo_summary(name, trace, table)
    _echo_failed_points(name, trace, running.path, problem)
    echo_verdict(name, diagnose_all({**outcome.traces, name: trace}, summaries=outcome.summaries)[name])
    if "limit" in trace.attrs and (_is_certified(problem, orders) or not may_learn_more(problem, orders)):
        most, until = _limit(orders), orders["until_ess"]
        if orders.get("exact"):
            most = int(trace.attrs["warmup_n_solves"]) + int(trace.attrs["n_solves"])
        aim = f"--until-ess {typed(until)}" if until else "convergence"
        click.echo(f"\n--max-solves {most} reached before {aim}: {name}")
        click.echo(f"To continue: fmu run --resume {running.path} --max-solves {10 * most}")
    click.echo()


def _is_certified(problem: UpdatingProblem, orders: Orders) -> bool:
    """Return True if the model has no surrogate or a certified one, or if the draws are made exact."""
    certificate = problem.model.certificate
    return certificate is None or bool(orders.get("exact")) or certificate.ok


def _until(orders: Orders) -> dict[str, object]:
    """Return a run's arguments for `fmu.sample`. They include stopping criteria unless `draws` is given."""
    from fmu.analysis.convergence.remedies import ESS_LIMIT

    arguments = {key: order for key, order in orders.items() if key in sampling.DEFAULTS}
    if orders["draws"] is None:
        return arguments | {"max_solves": _limit(orders), "until_ess": max(orders["until_ess"] or 0.0, ESS_LIMIT)}
    return arguments | {"max_solves": None}


def _limit(orders: Orders) -> int:
    """Return the limit on a sampler's solves.

    With a surrogate, whose solves are fast, it is at least the default limit.
    """
    return max(orders["max_solves"], MAX_SOLVES if orders.get("surrogate") else 0)


def _draw_trace(
    draw: Callable[..., xr.DataTree],
    name: str,
    problem: UpdatingProblem,
    running: RunDirectory,
    **arguments: object,
) -> xr.DataTree:
    """Draw with one sampler, write the trace and the list of failed solves, and return the trace.

    If the sampler is stopped, the draws made until then are written. The error names the sampler, both in this
    case and if too many solves fail. An OSError says how to resume the run.
    """
    from fmu.samplers.loop.saving import TooManyFailuresError
    from fmu.samplers.registry import make_sampler

    ledger, path = running.path / f"failures-{name}.csv", running.path / f"{name}.nc"
    if make_sampler(name).walkers > 1:  # each ensemble is a group
        del arguments["groups"]
    resume = f"To resume: fmu run --resume {running.path}"
    try:
        trace = draw(problem, name, **arguments)
    except sampling.StoppedRun as stop:
        if stop.trace is not None:
            _save(stop.trace, path, resume)
        raise sampling.StoppedRun(f"{name} {stop.where}", stop.trace) from None
    except TooManyFailuresError as error:
        raise TooManyFailuresError(
            f"{name}: {error}. See {ledger}; to continue regardless: fmu run --resume {running.path} "
            "--max-failure-rate 1",
            error.result,
        ) from None
    except OSError as error:
        raise OSError(f"{error}. {resume}") from error
    finally:
        with suppress(OSError):  # the failures are in the checkpoint, too
            running.take_ledger(name, ledger)
    _save(trace, path, resume)
    return trace


def _save(trace: xr.DataTree, path: Path, resume: str) -> None:
    from fmu.analysis.trace.conversion import save_trace

    try:
        save_trace(trace, path)
    except OSError as error:
        raise OSError(f"{error}. The draws are saved. {resume}") from error


def _write_csv(table: pd.DataFrame, path: Path) -> None:
    write_durably(path, table.to_csv().encode())


def tell(outcome: Sampled, problem: UpdatingProblem, directory: Path, orders: Orders) -> int:
    """Print the comparison, losses, evidences and certificates; write the comparison; return the exit code.

    The code is 0 if the number of draws was given, or all samplers and the surrogate meet their criteria.
    """
    from fmu.analysis.certificate import exact_in_words
    from fmu.analysis.convergence.diagnosis import choose_run, is_enough
    from fmu.analysis.evidence import found_evidences
    from fmu.analysis.trace.reading import LOSSES, has
    from fmu.cli.damage import echo_losses
    from fmu.surrogates.learning import certificate_of

    _, traces, summaries = outcome
    comparison, verdicts = echo_comparison(traces, summaries, with_verdicts=len(traces) > 1)
    _write_csv(comparison, directory / "comparison.csv")
    told = choose_run(verdicts, summaries)
    if has(traces[told], LOSSES):
        click.echo()
        echo_losses(traces[told], verdicts[told])
        click.echo(f"A picture, and other limits: fmu damage {directory}")
    echo_evidences(found_evidences(traces, verdicts, outcome.maxima))
    is_certified = _is_certified(problem, orders)
    certificate = problem.model.certificate
    if certificate is not None:
        click.echo("\nCertificate of the surrogate\n" + "\n".join(certificate.sentences()))
        if not is_certified and may_learn_more(problem, orders):
            more = 2 * certificate_of(problem).solves
            click.echo(f"To learn from more solves: fmu run --resume {directory} --max-solves {more}")
    for name, trace in traces.items() if orders.get("exact") else ():
        click.echo("\n" + " ".join([f"{name}:", *exact_in_words(trace.attrs)]))
    click.echo(f"\nWritten to {directory}")
    if verdicts[told].converged:
        click.echo(f"Next: fmu export {directory} writes the updated values and model.")
    if orders["draws"] is not None:
        return 0
    least = orders["until_ess"] or 0.0
    converged = all(is_enough(one, summaries[name], least) for name, one in verdicts.items())
    return 0 if converged and is_certified else FAILED


def _echo_failed_points(name: str, trace: xr.DataTree, directory: Path, problem: UpdatingProblem) -> None:
    """Print the number of points inside the bounds without a finite log-probability, unless it is zero."""
    groups = (trace[group] for group in ("warmup_sample_stats", "sample_stats"))
    failed = sum(int(stats["n_nonfinite"].sum()) for stats in groups if "n_nonfinite" in stats)
    if failed:
        where = f"see {directory / f'failures-{name}.csv'}"
        click.echo(
            f"{name}: {failed} points inside the bounds had no finite log-probability; {where}{_why(problem)}\n",
            err=True,
        )


@contextmanager
def _spread(problem: UpdatingProblem, engine: Engine, groups: int | None) -> Iterator[Engine]:
    """Yield the engine that advances the groups of chains.

    If the model calls a user's function or an external program, each call is expensive. The workers then share the
    evaluations in each step, and the chains advance in this process, unless groups are requested.
    """
    from fmu.engines.base import InProcess

    if engine.workers > 1 and groups is None and problem.model.functions:
        with problem.model.spread_over(engine):
            yield InProcess()
    else:
        yield engine


@contextmanager
def _explain_failure(problem: UpdatingProblem) -> Iterator[None]:
    """Within a ``with`` block, append the user function's first failure, if any, to a ValueError's message."""
    try:
        yield
    except ValueError as error:
        why = _why(problem)
        if not why:
            raise
        raise ValueError(f"{error}{why}") from error


def _why(problem: UpdatingProblem) -> str:
    """Return a description of the user function's first failure, or an empty string if there is none."""
    reasons = problem.model.reasons
    return f"; the function first failed at {reasons[0].theta.tolist()}: {reasons[0].reason}" if reasons else ""
