"""A model as another program exported it, its mesh, and the interface of a mesh format."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from fmu.formats.matrices.limits import DofName as DofName
from fmu.formats.matrices.limits import Motions, RefusedError
from fmu.types import FloatArray, IntArray

MOST_NODES = 2**20
MOST_ELEMENTS = 2**20


class Mesh(NamedTuple):
    """Nodes and elements.

    Attributes
    ----------
    nodes : ndarray of int, shape (n_nodes,)
        Ids, ascending.
    coordinates : ndarray, shape (n_nodes, 3)
        Global axes, the file's unit.
    elements : tuple of tuple of int
        Ids of each element's nodes: corners in order, midside nodes may follow.
    kinds : tuple of str
        meshio's names: ``"line"``, ``"quad"``, ``"hexahedron20"`` …
    notes : tuple of str
        What was left out, a sentence each.
    axes : mapping of int to ndarray, shape (3, 3)
        Rows are the unit vectors of the axes along which a node's degrees of freedom are, where these are not the
        global ones.
    sets : mapping of str to tuple of (node, direction)
        Rows that matrices without names can have, by what the program calls them.
    """

    nodes: IntArray
    coordinates: FloatArray
    elements: tuple[tuple[int, ...], ...]
    kinds: tuple[str, ...]
    notes: tuple[str, ...] = ()
    axes: Mapping[int, FloatArray] = {}
    sets: Mapping[str, tuple[DofName, ...]] = {}


NO_MESH = Mesh(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), (), ())


def mesh_of(
    places: Mapping[int, ArrayLike],
    elements: Sequence[tuple[int, ...]],
    kinds: Sequence[str],
    notes: Sequence[str] = (),
    axes: Mapping[int, FloatArray] | None = None,
    sets: Mapping[str, tuple[DofName, ...]] | None = None,
) -> Mesh:
    """Return the mesh of nodes by their ids, after checking it.

    Raises
    ------
    RefusedError
        If it has no nodes, too many nodes or elements, an element with an unknown node, or a coordinate that is
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


@dataclass(frozen=True, eq=False)
class ExportedModel:
    """Matrices of a structure with names of their degrees of freedom, as another program exported them.

    A model with a factor of the stiffness as its parameter, sensors by node id, and pictures::

        read = fmu.read_model("job.sti", mesh="job.inp")
        model = fmu.SeparableModel.from_terms(
            ["k"], [(read.stiffness, "k")], [read.mass], read.dofs, fmu.Geometry.of_mesh(read), read.motions
        )

    Attributes
    ----------
    stiffness, mass : scipy.sparse.csr_array, shape (n_dof, n_dof)
        Symmetric, in the program's units: fmu takes them for SI units.
    dofs : tuple of (node id, direction)
        One per row; a direction is one of ``"x" "y" "z" "rx" "ry" "rz"``, global axes.
    nodes : ndarray of int, shape (n_nodes,)
        Ids of the mesh's nodes; empty if the mesh is not known.
    coordinates : ndarray, shape (n_nodes, 3)
    elements : tuple of tuple of int
        Ids of each element's nodes: corners in order, midside nodes may follow.
    kinds : tuple of str
        meshio's names: ``"line"``, ``"triangle"``, ``"quad"``, ``"tetra"``, ``"hexahedron"``, ``"hexahedron20"`` …
    notes : tuple of str
        What was left out or assumed, a sentence each.
    motions : mapping of (node id, direction) to mapping of (node id, direction) to float
        Motions in global axes that are weighted sums of several `dofs`, such as that of a shell's middle surface
        in a model that has nodes on both faces. They go before `dofs` where both have a name.
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


@dataclass(frozen=True)
class MeshFormat:
    """A format of files with nodes and elements.

    Attributes
    ----------
    suffixes : tuple of str
        Of the file names, in lower case.
    read : callable
        ``read(path)`` returns a `Mesh`. A broken file may raise anything; the text of a `RefusedError` is shown
        unchanged.
    """

    suffixes: tuple[str, ...]
    read: Callable[[Path], Mesh]
