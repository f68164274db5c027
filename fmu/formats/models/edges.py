"""Lines for plotting a mesh, taken from line elements and face edges, and the nodes that lie inside solids."""

from __future__ import annotations

import numpy as np

from fmu.formats.models.exported import ExportedModel, Mesh
from fmu.types import FloatArray, IntArray

MOST_EDGES = 1000
"""Number of edges above which only some are plotted: edges at a border, between faces at an angle of more than
30°, and between faces with centres in different boxes of space."""
_BOXES = (10, 5, 2, 1)
"""Numbers of boxes along a mesh's longest side. The first that gives at most 2 `MOST_EDGES` lines is used, or the
last."""
_ANGLE = np.cos(np.radians(30.0))
FACES = {
    "triangle": ((0, 1, 2, 2),),
    "quad": ((0, 1, 2, 3),),
    "tetra": ((0, 1, 2, 2), (0, 1, 3, 3), (1, 2, 3, 3), (0, 2, 3, 3)),
    "pyramid": ((0, 1, 2, 3), (0, 1, 4, 4), (1, 2, 4, 4), (2, 3, 4, 4), (0, 3, 4, 4)),
    "wedge": ((0, 1, 2, 2), (3, 4, 5, 5), (0, 1, 4, 3), (1, 2, 5, 4), (0, 2, 5, 3)),
    "hexahedron": ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
}
"""Indices of the corners around each face; a triangle repeats its last corner."""
SOLID_EDGES = {
    "tetra": ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)),
    "pyramid": ((0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 4), (2, 4), (3, 4)),
    "wedge": ((0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)),
    "hexahedron": ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)),
}
"""Indices of the corners at both ends of each edge, in meshio's order of the midside nodes."""


def edges(mesh: Mesh | ExportedModel) -> IntArray:
    """Return the lines to plot, each as the row indices of its two ends in `mesh.nodes`, shape (n_lines, 2).

    Midside nodes are skipped. For solids, only the surfaces are plotted. If faces have more than `MOST_EDGES`
    edges, some are left out.
    """
    lines, faces = _lines_and_faces(mesh)
    drawn = [lines, _of_faces(faces, mesh.coordinates)]
    return np.unique(np.sort(np.concatenate(drawn), axis=1), axis=0)


def inside(mesh: Mesh | ExportedModel) -> IntArray:
    """Return the row indices in `mesh.nodes` of nodes inside solids, where no sensor can be, in ascending order.

    Corners on the surface of the solids, and corners of line elements and shells, are not inside. A midside node
    is inside unless both ends of its edge are such corners. The nodes at the centres of faces and of 27-node
    hexahedra are never returned.
    """
    lines, faces = _lines_and_faces(mesh)
    row = {node: i for i, node in enumerate(mesh.nodes.tolist())}
    outer, inner = {*lines.ravel().tolist(), *faces.ravel().tolist()}, set[int]()
    for kind, element in zip(mesh.kinds, mesh.elements, strict=True):
        sides = SOLID_EDGES.get(kind.rstrip("0123456789"), ())
        if sides:
            rows = [row[node] for node in element]
            corners = 1 + max(max(side) for side in sides)
            inner.update(node for node in rows[:corners] if node not in outer)
            ends = zip(sides, rows[corners:], strict=False)
            inner.update(node for (a, b), node in ends if not {rows[a], rows[b]} <= outer)
    return np.array(sorted(inner), dtype=np.int64)


def _lines_and_faces(mesh: Mesh | ExportedModel) -> tuple[IntArray, IntArray]:
    """Return the row indices of line element ends, shape (n, 2), and of surface face corners, shape (m, 4)."""
    row = {node: i for i, node in enumerate(mesh.nodes.tolist())}
    lines: list[tuple[int, int]] = []
    skin: list[tuple[int, ...]] = []
    inner: list[tuple[int, ...]] = []
    for kind, element in zip(mesh.kinds, mesh.elements, strict=True):
        base = kind.rstrip("0123456789")
        if base == "line":
            lines.append((row[element[0]], row[element[1]]))
        else:
            into = inner if base in SOLID_EDGES else skin
            into += [tuple(row[element[k]] for k in face) for face in FACES.get(base, ())]
    faces = np.array(skin, dtype=np.int64).reshape(-1, 4)
    if inner:
        faces = np.concatenate([faces, _outer(np.array(inner, dtype=np.int64))])
    return np.array(lines, dtype=np.int64).reshape(-1, 2), faces


def _outer(faces: IntArray) -> IntArray:
    """Return the faces that belong to only one solid, shape (n, 4)."""
    corners = faces.copy()
    corners[faces[:, 2] == faces[:, 3], 3] = -1  # whichever corner a triangle repeats
    _, first, counts = np.unique(np.sort(corners, axis=1), axis=0, return_index=True, return_counts=True)
    return np.asarray(faces[first[counts == 1]])


def _of_faces(faces: IntArray, coordinates: FloatArray) -> IntArray:
    """Return the edges of all faces, shape (n, 2), or a part of them if there are more than `MOST_EDGES`."""
    if not len(faces):
        return np.zeros((0, 2), dtype=np.int64)
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    face = np.repeat(np.arange(len(faces)), 4)
    is_edge = ends[:, 0] != ends[:, 1]
    ends, face = ends[is_edge], face[is_edge]
    found, index, counts = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    if len(found) <= MOST_EDGES:
        return found
    a, b, c, d = np.moveaxis(coordinates[faces], 1, 0)
    centre = 0.25 * (a + b + c + d) - coordinates.min(axis=0)
    length = max(np.ptp(coordinates, axis=0).max(), np.finfo(float).tiny)
    normal = np.cross(c - a, d - b)
    normal /= np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)[:, None]
    order = np.argsort(index.reshape(-1), kind="stable")
    starts = np.cumsum(counts) - counts
    first, second = face[order[starts]], face[order[np.minimum(starts + 1, len(order) - 1)]]
    is_sharp = np.abs(np.sum(normal[first] * normal[second], axis=1)) < _ANGLE
    for boxes in _BOXES:
        box = np.floor(centre * (boxes / length) + 1e-6)
        shown = found[(counts != 2) | is_sharp | np.any(box[first] != box[second], axis=1)]
        if len(shown) <= 2 * MOST_EDGES:
            break
    return np.asarray(shown)
