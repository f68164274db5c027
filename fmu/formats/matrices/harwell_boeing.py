"""Reader for sparse matrices in Harwell–Boeing files, which Ansys writes with ``HBMAT`` in ``/AUX2``.

The format is described by I. S. Duff, R. G. Grimes, J. G. Lewis (1992), *User's guide for the Harwell–Boeing
sparse matrix collection*. SciPy's reader accepts only unsymmetric matrices without right-hand sides.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
import scipy.sparse as sp

from fmu.formats.matrices.limits import (
    Labelled,
    MatrixFormat,
    check_indices,
    entries_within,
    mirror_triangle,
    rows_within,
)
from fmu.types import FloatArray

LONGEST_LINE = 4096
"""Longest line accepted, in bytes; the format specifies 80."""


def parse(file: BinaryIO) -> sp.csc_array:
    """Read a real assembled matrix; right-hand sides are skipped.

    Returns
    -------
    scipy.sparse.csc_array, shape (n_rows, n_columns)
        A symmetric matrix (``RSA``), which the file stores as one triangle, is returned with both triangles.

    Raises
    ------
    ValueError
        If the matrix is not real and assembled, or the text does not match its header.
    RefusedError
        If the matrix has more rows or entries than `fmu.formats.matrices.limits` allows, or a symmetric one has
        both entries of a pair.
    """
    lines = list(_lines(file, 4))
    counts = [_count(lines[1], at) for at in (14, 28, 42)]
    right_hand_sides = _count(lines[1], 56) if lines[1][56:70].strip() else 0
    kind = lines[2][:3].upper()
    if kind not in ("RSA", "RUA"):
        raise ValueError(f"must be real and assembled, RSA or RUA (got {kind!r})")
    n_rows, n_columns, n_entries = (_count(lines[2], at) for at in (14, 28, 42))
    rows_within(max(n_rows, n_columns))
    entries_within(n_entries * (2 if kind == "RSA" else 1))
    formats = lines[3][:16], lines[3][16:32], lines[3][32:52]
    if right_hand_sides > 0:
        list(_lines(file, 1))
    starts, rows, values = (
        _numbers(file, count, fortran, expected)
        for count, fortran, expected in zip(counts, formats, (n_columns + 1, n_entries, n_entries), strict=True)
    )
    matrix = sp.csc_array(
        (values, rows.astype(np.int64) - 1, starts.astype(np.int64) - 1), shape=(n_rows, n_columns)
    )
    check_indices(matrix)
    if kind == "RSA":
        matrix = mirror_triangle(matrix)
    return sp.csc_array(matrix)


def _lines(file: BinaryIO, count: int) -> Iterator[str]:
    for i in range(count):
        line = file.readline(LONGEST_LINE + 1)
        if len(line) > LONGEST_LINE or b"\0" in line:
            raise ValueError("it is not text with lines of 80 characters")
        if not line:
            raise ValueError(f"it is cut short (it lacks {count - i} lines)")
        yield line.decode("latin-1").rstrip("\r\n")


def _count(line: str, at: int) -> int:
    """Return the whole number in a header line's 14-character field.

    The field begins at column `at`, counted from 0. Raise ValueError if it does not contain a whole number.
    """
    word = line[at : at + 14].strip()
    if not word.isdecimal():
        raise ValueError(f"its header must have counts (got {word!r})")
    return int(word)


def _numbers(file: BinaryIO, n_lines: int, fortran: str, expected: int) -> FloatArray:
    """Read numbers from fixed-width columns in a Fortran format, such as ``(10I8)`` or ``(1P,3D26.18)``.

    If the text has the expected number of words separated by blanks, the widths are ignored, because SciPy writes
    wider columns than the format states. Raise ValueError if there are fewer numbers, more lines than numbers or a
    word that is not a number, or if the format is unknown.
    """
    if n_lines > expected:
        raise ValueError(f"it announces {n_lines} lines for {expected} numbers")
    width = re.search(r"[IEDFG](\d+)", fortran.upper())
    step = int(width.group(1)) if width is not None else 0
    if step < 1:
        raise ValueError(f"unknown number format {fortran.strip()!r}")
    lines = list(_lines(file, n_lines))
    words: Iterator[str] = (word for line in lines for word in line.split())
    if sum(len(line.split()) for line in lines) != expected:
        words = (line[at : at + step] for line in lines for at in range(0, len(line.rstrip()), step))
    found = np.fromiter((float(w.upper().replace("D", "E")) for w in islice(words, expected)), float)
    if len(found) < expected:
        raise ValueError(f"must have {expected} numbers in the format {fortran.strip()} (got {len(found)})")
    return found


def _read(path: Path, variable: str | None) -> Labelled:
    with open(path, "rb") as file:
        return Labelled(parse(file))


FORMAT = MatrixFormat((".hb", ".rsa", ".rua"), _read)
