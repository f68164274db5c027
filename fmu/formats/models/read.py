"""Models from files of other programs: matrices, names of their degrees of freedom, and the mesh.

==================  ============================================  =====================
program             stiffness and mass                            mesh
==================  ============================================  =====================
CalculiX            ``job.sti``, ``job.mas`` and ``job.dof``      ``job.inp``
Abaqus              ``job_STIF1.mtx`` and ``job_MASS1.mtx``       ``job.inp``
==================  ============================================  =====================

Units are the program's: fmu takes them for SI units.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from fmu.formats.files import too_large, why_no_file
from fmu.formats.matrices.abaqus import HELD
from fmu.formats.matrices.limits import LARGEST_FILE, Labelled, RefusedError
from fmu.formats.matrices.read import read_labelled
from fmu.formats.models import FORMATS
from fmu.formats.models.exported import NO_MESH, DofName, ExportedModel, Mesh
from fmu.formats.shown import names_shown
from fmu.types import DIRECTIONS

_FORMAT_OF = {suffix: form for form in FORMATS for suffix in form.suffixes}


def read_model(path: str | Path, mass: str | Path | None = None, mesh: str | Path | None = None) -> ExportedModel:
    """Read stiffness, mass, names of the degrees of freedom and mesh of a model that another program exported.

    Parameters
    ----------
    path : path
        The stiffness, or both matrices.
    mass : path, optional
        The mass, where it is in another file than the stiffness. By default the file beside it that the program
        writes: ``job.mas`` for ``job.sti``.
    mesh : path, optional
        Nodes and elements.

    Returns
    -------
    ExportedModel
        Rows without stiffness and mass are left out, and so are those that Abaqus marks as held.

    Raises
    ------
    ValueError
        If a file does not exist, is broken, of another kind or of another model. The text begins with the argument
        at fault: ``path:``, ``mass:`` or ``mesh:``.
    """
    path = Path(path)
    beside = _mass_beside(path) if mass is None else Path(mass)
    K, M = _matrix("path", path), _matrix("mass", beside)
    found = NO_MESH if mesh is None else _told("mesh", lambda: read_mesh(mesh))
    matrices, dofs, notes = on_the_same_dofs([K, M], 1, ("path", "mass"))
    motions = {**K.motions, **M.motions}
    known = set(found.nodes.tolist())
    if mesh is not None:
        named = {node for node, _ in motions} | {node for node, _ in dofs} - {
            node for weights in motions.values() for node, _ in weights
        }
        if not named & known:
            raise ValueError(
                f"mesh: must have the nodes of the matrices, such as {names_shown(sorted(named)[:3])} (got none)"
            )
    return ExportedModel(
        matrices[0],
        matrices[1],
        tuple(dofs),
        found.nodes,
        found.coordinates,
        found.elements,
        found.kinds,
        (*notes, *found.notes),
        motions,
    )


def read_mesh(path: str | Path) -> Mesh:
    """Read nodes and elements.

    Parameters
    ----------
    path : path

    Returns
    -------
    Mesh
        ``(nodes, coordinates, elements, kinds, …)``.

    Raises
    ------
    ValueError
        If the file does not exist, is of another kind, broken or too large.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _FORMAT_OF:
        raise ValueError(f"must end in {', '.join(_FORMAT_OF)} (got {path.name!r})")
    why = why_no_file(path)
    if why:
        raise ValueError(f"must be a file ({why})")
    if too_large(path, LARGEST_FILE):
        raise ValueError(too_large(path, LARGEST_FILE))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return _FORMAT_OF[suffix].read(path)
    except RefusedError as refused:
        raise ValueError(f"{path.name}: {refused}") from None
    except MemoryError:
        raise
    except Exception as error:  # whatever a broken file makes the readers raise
        text = str(error) if isinstance(error, ValueError | OSError) else "it is not as such a file has to be"
        raise ValueError(f"must hold a mesh ({path.name}: {text})") from error


def on_the_same_dofs(
    read: Sequence[Labelled], n_stiffness: int, where: Sequence[str]
) -> tuple[list[Any], list[DofName], list[str]]:
    """Return matrices on the same degrees of freedom, ascending, the names of these, and what was left out.

    Parameters
    ----------
    read : sequence of Labelled
        All with names of their rows. A matrix may lack those at which it is zero.
    n_stiffness : int
        How many of them, at the beginning, are of stiffness.
    where : sequence of str
        Where each was given, for messages.

    Returns
    -------
    matrices : list of csr_array
        Without the rows that Abaqus marks as held by a support, with 1e36 in the stiffness, and without rows that
        are zero in every matrix.
    dofs : list of (node, direction)
    notes : list of str

    Raises
    ------
    ValueError
        If a matrix has no names of rows, two have no row in common, or no row is left.
    """
    named: list[tuple[DofName, ...]] = []
    for one, at in zip(read, where, strict=True):
        if one.dofs is None:
            raise ValueError(f"{at}: must name its degrees of freedom")
        if len(one.dofs) != one.matrix.shape[0]:
            raise ValueError(f"{at}: must name {one.matrix.shape[0]} degrees of freedom (got {len(one.dofs)})")
        if named and not set(one.dofs) & set(named[0]):
            raise ValueError(f"{at}: must have degrees of freedom of {where[0]} (got none of them)")
        named.append(one.dofs)
    dofs = sorted({dof for names in named for dof in names}, key=lambda dof: (dof[0], DIRECTIONS.index(dof[1])))
    index = {dof: i for i, dof in enumerate(dofs)}
    matrices = [
        placed(one.matrix, [index[dof] for dof in names], len(dofs))
        for one, names in zip(read, named, strict=True)
    ]
    largest = np.max([np.abs(matrix.diagonal()) for matrix in matrices[:n_stiffness]], axis=0)
    is_held = largest >= HELD
    is_empty = np.sum([abs(matrix).sum(axis=1) for matrix in matrices], axis=0) == 0.0
    rows = np.flatnonzero(~is_held & ~is_empty)
    if len(rows) == 0:
        raise ValueError(f"{where[0]}: must have a row that is neither held nor empty")
    notes = [
        f"{np.sum(which)} degrees of freedom are left out: {why}."
        for which, why in ((is_held, "held by supports"), (is_empty & ~is_held, "without stiffness and mass"))
        if np.any(which)
    ]
    return [matrix[rows][:, rows] for matrix in matrices], [dofs[i] for i in rows], notes


def placed(matrix: Any, rows: Sequence[int], n_dof: int) -> Any:
    """Return a matrix whose row i becomes rows[i] of n_dof, a csr_array; other rows are zero."""
    entries, at = matrix.tocoo(), np.asarray(rows)
    return sp.csr_array((entries.data, (at[entries.row], at[entries.col])), shape=(n_dof, n_dof))


def _mass_beside(path: Path) -> Path:
    if path.suffix.lower() == ".sti":
        return path.with_suffix(".mas")
    if path.suffix.lower() == ".mtx" and "_STIF" in path.name:
        return path.with_name(path.name.replace("_STIF", "_MASS"))
    raise ValueError("mass: must be given")


def _matrix(argument: str, path: Path) -> Labelled:
    return _told(argument, lambda: read_labelled(path))


def _told(argument: str, read: Any) -> Any:
    try:
        return read()
    except ValueError as error:
        raise ValueError(f"{argument}: {error}") from error
