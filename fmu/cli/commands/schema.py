"""``fmu schema``."""

from __future__ import annotations

import json
from pathlib import Path

import click


@click.command("schema")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="Output file.  [default: print]")
def command(out: Path | None) -> None:
    """Print the JSON schema of problem files, for editors.

    An editor with Taplo (Even Better TOML) completes and checks files whose first line is
    #:schema ./fmu.schema.json
    """
    from fmu.config.schema import schema

    text = json.dumps(schema(), indent=2, ensure_ascii=False) + "\n"
    if out is None:
        click.echo(text, nl=False)
        return
    out.write_text(text, encoding="utf-8")
    click.echo(f"Written to {out}")
