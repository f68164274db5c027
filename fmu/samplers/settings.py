"""Check sampler settings, and convert them to plain data."""

from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from annotated_types import Ge
from numpy.typing import ArrayLike

from fmu.arguments import Numbers, require
from fmu.plain_data import mapping_in
from fmu.types import FloatArray, Positive

if TYPE_CHECKING:
    from fmu.samplers.kernel import Sampler

Scale = float | tuple[float, ...] | tuple[tuple[float, ...], ...]
_FEW = 100
"""Largest number of matrix entries that a message shows."""


def positive_number(name: str, value: float) -> float:
    """Return `value` as a float; raise ValueError unless it is a positive finite number."""
    require(name, value, Positive)
    return float(value)


def whole_number(name: str, value: int, minimum: int) -> int:
    """Return `value` as an int; raise ValueError unless it is a whole number of at least `minimum`."""
    require(name, value, Annotated[int, Ge(minimum)])
    return int(value)


def one_of(name: str, value: object, known: tuple[str, ...]) -> str:
    """Return `value` as a str; raise ValueError unless it is one of the `known` words."""
    if value not in known:
        raise ValueError(f"{name}: must be one of {', '.join(known)} (got {value!r})")
    return str(value)


def vector(name: str, value: ArrayLike) -> tuple[float, ...]:
    """Return a vector as a tuple of floats; raise ValueError unless it is one-dimensional, finite and nonempty."""
    array = _as_floats(name, value)
    if array.ndim != 1 or array.size == 0 or not np.all(np.isfinite(array)):
        raise ValueError(f"{name}: must be a vector of finite numbers (got {value!r})")
    return tuple(array.tolist())


def positive_scale(name: str, value: ArrayLike, *, matrix: bool) -> Scale:
    """Return a positive number, positive vector or positive definite matrix in hashable form.

    Parameters
    ----------
    name : str
        Name of the setting, for the error message.
    value : float or array_like, shape (ndim,) or (ndim, ndim)
    matrix : bool
        Whether a symmetric positive definite matrix is allowed.

    Raises
    ------
    ValueError
        If `value` is none of these, is empty or not finite, or is a matrix and `matrix` is False.
    """
    array = _as_floats(name, value)
    if not np.all(np.isfinite(array)) or array.size == 0:
        raise ValueError(f"{name}: must be finite (got {value!r})")
    if array.ndim <= 1:
        if np.any(array <= 0):
            raise ValueError(f"{name}: must be positive (got {value!r})")
        return float(array) if array.ndim == 0 else tuple(array.tolist())
    if not matrix or array.ndim != 2:
        allowed = "a number, a vector or a square matrix" if matrix else "a number or a vector"
        raise ValueError(f"{name}: must be {allowed} (got shape {array.shape})")
    cholesky_factor(name, array)
    return tuple(tuple(row) for row in array.tolist())


def cholesky_factor(name: str, matrix: FloatArray) -> FloatArray:
    """Return the lower Cholesky factor; raise ValueError unless `matrix` is symmetric and positive definite."""
    square = matrix.ndim == 2 and matrix.shape[0] == matrix.shape[1]
    if square and np.all(np.diag(matrix) > 0.0):
        size = np.sqrt(np.diag(matrix))
        if np.allclose(matrix / size / size[:, None], matrix.T / size / size[:, None], rtol=0.0, atol=1e-8):
            try:
                return np.linalg.cholesky(matrix)
            except np.linalg.LinAlgError:
                pass  # reported below, with the name of the setting
    got = matrix.tolist() if matrix.size <= _FEW else f"shape {matrix.shape}"
    raise ValueError(f"{name}: must be a symmetric positive definite matrix (got {got})")


def orthonormal(name: str, value: ArrayLike) -> tuple[tuple[float, ...], ...]:
    """Return a square matrix as a tuple of rows; raise ValueError unless its columns are orthonormal."""
    array = _as_floats(name, value)
    if array.ndim != 2 or array.shape[0] != array.shape[1]:
        raise ValueError(f"{name}: must be a square matrix (got shape {array.shape})")
    if not np.allclose(array.T @ array, np.eye(len(array)), rtol=0.0, atol=1e-8):
        raise ValueError(f"{name}: must have orthonormal columns (got {value!r})")
    return tuple(tuple(row) for row in array.tolist())


def fits(name: str, value: ArrayLike, ndim: int) -> FloatArray:
    """Return `value` as an array; raise ValueError unless it is a scalar or its first axis has length `ndim`."""
    array = np.asarray(value, dtype=float)
    if array.ndim and array.shape[0] != ndim:
        raise ValueError(f"{name}: must have length {ndim}, one entry per coordinate (got {array.shape[0]})")
    return array


def describe(settings: Any) -> dict[str, object]:
    """Return a dataclass's constructor arguments as data for JSON.

    A nested dataclass becomes a dict that also contains the name of its class, with the key ``type``.
    """
    fields = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings) if field.init}
    described: dict[str, object] = json.loads(json.dumps(fields, default=_make_plain))
    return described


def _make_plain(value: object) -> object:
    """Convert a value that JSON cannot represent to a dict, list or number if possible, or else to its `repr`."""
    if dataclasses.is_dataclass(value):
        return {"type": type(value).__name__, **describe(value)}
    table = mapping_in(value)
    if table is not None:
        return dict(table)
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else repr(value)


def _as_floats(name: str, value: ArrayLike) -> FloatArray:
    require(name, value, Numbers)
    return np.asarray(value, dtype=float)


def usual_costs(settings: Sampler, chains: int, solves_per_gradient: int) -> tuple[float, float]:
    """Return the typical numbers of solves that one step of all chains takes, in warm-up and after it.

    They are estimated from the sampler's mean costs over the built-in cases.
    """
    of_warmup, of_draw, _ = settings.cost
    each = chains * settings.walkers * (solves_per_gradient if settings.takes_gradients else 1)
    return each * of_warmup, each * of_draw
