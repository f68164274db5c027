"""``fmu report``."""

from __future__ import annotations

from pathlib import Path

import click


@click.command("report")
@click.argument("directory", type=click.Path(path_type=Path, exists=True, file_okay=False))
def command(directory: Path) -> None:
    """Write an HTML report on the run in DIRECTORY: report/index.html and one page per sampler."""
    from fmu.report.pages import write_report

    click.echo(f"Written to {write_report(directory)}")
