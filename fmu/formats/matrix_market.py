"""Matrix Market, the text format that most programs can write.

R. F. Boisvert, R. Pozo, K. A. Remington (1996), *The Matrix Market exchange formats: initial design*, NISTIR 5935.
SciPy's reader takes the process down on some broken files.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import scipy.sparse as sp

from fmu.formats.matrix_files import MOST_DOFS, RefusedError, fitting

BANNER = "%%matrixmarket"
_SYMMETRIES = {"general": 0.0, "symmetric": 1.0, "skew-symmetric": -1.0}


def parse(text: str) -> Any:
    """Return the real matrix in the text of a file, with both of its triangles.

    Returns
    -------
    scipy.sparse.coo_array or ndarray

    Raises
    ------
    ValueError
        If the text does not have the numbers that it announces.
    RefusedError
        If the matrix is not real or has no values, or is too large.
    """
    banner, _, rest = text.partition("\n")
    words = banner.lower().split()
    if len(words) != 5 or words[0] != BANNER or words[1] != "matrix" or words[2] not in ("coordinate", "array"):
        raise ValueError(f"unknown kind {banner.strip()!r}")
    layout, field, symmetry = words[2:]
    if field == "pattern":
        raise RefusedError("must have values (a Matrix Market pattern has none)")
    if field == "complex" or symmetry not in _SYMMETRIES:
        raise RefusedError(f"must hold a real square matrix (got {field}, {symmetry})")
    line, _, body = rest.partition("\n")
    while not line.strip() or line.startswith("%"):
        if not body:
            raise ValueError("it is cut short")
        line, _, body = body.partition("\n")
    sizes = [int(word) for word in line.split()]
    if len(sizes) != (3 if layout == "coordinate" else 2) or min(sizes) < 0:
        raise ValueError(f"unknown size {line.strip()!r}")
    if max(sizes[:2]) > MOST_DOFS:
        raise RefusedError(f"must have at most {MOST_DOFS} degrees of freedom (got {max(sizes[:2])})")
    if layout == "array":
        return _full(_table(body, 1).ravel(), sizes[0], sizes[1], _SYMMETRIES[symmetry])
    return _sparse(_table(body, 3), sizes, _SYMMETRIES[symmetry])


def _table(body: str, columns: int) -> Any:
    table = np.loadtxt(io.StringIO(body), comments="%", ndmin=2)
    return table.reshape(-1, columns) if table.size == 0 else table


def _sparse(table: Any, sizes: list[int], sign: float) -> Any:
    if len(table) != sizes[2] or table.shape[1] != 3:
        raise RefusedError(f"must have the {sizes[2]} entries that it announces (got {len(table)})")
    places = table[:, :2].astype(np.int64)
    if np.any(places != table[:, :2]):
        raise ValueError("rows and columns must be whole numbers")
    row, column = (places - 1).T
    matrix = sp.coo_array((table[:, 2], (row, column)), shape=(sizes[0], sizes[1]))
    if not sign:
        return matrix
    return sp.coo_array(matrix + sign * matrix.T - sp.diags_array(matrix.diagonal(), shape=matrix.shape))


def _full(values: Any, rows: int, columns: int, sign: float) -> Any:
    """Return a full matrix from its values column by column; of a symmetric one from the diagonal down."""
    fitting(8 * rows * columns)
    if not sign:
        return values.reshape((rows, columns), order="F")
    matrix = np.zeros((rows, columns))
    column, row = np.triu_indices(rows, 0 if sign > 0 else 1)
    if len(values) != len(row) or rows != columns:
        raise ValueError(f"must have {len(row)} values (got {len(values)})")
    matrix[row, column], matrix[column, row] = values, sign * values
    return matrix
