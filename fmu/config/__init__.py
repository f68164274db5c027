"""Read updating problems from TOML files.

Reading order: tables, problem; then a module for each table of the file: models/, parameters, measurement, errors.
"""

from __future__ import annotations

import math
import os
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from annotated_types import Gt

from fmu.arguments import ArgumentError, check_arguments, with_present_names
from fmu.config.mistakes import ConfigurationError as ConfigurationError
from fmu.config.mistakes import of_validation, place
from fmu.formats.files import why_no_file
from fmu.formats.shown import quote
from fmu.numbers import typed
from fmu.plain_data import list_in, mapping_in, number_in

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from fmu.config.problem import ProblemFile
    from fmu.engines.base import Engine
    from fmu.posterior.problem import UpdatingProblem

LARGEST_FILE = 2**21
"""Largest TOML file size in bytes. Large matrices belong in separate files, which are read a hundred times
faster."""
DEEPEST_KEY, DEEPEST = 6, 12
"""Largest number of parts in a dotted key, and of nested table or list levels. No problem needs half of these."""
SMALLEST_NUMBER, LARGEST_NUMBER = 1e-60, 1e60
"""Limits on a number's absolute value in SI units; beyond them products or reciprocals would overflow."""
_PART = r"""(?:[\w-]+|"(?:[^"\\\n]|\\.){0,200}"|'[^'\n]{0,200}')"""
_KEY = rf"(?:^|[{{,])[ \t]*\[{{0,2}}[ \t]*{_PART}(?:[ \t]*\.[ \t]*{_PART})"
_LONG_KEY = re.compile(rf"(?m)(?a:{_KEY}{{{DEEPEST_KEY},}}+[ \t]*[=\]]|{_KEY}{{{8 * DEEPEST_KEY},}}+)")
"""Pattern of a key with too many parts. Text not followed by ``=`` or ``]`` may have eight times as many."""


@check_arguments
def load(
    path: str | os.PathLike[str],
    pairing: str | None = None,
    beta: Annotated[ArrayLike, Gt(0.0)] | None = None,
    *,
    engine: Engine | None = None,
) -> UpdatingProblem:
    """Load an updating problem from a TOML file.

    Parameters
    ----------
    path : path-like
        The TOML file.
    pairing : {"shape", "index", "soft"}, optional
        How modes are paired: by MAC ("shape"), by order in the sorted spectrum ("index"), or by soft assignment
        ("soft"). Defaults to the setting in the file.
    beta : float or array_like, shape (n_modes,), optional
        Weights 1/(2 sd²) of the frequency errors, in 1/Hz²; replaces the measurement uncertainty in the file.
    engine : Engine, optional
        Trains the reduced model with its workers; see `fmu.engine`.

    Returns
    -------
    UpdatingProblem

    Raises
    ------
    ConfigurationError
        If the file has errors, or `pairing` or `beta` does not fit the problem. It is a ValueError that lists each
        error's location, the rule, and the value received.
    FileNotFoundError
        If there is no such file, or it cannot be read.
    ValueError
        If `beta` is not positive.
    """
    path = Path(path)
    return read(path).build(path.name, path.parent, pairing, beta, engine)


def read(path: Path) -> ProblemFile:
    """Return a problem file with the types and ranges of its values checked. Raise the same errors as `load`.

    Old names of keys in ``[[error]]`` are replaced by the present names, with a warning.
    """
    from pydantic import ValidationError

    from fmu.config.problem import ProblemFile
    from fmu.posterior.errors.noise import OLD_NAMES

    why = why_no_file(path)
    if why:
        raise FileNotFoundError(f"path: must be a TOML file ({why})")
    try:
        content = _parse_toml(path)
    except ValueError as error:
        raise ConfigurationError(path.name, [ArgumentError("", str(error))]) from error
    beyond = list(_out_of_size(content))
    if beyond:
        raise ConfigurationError(path.name, beyond)
    tables = list_in(content.get("error"))
    if tables is not None:
        content["error"] = [
            one if mapping_in(one) is None else with_present_names(one, OLD_NAMES) for one in tables
        ]
    try:
        return ProblemFile.model_validate(content)
    except ValidationError as error:
        raise ConfigurationError(path.name, of_validation(error)) from error


def _parse_toml(path: Path) -> dict[str, object]:
    """Parse a TOML file into a dict. Raise ValueError if the file is invalid, too large or too deeply nested.

    Dotted keys with too many parts are refused before parsing, because the parser's memory grows with the square
    of their length.
    """
    with path.open("rb") as file:
        raw = file.read(LARGEST_FILE + 1)
    if len(raw) > LARGEST_FILE:
        raise ValueError(f"must have at most {LARGEST_FILE} bytes")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"is not valid TOML: it must be text in UTF-8 (byte {error.start + 1} is not)") from error
    if "\0" in text:
        raise ValueError("is not valid TOML: it must be text in UTF-8 (it has NUL characters, as UTF-16 has)")
    deep = _LONG_KEY.search(text)
    if deep is not None:
        line = text.count("\n", 0, deep.start()) + 1
        raise ValueError(f"line {line}: a key must have at most {DEEPEST_KEY} parts with dots between them")
    try:
        return tomllib.loads(text.replace("\r\n", "\n"))
    except RecursionError:
        raise ValueError(f"must not be nested more than {DEEPEST} tables and lists deep") from None
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"is not valid TOML: {error}") from error
    except ValueError as error:  # from a number with thousands of digits, or an impossible date
        raise ValueError(f"is not valid TOML: it has a number or a date that cannot be read ({error})") from error


def _out_of_size(content: Mapping[str, object]) -> Iterator[ArgumentError]:
    """Yield an error for each table or list that is nested too deeply, and for each number out of range."""
    ahead: list[tuple[tuple[int | str, ...], object]] = [((), content)]
    while ahead:
        where, value = ahead.pop()
        table, several, number = mapping_in(value), list_in(value), number_in(value)
        if table is not None or several is not None:
            if len(where) > DEEPEST:
                yield ArgumentError(place(where), f"must not be nested more than {DEEPEST} tables and lists deep")
                continue
            items: Iterable[tuple[int | str, object]] = (
                enumerate(several or []) if table is None else table.items()
            )
            ahead += [((*where, key), inner) for key, inner in reversed(list(items))]
        elif number is not None and _is_out_of_size(number):
            rule = f"must be 0, or from {typed(SMALLEST_NUMBER)} to {typed(LARGEST_NUMBER)} in size"
            yield ArgumentError(place(where), rule, quote(value))


def _is_out_of_size(value: float) -> bool:
    size = abs(value)
    return 0 < size < SMALLEST_NUMBER or LARGEST_NUMBER < size < math.inf
