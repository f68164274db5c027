"""Numbers from text, a part of the file at a time."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

BLOCK = 2**22
"""Bytes that are read at a time; no line of numbers may be longer."""
MOST_IDLE = 4
"""Blocks without any number in a row."""


def text_blocks(file: BinaryIO) -> Iterator[str]:
    """Give the text of a file in parts that end where a line ends; memory stays within a few blocks.

    Raises
    ------
    ValueError
        If the file is no text, or has a line longer than a block.
    """
    rest = file.read(3).removeprefix(b"\xef\xbb\xbf") if file.tell() == 0 else b""
    while block := file.read(BLOCK):
        if b"\0" in block:
            raise ValueError("it is no text in ASCII or UTF-8: it has NUL bytes, as UTF-16 and binary files have")
        block = rest + block
        end = block.rfind(b"\n") + 1
        rest = block[end:]
        if len(rest) > BLOCK:
            raise ValueError(f"it has a line of more than {BLOCK} bytes")
        yield block[:end].decode("latin-1")
    yield rest.decode("latin-1")


def tables(
    file: BinaryIO,
    comments: str | None,
    delimiter: str | None = None,
    cleaned: Callable[[str], str] = str,
) -> Iterator[NDArray[np.float64]]:
    """Give the rows of numbers in a text, some (n, columns) at a time; lines that are empty do not count.

    Parameters
    ----------
    file : binary file
        From where it stands.
    comments : str or None
        What begins a comment.
    delimiter : str, optional
        Between numbers; blanks if not given.
    cleaned : callable, optional
        What to make of each part of the text first.

    Raises
    ------
    ValueError
        If the file is no text, a word is no number, or a row has not as many numbers as the first.
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
