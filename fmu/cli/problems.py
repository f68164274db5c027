"""Commands for problem files (`cases`, `init`, `schema`, `check` and `plan`), and functions that load problems."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fmu import cases as builtin
from fmu import config
from fmu.arguments import ArgumentError
from fmu.cli.messages import warnings_as_notes
from fmu.cli.output import make_writable
from fmu.config.kept import KeptProblem
from fmu.config.template import KINDS, files, template, write_template
from fmu.progress.phases import progress_lines

if TYPE_CHECKING:
    from fmu.engines.base import Engine
    from fmu.posterior.problem import UpdatingProblem


def pairing_option[Command: Callable[..., object]](command: Command) -> Command:
    """Add the option ``--pairing`` to a command."""
    text = (
        "How computed modes are paired with measured ones: by shape, by number in the spectrum, or softly by "
        "shape (no jumps).  [default: as in the file]"
    )
    return click.option("--pairing", type=click.Choice(("shape", "index", "soft")), help=text)(command)


def problem_of(case: str, pairing: str | None) -> KeptProblem:
    """Return the problem file of a built-in case or at a path. The problem is not built yet.

    `pairing` replaces the file's pairing, unless it is None.

    Raises
    ------
    click.BadParameter
        If `case` is neither a built-in case nor the name of a ``.toml`` file.
    ConfigurationError
        If the file is invalid.
    FileNotFoundError
        If there is no such file.
    """
    if not case.endswith(".toml") and case not in builtin.names():
        known = ", ".join(builtin.names())
        raise click.BadParameter(
            f"{case!r} is neither a built-in problem ({known}) nor a .toml file.", param_hint="'CASE'"
        )
    path = Path(case) if case.endswith(".toml") else builtin.path(case)
    with warnings_as_notes():
        found = config.read(path)
    return KeptProblem(path, path.parent, pairing or found.pairing)


def build_problem(problem: KeptProblem, engine: Engine | None = None) -> UpdatingProblem:
    """Build the problem from its file. If an engine is given, its workers train the reduced model.

    A message is printed first if standard error is a terminal.
    """
    if sys.stderr.isatty():  # a large structure takes minutes, once
        click.echo(f"Preparing {problem.file.name} …", err=True)
    return problem.load(engine)


@click.command()
def cases() -> None:
    """List the built-in problems."""
    width = max(map(len, builtin.names()))
    for name in builtin.names():
        click.echo(f"{name:{width}}  {builtin.describe(name)}")


@click.command()
@click.argument("kind", type=click.Choice(KINDS))
@click.argument("directory", type=click.Path(path_type=Path, file_okay=False), required=False)
def init(kind: str, directory: Path | None) -> None:
    """Write a commented template of a problem file, ready to run.

    KIND is the type of model: a frame of beams, matrices from a finite-element program, matrices that such a
    program exports at several values of the parameters (exports), a command that runs such a program (command for
    CalculiX, nastran for Nastran), a model in OpenSees, or a Python function. The template is printed (fmu init
    frame > beam.toml), or written to DIRECTORY with the files that it needs; existing files are never replaced.
    """
    if directory is not None:
        click.echo(f"Written to {write_template(kind, directory)}")
        return
    click.echo(template(kind), nl=False)
    beside = files(kind)[1:]
    if beside:
        click.echo(
            f"This file needs {', '.join(beside)} in the same directory; fmu init {kind} DIRECTORY writes all "
            f"of them.",
            err=True,
        )


@click.command()
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="Output file.  [default: print]")
def schema(out: Path | None) -> None:
    """Print the JSON schema of problem files, for editors.

    An editor with Taplo (Even Better TOML) completes and checks files whose first line is
    #:schema ./fmu.schema.json
    """
    from fmu.config.problem import schema

    text = json.dumps(schema(), indent=2, ensure_ascii=False) + "\n"
    if out is None:
        click.echo(text, nl=False)
        return
    out.write_text(text, encoding="utf-8")
    click.echo(f"Written to {out}")


@click.command()
@click.argument("case")
@pairing_option
@click.option("--draws", type=click.IntRange(min=2), default=200, show_default=True,
              help="Prior draws at which the model is solved. Use fewer if the model is slow.")  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True,
              help="Seed of the random numbers.")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Output directory.  [default: check/CASE]")
def check(case: str, pairing: str | None, draws: int, seed: int, out: Path | None) -> None:
    """Check CASE before sampling: a built-in problem, or a TOML file.

    Describes the model, pairs its modes with the measured ones, tests the gradient, and shows which parameters the
    data can identify and whether the prior covers the data. Writes a page with a drawing of the structure
    (index.html).
    """
    with progress_lines(f"checking {case}"):
        asked = problem_of(case, pairing)
        from fmu.analysis.start.check import check
        from fmu.report.check_page import write_check

        directory = out or Path("check") / asked.file.stem
        with warnings_as_notes():
            problem = build_problem(asked)
        make_writable(directory)
        found = check(problem, draws, seed)
        page = write_check(found, directory)
    click.echo(found)
    click.echo(f"\nWritten to {page}")
    first = "Look into the warnings first. " if found.doubts else ""
    option = "" if pairing is None else f" --pairing {pairing}"
    click.echo(f"Next: {first}fmu run {case}{option} samples the posterior.")


@click.command()
@click.argument("case")
@click.option("--sensors", type=click.IntRange(min=1), help="Number of sensors.  [default: as in the file, or 12]")
@click.option("--run", "run_directory", type=click.Path(path_type=Path, exists=True, file_okay=False),
              help="Directory of a run of CASE, whose posterior takes the place of the prior.")  # fmt: skip
@click.option("--draws", type=click.IntRange(min=2), default=32, show_default=True,
              help="Draws at which the model is linearised. Use fewer if the model is slow.")  # fmt: skip
@click.option("--tests", type=click.IntRange(min=0), default=0, show_default=True,
              help="Simulated tests that are updated with, to check the expected accuracy.")  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True,
              help="Seed of the random numbers.")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Output directory.  [default: plan/CASE]")
def plan(
    case: str,
    sensors: int | None,
    run_directory: Path | None,
    draws: int,
    tests: int,
    seed: int,
    out: Path | None,
) -> None:
    """Plan a modal test of CASE: a built-in problem, or a TOML file.

    Chooses the sensors that reduce the uncertainty of the parameters most, and says what they are expected to
    reveal. A file with a table [plan] needs no measurement. Writes a page (index.html), the sensors as CSV and as
    a universal file, and a table [measurement] to be filled in.
    """
    with progress_lines(f"planning {case}"):
        asked = problem_of(case, None)
        from fmu.analysis.plan.plan import plan as plan_test
        from fmu.report.export import read_choice
        from fmu.report.plan.files import write_plan
        from fmu.sampling.simulated_tests import simulate_plan

        directory = out or Path("plan") / asked.file.stem
        with warnings_as_notes():
            file = config.read(asked.file)
            problem = file.build(asked.file.name, asked.folder, planning=True)
            options = file.plan_options(asked.file.name, asked.folder)
            options |= {} if sensors is None else {"sensors": sensors}
            trace = None if run_directory is None else read_choice(run_directory, None)[1]
            make_writable(directory)
            try:
                found = plan_test(problem, **options, trace=trace, draws=draws, seed=seed)
            except ArgumentError as error:
                if sensors is not None:
                    error = error.replace_key("sensors", "--sensors")
                raise error if file.plan is None else file.plan.locate(error) from None
            simulated = simulate_plan(found, tests, seed=seed) if tests else None
        page = write_plan(found, directory, simulated)
    click.echo(found)
    if simulated is not None:
        click.echo(f"\n{simulated}")
    click.echo(f"\nWritten to {page}")


COMMANDS = (cases, init, schema, check, plan)
