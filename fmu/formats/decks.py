"""Input decks of other programs as templates, with ``{E1}`` where the value of the parameter E1 belongs.

A deck is any text, as bulk data of Nastran, APDL, an ``.inp`` of Abaqus or CalculiX, or a script of OpenSees::

    $ E1: {E1}, sd {E1 sd}                          ! sd: of the posterior, in `fmu export` alone
    MAT1    1       {E1:8}                0.3     7850.
    PSHELL* 1               1               {t:16}1
    MP,EX,1,{E1}
    *ELASTIC
    {E1}, 0.3
    ops.uniaxialMaterial("Elastic", 1, {E1})

``{E1:8}`` and ``{E1:16}`` fill so many columns, as Nastran's small and large fields have; ``{E1:.9e}`` is one of
Python's formats e, f and g. Braces around anything
that is not a single word, as in Tcl or Python, are no placeholders; ``{{word}}`` stands for ``{word}``.
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
"""Files that `fmu.report.export.export` writes besides; no deck may have such a name."""
LARGEST_DECK = 2**26
"""Bytes."""
WIDEST = 20
"""Characters that Abaqus and CalculiX read of a number; what is longer they cut off, its exponent first."""
FIELDS = (8, 16)
"""Columns of Nastran's small and large fields."""
_BRACES = re.compile(r"\{\{(\w+)\}\}|\{([^{}\n]+?)(?::(\d{1,2}|\.\d{1,2}[eEfgG]))?\}")
_WORD = re.compile(r"[^\W\d]\w*")


def read_deck(path: Path) -> str:
    """Read the text of a deck, with its line ends and bytes that are not UTF-8; ValueError if it is no text."""
    wrong = why_no_file(path) or too_large(path, LARGEST_DECK)
    if wrong:
        raise ValueError(f"must be a text file ({wrong})")
    raw = path.read_bytes()
    if b"\0" in raw:
        raise ValueError("must be a text file (it has NUL characters)")
    return raw.decode("utf-8", "surrogateescape")


def write_deck(path: Path, text: str) -> None:
    """Write the text of a deck, in the encoding in which it was read."""
    path.write_bytes(text.encode("utf-8", "surrogateescape"))


def placeholders(text: str) -> set[str]:
    """Return the names of everything in a deck that may be a placeholder."""
    return {match[2] for match in _BRACES.finditer(text) if match[2] is not None}


def filled_name(name: str) -> str:
    """Return the name of the deck that a template gives: ``"plate.inp"`` for ``"plate.inp.in"``.

    Raises
    ------
    ValueError
        If the template's name does not end with ``.in``.
    """
    path = Path(name)
    if path.suffix != ".in" or not path.stem.strip("."):
        raise ValueError("must end with .in, as plate.inp.in, which gives plate.inp")
    is_inside = not path.is_absolute() and ".." not in path.parts
    return (path.with_suffix("") if is_inside else Path(path.stem)).as_posix()


def fill_deck(text: str, values: Mapping[str, float]) -> str:
    """Return a deck with numbers for its placeholders.

    Parameters
    ----------
    text : str
    values : mapping of str to float

    Raises
    ------
    ValueError
        Names every placeholder that is none of `values` or has another width, with its line; or there is none.
    """
    wrong = list(_mistakes(text, values))
    if not wrong and not placeholders(text) & values.keys():
        wrong = [f"must have a placeholder, as {{{next(iter(values), 'E')}}} (it has none)"]
    if wrong:
        raise ValueError("; ".join(list_mistakes(wrong)))

    def write_number(match: re.Match[str]) -> str:
        if match[1] is not None:
            return f"{{{match[1]}}}"
        if match[2] not in values:
            return match[0]
        value, form = values[match[2]], match[3]
        if form is None:
            return number(value)
        return columns(value, int(form)) if form.isdecimal() else format(value, form)

    return _BRACES.sub(write_number, text)


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
    """Return a number with a decimal point, all digits that fit into `WIDEST` characters: ``"2.1e+11"``."""
    return _shortest(value, WIDEST, "e")


def columns(value: float, width: int) -> str:
    """Return a number that fills 8 or 16 columns, its exponent written as Nastran does: ``"2.0735+9"``."""
    return _shortest(value, width, "").ljust(width)


def _shortest(value: float, width: int, exponent: str) -> str:
    """Return the text of at most `width` characters that is closest to `value`; the shortest of several."""
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
    """Return the number in a field of Nastran, where an exponent has no letter."""
    return float(re.sub(r"(?<=[\d.])([+-])", r"e\1", text) if "e" not in text else text)
