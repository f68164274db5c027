"""``fmu init``."""

from __future__ import annotations

from pathlib import Path

import click

from fmu.config.template import KINDS, files, template, write_template


@click.command("init")
@click.argument("kind", type=click.Choice(KINDS))
@click.argument("directory", type=click.Path(path_type=Path, file_okay=False), required=False)
def command(kind: str, directory: Path | None) -> None:
    """Start a problem file: a commented template that runs as it stands.

    KIND is what the model is: a frame of beams, matrices of a finite-element program, or a Python function. The
    file is printed (fmu init frame > beam.toml), or written to DIRECTORY together with the files that it names.
    Existing files are never replaced.
    """
    if directory is not None:
        click.echo(f"Written to {write_template(kind, directory)}")
        return
    click.echo(template(kind), nl=False)
    beside = files(kind)[1:]
    if beside:
        click.echo(
            f"This file needs {', '.join(beside)} beside it: fmu init {kind} DIRECTORY writes all of them.",
            err=True,
        )
