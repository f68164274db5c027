"""Reader for Matrix Market files, a text format that most programs can write.

The format is described by R. F. Boisvert, R. Pozo, K. A. Remington (1996), *The Matrix Market exchange formats:
initial design*, NISTIR 5935. SciPy's reader crashes the process on some broken files; this reader raises an error.
"""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import BinaryIO

import numpy as np
import scipy.sparse as sp

from fmu.formats.matrices import abaqus
from fmu.formats.matrices.limits import (
    Labelled,
    Matrix,
    MatrixFormat,
    RefusedError,
    entries_within,
    mirror_triangle,
    rows_within,
    tables,
)
from fmu.types import FloatArray

BANNER = b"%%matrixmarket"
LONGEST_LINE = 4096
"""Largest length, in bytes, of the banner, a comment or the line with the sizes."""
MOST_COMMENTS = 100_000
SHORTEST_ENTRY = {"coordinate": 6, "array": 2}
"""Smallest number of bytes in an entry: ``1 1 1`` or ``1``, and the line end."""
_SYMMETRIES = {"general": 0.0, "symmetric": 1.0, "skew-symmetric": -1.0}


def _read(path: Path, variable: str | None) -> Labelled:
    """Read a ``.mtx`` file, which is a Matrix Market file or text written by Abaqus.

    Raise RefusedError if `variable` is given, except for element matrices of Abaqus.
    """
    is_compressed = path.suffix.lower() == ".gz"
    with gzip.open(path) if is_compressed else open(path, "rb") as file:
        start = file.read(LONGEST_LINE)
        file.seek(0)
        if abaqus.OF_ELEMENTS in start.upper():
            return abaqus.parse_elements(file, variable)  # type: ignore[arg-type]
        if variable is not None:
            raise RefusedError(
                f"a {path.suffix} file has one matrix, without a name (got {variable!r})", "variable"
            )
        if start[: len(BANNER)].lower() != BANNER:
            return Labelled(*abaqus.parse(file))  # type: ignore[arg-type]
        return Labelled(parse(file, None if is_compressed else path.stat().st_size))  # type: ignore[arg-type]


def parse(file: BinaryIO, n_bytes: int | None = None) -> Matrix:
    """Read a real matrix from a Matrix Market file, with both triangles.

    Parameters
    ----------
    file : binary file
        Positioned at its beginning.
    n_bytes : int, optional
        File size. If given, the entry count in the header is checked against it before the entries are read.

    Returns
    -------
    scipy.sparse.coo_array or ndarray

    Raises
    ------
    ValueError
        If the header or a row of numbers is malformed, or an index is out of range.
    RefusedError
        If the matrix is not real, has no values, is too large, or does not have the entry count in the header, or
        if a symmetric matrix has both entries of a pair.
    """
    layout, field, symmetry = _banner(_line(file))
    if field == "pattern":
        raise RefusedError("must have values (a Matrix Market pattern has none)")
    if field == "complex" or symmetry not in _SYMMETRIES:
        raise RefusedError(f"must hold a real square matrix (got {field}, {symmetry})")
    sizes = _sizes(file, layout)
    sign = _SYMMETRIES[symmetry]
    announced = sizes[2] if layout == "coordinate" else _count_stored(sizes[0], sizes[1], sign)
    rows_within(max(sizes[:2]))
    if n_bytes is not None and announced * SHORTEST_ENTRY[layout] > n_bytes + 1:
        raise RefusedError(
            f"must have the {announced} entries that it announces (its {n_bytes} bytes cannot hold them)"
        )
    entries_within(announced * (2 if sign else 1))
    if layout == "array":
        return _full(_numbers(file, announced, 1)[:, 0], sizes[0], sizes[1], sign)
    return _sparse(file, sizes, sign)


def _line(file: BinaryIO) -> str:
    line = file.readline(LONGEST_LINE + 1)
    if len(line) > LONGEST_LINE:
        raise ValueError(f"its header has a line of more than {LONGEST_LINE} bytes")
    if not line:
        raise ValueError("it is cut short")
    return line.decode("latin-1")


