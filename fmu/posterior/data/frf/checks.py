"""Check the arrays of measured frequency response functions."""

from __future__ import annotations

import re
from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np

from fmu.arguments import ArgumentError, first_repeated, shown
from fmu.formats.modes.measured_modes import is_node
from fmu.numbers import given, significant, whole
from fmu.types import BoolArray, ComplexArray, Dof, FloatArray

_DIRECTION = re.compile(r"-?r?[xyz]")
_ROUNDING = 1e-5
"""Amount by which a coherence rounded to six digits in a file may exceed 1."""


def checked_frequencies(frequencies_hz: Any) -> FloatArray:
    """Return the line frequencies in Hz as an array (n_lines,). The first frequency may be 0 Hz.

    Raise ValueError if they are not a list of numbers, are empty, negative or not finite, do not ascend, or
    consist of 0 Hz only.
    """
    f = np.array(frequencies_hz, dtype=float)
    if f.ndim != 1 or len(f) == 0:
        raise ArgumentError("frequencies_hz", "must be a list of numbers, one per line", f"shape {f.shape}")
    wrong = ~(np.isfinite(f) & (f >= 0.0))
    if wrong.any():
        at = int(np.argmax(wrong))
        raise ArgumentError(f"frequencies_hz.{at}", "must be finite and not negative", f"{f[at]} Hz")
    back = np.diff(f) <= 0.0
    if back.any():
        at = int(np.argmax(back)) + 1
        got = f"{given(f[at])} Hz after {given(f[at - 1])} Hz"
        raise ArgumentError(f"frequencies_hz.{at}", "must ascend; sort the lines and their values", got)
    if f[-1] == 0.0:
        raise ArgumentError("frequencies_hz", "must have a line above 0 Hz", "0 Hz only")
    return f


def complex_array(name: str, values: Any) -> ComplexArray:
    """Return `values` as a complex array; raise ValueError if they are not numbers."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, OverflowError):
        array = np.asarray(None)
    if array.dtype.kind not in "iufc":
        raise ArgumentError(name, "must be complex numbers (an array or a list of lists)", shown(values))
    return array.astype(complex)


def checked_values(values: Any, n_lines: int) -> ComplexArray:
    """Return FRF values as an array (n_frfs, n_lines).

    Raise ValueError if they are not numbers or have another shape.
    """
    array = complex_array("values", values)
    if array.ndim == 1 and len(array) == n_lines:
        rule = f"must have shape (n_frfs, {n_lines}); put the values of one FRF in a list"
        raise ArgumentError("values", rule, array.shape)
    if array.ndim != 2 or array.shape[1] != n_lines or len(array) == 0:
        advice = "; transpose them" if array.ndim == 2 and array.shape[0] == n_lines else ""
        raise ArgumentError("values", f"must have shape (n_frfs, {n_lines}), FRFs x lines", array.shape, advice)
    return array


def checked_dofs(name: str, dofs: Sequence[tuple[Hashable, str]], n_frfs: int) -> tuple[Dof, ...]:
    """Return each FRF's (place, direction); raise ValueError for a wrong number, place or direction."""
    if len(dofs) != n_frfs:
        advice = "; repeat the point that stays where it is" if len(dofs) == 1 else ""
        raise ArgumentError(name, f"must be {n_frfs}, one per FRF", len(dofs), advice)
    for i, (place, direction) in enumerate(dofs):
        if not isinstance(place, str) and not is_node(place):
            raise ArgumentError(f"{name}.{i}.0", "must be the number or the name of a node", shown(place))
        if not _DIRECTION.fullmatch(direction):
            rule = "must be x, y, z, rx, ry or rz, with or without a leading minus"
            raise ArgumentError(f"{name}.{i}.1", rule, shown(direction))
    return tuple((int(str(place)) if is_node(place) else place, str(direction)) for place, direction in dofs)


def checked_sd(sd: Any, shape: tuple[int, int]) -> FloatArray:
    """Return standard deviations as an array (n_frfs, n_lines). Unknown standard deviations are NaN or 0.

    The user may give one number for all values, one number per FRF with shape (n_frfs, 1), or the full array.
    Raise ValueError if `sd` has another shape, a standard deviation is negative or infinite, or none is positive.
    """
    array = np.array(sd, dtype=float)
    if array.shape not in ((), (shape[0], 1), shape):
        rule = f"must be a number or have shape {shape}, FRFs x lines, or {(shape[0], 1)}"
        raise ArgumentError("sd", rule, array.shape)
    wrong = (array < 0.0) | np.isinf(array)
    if wrong.any():
        raise ArgumentError("sd", "must be positive and finite, or NaN", significant(float(array[wrong].flat[0])))
    if not np.any(array > 0.0):
        raise ArgumentError("sd", "must be positive at a line", "0 or NaN at every line")
    return np.broadcast_to(array, shape).copy()


