"""Commands for a run's results (``fmu report``, ``damage``, ``predict``, ``export``), and ``fmu paper``."""

from __future__ import annotations

from pathlib import Path

import click

from fmu.cli import damage
from fmu.cli.predict import predict
from fmu.progress import progress_bars

_UPDATED = "updated.toml"


@click.command()
@damage.DIRECTORY
def report(directory: Path) -> None:
    """Write an HTML report on the run in DIRECTORY: report/index.html.

    If there are several samplers, each of them also has a page of its own.
    """
    from fmu.report.pages import write_report

    click.echo(f"Written to {write_report(directory)}")


@click.command()
@damage.DIRECTORY
@damage.SAMPLER
@click.option("--at", type=click.Choice(("mean", "map")), default="mean", show_default=True,
              help="Values to export: the posterior mean, or the highest maximum found.")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Output directory.  [default: DIRECTORY/export]")
@damage.MODEL
def export(directory: Path, sampler: str | None, at: str, out: Path | None, model: Path | None) -> None:
    """Write the updated model of the run in DIRECTORY.

    theta.csv lists the parameter values; updated.toml is the problem file with these values as start values. If
    the model has a stiffness and a mass matrix, they are written to K.mtx and M.mtx, and dofs.csv names their
    rows. If the problem file names templates of input decks, they are filled with the values. With one test and
    known coordinates, the mode shapes are written too.
    """
    from fmu.report.export import export

    written = export(directory, sampler, at, out, model)
    for remark in written.remarks:
        click.echo(f"Warning: {remark}", err=True)
    click.echo(f"Written to {written.directory}: {', '.join(written.files)}")
    if _UPDATED in written.files:
        click.echo(
            f"Next: fmu check {written.directory / _UPDATED} compares the updated model with the measurement."
        )


@click.command()
@click.option("--out", type=click.Path(path_type=Path), default=Path("results"), show_default=True,
              help="Output directory.")  # fmt: skip
def paper(out: Path) -> None:
    """Repeat both experiments of Boulkaibet et al. with mh, slice, hmc, emcee and mixture.

    The paper is "Sampling Techniques in Bayesian Finite Element Model Updating".
    """
    from fmu.paper import run_paper

    with progress_bars() as report:
        run_paper(out, report)
    click.echo(f"Written to {out}")


COMMANDS = (report, *damage.COMMANDS, predict, export, paper)
