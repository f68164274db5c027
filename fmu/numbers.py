"""Format numbers for readers, with as many digits as the uncertainty justifies.

Values that differ are shown with enough digits to look different. This module formats every number in a message,
table, page or label; data files keep all digits.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple, SupportsInt

MISSING = "–"
_MOST_DECIMALS, _MOST_DIGITS = 12, 15
_SMALLEST, _LARGEST = 1e-4, 1e7
"""Range of numbers written in decimal notation; numbers outside it are written with a power of ten."""
_AS_WRITTEN = 10
"""Largest number of digits of a value that a user entered; values with more digits were computed."""
_FREQUENCY_DIGITS = 6
_FEW = 1e-4


_SHOWN = {
    "N/m²": (1e9, "GPa"),
    "m⁴": (1e-12, "mm⁴"),
    "m²": (1e-6, "mm²"),
    "N/m": (1e3, "kN/m"),
    "N·m/rad": (1e3, "kN·m/rad"),
}


class Unit(NamedTuple):
    """A unit for display. A value in SI units is divided by `factor` to give the number in the unit `name`."""

    factor: float
    name: str

    def label(self, quantity: str) -> str:
        """Return an axis label, such as ``"E1 / GPa"``, or the quantity alone if the unit has no name."""
        return f"{quantity} / {self.name}" if self.name else quantity


def customary_unit(unit: str) -> Unit:
    """Return the customary unit that replaces the SI unit `unit`. Other units are kept, with the factor 1."""
    return Unit(*_SHOWN.get(unit, (1.0, unit)))


def with_unit(value: float, unit: str, sd: float = math.nan) -> str:
    """Format a value in SI units in its customary unit, with digits justified by `sd`: ``"170 GPa"``.

    Without `sd`, the value keeps the digits with which it was entered; see `given`.
    """
    factor, name = customary_unit(unit)
    value, sd = value / factor, sd / factor
    return f"{given(value) if math.isnan(sd) else round_by_sd(value, sd)} {name}".rstrip()


def decimals(spread: float) -> int:
    """Return the number of decimals needed to show two significant digits of a standard deviation, at most 12.

    Return 3 if the standard deviation is zero or not finite.
    """
    if not (math.isfinite(spread) and spread > 0):
        return 3
    return min(_MOST_DECIMALS, max(0, -_last_place(spread, 2)))


def fixed(value: float | None, places: int) -> str:
    """Format a number with `places` decimals; None, NaN and infinity give a dash."""
    return MISSING if value is None or not math.isfinite(value) else _drop_sign_of_zero(f"{value:.{places}f}")


def significant(value: float | None, digits: int = 3) -> str:
    """Format a number of unknown uncertainty with up to `digits` significant digits.

    A number below 1e7 keeps all digits before its decimal point. None and NaN give a dash, and infinity gives
    ``"∞"`` or ``"-∞"``.
    """
    if value is None or not math.isfinite(value):
        return MISSING if value is None else _infinite(value)
    text = f"{value:.{digits}g}"
    if (
        "e" in text and _SMALLEST <= abs(value) < _LARGEST
    ):  # such as "1e+03": all digits before the decimal point are shown
        text = f"{value:.0f}"
    return _power(text)


def round_by_sd(value: float, sd: float, digits: int = 4) -> str:
    """Format a value, rounded to the second significant digit of its standard deviation.

    Parameters
    ----------
    value, sd : float
    digits : int
        Number of significant digits if the standard deviation is unknown.
    """
    is_known = math.isfinite(sd) and sd > 0
    return apart(value, sd=sd)[0] if is_known else significant(value, digits)


def with_sd(value: float, sd: float) -> str:
    """Format a value with its standard deviation: ``"41.26 ± 0.15"``, ``"1.729e11 ± 0.022e11"``.

    If either is not finite, or `sd` is not positive, the value has four significant digits and `sd` has two.
    """
    if not (math.isfinite(value) and math.isfinite(sd) and sd > 0):
        return f"{round_by_sd(value, math.nan)} ± {significant(sd, 2)}"
    largest, place = max(abs(value), sd), max(_last_place(sd, 2), _last_place(value, _MOST_DIGITS))
    if _is_plain(largest):
        return f"{_at(value, place, True)} ± {_at(sd, place, True)}"
    exponent = _exponent(largest)
    places, scale = max(0, exponent - place), 10.0**exponent
    power = _power(f"e{exponent:+d}")
    return f"{fixed(value / scale, places)}{power} ± {fixed(sd / scale, places)}{power}"


def apart(*values: float, sd: float = math.nan, digits: int = 4, most: int = _MOST_DIGITS) -> tuple[str, ...]:
    """Format values to the same decimal place, with enough digits that different values look different.

    Parameters
    ----------
    *values : float
    sd : float
        Standard deviation of each value; the values are shown at least to its second significant digit.
    digits : int
        Number of significant digits of the largest value if `sd` is unknown.
    most : int
        Largest number of digits of the largest value; values that differ only beyond it may look the same.

    Returns
    -------
    tuple of str
        One text per value; a dash for NaN, and ``"∞"`` or ``"-∞"`` for an infinite value.
    """
    finite = sorted({value for value in values if math.isfinite(value)})
    largest = max(map(abs, finite), default=0.0)
    is_known = math.isfinite(sd) and sd > 0
    scale = max(largest, sd) if is_known else largest
    if scale == 0.0:
        return tuple(_infinite(value) if value != 0.0 else "0" for value in values)
    place = _last_place(sd, 2) if is_known else _last_place(largest, digits)
    lowest = _last_place(largest or scale, most)
    is_plain = _is_plain(largest) or _is_plain(scale)
    different = len({_at(value, lowest, is_plain) for value in finite})
    while place > lowest and len({_at(value, place, is_plain) for value in finite}) < different:
        place -= 1
    place = max(place, _last_place(largest or scale, _MOST_DIGITS))
    return tuple(_at(value, place, is_plain) if math.isfinite(value) else _infinite(value) for value in values)


def hertz(*values: float, measured: float = math.nan) -> tuple[str, ...]:
    """Format computed frequencies in Hz to 0.1 Hz or finer, with up to six digits if needed to tell them apart.

    Above 100 kHz, six digits are coarser than 0.1 Hz. If `measured` is given, at least as many decimals are shown
    as in the measured frequency.
    """
    largest = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
    digits = min(max(4, _exponent(largest) + 2), _FREQUENCY_DIGITS)
    texts, least = apart(*values, digits=digits, most=_FREQUENCY_DIGITS), given_decimals(measured)
    if all(len(text.partition(".")[2]) >= least for text in texts):
        return texts
    return tuple(fixed(value, least) for value in values)


def given_decimals(value: float) -> int:
    """Return the number of decimals with which `given` formats a value; 0 if it uses a power of ten."""
    text = given(value)
    return 0 if "e" in text else len(text.partition(".")[2])


def with_interval(value: float, low: float, high: float, places: int) -> str:
    """Format a value with an interval, as in a published table: ``"1.0 [0.5, 1.6]"``."""
    return f"{fixed(value, places)} [{fixed(low, places)}, {fixed(high, places)}]"


def interval(lower: float, upper: float, places: int) -> str:
    """Format an interval with `places` decimals: ``"170.1 to 177.3"``, ``"-∞ to 3.0"``."""
    return " to ".join(_infinite(end) if math.isinf(end) else fixed(end, places) for end in (lower, upper))


def given(value: float) -> str:
    """Format a value with the digits with which it was entered, such as ``"0.912"``.

    A value with more than ten digits must have been computed, and is shown with six significant digits.
    """
    if not math.isfinite(value):
        return _infinite(value)
    digits = _digits(value)
    return significant(value, digits if digits <= _AS_WRITTEN else _FREQUENCY_DIGITS)


def typed(value: float) -> str:
    """Format a number with all its digits, for a file or a command line: ``"1.5e+11"``, ``"-0.1"``."""
    short = f"{value:.6g}"
    return short if float(short) == value or math.isnan(value) else repr(float(value))


def _digits(value: float) -> int:
    """Return the number of significant digits that identify a float uniquely."""
    return max(len(repr(float(value)).partition("e")[0].strip("-").replace(".", "").strip("0")), 1)


def share(part: float, digits: int = 2) -> str:
    """Format a fraction as a percentage: ``"19 %"``, ``"99.7 %"``, ``"< 0.01 %"``, ``"> 99.99 %"``.

    The percentage has up to `digits` significant digits, or more if its complement would otherwise have fewer than
    `digits` - 1. It is never written as a power of ten. A fraction that is not finite gives a dash.
    """
    if not math.isfinite(part):
        return MISSING
    if 0.0 < part < _FEW:
        return "< 0.01 %"
    if 1.0 - _FEW < part < 1.0:
        return "> 99.99 %"
    place = min(_last_place(100.0 * part, digits), _last_place(100.0 * (1.0 - part), digits - 1))
    text = f"{100.0 * part:.{max(0, -place)}f}"
    return f"{_drop_sign_of_zero(text.rstrip('0').rstrip('.') if '.' in text else text)} %"


def change(ratio: float) -> str:
    """Format a relative change as a percentage with its sign: ``"+2.54 %"``, ``"-0.07 %"``, ``"> -0.01 %"``.

    The change has three significant digits, but at most two decimals. A change that is not finite gives a dash.
    """
    if not math.isfinite(ratio):
        return MISSING
    if 0.0 < abs(ratio) < _FEW:
        return "< 0.01 %" if ratio > 0 else "> -0.01 %"
    if ratio == 0.0:
        return "0 %"
    places = min(2, max(0, -_last_place(100.0 * ratio, 3)))
    return _drop_sign_of_zero(f"{100.0 * ratio:+.{places}f} %")


def whole(value: SupportsInt | None) -> str:
    """Format a whole number with thousands separators; None, NaN and pandas' NA give a dash."""
    if value is None or str(value) in ("nan", "<NA>"):
        return MISSING
    return f"{int(value):,}".replace(",", " ")


