"""Where a problem comes from: a built-in case or a file."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

if TYPE_CHECKING:
    from fmu.engines.base import Engine
    from fmu.posterior.problem import UpdatingProblem


class Source(NamedTuple):
    """A file with a problem.

    Attributes
    ----------
    path : Path
    stem : str
        What directories are called after.
    pairing : str
        How its modes are paired: as asked for, or as the file says.
    load : callable
        Returns the problem; an engine, if one is given, trains its reduced model where that may take long.
    """

    path: Path
    stem: str
    pairing: str
    load: Callable[..., UpdatingProblem]


def source(case: str, pairing: str | None) -> Source:
    """Return the file of a built-in case or of a user, read but not built.

    Raises
    ------
    click.BadParameter
        If `case` is neither.
    ConfigurationError
        If the file is broken.
    FileNotFoundError
        If there is no such file.
    """
    if case.endswith(".toml"):
        from fmu import config

        path = Path(case)
        described = config.read(path)
        by = pairing or described.pairing

        def load(engine: Engine | None = None) -> UpdatingProblem:
            if sys.stderr.isatty():  # a large structure takes minutes, once
                click.echo(f"Preparing {path} …", err=True)
            return described.build(path.name, path.parent, by, engine=engine)

        return Source(path, path.stem, by, load)
    from fmu import cases as builtin

    if case not in builtin.names():
        known = ", ".join(builtin.names())
        raise click.BadParameter(
            f"{case!r} is neither a built-in problem ({known}) nor a .toml file.", param_hint="'CASE'"
        )
    from fmu import config

    path = builtin.path(case)
    by = pairing or config.read(path).pairing
    return Source(path, case, by, lambda engine=None: builtin.load(case, pairing=by))
