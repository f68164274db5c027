"""Reader for stiffness and mass in Ansys ``.full`` files, using ansys-mapdl-reader in a separate process.

A modal analysis leaves ``file.full`` behind (``WRFULL,1`` stops after writing it). Rows fixed by supports are
empty. The library crashes the process on broken files, and so does mapdl-archive.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from fmu.formats.matrices.isolated import read_isolated
from fmu.formats.matrices.limits import (
    Labelled,
    MatrixFormat,
    RefusedError,
    choose_variable,
    entries_within,
    mirror_triangle,
    rows_within,
)
from fmu.types import DIRECTIONS, AnyArray

LIBRARY = "ansys.mapdl.reader"
EXTRA = "ansys"
NAMES = ("stiffness", "mass")


def full_arrays(path: Path) -> dict[str, AnyArray]:
    """Read the arrays in a ``.full`` file, keyed by name. This requires ansys-mapdl-reader.

    If the file lacks the stiffness or mass matrix, the arrays of that matrix are left out.

    Raises
    ------
    ValueError
        If the file is cut short, or has constraint equations, which the library does not apply.
    RefusedError
        If there are too many rows.
    """
    from ansys.mapdl.reader.common import read_table
    from ansys.mapdl.reader.full import FullFile

    full = FullFile(str(path))
    rows_within(int(full.neqn))
    header = full._header
    if 4 * header["ptrEND"] > path.stat().st_size:
        raise ValueError("it is cut short")
    if header["ncefull"] or header["nceGprime"]:
        raise ValueError(
            f"it has {max(header['ncefull'], header['nceGprime'])} constraint equations (CE, CP, RBE3, contact), "
            "which are not applied to its matrices"
        )
    names, K, M = full.load_km(sort=False)
    with open(path, "rb") as file:
        for _ in range(2):
            read_table(file, skip=True)
        kinds = read_table(file)
    found = {"nodes": names[:, 0], "directions": names[:, 1], "kinds": kinds, "counts": full.ndof}
    for name, matrix in zip(NAMES, (K, M), strict=True):
        if matrix is not None:
            entries = matrix.tocoo()
            found |= {f"{name}_row": entries.row, f"{name}_column": entries.col, f"{name}_entry": entries.data}
    return found


@lru_cache(maxsize=1)
def _arrays(path: Path, _modified: int, _size: int) -> dict[str, AnyArray]:
    """Read the arrays in a file, keyed by name.

    The result is cached until the file changes, because stiffness and mass are read in turn.
    """
    return read_isolated(f"{__name__}:full_arrays", path, LIBRARY, EXTRA)


def _read(path: Path, variable: str | None) -> Labelled:
    """Read the stiffness or mass matrix, with both triangles filled and row names.

    Reading the mass empties the cache. Raise RefusedError if the file cannot be read or has no such matrix, if it
    has both and `variable` is None, if the matrix is too large, or if a row has no direction or is neither a
    displacement nor a rotation.
    """
    status = path.stat()
    found = _arrays(path, status.st_mtime_ns, status.st_size)
    name = choose_variable([name for name in NAMES if f"{name}_row" in found], variable)
    if name == NAMES[-1]:
        _arrays.cache_clear()
    nodes, directions, kinds = (found[key].astype(np.int64) for key in ("nodes", "directions", "kinds"))
    n = len(nodes)
    rows_within(n)
    entries = found[f"{name}_entry"]
    entries_within(2 * len(entries))
    if len(np.unique(nodes)) < n and np.any(directions >= len(kinds)):
        raise RefusedError("must name the direction of each row (it does not)")
    numbers = kinds[directions]
    others = numbers[(numbers < 1) | (numbers > len(DIRECTIONS))]
    if len(others):
        raise RefusedError(
            f"must have displacements and rotations only (got degree of freedom {others[0]} of Ansys)"
        )
    row, column = found[f"{name}_row"], found[f"{name}_column"]
    matrix = sp.csr_array((entries, (row, column)), shape=(n, n))
    dofs = tuple((int(node), DIRECTIONS[k - 1]) for node, k in zip(nodes, numbers, strict=True))
    return Labelled(mirror_triangle(matrix), dofs)


FORMAT = MatrixFormat((".full",), _read, has_names=True)
