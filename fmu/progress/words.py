"""Format progress reports as text or JSON, with short numbers, and write lines to a stream."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import TextIO

from fmu.numbers import MISSING, fixed, significant

Info = Mapping[str, str | int | float]
"""Further items of a report, by name, such as ``accept``, ``rhat``, ``ess``, ``solves_per_s`` and ``label``."""
Report = Callable[[str, int, int, Info], None]
"""Called as ``report(phase, done, total, info)``: steps done and total steps of a phase, and further items."""
HIDDEN = ("label", "group", "lp", "solves", "elapsed_s")
"""Items not listed beside a bar. The first two are part of the bar's name."""

_RATE = "_per_s"
_DIGITS = {"accept": 2, "rhat": 3}
_PREFIXES = ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"))


def bar_name(phase: str, info: Info) -> str:
    """Return the name of a bar: the phase, preceded by the label and followed by the group, if there are any.

    For example ``hmc draws 1/2``.
    """
    return " ".join(str(part) for part in (info.get("label"), phase, info.get("group")) if part)


def in_words(info: Info, brief: bool = False) -> str:
    """Return the text beside a progress bar: ``accept 0.83 rhat 1.012 ess 1.2k 5.3k solves/s``.

    Items in `HIDDEN` are left out. Rates come last. If `brief` is True, a rate has no name: ``5.3k/s``.
    """
    names = sorted((name for name in info if name not in HIDDEN), key=lambda name: name.endswith(_RATE))
    return " ".join(_item(name, info[name], brief) for name in names)


def duration(seconds: float | None) -> str:
    """Format a time in seconds, rounded up, as ``0:04`` or ``1:02:03``, or as ``-:--`` if it is not known."""
    if seconds is None or not math.isfinite(seconds):
        return "-:--"
    minutes, s = divmod(math.ceil(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{s:02d}" if hours else f"{minutes}:{s:02d}"


def number(value: float) -> str:
    """Format a number with about three digits and a prefix such as ``k`` for thousands: ``1.2k``.

    A number that is not finite becomes a dash.
    """
    if not math.isfinite(value):
        return MISSING
    for size, prefix in _PREFIXES:
        if abs(value) >= 0.9995 * size:
            scaled = value / size
            return f"{fixed(scaled, 1 if abs(scaled) < 99.95 else 0)}{prefix}"
    return fixed(value, 0) if abs(value) >= 99.95 else significant(value)


def as_json(value: object) -> str:
    """Convert a value to JSON text.

    Numbers that are not finite become null. NumPy numbers become ordinary numbers. Other objects that JSON cannot
    represent become text.
    """
    return json.dumps(json.loads(json.dumps(value, default=_plain), parse_constant=lambda name: None))


def _plain(value: object) -> int | float | str:
    if isinstance(value, Integral):
        return int(value)
    return float(value) if isinstance(value, Real) else str(value)


def _item(name: str, value: str | int | float, brief: bool) -> str:
    if isinstance(value, str):
        return f"{name} {value}"
    digits = _DIGITS.get(name)
    text = number(value) if digits is None or not abs(value) < 10.0 else fixed(value, digits)
    if not name.endswith(_RATE):
        return f"{name} {text}"
    return f"{text}/s" if brief else f"{text} {name.removesuffix(_RATE)}/s"


class LineStream:
    """Writes lines to a stream and flushes it after each line. After an error it writes nothing more."""

    def __init__(self, stream: TextIO) -> None:
        self._stream: TextIO | None = stream

    def write(self, line: str) -> None:
        """Write a line and flush the stream."""
        if self._stream is None:
            return
        try:
            self._stream.write(line + "\n")
            self._stream.flush()
        except (OSError, ValueError):  # broken, or closed
            self._stream = None
