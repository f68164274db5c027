"""Where a problem comes from: a built-in case or a file."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from fmu.posterior.problem import UpdatingProblem


def source(case: str, pairing: str | None) -> tuple[Callable[..., UpdatingProblem], str, str]:
    """Return what loads a problem, what its directory is called after, and how its modes are paired."""
    if case.endswith(".toml"):
        from fmu import config

        path = Path(case)
        described = config.read(path)
        return partial(described.build, path.name, path.parent), path.stem, pairing or described.pairing
    from fmu import cases as builtin

    if case not in builtin.names():
        known = ", ".join(builtin.names())
        raise click.BadParameter(f"{case!r} is neither one of {known} nor a .toml file.", param_hint="'CASE'")
    return partial(builtin.load, case), case, pairing or "shape"
