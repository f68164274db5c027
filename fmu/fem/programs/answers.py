"""Validate the results of a user's function (see `fmu.fem.black_box`), and convert them to arrays."""

from __future__ import annotations

import inspect
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fmu.formats.shown import quote
from fmu.plain_data import mapping_in
from fmu.types import FloatArray

MOST_NUMBERS = 2**24
"""Largest number of elements in an array that the function may return."""
_PARTS = ("frequencies", "shapes", "gradient")


class Answer(NamedTuple):
    """Frequencies (m,) in Hz at one theta, shapes (n_sensors, m) or None, and gradient (m, ndim) or None."""

    frequencies: FloatArray
    shapes: FloatArray | None = None
    gradient: FloatArray | None = None


class AnswerError(ValueError):
    """Raised when a function's result has the wrong type, shape or values, or when a program's run fails."""


def read_answers(given: object, n_parameters: int, n_points: int | None = None) -> list[Answer]:
    """Convert a function's result to a list of answers, one per point.

    Parameters
    ----------
    given : array_like, mapping or tuple
        The function's result; see `fmu.fem.black_box`.
    n_parameters : int
    n_points : int, optional
        Number of points passed to a batched function. If not given, there is one point and no leading axis.

    Raises
    ------
    AnswerError
        If the result has the wrong type or shape or unknown keys, lacks frequencies, is a coroutine, or has an
        array of more than `MOST_NUMBERS` elements.
    """
    if inspect.iscoroutine(given):
        given.close()  # otherwise Python warns that it was never awaited
        raise AnswerError("must return numbers (got a coroutine: the function must not be async)")
    lead = () if n_points is None else (n_points,)
    parts = _parts(given)
    frequencies = _real("frequencies", parts[0])
    if frequencies.ndim != len(lead) + 1 or frequencies.shape[:-1] != lead or frequencies.shape[-1] == 0:
        expected = ", ".join([*map(str, lead), "n"]) + ("" if lead else ",")
        raise AnswerError(f"frequencies: must have shape ({expected}) (got {frequencies.shape})")
    m = frequencies.shape[-1]
    shapes = None if parts[1] is None else _real("shapes", parts[1])
    if shapes is not None and (
        shapes.ndim != len(lead) + 2 or (*shapes.shape[:-2], shapes.shape[-1]) != (*lead, m)
    ):
        expected = ", ".join([*map(str, lead), "n_sensors", str(m)])
        raise AnswerError(f"shapes: must have shape ({expected}) (got {shapes.shape})")
    gradient = None if parts[2] is None else _real("gradient", parts[2])
    if gradient is not None and gradient.shape != (*lead, m, n_parameters):
        raise AnswerError(f"gradient: must have shape {(*lead, m, n_parameters)} (got {gradient.shape})")
    if n_points is None:
        return [Answer(frequencies, shapes, gradient)]
    none = [None] * n_points
    rows = (frequencies, none if shapes is None else shapes, none if gradient is None else gradient)
    return [Answer(*row) for row in zip(*rows, strict=True)]


def _parts(given: object) -> list[Any]:
    """Return the frequencies, shapes and gradient as a list, with None for each missing array.

    Raise AnswerError if a mapping lacks frequencies or has other keys, or if a tuple has more than three arrays.
    """
    by_name = mapping_in(given)
    if by_name is not None:
        unknown = [key for key in by_name if key not in _PARTS]
        if unknown or "frequencies" not in by_name:
            raise AnswerError(
                f"must return frequencies, and may return shapes and gradient (got {quote(list(by_name))})"
            )
        return [by_name.get(part) for part in _PARTS]
    if isinstance(given, tuple) and any(_has_axes(part) for part in given):
        if len(given) > len(_PARTS):
            raise AnswerError(f"must return at most frequencies, shapes and gradient (got {len(given)} arrays)")
        return [*given, *[None] * (len(_PARTS) - len(given))]
    return [given, None, None]


def _has_axes(given: ArrayLike) -> bool:
    """Return True unless `given` is a number; rows of unequal length have axes too."""
    try:
        return np.ndim(given) > 0
    except ValueError:
        return True


def _real(name: str, given: ArrayLike) -> FloatArray:
    try:
        array = np.asarray(given)
        if np.ma.is_masked(given):
            array = np.ma.filled(np.ma.asarray(given).astype(float), np.nan)
    except ValueError as error:  # rows of unequal length
        raise AnswerError(f"{name}: must be an array with rows of equal length ({error})") from None
    if array.dtype.kind not in "fiu":
        what = "nothing" if given is None else f"{type(given).__name__} of {array.dtype}"
        raise AnswerError(f"{name}: must be real numbers (got {what})")
    if array.size > MOST_NUMBERS:
        raise AnswerError(f"{name}: must be at most {MOST_NUMBERS} numbers (got {array.size})")
    return array.astype(float)
