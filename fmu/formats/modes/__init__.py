"""Modes from files: measured ones of CSV, UFF and pyOMA, computed ones of Nastran's F06 and CalculiX.

Reading order: measured_modes; then one file a format.
"""

from fmu.formats.modes import calculix, f06, pyoma, uff
from fmu.formats.modes.measured_modes import ModesFormat

READERS: dict[str, ModesFormat] = {
    "uff": uff.FORMAT,
    "oma": pyoma.FORMAT,
    "f06": f06.FORMAT,
    "calculix": calculix.FORMAT,
}
"""By their keys in ``[measurement]``, and their names as ``reader`` of ``[model] type = "command"``."""
