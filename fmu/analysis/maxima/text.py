"""The maxima of a posterior side by side, and places of its parameter space, in words."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from fmu.numbers import rounded, share
from fmu.types import FloatArray

MOST_SHOWN = 6
"""Maxima that are shown side by side."""
NEGLIGIBLE = 0.01
"""Share of the probability that may be left out."""
RELIABLE = 20.0
"""Effective draws that the mass of a maximum must rest on."""


def share_of_mass(part: float) -> str:
    """Return the share of a maximum: it is above 0, even where it is too small for a number."""
    return share(max(part, np.finfo(float).tiny))


def mass_in_words(part: float) -> str:
    """Say what part of the probability there is: ``"about 3 %"``, ``"less than 0.01 %"``."""
    text = share_of_mass(part)
    return text.replace("< ", "less than ").replace("> ", "more than ") if text[0] in "<>" else f"about {text}"


def in_words(names: Iterable[str], theta: FloatArray, units: Iterable[str], sd: FloatArray | None = None) -> str:
    """Name a parameter vector: ``"Ix1 = 3.904e-9 m⁴, Ax1 = 0.0009 m²"``, with the digits that `sd` leaves."""
    spread = np.full(len(theta), np.nan) if sd is None else sd
    parts = zip(names, theta, spread, units, strict=True)
    return ", ".join(f"{name} = {rounded(float(x), float(s))} {unit}".rstrip() for name, x, s, unit in parts)
