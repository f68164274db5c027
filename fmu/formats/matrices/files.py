"""What reads a matrix from a file of each kind, within limits on what it may take."""

from __future__ import annotations

import gzip
import math
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import scipy.sparse as sp

from fmu.formats.text import tables

LARGEST_FILE = 2**30
"""Bytes of a file; more is refused before it is read."""
LARGEST_CONTENT = 2**29
"""Bytes of what a file holds once it is no longer compressed."""
MOST_DOFS = 2**20
MOST_ENTRIES = 2**24
"""Of one matrix: 4096 full rows, or 100 000 rows of a solid with 160 each. Reading them takes less than 1 GiB."""
MOST_NAMES = 10_000
"""Variables in a file, and members of its groups."""


class Labelled(NamedTuple):
    """A matrix, and the degrees of freedom (node, direction) of its rows where the file names them."""

    matrix: Any
    dofs: tuple[tuple[int, str], ...] | None


class RefusedError(Exception):
    """What is wrong with a file that was understood."""


def chosen(names: Sequence[str], variable: str | None) -> str:
    """Return which of several variables to read."""
    known = ", ".join([name[:100] for name in names[:12]] + ["…"] * (len(names) > 12))
    if not names:
        raise RefusedError("must hold a matrix (it holds none)")
    if variable is None and len(names) > 1:
        raise RefusedError(f"variable: must be given, one of {known}")
    if variable is not None and variable not in names:
        raise RefusedError(f"variable: must be one of {known} (got {variable!r})")
    return names[0] if variable is None else variable


def fitting(n_bytes: int) -> None:
    """Refuse to read more than `LARGEST_CONTENT` bytes, compressed as they may be."""
    if n_bytes > LARGEST_CONTENT:
        raise RefusedError(f"must hold at most {LARGEST_CONTENT} bytes (got {n_bytes})")


def entries_within(n_entries: int) -> None:
    """Refuse to read more than `MOST_ENTRIES` numbers."""
    if n_entries > MOST_ENTRIES:
        raise RefusedError(f"must have at most {MOST_ENTRIES} entries, both triangles counted (got {n_entries})")


def rows_within(n_rows: int) -> None:
    """Refuse a matrix of more than `MOST_DOFS` rows."""
    if n_rows > MOST_DOFS:
        raise RefusedError(f"must have at most {MOST_DOFS} degrees of freedom (got {n_rows})")


def checked(matrix: Any) -> Any:
    """Return a compressed sparse matrix whose indices all lie within it; ValueError otherwise.

    SciPy's own full check misses inner pointers where the last is zero, or where their difference overflows.
    """
    if np.any(matrix.indptr[1:] < matrix.indptr[:-1]):
        raise ValueError("index pointers must not decrease")
    matrix.check_format(full_check=True)
    return matrix


def _market(path: Path, variable: str | None) -> Any:
    with open(path, "rb") as file:
        return _from_text(file, path.stat().st_size)


def _market_gz(path: Path, variable: str | None) -> Any:
    with gzip.open(path) as file:
        return _from_text(file, None)  # type: ignore[arg-type]


def _from_text(file: BinaryIO, n_bytes: int | None) -> Any:
    from fmu.formats.matrices import abaqus, matrix_market

    start = file.read(len(matrix_market.BANNER))
    file.seek(0)
    if start.lower() == matrix_market.BANNER:
        return matrix_market.parse(file, n_bytes)
    return Labelled(*abaqus.parse(file))


def zipped(path: Path) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays in a file of NumPy by name, once they are known to be few and small enough.

    Raises
    ------
    RefusedError
        If there are too many, or they hold too much.
    Exception
        Whatever zipfile and NumPy make of a broken file.
    """
    with open(path, "rb") as file:
        file.seek(max(path.stat().st_size - 2**16, 0))
        end = file.read(2**16)
    at = end.rfind(b"PK\x05\x06")  # the record that ends a ZIP archive has the bytes of its list of members at 12
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
                shapes[member.filename.removesuffix(".npy")] = announced(file)
        return shapes


def announced(file: Any) -> tuple[int, ...]:
    """Return the shape of an array that NumPy saved, read from its header alone.

    Raises
    ------
    RefusedError
        If it has too many numbers.
    ValueError
        If it has Python objects, which are not unpickled.
    Exception
        Whatever NumPy makes of a broken header.
    """
    major = np.lib.format.read_magic(file)[0]
    read_header = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(file)
    if any(isinstance(n, bool) or n < 0 for n in shape):
        raise ValueError(f"it has an array of the shape {shape}")
    if dtype.hasobject:
        raise ValueError("it has Python objects, which are not read")
    entries_within(math.prod(shape))
    fitting(math.prod(shape) * dtype.itemsize)
    return tuple(int(n) for n in shape)


def _npz(path: Path, variable: str | None) -> Any:
    shapes = zipped(path)
    if "format" not in shapes:
        name = chosen([name for name, shape in shapes.items() if len(shape) == 2], variable)
        with np.load(path, allow_pickle=False) as content:
            return content[name]
    if variable is not None:
        raise RefusedError(f"variable: the file has one matrix, without a name (got {variable!r})")
    return sp.load_npz(path)


def _npy(path: Path, variable: str | None) -> Any:
    with open(path, "rb") as file:
        announced(file)
        file.seek(0)
        return np.load(file, allow_pickle=False)


def _mat(path: Path, variable: str | None) -> Any:
    with open(path, "rb") as file:
        if file.read(10).startswith((b"MATLAB 7.3", b"\x89HDF")):
            return _hdf5(path, variable)
        from fmu.formats.matrices.matlab import read

        return read(file, path.stat().st_size, variable)


def _hdf5(path: Path, variable: str | None) -> Any:
    from fmu.formats.matrices.hdf5 import read

    return read(path, variable)


def _harwell_boeing(path: Path, variable: str | None) -> Any:
    from fmu.formats.matrices.harwell_boeing import parse

    with open(path, "rb") as file:
        return parse(file)


def _csv(path: Path, variable: str | None) -> Any:
    """Return a full matrix: as many rows are read as the first one has numbers, and no more."""
    found: list[Any] = []
    n = 0
    with open(path, "rb") as file:
        for rows in tables(file, "#", ","):
            entries_within(rows.shape[1] ** 2)
            n += len(rows)
            if n > rows.shape[1]:
                raise RefusedError(
                    f"must hold a square matrix (got more than {rows.shape[1]} rows of {rows.shape[1]})"
                )
            found.append(rows)
    return np.concatenate(found) if found else np.zeros((0, 0))


READERS: dict[str, Callable[[Path, str | None], Any]] = {
    ".mtx": _market,
    ".mtx.gz": _market_gz,
    ".npz": _npz,
    ".npy": _npy,
    ".mat": _mat,
    ".h5": _hdf5,
    ".hdf5": _hdf5,
    ".hb": _harwell_boeing,
    ".rsa": _harwell_boeing,
    ".rua": _harwell_boeing,
    ".csv": _csv,
}
SEVERAL = (".npz", ".mat", ".h5", ".hdf5")
