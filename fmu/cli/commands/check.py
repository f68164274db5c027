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
              help="How computed modes are paired with measured ones: by shape, by number in the spectrum, or "
                   "softly by shape (no jumps).  [default: as in the file]")  # fmt: skip
@click.option("--draws", type=click.IntRange(min=2), default=200, show_default=True,
              help="Prior draws at which the model is solved. Use fewer if the model is slow.")  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="Output directory.  [default: check/CASE]")
def command(case: str, pairing: str | None, draws: int, seed: int, out: Path | None) -> None:
    """Check CASE before sampling: a built-in problem, or a TOML file.

    Describes the model, pairs its modes with the measured ones, tests the gradient, and shows which parameters the
    data can identify and whether the prior covers the data. Writes a page with a drawing of the structure
    (index.html).
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
