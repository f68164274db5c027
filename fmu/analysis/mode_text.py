"""The modes of a model beside the measured ones, as a table to print."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING

from fmu.analysis.pairing_doubts import ComputedMode

if TYPE_CHECKING:
    import pandas as pd

    from fmu.analysis.initial_modes import InitialModes

_MANY = 3
_NONE = "–"


def modes_as_text(found: InitialModes) -> pd.DataFrame:
    """Return one row a computed mode, numbers rounded, dashes where nothing applies.

    As many as three in a row and more that move no sensor are one row.
    """
    import pandas as pd

    rows = []
    for is_idle, group in groupby(found.modes, key=lambda mode: not mode.seen and mode.measured is None):
        modes = list(group)
        rows += [_many(modes)] if is_idle and len(modes) >= _MANY else [_one(found, mode) for mode in modes]
    table = pd.DataFrame(rows, dtype=object).fillna(_NONE)
    unknown = [] if found.modes[0].number is not None else ["number"]
    unknown += [] if found.mac is not None else ["MAC"]
    unknown += [] if any(mode.moves for mode in found.modes) else ["moves"]
    return table.drop(columns=unknown)


def _one(found: InitialModes, mode: ComputedMode) -> dict[str, str]:
    row = {"number": str(mode.number), "computed, Hz": _hz(mode.frequency_hz)}
    if mode.measured is None:
        row["measured mode"] = "not measured" if mode.seen else "moves no sensor"
        return row | {"measured, Hz": _NONE, "error, %": _NONE, "MAC": _NONE, "moves": mode.moves}
    k = mode.measured
    row |= {"measured mode": found.labels[k], "measured, Hz": f"{found.measured_hz[k]:.6g}"}
    row["error, %"] = f"{found.error_percent(k):+.2f}"
    row["MAC"] = _NONE if found.mac is None else f"{found.mac[k, found.modes.index(mode)]:.2f}"
    return row | {"moves": mode.moves}


def _many(modes: Sequence[ComputedMode]) -> dict[str, str]:
    first, last = modes[0], modes[-1]
    return {
        "number": f"{first.number}–{last.number}",
        "computed, Hz": f"{_hz(first.frequency_hz)} to {_hz(last.frequency_hz)}",
        "measured mode": f"{len(modes)} move no sensor",
        "measured, Hz": _NONE,
        "error, %": _NONE,
        "MAC": _NONE,
        "moves": _NONE,
    }


def _hz(frequency: float) -> str:
    return f"{frequency:.4g}" if frequency < 1000 else f"{frequency:.1f}"
