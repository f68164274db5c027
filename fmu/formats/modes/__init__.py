"""Readers for measured modes (CSV, UFF, pyOMA) and computed modes (Nastran F06, CalculiX), and writers (UFF, VTU).

Reading order: measured_modes; then one file per format.
"""

from fmu.formats.modes import calculix, f06, pyoma, uff
from fmu.formats.modes.measured_modes import ModesFormat

READERS: dict[str, ModesFormat] = {
    "uff": uff.FORMAT,
    "oma": pyoma.FORMAT,
    "f06": f06.FORMAT,
    "calculix": calculix.FORMAT,
}
"""Formats by their key in ``[measurement]``, which is also the ``reader`` in ``[model] type = "command"``."""
