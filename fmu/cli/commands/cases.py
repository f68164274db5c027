"""``fmu cases``."""

from __future__ import annotations

import click


@click.command("cases")
def command() -> None:
    """List the built-in problems."""
    from fmu import cases as builtin

    width = max(map(len, builtin.names()))
    for name in builtin.names():
        click.echo(f"{name:{width}}  {builtin.describe(name)}")
