"""``fmu paper``."""

from __future__ import annotations

from pathlib import Path

import click

from fmu.progress import progress_bars


@click.command("paper")
@click.option("--out", type=click.Path(path_type=Path), default=Path("results"), show_default=True,
              help="Output directory.")  # fmt: skip
def command(out: Path) -> None:
    """Repeat both experiments of the paper with every sampler."""
    from fmu.paper import run_paper

    with progress_bars() as report:
        run_paper(out, report)
    click.echo(f"Written to {out}")
