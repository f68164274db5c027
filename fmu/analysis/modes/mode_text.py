"""The modes of a model beside the measured ones, as a table to print."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING

from fmu.analysis.modes.pairing_doubts import ComputedMode
from fmu.numbers import MISSING, change, fixed, given, hertz

if TYPE_CHECKING:
    import pandas as pd

    from fmu.analysis.modes.initial_modes import InitialModes

_MANY = 3


def modes_as_text(found: InitialModes) -> pd.DataFrame:
    """Return one row a computed mode, numbers rounded, dashes where nothing applies.

    As many as three in a row and more that move no sensor are one row.
    """
    import pandas as pd

    rows = []
    for is_idle, group in groupby(found.modes, key=lambda mode: not mode.seen and mode.measured is None):
        modes = list(group)
        rows += [_many(modes)] if is_idle and len(modes) >= _MANY else [_one(found, mode) for mode in modes]
    table = pd.DataFrame(rows, dtype=object).fillna(MISSING)
    unknown = [] if found.modes[0].number is not None else ["number"]
    unknown += [] if found.mac is not None else ["MAC"]
    unknown += [] if any(mode.moves for mode in found.modes) else ["moves"]
    return table.drop(columns=unknown)


def _one(found: InitialModes, mode: ComputedMode) -> dict[str, str]:
    row = {"number": str(mode.number), "computed, Hz": _hz(mode.frequency_hz)}
    if mode.measured is None:
        row["measured mode"] = "not measured" if mode.seen else "moves no sensor"
        return row | {"measured, Hz": MISSING, "error": MISSING, "MAC": MISSING, "moves": mode.moves}
    k = mode.measured
    row |= {"measured mode": found.labels[k], "measured, Hz": given(found.measured_hz[k])}
    row["error"] = change(found.error_percent(k) / 100.0)
    row["MAC"] = MISSING if found.mac is None else fixed(found.mac[k, found.modes.index(mode)], 2)
    return row | {"moves": mode.moves}


def _many(modes: Sequence[ComputedMode]) -> dict[str, str]:
    first, last = modes[0], modes[-1]
    return {
        "number": f"{first.number}–{last.number}",
        "computed, Hz": f"{_hz(first.frequency_hz)} to {_hz(last.frequency_hz)}",
        "measured mode": f"{len(modes)} move no sensor",
        "measured, Hz": MISSING,
        "error": MISSING,
        "MAC": MISSING,
        "moves": MISSING,
    }


def _hz(frequency: float) -> str:
    return hertz(frequency)[0]
