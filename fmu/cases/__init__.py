"""Built-in problems. Each is a TOML file in this folder, in the same format as a user's problem file."""

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
    """Return the names of the built-in cases.

    Returns
    -------
    tuple of str
        Names that `load`, `describe` and `path` accept.
    """
    return tuple(sorted(file.stem for file in _FOLDER.glob("*.toml")))


@check_arguments
def describe(name: str) -> str:
    """Return a one-line description of a case.

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
    """Return the path to a case's TOML file, which may serve as a template.

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
    """Load a built-in problem.

    Parameters
    ----------
    name : str
        One of `names`.
    pairing : {"shape", "index", "soft"}, optional
        How modes are paired: by MAC ("shape"), by order in the sorted spectrum ("index", as in Boulkaibet et al.,
        `fmu.paper.published`), or by soft assignment ("soft"). Defaults to the setting in the case file.
    beta : float or array_like, shape (n_modes,), optional
        Weights 1/(2 sd²) of the frequency errors, in 1/Hz²; replaces the measurement uncertainty in the case file.
    engine : Engine, optional
        Trains the reduced model with its workers; see `fmu.engine`.

    Returns
    -------
    UpdatingProblem

    Raises
    ------
    ValueError
        If there is no such case or pairing, or `beta` is not positive, or is neither one number nor one value per
        mode.
    """
    from fmu.config import load as load_file

    return load_file(path(name), pairing, beta, engine=engine)
