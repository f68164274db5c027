"""``[model] type = "exports"``: K(θ) and M(θ) from matrices that a program exported at several parameter values.

`fmu.fem.exports.from_exports` explains how K(θ) and M(θ) are recovered, `fmu.formats.models.read` lists the file
formats, and `fmu.fem.programs.export_runs` says at which values fmu runs the program itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from fmu.arguments import ArgumentError
from fmu.config.mistakes import BrokenError, Mistakes
from fmu.config.models.matrices import check_stability
from fmu.config.parameters import ModelTable, ParameterTable
from fmu.config.tables import Built, FileName, Name, Positive, TomlTable
from fmu.fem.exports.from_exports import from_exports
from fmu.fem.exports.recovery import Export
from fmu.fem.programs.deck_run import DeckRun
from fmu.fem.programs.export_runs import run_exports, unit_values
from fmu.formats.decks import values_in_deck
from fmu.formats.models.assembly import place_matrix
from fmu.formats.models.exported import NO_MESH, Mesh
from fmu.formats.models.read import MESHES, read_mesh, read_model
from fmu.formats.shown import in_words, names_shown, quote

MOST_EXPORTS = 1000


class ExportedTable(TomlTable):
    """Matrices that a program exported in one run, and the parameter values in this run, in SI units."""

    stiffness: FileName | None = None
    """File of the stiffness matrix or of both matrices, relative to the folder of this file. If not given,
    [model.runs] runs the program."""
    mass: FileName | None = None
    """File of the mass matrix, unless it is next to the stiffness file under the program's own name."""
    values: dict[Name, float] = {}
    """Parameter values: all of them for the first export, only those that differ from the first for the others."""
    check: bool = False
    """Whether this export is only a check: the matrices recovered from the other exports must reproduce it."""


class _Files(NamedTuple):
    """Parameter values, files and input deck of one export."""

    values: Mapping[str, float]
    stiffness: Path
    mass: Path | None = None
    deck: Path = Path()


class RunsTable(TomlTable):
    """A program that fmu runs to export matrices.

    It runs once for each listed export without files. If none are listed, it runs once for each parameter, once
    with all parameters low, and once for a check.
    """

    template: FileName
    """The input deck, relative to the folder of this file, with {NAME} for the value of each parameter: {E1},
    {E1:.9e}, or {E1:8} in a Nastran field. plate.inp.in becomes plate.inp."""
    command: Annotated[list[str], Field(min_length=1, max_length=1000)]
    """The program and its arguments; {job} and {deck} are the name of the deck without and with its suffix."""
    stiffness: FileName
    """The file that the program writes with the stiffness matrix or both matrices; it may contain {job} and
    {deck}."""
    mass: FileName | None = None
    """File of the mass matrix, unless it is next to the stiffness file under the program's own name."""
    inputs: list[FileName] = []
    """Other files that the program needs, relative to the folder of this file; files included in Nastran bulk data
    are added automatically."""
    timeout: Positive = 600.0
    """Time limit for a run in s."""
    store: FileName = "exports"
    """Folder of the runs, relative to the folder of this file; finished runs are not repeated."""


