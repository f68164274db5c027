"""Interface of matrix formats, file size limits, and text parsers that respect these limits."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import scipy.sparse as sp

from fmu.arguments import ArgumentError
from fmu.formats.shown import names_shown
from fmu.types import FloatArray

LARGEST_FILE = 2**30
"""Largest file size, bytes; a larger file is rejected before it is read."""
LARGEST_CONTENT = 2**29
"""Largest size of a file's decompressed content, bytes."""
MOST_DOFS = 2**20
MOST_ENTRIES = 2**24
"""Largest number of entries in a matrix: 4096 full rows, or 100 000 rows of a solid model with 160 entries each.
Reading them takes less than 1 GiB of memory."""
MOST_NAMES = 10_000
"""Largest number of variables in a file, and of members in a group."""
BLOCK = 2**22
"""Number of bytes read at a time; no line of numbers may be longer."""
MOST_IDLE = 4
"""Largest number of consecutive blocks without a number."""


type Matrix = sp.sparray | FloatArray
DofName = tuple[int, str]
"""Node id and direction, one of `fmu.types.DIRECTIONS`."""
Motions = Mapping[DofName, Mapping[DofName, float]]


class Labelled(NamedTuple):
    """A matrix, with the (node, direction) names of its rows if the file gives them.

    Attributes
    ----------
    matrix : ndarray or sparse array, shape (n_dof, n_dof)
    dofs : tuple of (node, direction), optional
    motions : mapping of (node, direction) to mapping of (node, direction) to float
        Displacements and rotations that are weighted sums of several degrees of freedom, with their weights.
    fill : bool
        Whether a matrix with entries in only one triangle is treated as symmetric.
    notes : tuple of str
        One sentence for each triangle that was filled in.
    in_input_order : bool
        Whether unnamed rows follow MYSTRAN's order of nodes, which `fmu.formats.models.exported.Mesh.order` gives.
        Otherwise they follow ascending node ids.
    if_loaded : mapping of (node, direction) to mapping of (node, direction) to float
        Replaces `motions` for nodes in `fmu.formats.models.exported.Mesh.loaded` and for degrees of freedom in the
        equations of the mesh. It does not hold for others.
    is_whole : bool
        True if the matrix is known to include no supports or constraints, like a sum of element matrices.
    """

    matrix: Matrix
    dofs: tuple[DofName, ...] | None = None
    motions: Mapping[DofName, Mapping[DofName, float]] = {}
    fill: bool = False
    notes: tuple[str, ...] = ()
    in_input_order: bool = False
    is_whole: bool = False
    if_loaded: Mapping[DofName, Mapping[DofName, float]] = {}


@dataclass(frozen=True)
class MatrixFormat:
    """Reader for one matrix file format.

    Attributes
    ----------
    suffixes : tuple of str
        File name suffixes, in lower case.
    read : callable
        ``read(path, variable)`` returns a `Labelled` array or sparse array. A broken file may raise any exception;
        the text of a `RefusedError` is shown unchanged.
    has_names : bool
        Whether a file may contain several named matrices.
    largest : int
        Largest file size in bytes, if it exceeds `LARGEST_FILE` because the reader keeps only nonzero entries.
    """

    suffixes: tuple[str, ...]
    read: Callable[[Path, str | None], Labelled]
    has_names: bool = False
    largest: int | None = None


class RefusedError(Exception):
    """Raised when a file is refused, with a message for the user.

    Reasons are missing or unsupported content, a size limit that is exceeded, a constraint that cannot be applied,
    or a reader that fails in its separate process.

    Attributes
    ----------
    record : ArgumentError
        Its key is ``variable`` if the matrix name is at fault; otherwise it is empty.
    """

    def __init__(self, rule: str, key: str = "") -> None:
        self.record = ArgumentError(key, rule)
        super().__init__(str(self.record))


class NoMatrixError(RefusedError):
    """Raised when a readable file contains no matrix."""


