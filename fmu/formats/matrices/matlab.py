"""Reader for full and sparse numeric matrices in MATLAB files of versions 5 to 7 (version 7.3 is HDF5).

The format is described in MathWorks, *MAT-file format*, level 5. SciPy's reader crashes the process on some broken
files. This reader reads only numeric matrices, and raises an error if a file is cut short.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import scipy.sparse as sp

from fmu.formats.matrices import hdf5, limits
from fmu.formats.matrices.limits import (
    MOST_NAMES,
    Labelled,
    Matrix,
    MatrixFormat,
    RefusedError,
    choose_variable,
    entries_within,
    fitting,
    rows_within,
)
from fmu.types import DIRECTIONS, AnyArray

_MATRIX, _COMPRESSED = 14, 15
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_STRUCT, _SPARSE, _FULL = 2, 5, range(6, 16)
_FIELDS = 5
"""Number of parts of a struct before its fields: flags, dimensions, name, length of field names, field names."""
_COMPLEX = 0x0800
_NAMES = "dofs"
_NO_PART = (0, memoryview(b""))
_HEAD = 4096
"""Number of bytes at the beginning of a variable that hold its flags, dimensions and name."""


class _Variable(NamedTuple):
    """A matrix's header and its location in the file.

    `field` is its index among the parts of a struct, or None if it is not in a struct.
    """

    kind: int
    shape: tuple[int, ...]
    start: int
    size: int
    compressed: bool
    field: int | None = None


def parse(file: BinaryIO, n_bytes: int, variable: str | None) -> Labelled:
    """Read a matrix from a MATLAB file, with its row names if the file has them.

    A matrix in a struct is named ``model.K``. Row names are stored in a matrix ``dofs`` in the same struct or
    file, one row per degree of freedom: the node id, and a number from 1 to 6 for x, y, z, rx, ry, rz. A matrix
    ``dofs`` of another shape is ignored.

    Parameters
    ----------
    file : binary file
    n_bytes : int
        Size of the file.
    variable : str, optional
        Name of the matrix; not needed if the file has only one matrix, not counting scalars and ``dofs``.

    Returns
    -------
    Labelled

    Raises
    ------
    ValueError, zlib.error
        If the file was not written in a version from 5 to 7, or its content is broken.
    RefusedError
        If there is no such matrix, there are several and `variable` is None, or the matrix is complex or too
        large; if the file has too many variables; or if the row names are invalid.
    """
    file.seek(126)
    order = {b"IM": "<", b"MI": ">"}.get(file.read(2))
    if order is None:
        raise ValueError("it is not of a version from 5 to 7.3")
    found = dict(_variables(file, n_bytes, order))
    matrices = [name for name, one in found.items() if max(one.shape) > 1 and not _is_names(name)] or list(found)
    name = choose_variable(matrices if variable is None else list(found), variable)
    matrix, names = (
        _matrix(file, found[name], order),
        found.get(name.rpartition(".")[0] + "." * ("." in name) + _NAMES),
    )
    if names is None or names.shape != (matrix.shape[0], 2) or _is_names(name):
        return Labelled(matrix)
    return Labelled(matrix, _dofs(_matrix(file, names, order)))


def _is_names(name: str) -> bool:
    return name.rpartition(".")[2] == _NAMES


def _dofs(table: Matrix) -> tuple[tuple[int, str], ...]:
    """Convert a table (n, 2) of node ids and direction numbers to row names (node, direction).

    Raise RefusedError if a number is not whole or out of range.
    """
    rows = sp.coo_array(table).toarray()
    is_whole = np.all(rows == np.floor(rows)) and np.all(rows >= 1) and np.all(rows < 2**31)
    if not is_whole or rows[:, 1].max(initial=1) > len(DIRECTIONS):
        raise RefusedError(f"{_NAMES} must have rows of node and direction, 1 to 6 for {', '.join(DIRECTIONS)}")
    return tuple((int(node), DIRECTIONS[int(k) - 1]) for node, k in rows)


def _matrix(file: BinaryIO, one: _Variable, order: str) -> Matrix:
    if one.kind & _COMPLEX:
        raise RefusedError("must hold a real matrix (it is complex)")
    rows, columns = one.shape
    rows_within(max(one.shape))
    if one.kind & 0xFF != _SPARSE:
        entries_within(rows * columns)
    body = _body(file, one)
    if one.field is not None:
        body = next(islice(_parts(body, order), one.field, None))[1]
    parts = [_numbers(*part, order) for part in islice(_parts(body, order), 3, 6)]
    if one.kind & 0xFF == _SPARSE:
        if len(parts) < 2 or len(parts[1]) != columns + 1:
            raise ValueError("a sparse matrix must have row indices, and one pointer per column")
        ir, jc, values = parts[0], parts[1].astype(np.int64), parts[2] if len(parts) > 2 else np.zeros(0)
        n = int(jc[-1])
        return sp.csc_array((values[:n].astype(float), ir[:n], jc), shape=(rows, columns))
    if not parts or len(parts[0]) != rows * columns:
        got = len(parts[0]) if parts else 0
        raise ValueError(f"a matrix of {rows} by {columns} must have as many numbers (got {got})")
    return parts[0].astype(float).reshape((rows, columns), order="F")


def _variables(file: BinaryIO, n_bytes: int, order: str) -> Iterator[tuple[str, _Variable]]:
    """Yield the name and header of every numeric matrix in a file, including those in structs.

    Structs inside structs and arrays of structs are skipped. Raise ValueError or zlib.error if the file is broken,
    and RefusedError if it has too many variables, or a struct that is too large.
    """
    at = 128
    for _ in range(MOST_NAMES):
        file.seek(at)
        tag = file.read(8)
        if len(tag) < 8:
            return
        kind, size = np.frombuffer(tag, f"{order}u4").tolist()
        if kind not in (_MATRIX, _COMPRESSED):
            raise ValueError(f"it has an element of the unknown type {kind}")
        if at + 8 + size > n_bytes:
            raise ValueError("it is cut short")
        head = file.read(min(size, _HEAD))
        compressed = kind == _COMPRESSED
        if compressed:
            head = zlib.decompressobj().decompress(head, _HEAD)[8:]
        parts = _parts(memoryview(head), order, cut=True)
        flags, shape = (_numbers(*next(parts, _NO_PART), order).tolist() for _ in range(2))
        if _is_matrix(flags[0], shape):
            name = bytes(next(parts, _NO_PART)[1]).decode("ascii")
            yield name, _Variable(flags[0], tuple(shape), at + 8, size, compressed)
        elif flags[0] & 0xFF == _STRUCT and shape == [1, 1]:
            name = bytes(next(parts, _NO_PART)[1]).decode("ascii")
            whole = _Variable(flags[0], (1, 1), at + 8, size, compressed)
            for field, one in _fields(_body(file, whole), whole, order):
                yield f"{name}.{field}", one
        at += 8 + size
    raise RefusedError(f"must hold at most {MOST_NAMES} variables")


def _is_matrix(kind: int, shape: list[int]) -> bool:
    return (kind & 0xFF == _SPARSE or kind & 0xFF in _FULL) and len(shape) == 2 and min(shape) >= 0


def _fields(body: memoryview, struct: _Variable, order: str) -> Iterator[tuple[str, _Variable]]:
    """Yield the name and header of every numeric matrix in a struct.

    Raise ValueError if the struct is broken.
    """
    parts = _parts(body, order)
    length, names = (part for _, part in islice(parts, 3, _FIELDS))
    width = int(np.frombuffer(length, f"{order}i4")[0])
    if not 0 < width <= len(names) or len(names) // width > MOST_NAMES:
        raise ValueError("it has a struct without names of fields")
    for k in range(len(names) // width):
        kind, part = next(parts, _NO_PART)
        if kind != _MATRIX:
            raise ValueError("it has a struct that is cut short")
        inner = _parts(part, order, cut=True)
        flags, shape = (_numbers(*next(inner, _NO_PART), order).tolist() for _ in range(2))
        if _is_matrix(flags[0], shape):
            field = bytes(names[k * width : (k + 1) * width]).split(b"\0")[0].decode("ascii")
            yield field, struct._replace(kind=flags[0], shape=tuple(shape), field=_FIELDS + k)


def _body(file: BinaryIO, one: _Variable) -> memoryview:
    fitting(one.size)
    file.seek(one.start)
    content = file.read(one.size)
    if len(content) < one.size:
        raise ValueError("it is cut short")
    if not one.compressed:
        return memoryview(content)
    content = zlib.decompressobj().decompress(content, limits.LARGEST_CONTENT + 1)
    fitting(len(content))
    return memoryview(content)[8:]


def _parts(body: memoryview, order: str, *, cut: bool = False) -> Iterator[tuple[int, memoryview]]:
    """Yield the type and bytes of each part of a matrix.

    A truncated last part is skipped if `cut` is True; otherwise it raises ValueError.
    """
    at = 0
    while at + 8 <= len(body):
        kind, size = np.frombuffer(body, f"{order}u4", 2, at).tolist()
        start = at + 8
        if kind >> 16:  # up to four bytes of data, stored in the tag itself
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
        at = start + size + -(start + size) % 8
        if start + size > len(body):
            if cut:
                return
            raise ValueError("it is cut short")
        yield kind, body[start : start + size]


def _numbers(kind: int, part: memoryview, order: str) -> AnyArray:
    if kind not in _TYPES:
        raise ValueError(f"it has numbers of the unknown type {kind}")
    dtype = np.dtype(order + _TYPES[kind])
    if len(part) % dtype.itemsize:
        raise ValueError(f"it has {len(part)} bytes of numbers that have {dtype.itemsize} each")
    return np.frombuffer(part, dtype)


def _read(path: Path, variable: str | None) -> Labelled:
    with open(path, "rb") as file:
        if file.read(10).startswith((b"MATLAB 7.3", b"\x89HDF")):
            return hdf5.read(path, variable)
        return parse(file, path.stat().st_size, variable)


FORMAT = MatrixFormat((".mat",), _read, has_names=True)