def _banner(line: str) -> list[str]:
    """Return the layout, field and symmetry given in the banner, in lower case.

    Raise ValueError unless the banner announces a matrix in the coordinate or array layout.
    """
    words = line.lower().split()
    if len(words) != 5 or words[1] != "matrix" or words[2] not in ("coordinate", "array"):
        raise ValueError(f"unknown kind {line.strip()[:100]!r}")
    return words[2:]


def _sizes(file: BinaryIO, layout: str) -> list[int]:
    """Return the row and column counts and, for the coordinate layout, the entry count.

    Raise ValueError if they are not whole numbers, or there are too many comments.
    """
    for _ in range(MOST_COMMENTS):
        line = _line(file)
        if line.strip() and not line.startswith("%"):
            break
    else:
        raise ValueError(f"its header has more than {MOST_COMMENTS} comments")
    words = line.split()
    if len(words) != (3 if layout == "coordinate" else 2) or not all(w.isdecimal() and len(w) < 19 for w in words):
        raise ValueError(f"unknown size {line.strip()[:100]!r}")
    return [int(word) for word in words]


def _count_stored(rows: int, columns: int, sign: float) -> int:
    """Return how many values the array layout stores.

    A symmetric matrix is stored as one triangle, a skew-symmetric one as a triangle without the diagonal, and any
    other in full. Raise ValueError if a symmetric or skew-symmetric matrix is not square.
    """
    if not sign:
        return rows * columns
    if rows != columns:
        raise ValueError(f"a symmetric matrix must be square (got {rows} rows and {columns} columns)")
    return rows * (rows + 1) // 2 if sign > 0 else rows * (rows - 1) // 2


def _numbers(file: BinaryIO, announced: int, columns: int) -> FloatArray:
    """Read the table of numbers in a file, shape (announced, columns).

    Raise ValueError if a row is malformed, and RefusedError if there are more or fewer rows than announced.
    """
    found = np.empty((announced, columns))
    n = 0
    for rows in tables(file, "%"):
        if rows.shape[1] != columns:
            raise ValueError(f"each row must have {columns} numbers (got {rows.shape[1]})")
        if n + len(rows) > announced:
            raise RefusedError(f"must have the {announced} entries that it announces (got more)")
        found[n : n + len(rows)] = rows
        n += len(rows)
    if n < announced:
        raise RefusedError(f"must have the {announced} entries that it announces (got {n})")
    return found


def _sparse(file: BinaryIO, sizes: list[int], sign: float) -> sp.coo_array:
    table = _numbers(file, sizes[2], 3)
    places = table[:, :2]
    if np.any(places != np.floor(places)) or np.any(places < 1) or np.any(places > sizes[:2]):
        raise ValueError(f"rows and columns must be whole numbers from 1 to {sizes[0]} and {sizes[1]}")
    row, column = (places - 1).astype(np.int32).T
    matrix = sp.coo_array((table[:, 2].copy(), (row, column)), shape=(sizes[0], sizes[1]))
    if not sign:
        return matrix
    if sign > 0:
        return sp.coo_array(mirror_triangle(matrix))
    return sp.coo_array(matrix + sign * matrix.T - sp.diags_array(matrix.diagonal(), shape=matrix.shape))


def _full(values: FloatArray, rows: int, columns: int, sign: float) -> FloatArray:
    """Build a matrix (rows, columns) from its values in column order.

    A symmetric or skew-symmetric matrix is given by its lower triangle.
    """
    if not sign:
        return values.reshape((rows, columns), order="F")
    matrix = np.zeros((rows, columns))
    column, row = np.triu_indices(rows, 0 if sign > 0 else 1)
    matrix[row, column], matrix[column, row] = values, sign * values
    return matrix


FORMAT = MatrixFormat((".mtx", ".mtx.gz"), _read, has_names=True)