def about(value: float) -> str:
    """Format an estimate to two significant digits, ``"≈ 12 000 000"``; NaN and pandas' NA give a dash."""
    text = whole(value)
    return text if text == MISSING else f"≈ {whole(float(f'{float(value):.2g}'))}"


def listed(values: Iterable[float], digits: int = 3) -> str:
    """Format numbers of unknown uncertainty as a list: ``"0.5, 1.25, 3e10"``."""
    return ", ".join(significant(value, digits) for value in values)


def names_in_words(names: Sequence[str]) -> str:
    """Join names into a list in words: ``"a, b and c"``; the result is empty if there are no names."""
    return "".join(names) if len(names) < 2 else f"{', '.join(names[:-1])} and {names[-1]}"


def _exponent(value: float) -> int:
    """Return the power of ten of a number's first significant digit, or 0 for zero."""
    return int(f"{value:e}".partition("e")[2]) if value else 0


def _last_place(value: float, digits: int) -> int:
    """Return the power of ten of the last of `digits` significant digits of a value, or 0 for zero."""
    return int(f"{value:.{digits - 1}e}".partition("e")[2]) - digits + 1 if value else 0


def _is_plain(scale: float) -> bool:
    return _SMALLEST <= scale < _LARGEST


def _at(value: float, place: int, is_plain: bool) -> str:
    """Format a number to the decimal place 10^`place`, either in decimal notation or with a power of ten."""
    if is_plain:
        return _drop_sign_of_zero(f"{value:.{max(0, -place)}f}")
    digits = _exponent(value) - place
    if value == 0.0 or digits < 0:
        near = round(value / 10.0**place) if value else 0
        return "0" if near == 0 else _power(f"{near}e{place}")
    return _power(f"{value:.{digits}e}")


def _infinite(value: float) -> str:
    return MISSING if math.isnan(value) else "-∞" if value < 0 else "∞"


def _power(text: str) -> str:
    """Drop the plus sign and leading zeros of a formatted number's exponent."""
    mantissa, e, exponent = text.partition("e")
    return _drop_sign_of_zero(f"{mantissa}e{int(exponent)}" if e else mantissa)


def _drop_sign_of_zero(text: str) -> str:
    """Drop the minus sign of a formatted number that is zero."""
    if text.startswith("-") and not any(digit in "123456789" for digit in text.partition("e")[0]):
        text = text[1:]
    return text
