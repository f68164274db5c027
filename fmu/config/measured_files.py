"""``uff`` and ``oma`` in ``[measurement]``: modes in files of other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, StringConstraints

from fmu.config.mistakes import BrokenError, Mistake
from fmu.config.tables import FileName, TomlTable
from fmu.formats.modes.measured_modes import LEAST_MPC, MeasuredModes, ModesError
from fmu.formats.modes.pyoma import load_pyoma, pyoma_modes
from fmu.formats.modes.uff import read_uff

NodeNumber = Annotated[str, StringConstraints(pattern=r"^\d{1,9}$")]


class _ModesTable(TomlTable):
    """A file with modes; ``modes`` are the numbers of those to take, all if there are none."""

    file: FileName
    modes: list[Annotated[int, Field(ge=1)]] = []
    least_mpc: Annotated[float, Field(ge=0, le=1)] = LEAST_MPC


class UffTable(_ModesTable):
    """A universal file, dataset 55. ``nodes`` says which place of the model each node of the file is."""

    nodes: dict[NodeNumber, int | str] = {}

    def read(self, folder: Path, sensors: Sequence[tuple[Any, str]]) -> MeasuredModes:
        """Return the modes of the file, at `sensors`, or where anything moves if there are none."""
        return read_uff(
            folder / self.file, self.nodes or None, self.modes or None, sensors or None, self.least_mpc
        )


class OmaTable(_ModesTable):
    """A result of pyOMA_2, written by ``fmu.formats.modes.pyoma.save_pyoma``; its channels are the ``sensors``."""

    def read(self, folder: Path, sensors: Sequence[tuple[Any, str]]) -> MeasuredModes:
        """Return the modes of the file."""
        return pyoma_modes(load_pyoma(folder / self.file), sensors, self.modes or None, self.least_mpc)


def broken(where: str, error: Exception) -> BrokenError:
    """Return what is wrong with a file in the form of this package: each mistake at the key that names it."""
    if isinstance(error, FileNotFoundError):
        return BrokenError([Mistake(where, str(error).removeprefix("path: "))])
    if isinstance(error, ModesError):
        return BrokenError([Mistake(where, mistake) for mistake in error.mistakes])
    return BrokenError([Mistake(where, str(error))])
