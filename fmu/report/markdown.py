"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence


def table(header: Sequence[str], rows: Iterable[Sequence[str]], words: Collection[int] = (0,)) -> str:
    """Return a Markdown table.

    Parameters
    ----------
    header : sequence of str
    rows : iterable of sequence of str
    words : collection of int
        Columns that hold words, aligned to the left; the others hold numbers. Negative ones count from the end.

    Raises
    ------
    ValueError
        If a row has another length than the header.
    """
    n = len(header)
    lines = [list(map(_literal, header)), [":--" if i in words or i - n in words else "--:" for i in range(n)]]
    for row in rows:
        if len(row) != n:
            raise ValueError(f"rows: must have {n} cells (got {list(row)})")
        lines.append(list(map(_literal, row)))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _literal(cell: object) -> str:
    """Return a cell whose bars end no cell."""
    return str(cell).replace("|", r"\|")
