"""Numbers and names for the scripts of a page, compressed: no character of them is HTML."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fmu.types import AnyArray

_FEW = 32
"""Numbers that are written out."""
_MISSING = {8: 127, 16: 32767}
_INTEGERS = {8: "i1", 16: "i2"}


@dataclass(frozen=True, eq=False)
class Rounded:
    """Numbers as integers of few bits: the page needs no more than can be seen.

    Attributes
    ----------
    values : ndarray
        Not finite where there is no value.
    bits : {8, 16}
        The error is at most 1/508 or 1/131 068 of the range.
    """

    values: AnyArray
    bits: int = 16


def pack(content: object) -> str:
    """Return content as base64 of zlib's deflate of its JSON and, after that, its arrays.

    Parameters
    ----------
    content : mapping, sequence, str, number, None, ndarray or `Rounded`
        Arrays of floats are rounded to 16 bits. ``data.js`` reads all of them as flat arrays.
    """
    arrays: list[bytes] = []
    text = json.dumps(_plain(content, arrays), ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-(4 + len(text)) % 4)
    return base64.b64encode(zlib.compress(b"".join([len(text).to_bytes(4, "little"), text, *arrays]), 6)).decode()


def _plain(content: object, arrays: list[bytes]) -> object:
    """Return content as JSON has it, its arrays moved to `arrays`."""
    if isinstance(content, Mapping):
        return {str(key): _plain(value, arrays) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_plain(value, arrays) for value in content]
    if isinstance(content, np.ndarray):
        if content.size <= _FEW:
            return [_plain(value, arrays) for value in content.ravel().tolist()]
        if content.dtype.kind == "f":
            return _plain(Rounded(content), arrays)
        return _append_array(content.astype("u2" if content.max() < 2**16 else "u4"), arrays)
    if isinstance(content, Rounded):
        return _pack_rounded(content, arrays)
    if isinstance(content, (float, np.floating)):
        return float(f"{content:.7g}") if np.isfinite(content) else None
    return content.item() if isinstance(content, np.generic) else content


def _pack_rounded(content: Rounded, arrays: list[bytes]) -> dict[str, object]:
    """Return the middle and the step of numbers that are integers in `arrays`."""
    missing, x = _MISSING[content.bits], np.asarray(content.values, dtype=float)
    known = np.isfinite(x)
    low, high = (float(x[known].min()), float(x[known].max())) if known.any() else (0.0, 0.0)
    middle, step = 0.5 * (low + high), (high - low) / (2 * (missing - 1)) or 1.0
    if np.array_equal(x[known], np.rint(x[known])) and max(high, -low) < missing:
        middle, step = 0.0, 1.0
    elif low <= 0.0 <= high:  # zero, which is most of many shapes, stays zero
        middle, step = 0.0, max(high, -low) / (missing - 1) or 1.0
    levels = np.where(known, np.rint((np.where(known, x, middle) - middle) / step), missing)
    return _append_array(levels.astype(_INTEGERS[content.bits]), arrays) | {"middle": middle, "step": step}


def _append_array(array: AnyArray, arrays: list[bytes]) -> dict[str, object]:
    """Append an array at a multiple of four bytes, and return its place."""
    kept = array.astype(array.dtype.newbyteorder("<")).tobytes()
    at = sum(map(len, arrays))
    arrays.append(kept + b"\0" * (-len(kept) % 4))
    return {"at": at, "type": array.dtype.str[1:], "n": array.size}
