"""What reads a matrix from a file of each kind, within limits on what it may take."""

from __future__ import annotations

import gzip
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

LARGEST_FILE = 2**30
"""Bytes of a file, and of what it holds once it is no longer compressed; more is refused before it is read."""
MOST_DOFS = 2**20


class Labelled(NamedTuple):
    """A matrix, and the degrees of freedom (node, direction) of its rows where the file names them."""

    matrix: Any
    dofs: tuple[tuple[int, str], ...] | None


class RefusedError(Exception):
    """What is wrong with a file that was understood."""


def chosen(names: Sequence[str], variable: str | None) -> str:
    """Return which of several variables to read."""
    known = ", ".join(names)
    if not names:
        raise RefusedError("must hold a matrix (it holds none)")
    if variable is None and len(names) > 1:
        raise RefusedError(f"variable: must be given, one of {known}")
    if variable is not None and variable not in names:
        raise RefusedError(f"variable: must be one of {known} (got {variable!r})")
    return names[0] if variable is None else variable


def fitting(n_bytes: int) -> None:
    """Refuse to read more than `LARGEST_FILE` bytes, compressed as they may be."""
    if n_bytes > LARGEST_FILE:
        raise RefusedError(f"must hold at most {LARGEST_FILE} bytes (got {n_bytes})")


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
        return _from_text(file.read())


def _market_gz(path: Path, variable: str | None) -> Any:
    with gzip.open(path) as file:
        content = file.read(LARGEST_FILE + 1)
    fitting(len(content))
    return _from_text(content)


def _from_text(content: bytes) -> Any:
    from fmu.formats import abaqus, matrix_market

    text = content.decode("latin-1")
    if text[: len(matrix_market.BANNER)].lower() == matrix_market.BANNER:
        return matrix_market.parse(text)
    return Labelled(*abaqus.parse(text))


def _npz(path: Path, variable: str | None) -> Any:
    with zipfile.ZipFile(path) as archive:
        fitting(sum(member.file_size for member in archive.infolist()))
    with np.load(path, allow_pickle=False) as content:
        if "format" not in content:
            return content[chosen([name for name in content if content[name].ndim == 2], variable)]
    if variable is not None:
        raise RefusedError(f"variable: the file has one matrix, without a name (got {variable!r})")
    return sp.load_npz(path)


def _npy(path: Path, variable: str | None) -> Any:
    return np.array(np.load(path, mmap_mode="r", allow_pickle=False))


def _mat(path: Path, variable: str | None) -> Any:
    with open(path, "rb") as file:
        head = file.read(128)
    if head.startswith(b"MATLAB 7.3") or head.startswith(b"\x89HDF"):
        return _hdf5(path, variable)
    from fmu.formats.matlab import read

    return read(path.read_bytes(), variable)


def _hdf5(path: Path, variable: str | None) -> Any:
    from fmu.formats.hdf5 import read

    return read(path, variable)


def _harwell_boeing(path: Path, variable: str | None) -> Any:
    from fmu.formats.harwell_boeing import parse

    return parse(path.read_text(encoding="latin-1"))


def _csv(path: Path, variable: str | None) -> Any:
    return np.loadtxt(path, delimiter=",", ndmin=2)


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
