"""Numbers of a run as a bar shows them: short, and in the same places."""

from __future__ import annotations

import math
from collections.abc import Mapping

from fmu.numbers import MISSING, fixed, significant

HIDDEN = ("group", "lp", "solves")
"""What a bar has no room for: the first is part of its name."""

_RATE = "_per_s"
_DIGITS = {"accept": 2, "rhat": 3}
_PREFIXES = ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"))


def bar_name(phase: str, info: Mapping[str, str | int | float]) -> str:
    """Return the name of the bar: one a phase, and one a group of chains where ``info["group"]`` says so."""
    return f"{phase} {info['group']}" if "group" in info else phase


def in_words(info: Mapping[str, str | int | float], brief: bool = False) -> str:
    """Return what a bar says beside how far it is: ``accept 0.83 rhat 1.012 ess 1.2k 5.3k solves/s``.

    Rates come last; `brief` leaves out of what they are: ``5.3k/s``.
    """
    names = sorted((name for name in info if name not in HIDDEN), key=lambda name: name.endswith(_RATE))
    return " ".join(_said(name, info[name], brief) for name in names)


def duration(seconds: float | None) -> str:
    """Return a time as 4.2 s would be, ``0:04``, or ``1:02:03``; ``-:--`` where it is not known."""
    if seconds is None or not math.isfinite(seconds):
        return "-:--"
    minutes, s = divmod(math.ceil(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{s:02d}" if hours else f"{minutes}:{s:02d}"


def number(value: float) -> str:
    """Return a number in three digits, thousands as ``1.2k``; ``–`` for what is not finite."""
    if not math.isfinite(value):
        return MISSING
    for size, prefix in _PREFIXES:
        if abs(value) >= 0.9995 * size:
            scaled = value / size
            return f"{fixed(scaled, 1 if abs(scaled) < 99.95 else 0)}{prefix}"
    return fixed(value, 0) if isinstance(value, int) or abs(value) >= 99.95 else significant(value)


def _said(name: str, value: str | int | float, brief: bool) -> str:
    if isinstance(value, str):
        return f"{name} {value}"
    digits = _DIGITS.get(name)
    text = number(value) if digits is None or not abs(value) < 10.0 else fixed(value, digits)
    if not name.endswith(_RATE):
        return f"{name} {text}"
    return f"{text}/s" if brief else f"{text} {name.removesuffix(_RATE)}/s"
