"""Readers for matrices saved by NumPy and SciPy (``.npz``, ``.npy``) or as comma-separated text (``.csv``).

Nothing is unpickled, and sizes in the headers are checked before the numbers are read.
"""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import IO

import numpy as np
import scipy.sparse as sp

from fmu.formats.matrices.limits import (
    MOST_NAMES,
    Labelled,
    MatrixFormat,
    RefusedError,
    choose_variable,
    entries_within,
    fitting,
    tables,
)
from fmu.types import FloatArray


def shapes_in_archive(path: Path) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array in an ``.npz`` file, after checking the number and size of the arrays.

    Raises
    ------
    RefusedError
        If there are too many arrays, or they are too large.
    ValueError
        If an array contains Python objects.
    Exception
        Any error that zipfile and NumPy raise on a broken file.
    """
    with open(path, "rb") as file:
        file.seek(max(path.stat().st_size - 2**16, 0))
        end = file.read(2**16)
    at = end.rfind(b"PK\x05\x06")  # byte 12 of the record that ends a ZIP archive: the size of its directory
    if at >= 0 and int.from_bytes(end[at + 12 : at + 16], "little") > 200 * MOST_NAMES:
        raise RefusedError(f"must hold at most {MOST_NAMES} arrays")
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if len(members) > MOST_NAMES:
            raise RefusedError(f"must hold at most {MOST_NAMES} arrays (got {len(members)})")
        fitting(sum(member.file_size for member in members))
        shapes = {}
        for member in members:
            with archive.open(member) as file:
                shapes[member.filename.removesuffix(".npy")] = shape_in_header(file)
        return shapes


def shape_in_header(file: IO[bytes]) -> tuple[int, ...]:
    """Return the shape of a saved array, reading only its header.

    Raises
    ------
    RefusedError
        If the array is too large.
    ValueError
        If the array contains Python objects, which are not unpickled, or sizes that are not whole numbers.
    Exception
        Any error that NumPy raises on a broken header.
    """
    major = np.lib.format.read_magic(file)[0]
    read_header = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(file)
    if not all(str(n).isdecimal() for n in shape):  # a bool is no size
        raise ValueError(f"it has an array of the shape {shape}")
    if dtype.hasobject:
        raise ValueError("it has Python objects, which are not read")
    entries_within(math.prod(shape))
    fitting(math.prod(shape) * dtype.itemsize)
    return tuple(int(n) for n in shape)


def _npz(path: Path, variable: str | None) -> Labelled:
    shapes = shapes_in_archive(path)
    if "format" not in shapes:
        name = choose_variable([name for name, shape in shapes.items() if len(shape) == 2], variable)
        with np.load(path, allow_pickle=False) as content:
            return Labelled(content[name])
    if variable is not None:
        raise RefusedError(f"the file has one matrix, without a name (got {variable!r})", "variable")
    return Labelled(sp.load_npz(path))


def _npy(path: Path, variable: str | None) -> Labelled:
    with open(path, "rb") as file:
        shape_in_header(file)
        file.seek(0)
        return Labelled(np.load(file, allow_pickle=False))


def _csv(path: Path, variable: str | None) -> Labelled:
    """Read comma-separated numbers: a full matrix, or a table (n, 3) of row, column and entry.

    Raise RefusedError if there are too many rows or columns.
    """
    found: list[FloatArray] = []
    n = 0
    with open(path, "rb") as file:
        for rows in tables(file, "#", ","):
            entries_within(rows.shape[1] ** 2)
            n += len(rows)
            entries_within(n)
            if n > rows.shape[1] != 3:
                raise RefusedError(
                    f"must hold a square matrix (got more than {rows.shape[1]} rows of {rows.shape[1]})"
                )
            found.append(rows)
    return Labelled(np.concatenate(found) if found else np.zeros((0, 0)))


NPZ = MatrixFormat((".npz",), _npz, has_names=True)
NPY = MatrixFormat((".npy",), _npy)
CSV = MatrixFormat((".csv",), _csv)
