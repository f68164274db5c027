"""Apply a mesh's constraints to matrices, and express the motions of dependent degrees of freedom.

The constraints are u = T q, where q contains the independent degrees of freedom. Some programs write K and M for
all degrees of freedom u; others write Tᵀ K T and Tᵀ M T for q. The rows show which matrices were written: if a
dependent degree of freedom has a nonzero row, T has not been applied yet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from fmu.formats.constraints.equations import Equation
from fmu.formats.constraints.transformation import Transformation, transformation
from fmu.formats.matrices.limits import MOST_ENTRIES, DofName, Motions, RefusedError
from fmu.formats.models.exported import Mesh
from fmu.formats.shown import names_shown
from fmu.types import DIRECTIONS, FloatArray

_TRIPLES = (DIRECTIONS[:3], DIRECTIONS[3:])


class Constrained(NamedTuple):
    """Matrices on the independent degrees of freedom of a constrained mesh.

    Attributes
    ----------
    matrices : list of csr_array, shape (n_dof, n_dof)
    dofs : list of (node id, direction)
    basis : csr_array, shape (n_rows, n_dof)
        B in u = B q, where u are the rows of the given matrices and q are `dofs`.
    transformation : Transformation, optional
        T in u = T q, or None if there are no constraints.
    notes : list of str
    """

    matrices: list[sp.csr_array]
    dofs: list[DofName]
    basis: sp.csr_array
    transformation: Transformation | None
    notes: list[str]


def constrain(
    matrices: Sequence[sp.csr_array], dofs: Sequence[DofName], mesh: Mesh, means: Motions, *, is_whole: bool
) -> Constrained:
    """Return matrices without dependent and fixed degrees of freedom, together with T in u = T q.

    If the program has already applied the mesh's constraints and supports, the matrices are returned unchanged. T
    is None if the mesh has no constraints.

    Parameters
    ----------
    matrices : sequence of csr_array, shape (n_dof, n_dof)
    dofs : sequence of (node id, direction)
    mesh : Mesh
        Provides the constraints, and the supports if the matrices do not include them yet.
    means : mapping
        Degrees of freedom without rows of their own that are weighted sums of rows, as in
        `fmu.formats.matrices.limits.Labelled.motions`. The constraints may contain them.
    is_whole : bool
        Whether the matrices are known to include the rows that supports hold, so that the supports have not been
        applied. If a dependent degree of freedom has a nonzero row, this is assumed.

    Raises
    ------
    RefusedError
        See `transformation`; or if constraints of the mesh were skipped that the matrices do not include, or if
        the constraints couple too many degrees of freedom, or give matrices that are not finite.
    """
    has_row = np.sum([abs(matrix).sum(axis=1) for matrix in matrices], axis=0) > 0.0
    rows = {name for name, there in zip(dofs, has_row.tolist(), strict=True) if there}
    dependent = {one.dependent for one in mesh.equations}
    is_whole = is_whole or not rows.isdisjoint(dependent)
    if is_whole and mesh.unread:
        raise RefusedError(
            "must have only constraints that fmu reads, as the matrices include none "
            f"({names_shown(mesh.unread)} not read); export matrices to which the program has applied them"
        )
    held = mesh.held if is_whole else mesh.held - rows
    unit = sp.eye_array(len(dofs), format="csr")
    if not mesh.equations:
        free = [i for i, name in enumerate(dofs) if not (is_whole and name in held and name in rows)]
        kept = [dofs[i] for i in free]
        notes = [_of_supports(len(dofs) - len(kept))] if len(kept) < len(dofs) else []
        return Constrained([matrix[free][:, free] for matrix in matrices], kept, unit[:, free], None, notes)
    followed = {name for one in mesh.equations for name in one.weights} - dependent
    own = [Equation(name, weights, "the mean of copies") for name, weights in means.items() if name in followed]
    T = transformation([*mesh.equations, *own], dofs, held)
    if not is_whole:
        return Constrained(list(matrices), list(dofs), unit, T, [])
    _check_fill(T, mesh.equations, rows)
    top = sp.csr_array(T.T[: len(dofs)])
    n_held = len([name for name in held if name in rows])
    notes = [f"{len(dependent)} degrees of freedom follow others by constraints of the mesh."]
    notes += [_of_supports(n_held)] if n_held else []
    order = sorted(
        range(len(T.independent)), key=lambda i: (T.independent[i][0], DIRECTIONS.index(T.independent[i][1]))
    )
    top = sp.csr_array(top[:, order])
    T = T._replace(T=sp.csr_array(T.T[:, order]), independent=[T.independent[i] for i in order])
    reduced = [sp.csr_array(top.T @ matrix @ top) for matrix in matrices]
    if not all(np.all(np.isfinite(matrix.data)) for matrix in reduced):
        raise RefusedError("must have constraints with which the matrices are finite: a lever arm is too long")
    return Constrained(reduced, T.independent, top, T, notes)


def _of_supports(count: int) -> str:
    return f"{count} degrees of freedom are left out: supports of the mesh hold them."


def _check_fill(T: Transformation, equations: Sequence[Equation], rows: set[DofName]) -> None:
    """Raise RefusedError if the constraints couple more than `MOST_ENTRIES` pairs of degrees of freedom."""
    counts = dict(zip(T.dofs, np.diff(T.T.indptr).tolist(), strict=True))
    largest: dict[str, int] = {}
    for one in equations:
        if one.dependent in rows:
            largest[one.source] = max(largest.get(one.source, 0), counts[one.dependent])
    if sum(count**2 for count in largest.values()) > MOST_ENTRIES:
        source = max(largest, key=lambda name: largest[name])
        raise RefusedError(
            f"must have constraints that couple at most {MOST_ENTRIES} pairs of degrees of freedom "
            f"({source} couples each of {largest[source]} to all others)"
        )


def motions_of(
    T: Transformation, dofs: Sequence[DofName], turn: sp.csr_array | None, axes: Mapping[int, FloatArray]
) -> tuple[dict[DofName, dict[DofName, float]], list[str]]:
    """Return the motions along global axes of nodes with dependent degrees of freedom, and notes.

    A motion is left out if it equals a row, is zero, or depends on degrees of freedom without rows. In the last
    case, a note lists the node. At nodes with axes of their own, it is empty in the last two cases, as the row of
    the same name is along another axis.

    Parameters
    ----------
    T : Transformation
    dofs : sequence of (node id, direction)
        Rows of the final matrices. Columns of T whose names are not listed here have no row.
    turn : csr_array, shape (n_dof, n_dof), optional
        Rotation matrix in u = turn u_final, if any rows were rotated to global axes.
    axes : mapping of int to ndarray, shape (3, 3)
        Unit vectors (rows) along each node's own degrees of freedom.
    """
    index = {name: i for i, name in enumerate(dofs)}
    known = [(j, index[name]) for j, name in enumerate(T.independent) if name in index]
    columns, finals = np.array(known, dtype=np.int64).reshape(-1, 2).T
    select = sp.csr_array((np.ones(len(known)), (columns, finals)), shape=(T.T.shape[1], len(dofs)))
    to_final = sp.csr_array(T.T @ (select if turn is None else select @ turn))
    lost = sp.csr_array(abs(T.T)) @ np.isin(np.arange(T.T.shape[1]), columns, invert=True).astype(float) > 0.0
    row_of = {name: i for i, name in enumerate(T.dofs)}
    independent = set(T.independent)
    nodes = dict.fromkeys(node for node, d in T.dofs if (node, d) not in independent)
    place: dict[tuple[int, int], float] = {}
    names: list[DofName] = []
    unknown: dict[int, None] = {}
    found: dict[DofName, dict[DofName, float]] = {}
    for node in nodes:
        for three in _TRIPLES:
            there = [(k, row_of[node, d]) for k, d in enumerate(three) if (node, d) in row_of]
            if all(T.dofs[row] in independent for _, row in there):
                continue
            own = axes.get(node, np.eye(3))
            for j, d in enumerate(three):
                if any(lost[row] and abs(own[k, j]) > 1e-14 for k, row in there):
                    unknown[node] = None
                    found |= {(node, d): {}} if node in axes else {}
                    continue
                seen = [(row, float(own[k, j])) for k, row in there if abs(own[k, j]) > 1e-14]
                if seen:
                    place |= {(len(names), row): weight for row, weight in seen}
                    names.append((node, d))
    notes = []
    if unknown:
        notes.append(f"No sensors can be at nodes that follow others without rows: {names_shown(list(unknown))}.")
    if not names:
        return found, notes
    at, weights = np.array(list(place), dtype=np.int64), np.array(list(place.values()))
    seen_by = sp.csr_array((weights, (at[:, 0], at[:, 1])), shape=(len(names), len(T.dofs))) @ to_final
    seen_by = sp.csr_array(seen_by)
    for i, name in enumerate(names):
        here = slice(seen_by.indptr[i], seen_by.indptr[i + 1])
        seen_at = zip(seen_by.indices[here].tolist(), seen_by.data[here].tolist(), strict=True)
        weights_of = {dofs[j]: weight for j, weight in seen_at if weight}
        is_along_another = not weights_of and name in index and name[0] in axes
        if is_along_another or (weights_of and weights_of != {name: 1.0}):
            found[name] = weights_of
    return found, notes