def checked_coherence(coherence: Any, averages: float | None, shape: tuple[int, int]) -> FloatArray | None:
    """Return the coherence γ² as an array (n_frfs, n_lines), with NaN where it is unknown, or None if not given.

    Values that exceed 1 by rounding become 1. Raise ValueError for other values outside 0 to 1, a wrong shape, or
    if only one of the coherence and the number of averages is given.
    """
    if (coherence is None) != (averages is None):
        name, other = ("averages", "coherence") if averages is None else ("coherence", "averages")
        raise ArgumentError(name, f"must be given together with {other}", "None")
    if coherence is None:
        return None
    array = np.array(coherence, dtype=float)
    if array.shape != shape:
        raise ArgumentError("coherence", f"must have shape {shape}, FRFs x lines", array.shape)
    wrong = (array < 0.0) | (array > 1.0 + _ROUNDING)
    if wrong.any():
        value = float(array[wrong][0])
        advice = "; divide per cent by 100" if 1.0 < value <= 100.0 else ""
        raise ArgumentError("coherence", "must be from 0 to 1, or NaN", significant(value), advice)
    return np.minimum(array, 1.0)


def checked_bools(name: str, values: Any, shape: tuple[int, int]) -> BoolArray:
    """Broadcast booleans of shape (n_lines,) or (n_frfs, n_lines) to (n_frfs, n_lines).

    Raise ValueError if they are not booleans or have another shape.
    """
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, OverflowError):
        array = np.asarray(None)
    if array.dtype.kind != "b":
        raise ArgumentError(name, "must be True or False, one per line", shown(values))
    if array.shape not in (shape[1:], shape):
        raise ArgumentError(name, f"must have shape {shape[1:]} or {shape}", array.shape)
    return np.broadcast_to(array, shape).copy()


def check_rows(labels: Sequence[str], missing: BoolArray) -> list[str]:
    """Return a list with a sentence for each FRF that lacks some values.

    Parameters
    ----------
    labels : sequence of str
    missing : ndarray of bool, shape (n_frfs, n_lines)

    Raises
    ------
    ValueError
        If an FRF has no values at all, or a label occurs twice.
    """
    twice = first_repeated(labels)
    if twice is not None:
        advice = "; average repeated FRFs with FRFData.from_hits"
        raise ArgumentError(
            "responses", "each pair of response and drive must be there once", labels[twice], advice
        )
    empty = missing.all(axis=1)
    if empty.any():
        at = int(np.argmax(empty))
        rule = f"must have an FRF with values in each row; delete the row of {labels[at]!r}"
        raise ArgumentError(f"values.{at}", rule, "0 or NaN at every line")
    counts = zip(labels, missing.sum(axis=1).tolist(), strict=True)
    of = f"of {whole(missing.shape[1])} lines"
    return [f"The FRF {label} has no value (0 or NaN) at {whole(n)} {of}." for label, n in counts if n]


def check_used(f: FloatArray, chosen: BoolArray, used: BoolArray, name: str, of_sd: str) -> list[str]:
    """Return a list with one sentence if some chosen values have no standard deviation, otherwise an empty list.

    Parameters
    ----------
    f : ndarray, shape (n_lines,), Hz
    chosen, used : ndarray of bool, shape (n_frfs, n_lines)
        Values that the user chose and that are not missing; values that are used, because they also have an sd.
    name, of_sd : str
        Name of the attribute that chose the lines, and name of the attribute that gives the standard deviation.

    Raises
    ------
    ValueError
        If no value was chosen, or no chosen value has a standard deviation.
    """
    n, without = int(chosen.sum()), int(np.sum(chosen & ~used))
    if n == 0:
        advice = f"; lines are {given(f[0])} to {given(f[-1])} Hz"
        raise ArgumentError(name, "must leave a line with a value", "none", advice)
    values = "0 or NaN" if of_sd == "sd" else "0, 1 or NaN"
    if without == n:
        raise ArgumentError(of_sd, "must give a standard deviation above 0 at a line that is used", values)
    why = f"the {of_sd} of each is {values}"
    return [f"{whole(without)} of {whole(n)} values are not used: {why}."] if without else []
