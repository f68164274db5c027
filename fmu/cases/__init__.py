"""Built-in problems: each is a TOML file of this folder, as a user would write it."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from annotated_types import Gt

from fmu.arguments import ArgumentError, check_arguments

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from fmu.engines.base import Engine
    from fmu.posterior.problem import UpdatingProblem

__all__ = ["describe", "load", "names", "path"]

_FOLDER = Path(__file__).parent


def names() -> tuple[str, ...]:
    """List the built-in cases.

    Returns
    -------
    tuple of str
        What `load`, `describe` and `path` take.
    """
    return tuple(sorted(file.stem for file in _FOLDER.glob("*.toml")))


@check_arguments
def describe(name: str) -> str:
    """Say in one line what a case is.

    Parameters
    ----------
    name : str
        One of `names`.

    Returns
    -------
    str

    Raises
    ------
    ValueError
        If there is no such case.
    """
    return str(tomllib.loads(path(name).read_text(encoding="utf-8"))["description"])


@check_arguments
def path(name: str) -> Path:
    """Return the path of a case's TOML file, which may serve as a template.

    Parameters
    ----------
    name : str
        One of `names`.

    Returns
    -------
    pathlib.Path

    Raises
    ------
    ValueError
        If there is no such case.
    """
    if name not in names():
        raise ArgumentError("case", f"must be one of {', '.join(names())}", repr(name))
    return _FOLDER / f"{name}.toml"


@check_arguments
def load(
    name: str,
    pairing: str | None = None,
    beta: Annotated[ArrayLike, Gt(0.0)] | None = None,
    *,
    engine: Engine | None = None,
) -> UpdatingProblem:
    """Return a built-in problem.

    Parameters
    ----------
    name : str
        One of `names`.
    pairing : {"shape", "index", "soft"}, optional
        By MAC, by number in the sorted spectrum as in the paper, or softly; as its file says if not given.
    beta : float or array_like, shape (n_modes,), optional
        Weight of a squared frequency error, 1/Hz², instead of the trust in the data that the file gives.
    engine : Engine, optional
        Trains the reduced model with its workers; see `fmu.engine`.

    Returns
    -------
    UpdatingProblem

    Raises
    ------
    ValueError
        If there is no such case or pairing, or `beta` is not positive.
    """
    from fmu.config import load as load_file

    return load_file(path(name), pairing, beta, engine=engine)
