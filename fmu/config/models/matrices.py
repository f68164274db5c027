"""``[model] type = "matrices"``: stiffness and mass terms, from files of other programs or as rows of numbers.

`fmu.formats.matrices.read` lists the file formats and explains how to export them from other programs.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, Self, cast

import numpy as np
import scipy.sparse as sp
from pydantic import Field, model_validator

from fmu.arguments import ArgumentError, Place
from fmu.config.mistakes import BrokenError, Mistakes
from fmu.config.models.lines import LineTable, mistakes_of_lines, picture_of
from fmu.config.parameters import ModelTable, ParameterTable
from fmu.config.tables import Built, FileName, Name, SensorTable, TomlTable, Vector, one_length
from fmu.fem.frame.stability import MechanismError, require_stable
from fmu.fem.modes.separable import Geometry, SeparableModel
from fmu.fem.modes.terms import Term
from fmu.formats.matrices.abaqus import HELD
from fmu.formats.matrices.limits import DofName, Labelled
from fmu.formats.matrices.read import read_labelled, symmetric_matrix
from fmu.formats.models.assembly import Assembled, assemble, notes_of, place_matrix
from fmu.formats.models.exported import NO_MESH, Mesh, Rows
from fmu.formats.models.read import read_mesh, read_ties, require_nodes
from fmu.formats.shown import names_shown, quote
from fmu.numbers import typed
from fmu.types import DIRECTIONS

MOST_TERMS = 1000


class TermTable(TomlTable):
    """A matrix in SI units, multiplied by powers of parameters."""

    file: FileName | None = None
    """File of the matrix, relative to the folder of this file."""
    matrix: Annotated[list[list[float]], Field(min_length=1), one_length("column")] | None = None
    """The rows of the matrix, for a small model without files."""
    variable: FileName | None = None
    """Name of the matrix, if the file contains several."""
    triangle: bool | Literal["lower", "upper"] = False
    """Whether only one triangle of the matrix is given; "lower" or "upper" also requires that it is that
    triangle."""
    factor: float = 1.0
    """A number by which the matrix is multiplied."""
    powers: dict[Name, float] = {}
    """Parameters by which the matrix is multiplied, with their powers."""

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.file is None) == (self.matrix is None):
            raise ValueError("must have either file or matrix")
        if self.matrix is not None and self.variable is not None:
            raise ValueError("variable must not be given together with matrix")
        return self

    @property
    def source(self) -> str:
        """Key that gives the matrix."""
        return "matrix" if self.file is None else "file"

    def read(self, folder: Path) -> Labelled:
        """Return the matrix, with row names if its file has them.

        Raise ValueError if it cannot be read.
        """
        if self.file is not None:
            return read_labelled(folder / self.file, self.variable, self.triangle)
        return Labelled(symmetric_matrix(np.array(self.matrix), self.triangle), None)


def check_stability(
    model: SeparableModel, parameters: Sequence[ParameterTable], free: bool, mesh: Mesh | None
) -> None:
    """Raise BrokenError if the structure is a mechanism at the start, or `require_stable` rejects its matrices.

    The notes of the mesh on supports and constraints, which may explain a mechanism, follow in the message.
    """
    try:
        require_stable(model, [table.start for table in parameters], free)
    except ValueError as error:
        said = f"{error}, at the start"
        if isinstance(error, MechanismError):
            said += "" if free else "; set free = true if it is free on purpose"
            said = ". ".join((said, *(note.removesuffix(".") for note in (mesh.notes if mesh else ()))))
        raise BrokenError(ArgumentError("model", said)) from error


class MatricesTable(ModelTable):
    """K(theta) and M(theta) as sums of matrices.

    Set ``free = true`` if the structure is intentionally unsupported.
    """

    type: Literal["matrices"]
    stiffness: Annotated[list[TermTable], Field(min_length=1, max_length=MOST_TERMS)]
    mass: Annotated[list[TermTable], Field(min_length=1, max_length=MOST_TERMS)]
    dofs: list[SensorTable] | None = None
    mesh: FileName | None = None
    """File of nodes and elements for plots, from CalculiX, Abaqus, Ansys or Nastran."""
    tied_modes: FileName | None = None
    """File of modes that CalculiX printed at all nodes, from which the motion of nodes eliminated by ``*TIE`` is
    found."""
    points: dict[Name, Vector] = {}
    """Coordinates in m for plots, if there is no mesh; sensors at places with these names are plotted."""
    lines: list[LineTable] = []
    free: bool = False

    def mistakes(self, parameters: Sequence[ParameterTable]) -> list[ArgumentError]:
        """Return inconsistencies in the tables, such as unknown or unused parameters."""
        names = [parameter.name for parameter in parameters]
        found, used = Mistakes(), set[str]()
        for where, term in self._terms():
            used |= set(term.powers)
            found += [
                ArgumentError(f"{where}.powers", f"must name one of {names_shown(names)}", quote(name))
                for name in term.powers
                if name not in names
            ]
        for i, table in enumerate(parameters):
            if table.name not in used:
                found.add(f"parameters.{i}.name", "must be in the powers of a term", quote(table.name))
        found += mistakes_of_lines(self.points, self.lines, parameters, self.mesh is not None)
        return found + self._of_powers(parameters) + super().mistakes(parameters) + self._of_dofs()

    def build(self, folder: Path, parameters: Sequence[ParameterTable]) -> Built:
        """Read the matrices and build the model. Raise BrokenError on failure."""
        read: list[Labelled] = []
        found: list[ArgumentError] = []
        for where, table in self._terms():
            try:
                read.append(table.read(folder))
            except ValueError as error:
                wrong = ArgumentError.of(error)
                own = wrong if wrong.key in ("variable", "triangle") else ArgumentError(table.source, str(error))
                found.append(own.under(where))
        mesh = NO_MESH
        if self.mesh is not None:
            try:
                mesh = read_mesh(folder / self.mesh)
            except ValueError as error:
                found.append(ArgumentError.of(error).replace_key("path", "model.mesh"))
        if found:
            raise BrokenError(*found)
        joined = self._on_the_same_dofs(read, mesh)
        terms = [
            Term(matrix * table.factor, tuple(table.powers.get(p.name, 0.0) for p in parameters))
            for matrix, (_, table) in zip(joined.matrices, self._terms(), strict=True)
        ]
        n = len(self.stiffness)
        if self.tied_modes is not None:
            try:
                ties, notes = read_ties(folder / self.tied_modes, mesh, joined.dofs, joined.motions)
            except ValueError as error:
                raise BrokenError(ArgumentError("model.tied_modes", str(error))) from error
            joined = joined._replace(motions={**joined.motions, **ties}, notes=[*joined.notes, *notes])
        try:
            model = SeparableModel(
                terms[:n], terms[n:], joined.dofs, Geometry.of_mesh(mesh), motions=joined.motions
            )
            model.notes = (*joined.notes, *mesh.notes)
            model.picture = picture_of(self.points, self.lines, parameters)
        except ValueError as error:
            wrong = ArgumentError.of(error).replace_key("K_terms", "stiffness").replace_key("M_terms", "mass")
            raise BrokenError(ArgumentError("model", f"{wrong}, at the start")) from error
        check_stability(model, parameters, self.free, mesh)
        are_named = mesh is not NO_MESH or read[0].dofs is not None
        return Built(
            model, {}, model.n_dof, partial(self._place, rows=joined.rows, mesh=mesh, are_named=are_named)
        )

    def _place(self, one: Labelled, where: str, rows: Rows, mesh: Mesh, are_named: bool) -> sp.csr_array:
        """Return a further matrix, such as the damping, on the model's degrees of freedom.

        Its rows are named like the rows of the stiffness and mass matrices; `are_named` says whether files or the
        mesh name those. Raise ValueError if the rows of the matrix do not match them.
        """
        if one.dofs is not None and self.dofs is None and not are_named:
            raise ArgumentError(where, "must not name its rows, as the other matrices do not")
        if one.dofs is None and (self.dofs is not None or not are_named):
            names = rows.names if self.dofs is None else tuple((node, str(d)) for node, d in self.dofs)
            if one.matrix.shape[0] != len(names):
                raise ArgumentError(
                    where, f"must have {len(names)} rows, as the other matrices", one.matrix.shape[0]
                )
            one = one._replace(dofs=cast("tuple[DofName, ...]", names))
        return place_matrix(one, where, rows, mesh)

    def _terms(self) -> list[tuple[str, TermTable]]:
        """Return the key and table of each term, stiffness terms first."""
        both = (("stiffness", self.stiffness), ("mass", self.mass))
        return [(f"model.{key}.{i}", term) for key, terms in both for i, term in enumerate(terms)]

    def _of_powers(self, parameters: Sequence[ParameterTable]) -> list[ArgumentError]:
        """Return an error for each term and parameter whose power may be undefined between the bounds."""
        found = Mistakes()
        for where, term in self._terms():
            for i, table in enumerate(parameters):
                power = term.powers.get(table.name, 1.0)
                if (power < 0.0 or not power.is_integer()) and not table.is_positive():
                    rule = f"must be positive, as {where}.powers has it to the power {typed(power)}"
                    found.add(f"parameters.{i}.lower", rule, quote(table.lower))
        return found

    def _of_dofs(self) -> list[ArgumentError]:
        found, seen = Mistakes(), set()
        for i, (node, direction) in enumerate(self.dofs or []):
            if direction not in DIRECTIONS:
                rule = f"must be a node and one of {', '.join(DIRECTIONS)}"
                found.add(f"model.dofs.{i}", rule, quote([node, direction]))
            if (node, direction) in seen:
                found.add(f"model.dofs.{i}", "must not be the name of another row", quote([node, direction]))
            seen.add((node, direction))
        return found

    def _on_the_same_dofs(self, read: Sequence[Labelled], mesh: Mesh) -> Assembled[Place]:
        """Return the matrices on their common degrees of freedom, and the names of these degrees of freedom.

        If the files name their degrees of freedom, a matrix may omit rows that are zero. Degrees of freedom that
        Abaqus fixes by a stiffness of 1e36 are removed. If the files name their degrees of freedom, or if there is
        a mesh, degrees of freedom at which all matrices are zero are removed too. Raise BrokenError if the
        matrices do not fit together.
        """
        rows = [one.matrix.shape[0] for one in read]
        is_known = any(len(names) in rows for names in mesh.sets.values()) and self.dofs is None
        self._check(read, any(one.dofs is not None for one in read) or is_known, is_known)
        named = [(node, str(direction)) for node, direction in self.dofs or []]
        if self.mesh is not None and self.dofs is not None:
            numbered = [(node, direction) for node, direction in named if isinstance(node, int)]
            if len(numbered) < len(named):
                raise BrokenError(ArgumentError("model.dofs", "must be nodes of the mesh, by their numbers"))
            read = [one._replace(dofs=tuple(numbered)) for one in read]
        if self.mesh is not None or read[0].dofs is not None:
            try:
                found = assemble(read, len(self.stiffness), [self._at(k) for k in range(len(read))], mesh)
                if self.mesh is not None:
                    files = [Path(table.file) for _, table in self._terms() if table.file is not None]
                    require_nodes(found.dofs, found.motions, mesh, files)
            except ValueError as error:
                raise BrokenError(ArgumentError.of(error).replace_key("mesh", "model.mesh")) from error
            return found
        matrices = [one.matrix for one in read]
        dofs = named or [(i, "x") for i in range(rows[0])]
        largest = np.max([np.abs(matrix.diagonal()) for matrix in matrices[: len(self.stiffness)]], axis=0)
        free = np.flatnonzero(largest < HELD)
        if len(free) == 0:
            raise BrokenError(ArgumentError("model.stiffness", f"must have a diagonal entry below {typed(HELD)}"))
        own = Rows(tuple(dofs), sp.eye_array(len(dofs), format="csr")[:, free])
        return Assembled(
            [matrix[free][:, free] for matrix in matrices], [dofs[i] for i in free], {}, notes_of(read), own
        )

    def _at(self, k: int) -> str:
        where, table = self._terms()[k]
        return f"{where}.{table.source}"

    def _check(self, read: Sequence[Labelled], are_named: bool, by_mesh: bool = False) -> None:
        """Raise BrokenError if matrices without row names differ in size, or if row names are missing or wrong.

        If `are_named` is True, `dofs` must not be given, and each file must name its degrees of freedom, unless
        the mesh names them (`by_mesh`). Otherwise `dofs`, if given, must have one name per row.
        """
        n, found = read[0].matrix.shape[0], Mistakes()
        for (where, table), one in zip(self._terms(), read, strict=True):
            rows = one.matrix.shape[0]
            if are_named and one.dofs is None and not by_mesh:
                rule = "must name its degrees of freedom, as the other files do"
                found.add(f"{where}.{table.source}", rule)
            elif not are_named and rows != n:
                rule = f"must have {n} rows, as model.stiffness.0 has"
                found.add(f"{where}.{table.source}", rule, rows)
        if self.dofs is not None and are_named:
            found.add("model.dofs", "must not be given: the files name the degrees of freedom")
        elif self.dofs is not None and len(self.dofs) != n:
            found.add("model.dofs", f"must name {n} degrees of freedom, one per row", len(self.dofs))
        if found:
            raise BrokenError(*found)
