"""Make pandas data frames, text tables that fit a terminal, and Markdown tables."""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

    from fmu.types import AnyArray

WIDTH = 100
_GAP = "  "
_NARROWEST = 12
"""Smallest width in characters to which a column of words is narrowed."""


def data_frame(
    content: Mapping[str, object] | Sequence[Mapping[str, object]],
    name: str,
    index: Sequence[object] | AnyArray,
) -> pd.DataFrame:
    """Return a data frame from its columns (a mapping) or its rows (a list of mappings).

    Parameters
    ----------
    content : mapping of str to array_like, or list of mapping
    name : str
        Name of the index.
    index : sequence or ndarray
        The index entry of each row.
    """
    import pandas as pd

    return pd.DataFrame(content, index=pd.Index(index, name=name))


def text_table(
    header: Sequence[str], rows: Sequence[Sequence[str]], words: Collection[int] = (0,), width: int = WIDTH
) -> str:
    """Format a table as text, with columns as wide as their cells.

    If the table would be wider than `width`, columns of words are wrapped. If that is not enough, the remaining
    columns follow below, with the first column repeated.

    Parameters
    ----------
    header : sequence of str
    rows : sequence of sequence of str
        Each row is as long as the header; its first cell names the row.
    words : collection of int
        Indices of columns of words, which are left-aligned; all other columns are right-aligned.
    width : int
        Largest width of the table in characters; exceeded if the first column and a single other one do not fit.
    """
    columns = [[str(cell) for cell in column] for column in zip(header, *rows, strict=True)]
    widths = _fold_columns([max(map(len, column)) for column in columns], words, width)
    blocks = _blocks(widths, width)
    return "\n\n".join("\n".join(_lines(columns, widths, words, block)) for block in blocks)


def wrap_text(text: str, first: str = "", others: str = "", width: int = WIDTH) -> str:
    """Wrap a text to lines of `width` characters, with the given indents; long words are not broken."""
    return textwrap.fill(
        text, width, initial_indent=first, subsequent_indent=others, break_long_words=False, break_on_hyphens=False
    )


def distinct(names: Iterable[str]) -> list[str]:
    """Make names unique by appending underscores to repeated names."""
    found: list[str] = []
    for name in names:
        while name in found:
            name += "_"
        found.append(name)
    return found


def _fold_columns(widths: list[int], words: Collection[int], width: int) -> list[int]:
    """Return the column widths, with columns of words narrowed until the table fits if that is possible."""
    widths = list(widths)
    narrowest = [width // 3] + [_NARROWEST] * (len(widths) - 1)  # names of rows are easier to read on one line
    while sum(widths) + len(_GAP) * (len(widths) - 1) > width:
        widest = max((i for i in words if widths[i] > narrowest[i]), key=lambda i: widths[i], default=None)
        if widest is None:
            break
        widths[widest] -= 1
    return widths


def _blocks(widths: list[int], width: int) -> list[list[int]]:
    """Divide the columns into lists that fit side by side. Each list begins with the first column."""
    blocks = [[0]]
    for column in range(1, len(widths)):
        taken = sum(widths[i] + len(_GAP) for i in blocks[-1])
        if taken + widths[column] > width and len(blocks[-1]) > 1:
            blocks.append([0])
        blocks[-1].append(column)
    return blocks


def _lines(columns: list[list[str]], widths: list[int], words: Collection[int], block: list[int]) -> Iterator[str]:
    """Yield the lines of text of the columns in `block`."""
    for row in zip(*(columns[i] for i in block), strict=True):
        cells = [textwrap.wrap(cell, widths[i]) or [""] for i, cell in zip(block, row, strict=True)]
        for line in range(max(map(len, cells))):
            parts = (cell[line] if line < len(cell) else "" for cell in cells)
            aligned = (
                part.ljust(widths[i]) if i in words else part.rjust(widths[i])
                for i, part in zip(block, parts, strict=True)
            )
            yield _GAP.join(aligned).rstrip()


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]], words: Collection[int] = (0,)) -> str:
    """Format a table in Markdown.

    Parameters
    ----------
    header : sequence of str
    rows : iterable of sequence of str
    words : collection of int
        Indices of columns of words, which are left-aligned; all other columns are right-aligned. Negative indices
        count from the end.

    Raises
    ------
    ValueError
        If a row is not as long as the header.
    """
    n = len(header)
    lines = [list(map(_literal, header)), [":--" if i in words or i - n in words else "--:" for i in range(n)]]
    for row in rows:
        if len(row) != n:
            raise ValueError(f"rows: must have {n} cells (got {list(row)})")
        lines.append(list(map(_literal, row)))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _literal(cell: object) -> str:
    """Return the text of a cell with its vertical bars escaped."""
    return str(cell).replace("|", r"\|")
