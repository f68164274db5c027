"""The shell commands. They read arguments and write tables and files; the rest of fmu does the computation.

Reading order: `run`, then `sampled`, which it calls; `compare`, `problems`, `results` and `watch` are the other
commands. Large libraries are imported only when a command needs them.
"""

from __future__ import annotations

import click

from fmu.cli import compare, problems, results, run, watch
from fmu.cli.messages import Commands


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="fmu")
def main() -> None:
    """Bayesian finite-element model updating."""


for _command in (*problems.COMMANDS, run.run, compare.compare, watch.watch, *results.COMMANDS):
    main.add_command(_command)
