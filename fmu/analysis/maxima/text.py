"""The maxima of a posterior side by side, and places of its parameter space, in words."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from fmu.numbers import apart, given, hertz, rounded, share, written_digits
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd

    from fmu.analysis.maxima.results import Maxima, PosteriorMaximum


MOST_SHOWN = 6
"""Maxima that are shown side by side."""
NEGLIGIBLE = 0.01
"""Share of the probability that may be left out."""
RELIABLE = 20.0
"""Effective draws that the mass of a maximum must rest on."""
_FEWEST_DIGITS = 4


def maxima_as_text(found: Maxima, most: int) -> pd.DataFrame:
    """Return the table that `Maxima.side_by_side` describes."""
    import pandas as pd

    best = found.maxima[:most]
    rows = [
        ["", "", *(rounded(m.log_prob, 1.0) for m in best), ""],
        ["", "", *map(share_of_mass, best), ""],
        ["", "", *(str(m.starts) for m in best), ""],
    ]
    for k, unit in enumerate(found.units):
        sd = min((float(m.sd[k]) for m in best if m.share > NEGLIGIBLE and m.sd[k] > 0), default=np.nan)
        rows.append([unit, given(found.start[k]), *apart(*(float(m.theta[k]) for m in best), sd=sd), ""])
    for k in range(len(found.labels)):
        hz = (float(f[k]) for f in (found.before, *(m.frequencies for m in best), found.measured))
        *texts, _ = hertz(*hz, digits=max(_FEWEST_DIGITS, written_digits(found.measured[k])))
        rows.append(["Hz", *texts, given(found.measured[k])])
    index = ["log-probability", "share of mass", "starts", *found.names]
    index += [f"mode {label}" for label in found.labels]
    header = ["unit", "before", *(f"maximum {k}" for k in range(1, len(best) + 1)), "measured"]
    return pd.DataFrame(rows, index=index, columns=header)


def share_of_mass(maximum: PosteriorMaximum) -> str:
    """Return the share of a maximum in words: it is above 0, even where it is too small for a number."""
    return share(max(maximum.share, np.finfo(float).tiny))


def mass_in_words(part: float) -> str:
    """Say what part of the probability there is: ``"about 3 %"``, ``"less than 0.01 %"``."""
    text = share(max(part, np.finfo(float).tiny))
    return text.replace("< ", "less than ").replace("> ", "more than ") if text[0] in "<>" else f"about {text}"


def in_words(names: Iterable[str], theta: FloatArray, units: Iterable[str], sd: FloatArray | None = None) -> str:
    """Name a parameter vector: ``"Ix1 = 3.904e-9 m⁴, Ax1 = 0.0009 m²"``, with the digits that `sd` leaves."""
    spread = np.full(len(theta), np.nan) if sd is None else sd
    parts = zip(names, theta, spread, units, strict=True)
    return ", ".join(f"{name} = {rounded(float(x), float(s))} {unit}".rstrip() for name, x, s, unit in parts)
