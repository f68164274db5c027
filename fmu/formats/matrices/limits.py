"""Limits on what a file of a matrix may hold, and how one that holds more is refused."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

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
