"""Input decks of other programs used as templates, in which ``{E1}`` marks the value of parameter E1.

A deck is any text, such as Nastran bulk data, APDL, an ``.inp`` file of Abaqus or CalculiX, or an OpenSees
script::

    $ E1: {E1}, sd {E1 sd}                          ! posterior sd, only for `fmu export`
    MAT1    1       {E1:8}                0.3     7850.
    PSHELL* 1               1               {t:16}1
    MP,EX,1,{E1}
    *ELASTIC
    {E1}, 0.3
    ops.uniaxialMaterial("Elastic", 1, {E1})

``{E1:8}`` and ``{E1:16}`` fill 8 and 16 columns, the widths of Nastran's small and large fields; other widths of
one or two digits are errors. Eight columns hold four digits of 2.1e11. ``{E1:.9e}`` sets the number of decimals or
digits as in Python (with e, f or g).
Other formats, such as ``{E1:12.4e}``, ``{E1:e}`` or ``{E1:100}``, are not recognised and are left unchanged.

A single word in braces must be the name of a value. Other text in braces, as in Tcl or Python, is left unchanged
unless it is such a name; ``{{word}}`` becomes ``{word}``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from fmu.formats.files import too_large, why_no_file
from fmu.formats.shown import list_mistakes, names_shown

MESH_MODES, UPDATED_MODES, MEASURED_MODES = "modes.vtu", "updated.uff", "measured.uff"
VALUES, STIFFNESS, MASS, DOFS, PROBLEM = "theta.csv", "K.mtx", "M.mtx", "dofs.csv", "updated.toml"
EXPORTED = (VALUES, STIFFNESS, MASS, DOFS, PROBLEM, MESH_MODES, UPDATED_MODES, MEASURED_MODES)
"""Names of the other files that `fmu.report.export.export` writes; no deck may have one of these names."""
LARGEST_DECK = 2**26
"""Largest deck size, bytes."""
WIDEST = 20
"""Largest number of characters that Abaqus and CalculiX read in a number; they cut off the rest, even an
exponent."""
FIELDS = (8, 16)
"""Widths of Nastran's small and large fields, columns."""
_BRACES = re.compile(r"\{\{(\w+)\}\}|\{([^{}\n]+?)(?::(\d{1,2}|\.\d{1,2}[eEfgG]))?\}")
_WORD = re.compile(r"[^\W\d]\w*")


def read_deck(path: Path) -> str:
    """Read a deck, preserving line ends and non-UTF-8 bytes.

    Raise ValueError if the file does not exist, is larger than `LARGEST_DECK` or is not text.
    """
    wrong = why_no_file(path) or too_large(path, LARGEST_DECK)
    if wrong:
        raise ValueError(f"must be a text file ({wrong})")
    raw = path.read_bytes()
    if b"\0" in raw:
        raise ValueError("must be a text file (it has NUL characters)")
    return raw.decode("utf-8", "surrogateescape")


def write_deck(path: Path, text: str) -> None:
    """Write a deck in the same encoding that `read_deck` uses."""
    path.write_bytes(text.encode("utf-8", "surrogateescape"))


def placeholders(text: str) -> set[str]:
    """Return the texts in single braces in a deck, each of which may be the name of a placeholder."""
    return {match[2] for match in _BRACES.finditer(text) if match[2] is not None}


def filled_name(name: str) -> str:
    """Return the name of the deck produced from a template: ``"plate.inp"`` for ``"plate.inp.in"``.

    The folder is dropped if the path is absolute or contains ``..``.

    Raises
    ------
    ValueError
        If the template's name does not end with ``.in``, or contains only dots before it.
    """
    path = Path(name)
    if path.suffix != ".in" or not path.stem.strip("."):
        raise ValueError("must end with .in, as plate.inp.in, which gives plate.inp")
    is_inside = not path.is_absolute() and ".." not in path.parts
    return (path.with_suffix("") if is_inside else Path(path.stem)).as_posix()


def fill_deck(text: str, values: Mapping[str, float]) -> str:
    """Return a deck with its placeholders replaced by numbers.

    Parameters
    ----------
    text : str
    values : mapping of str to float
        Parameter values, keyed by placeholder name.

    Raises
    ------
    ValueError
        If the deck has no placeholder, or a placeholder has no value or a width other than 8 or 16. The message
        lists the mistakes with their lines.
    """
    wrong = list(_mistakes(text, values))
    if not wrong and not placeholders(text) & values.keys():
        wrong = [f"must have a placeholder, as {{{next(iter(values), 'E')}}} (it has none)"]
    if wrong:
        raise ValueError("; ".join(list_mistakes(wrong)))

    return _BRACES.sub(lambda match: _fill_in(match, values), text)


