"""Assembly of matrices on common degrees of freedom, matched by name and rotated to global axes."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from fmu.arguments import ArgumentError
from fmu.formats.constraints.equations import turning_name
from fmu.formats.matrices.abaqus import HELD
from fmu.formats.matrices.limits import Labelled, Matrix, Motions, RefusedError
from fmu.formats.models.constrained import constrain, motions_of
from fmu.formats.models.exported import NO_MESH, DofName, Mesh, Rows
from fmu.formats.shown import names_shown
from fmu.types import DIRECTIONS, FloatArray


class Assembled[Node](NamedTuple):
    """Several matrices on the same degrees of freedom.

    Attributes
    ----------
    matrices : list of csr_array, shape (n_dof, n_dof)
    dofs : list of (node, direction)
        Row names, in ascending order if the nodes are numbers.
    motions : mapping
        See `fmu.formats.models.exported.ExportedModel`.
    notes : list of str
        One sentence for each omission or assumption.
    rows : Rows
        Rows of the given matrices, on which a further matrix can be placed.
    """

    matrices: list[sp.csr_array]
    dofs: Sequence[tuple[Node, str]]
    motions: Motions
    notes: list[str]
    rows: Rows


def assemble(
    read: Sequence[Labelled], n_stiffness: int, where: Sequence[str], mesh: Mesh = NO_MESH
) -> Assembled[int]:
    """Assemble matrices on their common degrees of freedom, leaving out fixed and empty rows.

    Parameters
    ----------
    read : sequence of Labelled
        The matrices. A matrix with named rows may lack rows that are zero. A matrix without row names is given the
        names in the set of `mesh` that has the same number of rows.
    n_stiffness : int
        Number of stiffness matrices, which come first.
    where : sequence of str
        The argument that gave each matrix, for messages.
    mesh : Mesh, optional
        Its constraints and supports are applied, unless the matrices already include them. In that case, the
        constraints are used only for the motions of dependent degrees of freedom; see
        `fmu.formats.models.constrained`. A note lists supported degrees of freedom that keep their rows.

        If nodes of the mesh have their own axes, matrices are rotated to global axes where all three displacements
        (or rotations) of a node have rows. Where some of the three have no row, the other rows keep their axes,
        and `Assembled.motions` gives the displacements (or rotations) along global axes as weighted sums of
        degrees of freedom.

    Raises
    ------
    ValueError
        If rows have no names and no set of `mesh` has the same number of rows, if names are repeated or their
        number is wrong, if a matrix has no degree of freedom in common with the first matrix, if no row is left,
        or if the constraints of the mesh cannot be applied (``mesh:``).
    """
    assumed: dict[str, str] = {}
    named = [_name_rows(one, at, mesh, assumed) for one, at in zip(read, where, strict=True)]
    for names, at in zip(named, where, strict=True):
        if not set(names) & set(named[0]):
            rule = f"must have degrees of freedom that {where[0]} has"
            raise ArgumentError(at, rule, f"{_show_names(names)}; {where[0]} has {_show_names(named[0])}")
    given = dofs = sorted({dof for names in named for dof in names}, key=_order)
    index = {dof: i for i, dof in enumerate(dofs)}
    matrices = [
        _place_rows(one.matrix, [index[dof] for dof in names], len(dofs))
        for one, names in zip(read, named, strict=True)
    ]
    means = {name: weights for one in read for name, weights in one.motions.items()}
    in_equations = {name for one in mesh.equations for name in one.weights}
    loaded = {name: weights for one in read for name, weights in one.if_loaded.items()}
    means |= {name: loaded[name] for name in loaded if name[0] in mesh.loaded or name in in_equations}
    is_whole = _is_whole(read, dofs, mesh, assumed)
    try:
        within = constrain(matrices, dofs, mesh, means, is_whole=is_whole)
    except RefusedError as error:
        raise ArgumentError("mesh", str(error)) from error
    matrices, dofs = within.matrices, within.dofs
    largest = np.max([np.abs(matrix.diagonal()) for matrix in matrices[:n_stiffness]], axis=0)
    is_held = largest >= HELD
    is_empty = np.sum([abs(matrix).sum(axis=1) for matrix in matrices], axis=0) == 0.0
    rows = np.flatnonzero(~is_held & ~is_empty)
    if len(rows) == 0:
        raise ArgumentError(where[0], "must have a row that is neither held nor empty")
    empty = {dofs[i] for i in np.flatnonzero(is_empty & ~is_held)}
    notes = [
        f"{np.sum(which)} degrees of freedom are left out: {why}."
        for which, why in ((is_held, "held by supports"), (is_empty & ~is_held, "without stiffness and mass"))
        if np.any(which)
    ]
    matrices, dofs = [matrix[rows][:, rows] for matrix in matrices], [dofs[i] for i in rows]
    condensed = {*mesh.sets["g"]} - mesh.held if "a" in mesh.sets else set()
    supported = [f"{node} {direction}" for node, direction in dofs if (node, direction) in mesh.held]
    if supported:
        which = names_shown(supported)
        notes.append(f"{len(supported)} degrees of freedom that the mesh holds have rows, and stay free: {which}.")
    turn, motions, told = _turn_axes(dofs, mesh.axes, condensed)
    basis = within.basis[:, rows]
    if turn is not None:
        matrices = [sp.csr_array(turn.T @ matrix @ turn) for matrix in matrices]
        basis = sp.csr_array(basis @ turn)
    filled = [i for i, dof in enumerate(given) if dof not in empty]
    if within.transformation is not None:
        following, lost = motions_of(within.transformation, dofs, turn, mesh.axes)
        motions, told = motions | following, [*told, *lost]
    notes = [*notes_of(read), *assumed, *within.notes, *notes, *told]
    return Assembled(matrices, dofs, motions | means, notes, Rows(tuple(given[i] for i in filled), basis[filled]))


def place_matrix(one: Labelled, where: str, rows: Rows, mesh: Mesh = NO_MESH) -> sp.csr_array:
    """Return a further matrix, such as the damping, on the degrees of freedom of an assembled model.

    Parameters
    ----------
    one : Labelled
        If it does not name its rows, they are named as in `assemble`.
    where : str
        The argument that gave it, for messages.
    rows : Rows
        See `Assembled.rows`.
    mesh : Mesh, optional
        The mesh with which the model was assembled.

    Raises
    ------
    ValueError
        If its rows cannot be named, or one that is not zero has neither stiffness nor mass.
    """
    try:
        return rows.place(one.matrix, _name_rows(one, where, mesh, {}))
    except ArgumentError as error:
        raise error.replace_key("names", where) from None


def _is_whole(read: Sequence[Labelled], dofs: Sequence[DofName], mesh: Mesh, assumed: Mapping[str, str]) -> bool:
    """Return True if the matrices are known to include the rows that supports hold.

    These are sums of element matrices, matrices whose rows are all degrees of freedom of the mesh (the g-set), and
    matrices without row names that have the size of the n-set: Nastran eliminates dependent degrees of freedom
    first, and applies supports to what remains.
    """
    every = set(dofs) == set(mesh.sets.get("g", ()))
    return every or "n" in assumed.values() or any(one.is_whole for one in read)


def notes_of(read: Sequence[Labelled]) -> list[str]:
    """Return the notes on all matrices, such as notes on triangles that were filled in, without duplicates."""
    return list(dict.fromkeys(note for one in read for note in one.notes))


def _name_rows(one: Labelled, where: str, mesh: Mesh, assumed: dict[str, str]) -> tuple[DofName, ...]:
    """Return a matrix's row names, or the names in the mesh set of the same size if the file gives none.

    In the second case, a note that names the set is added to `assumed`. Raise ArgumentError if no set has that
    size, or if the names in the file are repeated or differ in number from the rows.
    """
    n = one.matrix.shape[0]
    if one.dofs is not None and len(one.dofs) != n:
        raise ArgumentError(where, f"must name {n} degrees of freedom", len(one.dofs))
    if one.dofs is not None:
        if len(set(one.dofs)) < n:
            seen: set[DofName] = set()
            twice = next(dof for dof in one.dofs if dof in seen or seen.add(dof))  # type: ignore[func-returns-value]
            raise ArgumentError(where, "must name each degree of freedom once", f"{_show_names([twice])} twice")
        return tuple(turning_name(name, mesh.turning) for name in one.dofs)
    for which, names in mesh.sets.items():
        if len(names) == n:
            assumed[f"Rows have no names: they are taken for the {n} of the {which}-set."] = which
            if not one.in_input_order:
                return names
            place = {node: i for i, node in enumerate(mesh.order)}
            return tuple(sorted(names, key=lambda name: (place[name[0]], DIRECTIONS.index(name[1]))))
    known = ", ".join(f"{len(names)} of the {name}-set" for name, names in mesh.sets.items())
    rule = f"has {n} rows without names: give them in a file of node,direction a row (dofs)"
    if known:
        rule += f", as the mesh has other numbers of rows, {known}; rows that AUTOSPC held are missing in matrices"
        rule += " (SPC1 entries name them; KGG and MGG of MYSTRAN have all rows)"
    raise ArgumentError(where, rule)


def _order(dof: DofName) -> tuple[int, int]:
    return dof[0], DIRECTIONS.index(dof[1])


def _show_names(names: Sequence[DofName]) -> str:
    return names_shown([f"{node} {direction}" for node, direction in names[:3]])


def _place_rows(matrix: Matrix, rows: Sequence[int], n_dof: int) -> sp.csr_array:
    """Expand a matrix to shape (n_dof, n_dof), moving its row and column i to rows[i] and filling with zeros."""
    entries, at = sp.coo_array(matrix), np.asarray(rows)
    return sp.csr_array((entries.data, (at[entries.row], at[entries.col])), shape=(n_dof, n_dof))


def _turn_axes(
    dofs: Sequence[DofName], axes: Mapping[int, FloatArray], condensed: Collection[DofName]
) -> tuple[sp.csr_array | None, dict[DofName, dict[DofName, float]], list[str]]:
    """Return the rotation matrix T in u = T u_global, motions along global axes, and notes.

    The displacements (or rotations) of a node with axes of its own are rotated if all three have rows. If only
    some do, the motions express them along global axes as weighted sums of rows, and a note lists the node.
    Displacements without rows are taken as fixed, except those in `condensed`, whose motion is unknown. A motion
    that depends on one of these is empty. T is None if nothing is rotated.
    """
    index = {dof: i for i, dof in enumerate(dofs)}
    place: dict[tuple[int, int], float] = {}
    motions: dict[DofName, dict[DofName, float]] = {}
    kept: dict[int, None] = {}
    for node, own in axes.items():
        for three in (DIRECTIONS[:3], DIRECTIONS[3:]):
            there = [(k, index[node, d]) for k, d in enumerate(three) if (node, d) in index]
            if len(there) == 3:
                place |= {(row, column): own[k, j] for k, row in there for j, column in there}
            elif there:
                kept[node] = None
                unknown = [k for k, d in enumerate(three) if (node, d) in condensed and (node, d) not in index]
                for j, d in enumerate(three):
                    is_known = not np.any(np.abs(own[unknown, j]) > 1e-14)
                    seen = {dofs[row]: float(own[k, j]) for k, row in there if abs(own[k, j]) > 1e-14}
                    motions[node, d] = seen if is_known else {}
    motions = {name: weights for name, weights in motions.items() if weights or name in index}
    told = [
        f"Rows of {len(kept)} nodes with supports along axes of their own stay so: {names_shown(list(kept))}."
    ] * bool(kept)
    if not place:
        return None, motions, told
    rows, columns = np.array(list(place)).T
    rest = np.setdiff1d(np.arange(len(dofs)), rows)
    turn = sp.csr_array(
        (
            np.concatenate([np.array(list(place.values())), np.ones(len(rest))]),
            (np.concatenate([rows, rest]), np.concatenate([columns, rest])),
        ),
        shape=(len(dofs),) * 2,
    )
    return turn, motions, told
