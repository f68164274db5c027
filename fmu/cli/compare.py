"""The command ``fmu compare``, which compares several samplers on one problem, or the samplers in one run."""

from __future__ import annotations

from pathlib import Path

import click

from fmu.cli.run import run
from fmu.cli.tables import echo_comparison, echo_models
from fmu.config.variants import VARIANTS
from fmu.samplers.registry import COMPARED

MAX_SOLVES = 300_000
"""Default limit on solves, enough for emcee to pass its own tests on the built-in cantilevers."""
_LIKE_RUN = {"pairing", "seed", "overwrite", "chains", "starts", "workers", "progress", "reports"}


def _as_in_run(command: click.Command) -> click.Command:
    """Add the options of ``fmu run`` that are named in `_LIKE_RUN` to a command."""
    command.params += [option for option in run.params if option.name in _LIKE_RUN]
    return command


@_as_in_run
@click.command()
@click.argument("case", metavar="CASE|FILE|RUN")
@click.option("--max-solves", type=click.IntRange(min=1), default=MAX_SOLVES, show_default=True, metavar="N",
              help="About how many solves a sampler may take, warm-up included.")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Output directory.  [default: compare/CASE-PAIRING]")
@click.pass_context
def compare(context: click.Context, case: str, out: Path | None, pairing: str | None, **orders: object) -> int:
    """Compare samplers on one problem, with emcee as the baseline.

    For a built-in problem or a TOML file, searches for the maxima and then runs mh, slice, hmc, emcee and mixture.
    Each sampler runs until it has converged, or has taken about --max-solves solves. To converge, it needs R-hat
    below 1.01, and bulk and tail ESS of at least 400 for every parameter (100 per chain, if there are more than
    four chains). emcee also needs a run of 50 autocorrelation times. Writes the same files as fmu run, into
    compare/CASE-PAIRING. For the directory of a run, compares the traces in it; for a directory written by fmu run
    --discrepancy all, compares the discrepancies.
    """
    if Path(case).is_dir():
        _compare_run(Path(case))
        return 0
    from fmu.cli.problems import problem_of

    problem = problem_of(case, pairing)
    directory = out or Path("compare") / f"{problem.file.stem}-{problem.pairing}"
    return int(context.invoke(run, case=case, out=directory, pairing=pairing, samplers=COMPARED, **orders))


def _compare_run(directory: Path) -> None:
    from fmu.analysis.convergence.diagnostics import summary
    from fmu.analysis.trace.conversion import load_traces
    from fmu.runs.words import why_no_traces

    if any((directory / kind).is_dir() for kind in VARIANTS):
        echo_models(directory)
        return
    traces = load_traces(directory)
    if not traces:
        raise click.BadParameter(f"{why_no_traces(directory)}.", param_hint="'CASE|FILE|RUN'")
    problems = {trace.attrs["problem"] for trace in traces.values()}
    if len(problems) > 1:
        raise click.BadParameter(f"{directory} contains runs of different problems: "
                                 f"{', '.join(sorted(problems))}.",
                                 param_hint="'CASE|FILE|RUN'")  # fmt: skip
    echo_comparison(traces, {name: summary(trace) for name, trace in traces.items()})
