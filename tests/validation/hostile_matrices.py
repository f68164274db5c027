"""Matrix files: right ones of every kind, to be changed at random, and those that were broken by hand."""

from __future__ import annotations

import gzip
import io
import warnings
from pathlib import Path

import scipy.io
import scipy.sparse as sp

from tests.matrix_files import write_matrix
from tests.validation.hostile_binary import K, hdf5_cases, matlab_cases, numpy_cases
from tests.validation.hostile_text import Writer, boeing_cases, text_cases


def right(suffix: str, path: Path) -> bytes:
    """Return a file of a kind as it should be."""
    if suffix == ".mtx.gz":
        buffer = io.BytesIO()
        scipy.io.mmwrite(buffer, sp.coo_array(K))
        return gzip.compress(buffer.getvalue(), mtime=0)
    if suffix in (".hb", ".rua"):
        with warnings.catch_warnings(action="ignore"):
            scipy.io.hb_write(path, sp.csc_matrix(K))
    elif suffix == "full.mat":
        scipy.io.savemat(path, {"K": K})
    elif suffix == "packed.mat":
        scipy.io.savemat(path, {"K": sp.csc_array(K)}, do_compression=True)
    elif suffix == "abaqus.mtx":
        rows = [f"{i + 1},1, {j + 1},1, {K[i, j]:.17e}" for i in range(5) for j in range(i + 1) if K[i, j]]
        path.write_text("** STIFFNESS\n*MATRIX, TYPE=STIFFNESS\n" + "\n".join(rows) + "\n")
    else:
        write_matrix(path.with_suffix(suffix), K)
        path = path.with_suffix(suffix)
    return path.read_bytes()


KINDS = (
    ".mtx",
    ".mtx.gz",
    ".npz",
    ".npy",
    ".mat",
    "full.mat",
    "packed.mat",
    ".h5",
    ".hb",
    ".rua",
    ".csv",
    "abaqus.mtx",
)
"""All of them are changed at random, too."""


def crafted() -> dict[str, Writer]:
    """Return what writes each file that was made by hand; its name ends as the file's does."""
    return text_cases() | numpy_cases() | matlab_cases() | hdf5_cases() | boeing_cases()
