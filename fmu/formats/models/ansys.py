"""Readers for nodes and elements in Ansys archives (``.cdb``, written by ``CDWRITE``) and result files (``.rst``).

mapdl-archive and ansys-mapdl-reader read them in a separate process, because both libraries crash on broken files.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import numpy as np

from fmu.formats.constraints.ansys import equations_of
from fmu.formats.matrices import ansys
from fmu.formats.matrices.isolated import read_isolated
from fmu.formats.matrices.limits import text_lines
from fmu.formats.models.exported import Mesh, MeshFormat, mesh_of
from fmu.types import AnyArray, FloatArray

_KINDS = {
    1: {1: "vertex"},
    3: {2: "line"},
    21: {3: "line3"},
    5: {3: "triangle", 6: "triangle6"},
    22: {6: "triangle6"},
    9: {4: "quad", 8: "quad8"},
    23: {8: "quad8"},
    10: {4: "tetra", 10: "tetra10"},
    24: {10: "tetra10"},
    12: {8: "hexahedron", 20: "hexahedron20"},
    25: {20: "hexahedron20"},
    13: {6: "wedge", 15: "wedge15"},
    26: {15: "wedge15"},
    14: {5: "pyramid", 13: "pyramid13"},
    27: {13: "pyramid13"},
}
"""Element kinds (meshio's names), by VTK cell type and number of nodes."""


class _Grid(Protocol):
    """The part of a PyVista grid's interface that fmu uses."""

    point_data: Mapping[str, AnyArray]
    points: AnyArray
    cells: AnyArray
    celltypes: AnyArray


def cdb_arrays(path: Path) -> dict[str, AnyArray]:
    """Return the grid arrays in an archive, keyed by name. This requires mapdl-archive."""
    from mapdl_archive import Archive

    return _arrays(Archive(str(path)).grid)


def rst_arrays(path: Path) -> dict[str, AnyArray]:
    """Return the grid arrays in a result file, keyed by name. This requires ansys-mapdl-reader."""
    from ansys.mapdl import reader

    return _arrays(reader.read_binary(str(path)).grid)


def _arrays(grid: _Grid) -> dict[str, AnyArray]:
    found = {
        "nodes": grid.point_data["ansys_node_num"],
        "coordinates": grid.points,
        "cells": grid.cells,
        "types": grid.celltypes,
    }
    if "angles" in grid.point_data:
        found["angles"] = grid.point_data["angles"]
    return {name: np.asarray(array) for name, array in found.items()}


def node_axes(angles: FloatArray) -> FloatArray:
    """Return a node's axes as rows, shape (3, 3), from its rotation angles THXY, THYZ, THZX in degrees.

    The rotations are about z, then x', then y'' (Ansys, ``NROTAT``).
    """
    (cz, cx, cy), (sz, sx, sy) = np.cos(np.radians(angles)), np.sin(np.radians(angles))
    about_z = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    return np.asarray((about_z @ about_x @ about_y).T)


def _mesh(found: dict[str, AnyArray]) -> Mesh:
    nodes, cells = found["nodes"].astype(np.int64), found["cells"].astype(np.int64)
    places = {
        node: place
        for node, place in zip(nodes.tolist(), found["coordinates"].astype(float), strict=True)
        if node > 0
    }
    elements, kinds, left_out, at = [], [], 0, 0
    for cell in found["types"].tolist():
        count = int(cells[at])
        kind = _KINDS.get(cell, {}).get(count, "")
        corners = nodes[cells[at + 1 : at + 1 + count]].tolist()
        at += 1 + count
        if kind and min(corners) > 0:
            elements.append(tuple(corners))
            kinds.append(kind)
        else:
            left_out += 1
    notes = [f"{left_out} elements of unknown kinds are left out of the mesh."] if left_out else []
    angles = found.get("angles", np.zeros((len(nodes), 3)))
    axes = {int(nodes[i]): node_axes(angles[i]) for i in np.flatnonzero(np.any(angles, axis=1)) if nodes[i] > 0}
    return mesh_of(places, elements, kinds, notes, axes)


def _cdb(path: Path) -> Mesh:
    with open(path, "rb") as file:
        equations, notes, unread = equations_of(text_lines(file))
    mesh = _mesh(read_isolated(f"{__name__}:cdb_arrays", path, "mapdl_archive", ansys.EXTRA))
    return mesh._replace(equations=tuple(equations), notes=(*mesh.notes, *notes), unread=unread)


def _rst(path: Path) -> Mesh:
    return _mesh(read_isolated(f"{__name__}:rst_arrays", path, ansys.LIBRARY, ansys.EXTRA))


CDB = MeshFormat((".cdb",), _cdb)
RST = MeshFormat((".rst",), _rst)
