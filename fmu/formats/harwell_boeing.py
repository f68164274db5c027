"""The Harwell–Boeing format of sparse matrices, which Ansys writes with ``HBMAT`` in ``/AUX2``.

I. S. Duff, R. G. Grimes, J. G. Lewis (1992), *User's guide for the Harwell–Boeing sparse matrix collection*. SciPy
reads the unsymmetric kind only, and no right-hand sides.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import scipy.sparse as sp

from fmu.formats.matrix_files import checked


def parse(text: str) -> Any:
    """Return the real assembled matrix in the text of a file, right-hand sides left out.

    Returns
    -------
    scipy.sparse.csc_array, shape (n_rows, n_columns)
        Of a symmetric kind (``RSA``), which the file has one triangle of, with both.

    Raises
    ------
    ValueError
        If the matrix is of another kind, or the text does not have the numbers that it announces.
    """
    lines = text.splitlines()
    if len(lines) < 4:
        raise ValueError(f"the header must have four lines (got {len(lines)})")
    counts = [int(lines[1][at : at + 14]) for at in (14, 28, 42)]
    right_hand_sides = int(lines[1][56:70].strip() or 0)
    kind = lines[2][:3].upper()
    if kind not in ("RSA", "RUA"):
        raise ValueError(f"must be real and assembled, RSA or RUA (got {kind!r})")
    n_rows, n_columns, n_entries = (int(lines[2][at : at + 14]) for at in (14, 28, 42))
    formats = lines[3][:16], lines[3][16:32], lines[3][32:52]
    at = 5 if right_hand_sides > 0 else 4
    parts = []
    for count, fortran, expected in zip(counts, formats, (n_columns + 1, n_entries, n_entries), strict=True):
        parts.append(_numbers(lines[at : at + count], fortran, expected))
        at += count
    starts, rows, values = parts
    matrix = sp.csc_array(
        (values.astype(float), rows.astype(np.int64) - 1, starts.astype(np.int64) - 1), shape=(n_rows, n_columns)
    )
    checked(matrix)
    if kind == "RSA":
        matrix = matrix + matrix.T - sp.diags_array(matrix.diagonal())
    return sp.csc_array(matrix)


def _numbers(lines: list[str], fortran: str, expected: int) -> Any:
    """Return the numbers on lines of fixed columns, as of ``(10I8)`` or ``(1P,3D26.18)``.

    Where blanks part as many as are expected, columns do not matter: SciPy writes wider ones than it announces.
    """
    width = re.search(r"[IEDFG](\d+)", fortran.upper())
    if width is None:
        raise ValueError(f"unknown number format {fortran.strip()!r}")
    step = int(width.group(1))
    if step < 1:
        raise ValueError(f"unknown number format {fortran.strip()!r}")
    words = " ".join(lines).split()
    if len(words) != expected:
        words = [line[at : at + step] for line in lines for at in range(0, len(line.rstrip()), step)]
    if len(words) < expected:
        raise ValueError(f"must have {expected} numbers in the format {fortran.strip()} (got {len(words)})")
    return np.array([float(word.upper().replace("D", "E")) for word in words[:expected]])
