"""Models and meshes as exported by another program, and the interface of mesh formats."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError
from fmu.formats.constraints.equations import Equation
from fmu.formats.matrices.limits import DofName as DofName
from fmu.formats.matrices.limits import Matrix, Motions, RefusedError
from fmu.formats.shown import names_shown
from fmu.types import Dof, FloatArray, IntArray

MOST_NODES = 2**20
MOST_ELEMENTS = 2**20


class Mesh(NamedTuple):
    """Nodes and elements of a model.

    Attributes
    ----------
    nodes : ndarray of int, shape (n_nodes,)
        Node ids, in ascending order.
    coordinates : ndarray, shape (n_nodes, 3)
        Along global axes, in the file's unit of length.
    elements : tuple of tuple of int
        Node ids of each element: corners in order, then any midside nodes.
    kinds : tuple of str
        meshio's name for each element's kind: ``"line"``, ``"quad"``, ``"hexahedron20"`` …
    notes : tuple of str
        One sentence for each omission or assumption.
    axes : mapping of int to ndarray, shape (3, 3)
        Unit vectors (rows) along a node's degrees of freedom, if these are not along global axes.
    sets : mapping of str to tuple of (node, direction)
        Possible rows of matrices without names, keyed by the program's name for the set, such as ``"g"``.
    order : tuple of int
        Ids of nodes and scalar points in the order of MYSTRAN's rows: as the deck defines them, or ascending with
        PARAM,GRIDSEQ,GRID. Empty unless the mesh is from Nastran bulk data.
    equations : tuple of Equation
        Constraints between degrees of freedom, along the axes of each node.
    held : frozenset of (node, direction)
        Degrees of freedom that supports fix, along the axes of each node.
    unread : tuple of str
        Constraints that were skipped. Matrices that include no constraints are refused with such a mesh.
    loaded : frozenset of int
        Nodes that shells or beams share with masses, springs or solids. CalculiX keeps rows for them.
    turning : frozenset of int
        Rotation nodes of rigid bodies in CalculiX, which names their rotations like displacements. Constraints and
        supports of a mesh, and rows of models, name them rx, ry and rz.
    """

    nodes: IntArray
    coordinates: FloatArray
    elements: tuple[tuple[int, ...], ...]
    kinds: tuple[str, ...]
    notes: tuple[str, ...] = ()
    axes: Mapping[int, FloatArray] = {}
    sets: Mapping[str, tuple[DofName, ...]] = {}
    order: tuple[int, ...] = ()
    equations: tuple[Equation, ...] = ()
    held: frozenset[DofName] = frozenset()
    unread: tuple[str, ...] = ()
    turning: frozenset[int] = frozenset()
    loaded: frozenset[int] = frozenset()


NO_MESH = Mesh(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), (), ())


def mesh_of(
    places: Mapping[int, ArrayLike],
    elements: Sequence[tuple[int, ...]],
    kinds: Sequence[str],
    notes: Sequence[str] = (),
    axes: Mapping[int, FloatArray] | None = None,
    sets: Mapping[str, tuple[DofName, ...]] | None = None,
) -> Mesh:
    """Check nodes and elements, and return them as a mesh with node ids in ascending order.

    Raises
    ------
    RefusedError
        If there are no nodes, too many nodes or elements, an element with an unknown node, or a coordinate that is
        not finite.
    """
    if not places:
        raise RefusedError("must have nodes (it has none)")
    for what, most, count in (("nodes", MOST_NODES, len(places)), ("elements", MOST_ELEMENTS, len(elements))):
        if count > most:
            raise RefusedError(f"must have at most {most} {what} (got {count})")
    nodes = np.array(sorted(places), dtype=np.int64)
    coordinates = np.array([places[node] for node in nodes.tolist()], dtype=float)
    if not np.all(np.isfinite(coordinates)):
        at = nodes[np.flatnonzero(~np.isfinite(coordinates).all(axis=1))[0]]
        raise RefusedError(f"must have finite coordinates (node {at} has others)")
    for element in elements:
        for node in element:
            if node not in places:
                raise RefusedError(f"must have the nodes of all elements (there is no node {node})")
    return Mesh(nodes, coordinates, tuple(elements), tuple(kinds), tuple(notes), axes or {}, sets or {})


class Rows(NamedTuple):
    """Rows of a program's matrices, and their motions u = B q, where q are the model's degrees of freedom.

    Attributes
    ----------
    names : tuple of (node, direction)
        Rows with stiffness or mass, along the axes of each node, before constraints and supports are applied.
    basis : csr_array, shape (n_rows, n_dof)
        B. It orders rows, leaves out supports, applies constraints, and rotates axes.
    """

    names: tuple[Dof, ...]
    basis: sp.csr_array

    def place(self, matrix: Matrix, names: Sequence[Dof]) -> sp.csr_array:
        """Return Bᵀ A B, shape (n_dof, n_dof), of a further matrix A of the same model, such as its damping.

        Parameters
        ----------
        matrix : ndarray or sparse array, shape (n, n)
            A, which may lack rows that are zero.
        names : sequence of (node, direction)
            Names of the rows of A, in their order.

        Raises
        ------
        ValueError
            If a row of A that is not zero is not among the rows with stiffness or mass.
        """
        index = {name: i for i, name in enumerate(self.names)}
        at = np.array([index.get(name, -1) for name in names], dtype=np.int64)
        entries = sp.coo_array(matrix)
        row, column = at[entries.row], at[entries.col]
        is_lost = ((row < 0) | (column < 0)) & (entries.data != 0.0)
        if np.any(is_lost):
            lost = np.unique(np.append(entries.row[is_lost & (row < 0)], entries.col[is_lost & (column < 0)]))
            which = names_shown([" ".join(map(str, names[i])) for i in lost.tolist()])
            raise ArgumentError("names", "must be of rows with stiffness or mass", which)
        kept = (row >= 0) & (column >= 0)
        n = len(self.names)
        A = sp.csr_array((entries.data[kept], (row[kept], column[kept])), shape=(n, n))
        placed = sp.csr_array(self.basis.T @ A @ self.basis)
        placed.sort_indices()
        return placed


@dataclass(frozen=True, eq=False)
class ExportedModel:
    """Stiffness and mass matrices exported by another program, with named degrees of freedom.

    An example with a stiffness factor as the parameter, sensors at node ids, and plots::

        read = fmu.read_model("job.sti", mesh="job.inp")
        model = fmu.SeparableModel.from_terms(
            ["k"], [(read.stiffness, "k")], [read.mass], read.dofs, fmu.Geometry.of_mesh(read), read.motions
        )

    Attributes
    ----------
    stiffness, mass : scipy.sparse.csr_array, shape (n_dof, n_dof)
        Symmetric, in the program's units; fmu assumes SI units.
    dofs : tuple of (node id, direction)
        One per row; a direction is ``"x"``, ``"y"``, ``"z"``, ``"rx"``, ``"ry"`` or ``"rz"``, along global axes
        except at nodes that a note lists.
    nodes : ndarray of int, shape (n_nodes,)
        Node ids in the mesh; empty if the mesh is not known.
    coordinates : ndarray, shape (n_nodes, 3)
    elements : tuple of tuple of int
        Node ids of each element: corners in order, then any midside nodes.
    kinds : tuple of str
        meshio's name for each element's kind: ``"line"``, ``"triangle"``, ``"quad"``, ``"tetra"``,
        ``"hexahedron"``, ``"hexahedron20"`` …
    notes : tuple of str
        One sentence for each omission or assumption.
    motions : mapping of (node id, direction) to mapping of (node id, direction) to float
        Displacements and rotations along global axes that are weighted sums of `dofs`. An example is the
        displacement of a shell's middle surface in a model with nodes on both faces. They take precedence over
        `dofs` of the same name. A motion without weights is zero or unknown: no sensor can be there.
    rows : Rows, optional
        Rows of the program's matrices. ``read.rows.place(C, names)`` brings a damping matrix C of the same program
        to `dofs`.
    """

    stiffness: sp.csr_array
    mass: sp.csr_array
    dofs: tuple[DofName, ...]
    nodes: IntArray
    coordinates: FloatArray
    elements: tuple[tuple[int, ...], ...]
    kinds: tuple[str, ...]
    notes: tuple[str, ...] = ()
    motions: Motions = field(default_factory=dict)
    rows: Rows | None = None


@dataclass(frozen=True)
class MeshFormat:
    """Reader for one mesh file format.

    Attributes
    ----------
    suffixes : tuple of str
        File name suffixes, in lower case.
    read : callable
        ``read(path)`` returns a `Mesh`. A broken file may raise any exception; the text of a `RefusedError` is
        shown unchanged.
    """

    suffixes: tuple[str, ...]
    read: Callable[[Path], Mesh]