class SeveralError(RefusedError):
    """Raised when a file contains several matrices and the user named none.

    Attributes
    ----------
    names : tuple of str
        Names of the matrices in the file.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        super().__init__(f"must be given, one of {names_shown(names)}", "variable")


def choose_variable(names: Sequence[str], variable: str | None) -> str:
    """Return the name of the matrix to read: `variable`, or the only name in the file if it is None.

    Raises
    ------
    NoMatrixError, SeveralError
        If the file has no matrix, or has several and `variable` is None.
    RefusedError
        If the file has no matrix named `variable`.
    """
    if not names:
        raise NoMatrixError("must hold a matrix (it holds none)")
    if variable is None and len(names) > 1:
        raise SeveralError(names)
    if variable is not None and variable not in names:
        raise RefusedError(f"must be one of {names_shown(names)} (got {variable!r})", "variable")
    return names[0] if variable is None else variable


def fitting(n_bytes: int) -> None:
    """Raise RefusedError if the decompressed content, `n_bytes`, is larger than `LARGEST_CONTENT`."""
    if n_bytes > LARGEST_CONTENT:
        raise RefusedError(f"must hold at most {LARGEST_CONTENT} bytes (got {n_bytes})")


def entries_within(n_entries: int) -> None:
    """Raise RefusedError if there are more than `MOST_ENTRIES` entries."""
    if n_entries > MOST_ENTRIES:
        raise RefusedError(f"must have at most {MOST_ENTRIES} entries, both triangles counted (got {n_entries})")


def rows_within(n_rows: int) -> None:
    """Raise RefusedError if a matrix has more than `MOST_DOFS` rows."""
    if n_rows > MOST_DOFS:
        raise RefusedError(f"must have at most {MOST_DOFS} degrees of freedom (got {n_rows})")


def check_indices(matrix: sp.sparray) -> None:
    """Raise ValueError if a compressed sparse matrix has an index out of range, or pointers that decrease.

    Matrices in other formats are not checked. The pointers are checked separately, because SciPy's full check
    misses wrong pointers if the last pointer is zero or a difference overflows.
    """
    if matrix.format not in ("csr", "csc"):
        return
    if np.any(matrix.indptr[1:] < matrix.indptr[:-1]):
        raise ValueError("index pointers must not decrease")
    matrix.check_format(full_check=True)


def mirror_triangle(matrix: sp.sparray) -> sp.csr_array:
    """Return a symmetric matrix in full, given one that stores only one entry of each symmetric pair.

    Raises
    ------
    RefusedError
        If the matrix has both entries of a pair.
    """
    upper, lower = sp.triu(matrix, 1, format="csr"), sp.tril(matrix, -1, format="csr")
    if upper.astype(bool).multiply(lower.T.astype(bool)).nnz:
        raise RefusedError("must have each pair of entries once (it has both of some)")
    return sp.csr_array(matrix + upper.T + lower.T)


def from_triplets(table: FloatArray, name: str, size: tuple[int, int] | None = None) -> Labelled:
    """Build a sparse matrix from a table (n, 3) with columns row, column (both counted from 1) and entry.

    Duplicate entries are added, as in MATLAB's ``sparse``. If only one triangle has entries, the matrix is treated
    as symmetric (`Labelled.fill`). `size` gives the numbers of rows and columns. By default, the matrix is square,
    and the largest row or column number is its size.

    Raises
    ------
    ValueError
        If a row or column is not a whole number from 1, or is larger than `size`.
    RefusedError
        If the matrix is too large.
    """
    entries_within(len(table))
    places = table[:, :2]
    if np.any(places != np.floor(places)) or np.any(places < 1) or np.any(places > 2**31):
        raise ValueError(f"{name} must have rows and columns that are whole numbers from 1")
    row, column = places.astype(np.int64).T - 1
    shape = size or (max(int(row.max(initial=0)), int(column.max(initial=0))) + 1,) * 2
    rows_within(max(shape))
    return Labelled(sp.csr_array((table[:, 2], (row, column)), shape=shape), fill=True)


def text_blocks(file: BinaryIO) -> Iterator[str]:
    """Yield a file's text in blocks of whole lines, so that memory use stays limited.

    Raises
    ------
    ValueError
        If the file is not text, or has a line longer than a block.
    """
    rest = file.read(3).removeprefix(b"\xef\xbb\xbf") if file.tell() == 0 else b""
    while block := file.read(BLOCK):
        if b"\0" in block:
            raise ValueError("it is not ASCII or UTF-8 text: it has NUL bytes, as UTF-16 and binary files have")
        block = rest + block
        end = block.rfind(b"\n") + 1
        rest = block[end:]
        if len(rest) > BLOCK:
            raise ValueError(f"it has a line of more than {BLOCK} bytes")
        yield block[:end].decode("latin-1")
    yield rest.decode("latin-1")


def text_lines(file: BinaryIO) -> Iterator[str]:
    """Yield the lines of a text file without their line-end characters; see `text_blocks`."""
    for text in text_blocks(file):
        yield from (line.rstrip("\r") for line in text.removesuffix("\n").split("\n"))


def tables(
    file: BinaryIO,
    comments: str | None,
    delimiter: str | None = None,
    cleaned: Callable[[str], str] = str,
) -> Iterator[FloatArray]:
    """Parse numeric text, and yield arrays (n_rows, n_columns) of consecutive rows. Empty lines are skipped.

    Parameters
    ----------
    file : binary file
        Read from its current position.
    comments : str or None
        The character that begins a comment.
    delimiter : str, optional
        Separator between numbers. Defaults to blanks.
    cleaned : callable, optional
        Function that is applied to each block of text before it is parsed.

    Raises
    ------
    ValueError
        If the file is not text, a word is not a number, the rows do not all have the same number of values, or
        more than `MOST_IDLE` blocks in a row have no numbers.
    """
    columns, idle = 0, 0
    for text in text_blocks(file):
        text = cleaned(text)
        if not text or text.isspace():
            rows = np.zeros((0, columns))
        else:
            rows = np.loadtxt(io.StringIO(text), comments=comments, delimiter=delimiter, ndmin=2)
        idle = 0 if len(rows) else idle + 1
        if idle > MOST_IDLE:
            raise ValueError(f"it has more than {MOST_IDLE * BLOCK} bytes in a row without a number")
        if len(rows):
            if columns and rows.shape[1] != columns:
                raise ValueError(f"each row must have {columns} numbers, as the first has (got {rows.shape[1]})")
            columns = rows.shape[1]
            yield rows
