"""``fmu init``."""

from __future__ import annotations

from pathlib import Path

import click

from fmu.config.template import KINDS, files, template, write_template


@click.command("init")
@click.argument("kind", type=click.Choice(KINDS))
@click.argument("directory", type=click.Path(path_type=Path, file_okay=False), required=False)
def command(kind: str, directory: Path | None) -> None:
    """Write a commented template of a problem file, ready to run.

    KIND is the type of model: a frame of beams, matrices from a finite-element program, or a Python function. The
    file is printed (fmu init frame > beam.toml), or written to DIRECTORY together with the files that it needs.
    Existing files are never replaced.
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
