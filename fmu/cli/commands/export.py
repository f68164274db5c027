"""``fmu export``."""

from __future__ import annotations

from pathlib import Path

import click


@click.command("export")
@click.argument("directory", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--sampler", help="Whose draws.  [default: the first that converged]")
@click.option("--at", type=click.Choice(("mean", "map")), default="mean", show_default=True,
              help="The posterior mean, or the highest maximum found.")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path), help="Directory to write.  [default: DIRECTORY/export]")
@click.option("--model", type=click.Path(path_type=Path, exists=True, dir_okay=False),
              help="The problem's file, where the files that it names have moved.")  # fmt: skip
def command(directory: Path, sampler: str | None, at: str, out: Path | None, model: Path | None) -> None:
    """Write the updated model of the run in DIRECTORY, to take back to where it came from.

    theta.csv has the values, updated.toml is the problem file with them as its start; of a structure given by
    matrices also K.mtx, M.mtx and what their rows are, dofs.csv.
    """
    from fmu.report.export import export

    written = export(directory, sampler, at, out, model)
    for remark in written.remarks:
        click.echo(f"Warning: {remark}", err=True)
    click.echo(f"Written to {written.directory}: {', '.join(written.files)}")
