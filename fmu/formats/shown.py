"""Format values, names and errors for messages: shortened, on one line and without control characters."""

from __future__ import annotations

import datetime
from collections.abc import Collection, Sequence
from itertools import islice
from reprlib import Repr

from fmu.numbers import whole

MOST = 60
"""Largest number of characters shown from a value."""
MOST_NAMES = 12
"""Largest number of names shown in a list."""
MOST_OF_A_LINE = 1000
MOST_TOLD = 20
"""Largest number of error messages listed individually."""
_DIGITS_A_BIT = 0.30103


class _Shown(Repr):
    """A `repr` that shortens long values without formatting them whole. It writes dates and booleans like TOML."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel, self.maxother = 4, MOST
        self.maxlist = self.maxtuple = self.maxdict = self.maxset = 20

    def repr_date(self, x: datetime.date | datetime.time, level: int) -> str:
        return x.isoformat()

    repr_time = repr_datetime = repr_date

    def repr_str(self, x: str, level: int) -> str:
        return repr(x) if len(x) <= MOST else f"{x[:MOST]!r} …"

    def repr_int(self, x: int, level: int) -> str:
        bits = x.bit_length()
        return repr(x) if bits <= 4 * MOST else f"a whole number of {round(bits * _DIGITS_A_BIT)} digits"

    def repr_bool(self, x: bool, level: int) -> str:
        return "true" if x else "false"


_SHOWN = _Shown()


def quote(value: object) -> str:
    """Return a value's text for a message, cut after about `MOST` characters."""
    text = _SHOWN.repr(value)
    return text if len(text) <= MOST + 2 or text.endswith(" …") else f"{text[:MOST]} …"


def names_shown(names: Collection[object]) -> str:
    """Return names joined by commas, each cut after `MOST` characters.

    If there are more than `MOST_NAMES`, give the first ones and the total number.
    """
    first = ", ".join(_cut(str(name), MOST) for name in islice(names, MOST_NAMES))
    return first if len(names) <= MOST_NAMES else f"{first}, … ({len(names)} in all)"


def one_line(text: str, most: int = MOST_OF_A_LINE) -> str:
    """Return a text on one line, cut after `most` characters, with unprintable characters escaped."""
    line = " ".join(_cut(text, 4 * most).split())
    if not line.isprintable():
        line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
    return _cut(line, most)


def list_mistakes(mistakes: Sequence[object]) -> list[str]:
    """Return the first `MOST_TOLD` error messages, each on one line, and a line that counts any others."""
    lines = [one_line(str(mistake)) for mistake in mistakes[:MOST_TOLD]]
    more = len(mistakes) - MOST_TOLD
    return [*lines, f"… and {whole(more)} more"] if more > 0 else lines


def in_words(error: BaseException) -> str:
    """Return an error's type and text on one line, even if converting the error to text fails."""
    name = type(error).__name__ or "an error"
    try:
        text = one_line(str(error), 500)
    except KeyboardInterrupt:
        raise
    except BaseException:
        return f"{name}, whose text cannot be shown"
    return f"{name}: {text}" if text else name


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[:most]} …"
