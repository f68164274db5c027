"""Numbers as people read them: no more digits than their spread gives meaning to."""

from __future__ import annotations

import math

from fmu.report.markdown import MISSING

_MOST = 12


def decimals(spread: float) -> int:
    """Return how many decimals show two significant digits of a standard deviation."""
    if not (math.isfinite(spread) and spread > 0):
        return 3
    return min(_MOST, max(0, 1 - math.floor(math.log10(spread))))


def fixed(value: float, places: int) -> str:
    """Format with a number of decimals; a dash where there is no number."""
    return _signed(f"{value:.{places}f}") if math.isfinite(value) else MISSING


def significant(value: float, digits: int = 3) -> str:
    """Format with a number of significant digits; a dash where there is no number."""
    if not math.isfinite(value):
        return MISSING
    return _signed(f"{value:.{digits}g}".replace("e-0", "e-").replace("e+0", "e").replace("e+", "e"))


def percent(value: float, places: int = 1) -> str:
    """Format a change, its sign always shown: ``"+2.5 %"``."""
    return f"{value:+.{places}f} %".replace("-", "−") if math.isfinite(value) else MISSING


def span(lower: float, upper: float, places: int) -> str:
    """Format an interval: ``"170.1 to 177.3"``, ``"−∞ to 3.0"``."""
    ends = (("−∞" if end < 0 else "∞") if math.isinf(end) else fixed(end, places) for end in (lower, upper))
    return " to ".join(ends)


def _signed(text: str) -> str:
    """Write the minus of mathematics."""
    return text.replace("-", "−")
