"""``[model] type = "exports"``: K(θ) and M(θ) from another program's matrices at several values of the parameters.

`fmu.fem.exports.from_exports` explains how K(θ) and M(θ) are recovered, and `fmu.formats.models.read` lists the
file formats.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from fmu.arguments import ArgumentError
from fmu.config.mistakes import BrokenError, Mistakes
from fmu.config.parameters import ModelTable, ParameterTable
from fmu.config.tables import Built, FileName, Name, TomlTable
from fmu.fem.exports.from_exports import from_exports
from fmu.fem.exports.recovery import Export
from fmu.fem.frame.stability import require_stable
from fmu.formats.models.read import read_mesh, read_model
from fmu.formats.shown import names_shown, quote

MOST_EXPORTS = 1000


class ExportedTable(TomlTable):
    """Matrices that the program exported, and the values of its parameters in that run, SI units."""

    stiffness: FileName
    """From the folder of this file: the stiffness, or both matrices."""
    mass: FileName | None = None
    """The mass, if it is in a file that is not beside the stiffness under the program's own name."""
    values: dict[Name, float] = {}
    """Of the parameters: all in the first export, those that differ from it in the others."""
    check: bool = False
    """Not used, but to be reproduced by what is recovered from the others."""


class ExportsTable(ModelTable):
    """Matrices at first values, and with each parameter changed; ``free = true`` if nothing holds it."""

    type: Literal["exports"]
    exports: Annotated[list[ExportedTable], Field(min_length=2, max_length=MOST_EXPORTS)]
    mesh: FileName | None = None
    """Nodes and elements, for pictures."""
    tied_modes: FileName | None = None
    """Modes that CalculiX printed at all nodes: how nodes move that ``*TIE`` leaves without rows."""
    free: bool = False

    def mistakes(self, parameters: Sequence[ParameterTable]) -> list[ArgumentError]:
        """Return the list of errors: values of unknown parameters, parameters without a value, keys of frames."""
        names = [parameter.name for parameter in parameters]
        found = Mistakes()
        for i, one in enumerate(self.exports):
            for name in [name for name in one.values if name not in names]:
                found.add(f"model.exports.{i}.values", f"must be of {names_shown(names)}", quote(name))
        for i, name in enumerate(names):
            if name not in self.exports[0].values:
                found.add(f"parameters.{i}.name", "must have a value in the first of model.exports", quote(name))
        return found + super().mistakes(parameters)

    def build(self, folder: Path, parameters: Sequence[ParameterTable]) -> Built:
        """Return the model that is recovered from the exports; BrokenError if this fails."""
        nominal = self.exports[0].values
        try:
            mesh = None if self.mesh is None else read_mesh(folder / self.mesh)
        except ValueError as error:
            raise BrokenError(ArgumentError.of(error).replace_key("path", "model.mesh")) from error
        exports, found = list[Export](), list[ArgumentError]()
        for i, one in enumerate(self.exports):
            values = {p.name: one.values.get(p.name, nominal[p.name]) for p in parameters}
            try:
                mass = None if one.mass is None else folder / one.mass
                tied = folder / self.tied_modes if self.tied_modes and not i else None
                read = read_model(folder / one.stiffness, mass, mesh, tied_modes=tied)
                exports.append(Export(values, read, one.check, one.stiffness))
            except ValueError as error:
                wrong, here = ArgumentError.of(error), f"exports.{i}"
                wrong = wrong.replace_key("path", f"{here}.stiffness").replace_key("mass", f"{here}.mass")
                found.append(wrong.under("model"))
        if found:
            raise BrokenError(*found)
        ends = ((p.name, p.lower, p.upper) for p in parameters)
        try:
            model = from_exports(exports, {n: (a, b) for n, a, b in ends if a is not None and b is not None})
        except ValueError as error:
            raise BrokenError(ArgumentError.of(error).under("model")) from error
        try:
            require_stable(model, [table.start for table in parameters], self.free)
        except ValueError as error:
            raise BrokenError(ArgumentError("model", f"{error}, at the start")) from error
        return Built(model, {}, model.n_dof)
