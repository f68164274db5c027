"""The shell's face of the package, a module a command: arguments, progress and files; the work is done elsewhere.

Nothing heavy is imported before a command needs it.
"""

from __future__ import annotations

import click

from fmu.cli.commands import cases, check, compare, export, init, paper, report, run, schema, watch
from fmu.cli.errors import Commands


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="fmu")
def main() -> None:
    """Bayesian finite-element model updating."""


for _module in (init, schema, cases, check, run, watch, compare, report, export, paper):
    main.add_command(_module.command)
