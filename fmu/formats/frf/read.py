"""Read frequency response functions from a file in any supported format, recognised by the file suffix."""

from __future__ import annotations

from pathlib import Path

from fmu.arguments import ArgumentError
from fmu.formats.frf import arrays, table, uff
from fmu.formats.frf.measured_frfs import MeasuredFRFs, Wanted
from fmu.formats.modes.measured_modes import ModesError

FORMATS = (uff.FORMAT, table.FORMAT, *arrays.FORMATS)
_FORMAT_OF = {suffix: one for one in FORMATS for suffix in one.suffixes}


def read_frfs(path: Path, wanted: Wanted) -> MeasuredFRFs:
    """Read the FRFs in a file.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ImportError
        If the file is a universal file, and pyuff is not installed.
    ValueError
        If the suffix is unknown, an argument does not apply to the format, the file is invalid or too large, the
        requested FRFs are missing, the points of the FRFs are unknown or their number is wrong, or h5py is needed
        and not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in _FORMAT_OF:
        raise ModesError(path.name, [f"path: must end in {', '.join(_FORMAT_OF)} (got {suffix!r})"])
    one = _FORMAT_OF[suffix]
    for name in ("nodes", "variables"):
        if getattr(wanted, name) and name not in one.takes:
            raise ArgumentError(name, f"must not be given for a {suffix} file", "a mapping")
    return one.read(path, wanted)
