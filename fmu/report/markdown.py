"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Any

MISSING = "–"


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
    lines = [list(header), [":--" if i in words or i - n in words else "--:" for i in range(n)]]
    for row in rows:
        if len(row) != n:
            raise ValueError(f"rows: must have {n} cells (got {list(row)})")
        lines.append([str(cell).replace("|", r"\|") for cell in row])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def number(value: object, style: str) -> str:
    """Format a number; a dash where there is none."""
    if value is None or value != value:
        return MISSING
    return format(value, style).replace("e-0", "e-").replace("e+0", "e")


def whole(value: Any) -> str:
    """Format a whole number, its thousands apart; a dash where there is none (None, NaN or pandas' NA)."""
    if value is None or str(value) in ("nan", "<NA>"):
        return MISSING
    return f"{int(value):,}".replace(",", " ")


def about(value: Any) -> str:
    """Format an estimate to two significant digits, ``"≈ 12 000 000"``; a dash where there is none."""
    text = whole(value)
    return text if text == MISSING else f"≈ {whole(float(f'{float(value):.2g}'))}"


def interval(mean: float, lower: float, upper: float, style: str) -> str:
    """Return ``mean [lower, upper]``."""
    return f"{mean:{style}} [{lower:{style}}, {upper:{style}}]"
