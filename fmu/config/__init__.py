"""Problems from TOML files."""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fmu.config.mistakes import ConfigurationError as ConfigurationError
from fmu.config.mistakes import Mistake, got, of_validation
from fmu.numbers import typed

if TYPE_CHECKING:
    from fmu.config.problem import ProblemFile
    from fmu.engines.engine import Engine
    from fmu.posterior.problem import UpdatingProblem

LARGEST_FILE = 2**23
"""Bytes of a TOML file; large matrices are in files of their own, which are read a hundred times faster."""
SMALLEST_NUMBER, LARGEST_NUMBER = 1e-60, 1e60
"""In SI units: of numbers beyond these products overflow and tell nothing."""


def load(
    path: str | os.PathLike[str], pairing: str | None = None, beta: Any = None, *, engine: Engine | None = None
) -> UpdatingProblem:
    """Return the updating problem that a TOML file describes.

    Parameters
    ----------
    path : path-like
    pairing : {"shape", "index", "soft"}, optional
        Instead of that of the file.
    beta : float or array_like, shape (n_modes,), optional
        Instead of the trust in the data that the file gives, 1/Hz².
    engine : Engine, optional
        Trains the reduced model with its workers, see `fmu.engine`.

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
    return read(path).build(path.name, path.parent, pairing, beta, engine)


def read(path: Path) -> ProblemFile:
    """Return what is in a file, its types and ranges checked; see `load`."""
    from pydantic import ValidationError

    from fmu.config.problem import ProblemFile

    if not path.is_file():
        why = f"{path} is a directory" if path.is_dir() else f"no such file: {path}"
        raise FileNotFoundError(f"path: must be a TOML file ({why})")
    if path.stat().st_size > LARGEST_FILE:
        raise ConfigurationError(path.name, [Mistake("", f"must have at most {LARGEST_FILE} bytes")])
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # of TOML, of its encoding, of a number with thousands of digits
        raise ConfigurationError(path.name, [Mistake("", f"is no TOML: {error}")]) from error
    beyond = list(_out_of_size(content, ()))
    if beyond:
        raise ConfigurationError(path.name, beyond)
    try:
        return ProblemFile.model_validate(content)
    except ValidationError as error:
        raise ConfigurationError(path.name, of_validation(error)) from error


def _out_of_size(value: Any, where: tuple[int | str, ...]) -> Iterator[Mistake]:
    """Give the finite numbers that nothing in SI units is as large or as small as."""
    if isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _out_of_size(inner, (*where, key))
    elif isinstance(value, float | int) and _is_out_of_size(value):
        rule = f"must be 0, or from {typed(SMALLEST_NUMBER)} to {typed(LARGEST_NUMBER)} in size"
        yield Mistake(".".join(map(str, where)), got(rule, value))


def _is_out_of_size(value: float) -> bool:
    is_finite = isinstance(value, int) or math.isfinite(value)
    return value != 0 and is_finite and not SMALLEST_NUMBER <= abs(value) <= LARGEST_NUMBER
