"""``fmu check``."""

from __future__ import annotations

from pathlib import Path

import click

from fmu.cli.notes import warnings_as_notes
from fmu.cli.output import make_writable
from fmu.cli.source import source


@click.command("check")
@click.argument("case")
@click.option("--pairing", type=click.Choice(("shape", "index", "soft")),
              help="Pair computed with measured modes by shape, by number in the spectrum, or softly by shape, "
              "without jumps.  [default: what the file says]")  # fmt: skip
@click.option("--draws", type=click.IntRange(min=2), default=200, show_default=True,
              help="Draws from the prior at which the model is solved; fewer where a solve is slow.")  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="Directory to write.  [default: check/CASE]")
def command(case: str, pairing: str | None, draws: int, seed: int, out: Path | None) -> None:
    """Look at CASE before sampling it: a built-in problem, or one that a TOML file describes.

    Says what the model is, which of its modes answer to the measured ones, whether its gradient is right, what the
    data can tell of the parameters, and whether the prior expects the data. Draws the structure: index.html.
    """
    problem_of = source(case, pairing)
    from fmu.analysis.check import check
    from fmu.report.check_page import write_check

    directory = out or Path("check") / problem_of.stem
    with warnings_as_notes():
        problem = problem_of.load()
    make_writable(directory)
    found = check(problem, draws, seed)
    click.echo(found)
    page = write_check(found, directory)
    click.echo(f"\nWritten to {page}")
