"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

MISSING = "–"


def table(header: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """Return a Markdown table.

    Parameters
    ----------
    header : sequence of str
    rows : iterable of sequence of str
    left : int
        How many of the first columns hold words and are aligned to the left; the others hold numbers.

    Raises
    ------
    ValueError
        If a row has another length than the header.
    """
    lines = [list(header), [":--" if i < left else "--:" for i in range(len(header))]]
    for row in rows:
        if len(row) != len(header):
            raise ValueError(f"rows: must have {len(header)} cells (got {list(row)})")
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


def interval(mean: float, lower: float, upper: float, style: str) -> str:
    """Return ``mean [lower, upper]``."""
    return f"{mean:{style}} [{lower:{style}}, {upper:{style}}]"
