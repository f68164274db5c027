"""Units that people read: moduli in GPa, second moments of area in mm⁴, areas in mm², springs in kN/m."""

from __future__ import annotations

from typing import NamedTuple

_SHOWN = {
    "N/m²": (1e9, "GPa"),
    "m⁴": (1e-12, "mm⁴"),
    "m²": (1e-6, "mm²"),
    "N/m": (1e3, "kN/m"),
    "N·m/rad": (1e3, "kN·m/rad"),
}


class Unit(NamedTuple):
    """A unit to show numbers in: a number in SI units divided by `factor` is in `name`."""

    factor: float
    name: str

    def label(self, quantity: str) -> str:
        """Return an axis label, ``"E1 / GPa"``; the bare quantity where it has no unit."""
        return f"{quantity} / {self.name}" if self.name else quantity


def shown(unit: str) -> Unit:
    """Return the unit in which numbers given in `unit` are shown: itself, where no other is customary."""
    return Unit(*_SHOWN.get(unit, (1.0, unit)))
