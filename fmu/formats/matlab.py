"""Numeric matrices, full and sparse, in MATLAB's files of version 5 to 7 (7.3 is HDF5).

MathWorks, *MAT-file format*, level 5. SciPy's reader takes the process down on some broken files; this one knows
nothing but matrices of numbers, and reads no byte that is not there.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from fmu.formats.matrix_files import RefusedError, chosen, fitting

_MATRIX, _COMPRESSED = 14, 15
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_SPARSE, _FULL = 5, range(6, 16)
_COMPLEX = 0x0800
_HEAD = 4096
"""Bytes that flags, dimensions and name are within."""


class _Variable(NamedTuple):
    kind: int
    shape: tuple[int, ...]
    body: memoryview
    compressed: bool


def read(content: bytes, variable: str | None) -> Any:
    """Return a matrix of a file's content.

    Parameters
    ----------
    content : bytes
    variable : str, optional
        Its name; not needed if there is one alone, numbers aside.

    Returns
    -------
    ndarray or scipy.sparse.csc_array

    Raises
    ------
    ValueError
        If the content is broken.
    RefusedError
        If there is no such matrix, it is complex or too large.
    """
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise ValueError("it is of no version from 5 to 7.3")
    found = dict(_variables(memoryview(content), order))
    matrices = [name for name, one in found.items() if max(one.shape) > 1] or list(found)
    one = found[chosen(matrices if variable is None else list(found), variable)]
    if one.kind & _COMPLEX:
        raise RefusedError("must hold a real matrix (it is complex)")
    body = memoryview(_inflated(one.body)[8:]) if one.compressed else one.body
    parts = [_numbers(*part, order) for i, part in enumerate(_parts(body, order)) if i > 2]
    rows, columns = one.shape
    if one.kind & 0xFF == _SPARSE:
        ir, jc, values = parts[0], parts[1], parts[2] if len(parts) > 2 else np.zeros(0)
        n = int(jc[-1])
        return sp.csc_array((values[:n].astype(float), ir[:n], jc), shape=(rows, columns))
    fitting(8 * rows * columns)
    return parts[0].astype(float).reshape((rows, columns), order="F")


def _variables(content: memoryview, order: str) -> Iterator[tuple[str, _Variable]]:
    """Give the name and what is known of every matrix of numbers."""
    at = 128
    while at + 8 <= len(content):
        kind, size = np.frombuffer(content, f"{order}u4", 2, at).tolist()
        body = content[at + 8 : at + 8 + size]
        if len(body) < size:
            raise ValueError("it is cut short")
        if kind in (_MATRIX, _COMPRESSED):
            compressed = kind == _COMPRESSED
            head = memoryview(zlib.decompressobj().decompress(body, _HEAD)[8:]) if compressed else body[:_HEAD]
            parts = _parts(head, order)
            flags, shape = (_numbers(*next(parts), order).tolist() for _ in range(2))
            if (flags[0] & 0xFF == _SPARSE or flags[0] & 0xFF in _FULL) and len(shape) == 2 and min(shape) >= 0:
                name = bytes(next(parts)[1]).decode("ascii")
                yield name, _Variable(flags[0], tuple(shape), body, compressed)
        at += 8 + size


def _inflated(body: memoryview) -> bytes:
    from fmu.formats import matrix_files

    content = zlib.decompressobj().decompress(body, matrix_files.LARGEST_FILE + 1)
    fitting(len(content))
    return content


def _parts(body: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Give type and bytes of each part of a matrix."""
    at = 0
    while at + 8 <= len(body):
        kind, size = np.frombuffer(body, f"{order}u4", 2, at).tolist()
        start = at + 8
        if kind >> 16:  # up to four bytes, in the tag itself
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
        at = start + size + -(start + size) % 8
        if start + size > len(body):
            raise ValueError("it is cut short")
        yield kind, body[start : start + size]


def _numbers(kind: int, part: memoryview, order: str) -> Any:
    if kind not in _TYPES:
        raise ValueError(f"it has numbers of the unknown type {kind}")
    return np.frombuffer(part, order + _TYPES[kind])
