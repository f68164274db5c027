"""Problems from TOML files."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fmu.config.mistakes import ConfigurationError as ConfigurationError
from fmu.config.mistakes import Mistake, of_validation

if TYPE_CHECKING:
    from fmu.config.problem import ProblemFile
    from fmu.posterior.problem import UpdatingProblem

LARGEST_FILE = 2**26
"""Bytes of a TOML file."""


def load(path: str | os.PathLike[str], pairing: str | None = None, beta: Any = None) -> UpdatingProblem:
    """Return the updating problem that a TOML file describes.

    Parameters
    ----------
    path : path-like
    pairing : {"shape", "index", "soft"}, optional
        Instead of that of the file.
    beta : float or array_like, shape (n_modes,), optional
        Instead of the trust in the data that the file gives, 1/Hz².

    Returns
    -------
    UpdatingProblem

    Raises
    ------
    ConfigurationError
        With every mistake in the file, its place, the rule and the value received; a ValueError.
    FileNotFoundError
        If there is no such file.
    """
    path = Path(path)
    return read(path).build(path.name, path.parent, pairing, beta)


def read(path: Path) -> ProblemFile:
    """Return what is in a file, its types and ranges checked; see `load`."""
    from pydantic import ValidationError

    from fmu.config.problem import ProblemFile

    if not path.is_file():
        raise FileNotFoundError(f"path: must be a TOML file (no such file: {path})")
    if path.stat().st_size > LARGEST_FILE:
        raise ConfigurationError(path.name, [Mistake("", f"must have at most {LARGEST_FILE} bytes")])
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigurationError(path.name, [Mistake("", f"is no TOML: {error}")]) from error
    try:
        return ProblemFile.model_validate(content)
    except ValidationError as error:
        raise ConfigurationError(path.name, of_validation(error)) from error
