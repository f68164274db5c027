"""``fmu export``."""

from __future__ import annotations

from pathlib import Path

import click


@click.command("export")
@click.argument("directory", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--sampler", help="Sampler whose draws are used.  [default: the first that converged]")
@click.option("--at", type=click.Choice(("mean", "map")), default="mean", show_default=True,
              help="Posterior mean, or highest maximum found.")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Output directory.  [default: DIRECTORY/export]")
@click.option("--model", type=click.Path(path_type=Path, exists=True, dir_okay=False),
              help="Problem file, if the files it refers to have moved.")  # fmt: skip
def command(directory: Path, sampler: str | None, at: str, out: Path | None, model: Path | None) -> None:
    """Write the updated model of the run in DIRECTORY.

    theta.csv lists the parameter values; updated.toml is the problem file with these values as start values. For a
    structure given by matrices, K.mtx and M.mtx are written too, and dofs.csv, which names their rows.
    """
    from fmu.report.export import export

    written = export(directory, sampler, at, out, model)
    for remark in written.remarks:
        click.echo(f"Warning: {remark}", err=True)
    click.echo(f"Written to {written.directory}: {', '.join(written.files)}")