class ExportsTable(ModelTable):
    """Matrices exported at initial values and with each parameter changed.

    Set ``free = true`` if the structure is intentionally unsupported.
    """

    type: Literal["exports"]
    exports: Annotated[list[ExportedTable], Field(max_length=MOST_EXPORTS)] = []
    """Not needed with [model.runs]. The program then runs once per parameter: that parameter has its starting
    value, and all others have a thousandth of theirs, for K(θ) = K_0 + Σ θ_j K_j."""
    runs: RunsTable | None = None
    mesh: FileName | None = None
    """File of nodes, elements and constraints of all exports; by default, with [model.runs], each run's deck."""
    tied_modes: FileName | None = None
    """File of modes that CalculiX printed at all nodes, from which the motion of nodes eliminated by ``*TIE`` is
    found."""
    free: bool = False

    @property
    def decks(self) -> list[str]:
        """List with the template's name, empty if there is no template."""
        return [] if self.runs is None else [self.runs.template]

    def mistakes(self, parameters: Sequence[ParameterTable]) -> list[ArgumentError]:
        """Return the errors found in the exports and the parameters.

        At least two exports are needed without ``[model.runs]``. The first export must give a value for each
        parameter. Without exports, no parameter may start at 0.
        """
        names = [parameter.name for parameter in parameters]
        found = Mistakes()
        if self.runs is None and len(self.exports) < 2:
            found.add("model.exports", "must be at least 2, or be run by [model.runs]", len(self.exports))
        for i, one in enumerate(self.exports):
            if one.stiffness is None and self.runs is None:
                found.add(f"model.exports.{i}.stiffness", "must be given without [model.runs]")
            for name in [name for name in one.values if name not in names]:
                found.add(f"model.exports.{i}.values", f"must be of {names_shown(names)}", quote(name))
        for i, table in enumerate(parameters):
            if self.exports and table.name not in self.exports[0].values:
                found.add(
                    f"parameters.{i}.name", "must have a value in the first of model.exports", quote(table.name)
                )
            if not self.exports and table.start == 0.0:
                found.add(f"parameters.{i}.start", "must not be zero: unit runs have this value", table.start)
        return found + super().mistakes(parameters)

    def build(self, folder: Path, parameters: Sequence[ParameterTable]) -> Built:
        """Recover the model from the exports, after running the program for those without files.

        Raise BrokenError on failure.
        """
        start = {p.name: p.start for p in parameters}
        units = unit_values(start)
        tables = self.exports or [ExportedTable(values=one, check=one is units[-1]) for one in units]
        values = [{name: one.values.get(name, tables[0].values[name]) for name in start} for one in tables]
        runs = self._run_program(folder, tables, values)
        files = [
            runs.get(i)
            or _Files(values[i], folder / (one.stiffness or ""), folder / one.mass if one.mass else None)
            for i, one in enumerate(tables)
        ]
        mesh = self._mesh(folder, next(iter(runs.values())).deck if runs else None)
        exports, found = list[Export](), list[ArgumentError]()
        for i, (one, (own, stiffness, mass, deck)) in enumerate(zip(tables, files, strict=True)):
            # a parameter may be in the constraints of the run's own deck
            its_mesh = self._mesh(folder, deck) if i in runs and self.mesh is None else mesh
            try:
                tied = folder / self.tied_modes if self.tied_modes and not i else None
                read = read_model(stiffness, mass, its_mesh, tied_modes=tied)
                exports.append(Export(own, read, one.check, one.stiffness or stiffness.name))
            except ValueError as error:
                wrong, here = ArgumentError.of(error), f"exports.{i}"
                if one.stiffness is None:
                    here = "runs"
                wrong = wrong.replace_key("path", f"{here}.stiffness").replace_key("mass", f"{here}.mass")
                found.append(wrong.under("model"))
        if found:
            raise BrokenError(*found)
        if not self.exports:  # nodes that parameters move: plotted where these are not a thousandth
            exports[0] = replace(
                exports[0], model=replace(exports[0].model, coordinates=exports[-1].model.coordinates)
            )
        ends = {p.name: (p.lower, p.upper) for p in parameters}
        known = {name: (a, b) for name, (a, b) in ends.items() if a is not None and b is not None}
        try:
            model = from_exports(exports, {name: (0.5 * x, 2.0 * x) for name, x in start.items()} | known)
        except ValueError as error:
            raise BrokenError(ArgumentError.of(error).under("model")) from error
        check_stability(model, parameters, self.free, mesh)
        rows = exports[0].model.rows
        place = None if rows is None else partial(place_matrix, rows=rows, mesh=NO_MESH if mesh is None else mesh)
        return Built(model, {}, model.n_dof, place)

    def _run_program(
        self, folder: Path, tables: Sequence[ExportedTable], values: Sequence[Mapping[str, float]]
    ) -> dict[int, _Files]:
        """Run the program for each export that has no files; return the new files, keyed by export index.

        The dict is empty if all exports have files. Raise BrokenError if the program cannot be run or fails.
        """
        which = [i for i, one in enumerate(tables) if one.stiffness is None]
        if self.runs is None or not which:
            return {}
        own, home = self.runs, folder.resolve()
        run, wrong = DeckRun.of(list(values[0]), own.template, own.command, own.inputs, own.timeout, home)
        if wrong:
            raise BrokenError(*(mistake.under("model.runs") for mistake in wrong))
        needed = [own.stiffness] if own.mass is None else [own.stiffness, own.mass]
        try:
            written = [values_in_deck(run.template, values[i]) for i in which]
            folders = run_exports(run, [values[i] for i in which], needed, home / own.store)
        except OSError as error:
            raise BrokenError(ArgumentError("model.runs", in_words(error))) from error
        except ValueError as error:
            raise BrokenError(ArgumentError("model.runs", str(error))) from error
        return {
            i: _Files(
                at,
                run.find_output(own.stiffness, place),
                run.find_output(own.mass, place) if own.mass else None,
                place / run.deck,
            )
            for i, at, place in zip(which, written, folders, strict=True)
        }

    def _mesh(self, folder: Path, deck: Path | None) -> Mesh | None:
        """Return the mesh in the file ``mesh`` or, if none is given, in a run's deck.

        Return None if there is neither, or if the deck's format cannot be read. Raise
        BrokenError if the file is invalid.
        """
        path, key = None if self.mesh is None else folder / self.mesh, "model.mesh"
        if path is None and deck is not None and deck.suffix.lower() in MESHES:
            path, key = deck, "model.runs.template"
        try:
            return None if path is None else read_mesh(path)
        except ValueError as error:
            raise BrokenError(ArgumentError.of(error).replace_key("path", key)) from error
