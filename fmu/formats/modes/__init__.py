"""Modes from files: measured ones of CSV, UFF, pyOMA and F06 of Nastran; what CalculiX printed.

Reading order: measured_modes; then one file a format.
"""

from collections.abc import Callable

from fmu.formats.modes.f06 import read_f06
from fmu.formats.modes.measured_modes import MeasuredModes
from fmu.formats.modes.pyoma import read_pyoma
from fmu.formats.modes.uff import read_uff

READERS: dict[str, Callable[..., MeasuredModes]] = {"uff": read_uff, "oma": read_pyoma, "f06": read_f06}
"""By their keys in ``[measurement]``: each returns `MeasuredModes`; its arguments are the keys of its table."""
