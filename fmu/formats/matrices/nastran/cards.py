"""Reader for Nastran bulk data entries: small, large and free fields, with continuations.

The argument `what` of the field parsers names the value in error messages.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from fmu.formats.matrices.limits import RefusedError
from fmu.formats.shown import quote

MOST_FIELDS = 2**20
"""Largest number of fields in an entry, continuations included."""
LARGEST_ID = 10**9
_SELECTION = re.compile(r"\s*(MPC|SPC)\s*=\s*(\d{1,9})$", re.IGNORECASE)


def cards(lines: Iterator[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield the name and fields of each entry, in upper case and stripped of blanks.

    A continuation must directly follow its entry. Lines before the bulk data are yielded too, as if they were
    entries; a selection of the case control, such as ``MPC = 8``, may be indented and has the name ``MPC=8``.
    Reading stops at ENDDATA.

    Raises
    ------
    RefusedError
        If the deck has superelements, or an entry is too long or repeats fields of the previous entry (=).
    """
    name, fields = "", list[str]()
    for line in lines:
        line = line.partition("$")[0].rstrip()
        if not line:
            continue
        if "\t" in line:
            line = line.expandtabs(8)
        upper = line.upper().lstrip()
        if upper.startswith("BEGIN") and "SUPER" in upper:
            raise RefusedError("must be one structure (it has superelements)")
        if upper.startswith("ENDDATA"):
            break
        selection = _SELECTION.match(line)
        if selection:
            if name:
                yield name, fields
            yield f"{selection[1].upper()}={selection[2]}", []
            name, fields = "", []
            continue
        first, rest = _fields(line)
        if first.startswith("="):
            raise RefusedError("entries that repeat fields of the one before (=) are not read: write each in full")
        if first and first[0] not in "+*":
            if name:
                yield name, fields
            name, fields = first.rstrip("*"), rest
        elif name:
            fields += rest
            if len(fields) > MOST_FIELDS:
                raise RefusedError(f"must have entries of at most {MOST_FIELDS} fields ({name} has more)")
    if name:
        yield name, fields


def _fields(line: str) -> tuple[str, list[str]]:
    """Split a line into its first field and its data fields: 8 in small and free format, 4 in large format."""
    if "," in line:
        first, *words = (word.strip().upper() for word in line.split(","))
        many = 4 if "*" in first else 8
        return first, (words + [""] * many)[:many]
    first = line[:8].strip().upper()
    many, wide = (4, 16) if "*" in first else (8, 8)
    return first, [line[8 + wide * k : 8 + wide * (k + 1)].strip().upper() for k in range(many)]


def whole(field: str, what: str, default: int | None = None) -> int:
    """Return the integer in a field, or the default if the field is empty.

    Raise ValueError if the field is not a whole number, or is empty without a default.
    """
    if not field and default is not None:
        return default
    if not re.fullmatch(r"[+-]?\d{1,10}", field):
        raise ValueError(f"{what} must be a whole number (got {quote(field)})")
    return int(field)


def identity(field: str, what: str) -> int:
    """Return the node, element or coordinate system id in a field.

    Raise ValueError unless it is a whole number between 1 and `LARGEST_ID`.
    """
    number = whole(field, what)
    if not 1 <= number <= LARGEST_ID:
        raise ValueError(f"{what} must be a number from 1 to {LARGEST_ID} (got {number})")
    return number


def number(field: str, what: str, default: float | None = None) -> float:
    """Return the real number in a field, such as ``7.1-3`` or ``7.1D-3``, or the default if the field is empty.

    Raise ValueError if the field is not a real number, or is empty without a default.
    """
    if not field and default is not None:
        return default
    found = re.fullmatch(r"([+-]?(?:\d+\.?\d*|\.\d+))(?:[ED]?([+-]\d{1,4})|[ED](\d{1,4}))?", field)
    if found is None:
        raise ValueError(f"{what} must be a real number (got {quote(field)})")
    return float(f"{found[1]}E{found[2] or found[3] or 0}")


def components(field: str, what: str) -> list[int]:
    """Return the components (1 to 6) in a field such as ``123456``, in ascending order.

    A field that is 0 or empty (scalar point) gives [1]. Raise ValueError if the field has anything else.
    """
    if field in ("", "0"):
        return [1]
    if not re.fullmatch("[1-6]{1,6}", field):
        raise ValueError(f"{what} must be components 1 to 6 (got {quote(field)})")
    return sorted({int(digit) for digit in field})


def expand_list(fields: list[str], what: str) -> list[int]:
    """Return the ids in a list of fields, with ``THRU`` ranges expanded and empty fields skipped.

    Raise ValueError if a field is not an id, and RefusedError if there are more than `MOST_FIELDS` ids.
    """
    words = [field for field in fields if field]
    found: list[int] = []
    at = 0
    while at < len(words):
        first = identity(words[at], what)
        last = first
        if at + 2 < len(words) and words[at + 1] == "THRU":
            last = identity(words[at + 2], what)
            at += 2
        if last - first >= MOST_FIELDS - len(found):
            raise RefusedError(f"{what} must be at most {MOST_FIELDS} numbers")
        found += range(first, last + 1)
        at += 1
    return found
