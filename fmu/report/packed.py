"""Compress the data for a page's scripts into text without special HTML characters."""

from __future__ import annotations

import base64
import json
import zlib
from dataclasses import dataclass

import numpy as np

from fmu.plain_data import mapping_in
from fmu.types import AnyArray

_FEW = 32
"""Largest number of entries of an array that is written as JSON."""
_ORDERS = 100.0
"""Ratio of the largest to the smallest positive number from which an array is kept in single precision."""
_MISSING = {8: 127, 16: 32767}
_INTEGERS = {8: "i1", 16: "i2"}
_WHOLE = ("u2", "i2", "u4", "i4")
"""Types for arrays of whole numbers, in order of preference. ``data.js`` has an array for each."""


@dataclass(frozen=True, eq=False)
class Rounded:
    """Numbers to be stored as integers of 8 or 16 bits, which is accurate enough for drawing.

    Attributes
    ----------
    values : ndarray
        The numbers; entries that are not finite are missing values.
    bits : {8, 16}
        Bits per number. The rounding error is at most 1/252 or 1/65 532 of the range. If all numbers are small
        whole numbers, they stay exact.
    """

    values: AnyArray
    bits: int = 16


def pack(content: object) -> str:
    """Return content as text: its JSON and its arrays, compressed with zlib and encoded in base64.

    Parameters
    ----------
    content : mapping, sequence, str, number, None, ndarray or `Rounded`
        Float arrays with more than 32 entries are rounded to 16 bits, or to single precision if they have positive
        numbers of several orders of magnitude, such as |H|; other floats are rounded to seven digits. NaN and
        infinity become missing values. Whole numbers stay exact. ``data.js`` reads arrays as flat arrays.
    """
    arrays: list[bytes] = []
    text = json.dumps(_plain(content, arrays), ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-(4 + len(text)) % 4)
    return base64.b64encode(zlib.compress(b"".join([len(text).to_bytes(4, "little"), text, *arrays]), 6)).decode()


def _plain(content: object, arrays: list[bytes]) -> object:
    """Return content as JSON types. Its longer arrays are appended to `arrays`."""
    table = mapping_in(content)
    if table is not None:
        return {str(key): _plain(value, arrays) for key, value in table.items()}
    if isinstance(content, (list, tuple)):
        return [_plain(value, arrays) for value in content]
    if isinstance(content, np.ndarray):
        if content.size > _FEW and _is_logarithmic(content):
            return _append_array(np.where(np.isfinite(content), content, np.nan).astype("f4"), arrays)
        if content.size > _FEW and content.dtype.kind == "f":
            return _plain(Rounded(content), arrays)
        kind = _whole_type(content) if content.size > _FEW else None
        if kind is None:
            return [_plain(value, arrays) for value in content.ravel().tolist()]
        return _append_array(content.astype(kind), arrays)
    if isinstance(content, Rounded):
        return _pack_rounded(content, arrays)
    if isinstance(content, (float, np.floating)):
        return float(f"{content:.7g}") if np.isfinite(content) else None
    return content.item() if isinstance(content, np.generic) else content


def _is_logarithmic(content: AnyArray) -> bool:
    """Return True if all known numbers are positive, and too different for equal steps of their range."""
    if content.dtype.kind != "f" or not (known := content[np.isfinite(content)]).size:
        return False
    low, high, single = float(known.min()), float(known.max()), np.finfo(np.float32)
    return bool(single.tiny < low < high / _ORDERS and high < single.max)


def _whole_type(content: AnyArray) -> str | None:
    """Return the first type in `_WHOLE` that holds all of an array's whole numbers, or None if none does."""
    low, high = int(content.min()), int(content.max())
    return next((kind for kind in _WHOLE if np.iinfo(kind).min <= low and high <= np.iinfo(kind).max), None)


def _pack_rounded(content: Rounded, arrays: list[bytes]) -> dict[str, object]:
    """Append numbers to `arrays` as integers; return their position, offset and step as a dict.

    A number is ``middle + step * integer``.
    """
    missing, x = _MISSING[content.bits], np.asarray(content.values, dtype=float)
    known = np.isfinite(x)
    low, high = (float(x[known].min()), float(x[known].max())) if known.any() else (0.0, 0.0)
    middle, step = 0.5 * (low + high), (high - low) / (2 * (missing - 1)) or 1.0
    if np.array_equal(x[known], np.rint(x[known])) and max(high, -low) < missing:
        middle, step = 0.0, 1.0
    elif low <= 0.0 <= high:  # zeros, which are frequent in mode shapes, stay exact
        middle, step = 0.0, max(high, -low) / (missing - 1) or 1.0
    levels = np.where(known, np.rint((np.where(known, x, middle) - middle) / step), missing)
    return _append_array(levels.astype(_INTEGERS[content.bits]), arrays) | {"middle": middle, "step": step}


def _append_array(array: AnyArray, arrays: list[bytes]) -> dict[str, object]:
    """Append an array, aligned to four bytes; return its offset in bytes, type and length as a dict."""
    kept = array.astype(array.dtype.newbyteorder("<")).tobytes()
    at = sum(map(len, arrays))
    arrays.append(kept + b"\0" * (-len(kept) % 4))
    return {"at": at, "type": array.dtype.str[1:], "n": array.size}