def values_in_deck(text: str, values: Mapping[str, float]) -> dict[str, float]:
    """Return the parameter values as the filled deck contains them, rounded for example by ``{E1:8}``.

    A value that is not used in the deck is returned unchanged.

    Raises
    ------
    ValueError
        If a value has different digits in two places of the deck.
    """
    found = dict(values)
    first: dict[str, str] = {}
    for match in _BRACES.finditer(text):
        name = match[2]
        if name not in values:
            continue
        written = _fill_in(match, values).strip()
        if name in first and _read(first[name]) != _read(written):
            raise ValueError(
                f"must have the same digits of {name} everywhere (it has {first[name]} and {written})"
            )
        first.setdefault(name, written)
        found[name] = _read(written)
    return found


def braces_of(text: str) -> str:
    """Return a deck's text in braces alone, which has the same placeholders as the deck."""
    return " ".join(match[0] for match in _BRACES.finditer(text))


def rounded_values(text: str, values: Mapping[str, float]) -> dict[str, float]:
    """Return the parameter values as the filled deck contains them, each with its largest rounding error.

    A comment may have more digits of a value than the field that the program reads.
    """
    found = dict(values)
    for match in _BRACES.finditer(text):
        if (name := match[2]) in values:
            written = _read(_fill_in(match, values))
            found[name] = max(found[name], written, key=lambda x: abs(x - values[name]))
    return found


def _fill_in(match: re.Match[str], values: Mapping[str, float]) -> str:
    """Return the replacement for text in braces.

    It is a number for a placeholder, ``{word}`` for ``{{word}}``, and otherwise the text itself.
    """
    if match[1] is not None:
        return f"{{{match[1]}}}"
    if match[2] not in values:
        return match[0]
    value, form = values[match[2]], match[3]
    if form is None:
        return number(value)
    return columns(value, int(form)) if form.isdecimal() else format(value, form)


def _mistakes(text: str, values: Mapping[str, float]) -> Iterator[str]:
    for match in _BRACES.finditer(text):
        rule = ""
        if match[2] in values and (match[3] or "8").isdecimal() and match[3] not in (None, *map(str, FIELDS)):
            rule = "must have 8 or 16 columns, as a field of Nastran"
        elif match[2] is not None and match[2] not in values and _WORD.fullmatch(match[2]):
            rule = f"must name one of {names_shown(list(values))}"
        if rule:
            yield f"line {text.count('\n', 0, match.start()) + 1}: {match[0]} {rule}"


def number(value: float) -> str:
    """Format a number with a decimal point, in at most `WIDEST` characters: ``"2.1e+11"``."""
    return _shortest(value, WIDEST, "e")


def columns(value: float, width: int) -> str:
    """Format a number in 8 or 16 columns, with Nastran's exponent notation: ``"2.0735+9"``."""
    return _shortest(value, width, "").ljust(width)


def _shortest(value: float, width: int, exponent: str) -> str:
    """Return the text of up to `width` characters that is nearest to `value`, or the shortest one on a tie.

    `exponent` is the letter before the exponent, or "" for Nastran's notation.
    """
    ways = set()
    for digits in range(1, 18):
        mantissa, power = f"{value:.{digits - 1}e}".split("e")
        mantissa = mantissa if "." in mantissa else f"{mantissa}."
        ways.add(f"{mantissa}{exponent}{int(power):+d}")
        fixed = f"{value:.{max(0, digits - 1 - int(power))}f}" if abs(int(power)) < 17 else ""
        ways.add(fixed if "." in fixed else f"{fixed}." if fixed else "")
    if not exponent:
        ways |= {re.sub(r"^(-?)0(?=\.\d)", r"\1", way) for way in ways}
    fitting = (way for way in ways if way and len(way) <= width)
    return min(fitting, key=lambda way: (abs(_read(way) - value), len(way), way))


def _read(text: str) -> float:
    """Convert the text of a number to float. The letter of its exponent may be missing, as in a Nastran field."""
    return float(re.sub(r"(?<=[\d.])([+-])", r"e\1", text) if "e" not in text else text)
