"""Displacements of nodes that ``*TIE`` ties to a face, expressed by the displacements of the face's nodes.

CalculiX's matrices have no rows for tied nodes. CalculiX does not write the tie equations either, but it prints
the modes at tied nodes too. A node that moves but has no row is therefore projected onto the nearest faces. If the
shape functions at the projection reproduce the printed displacements, they are the weights of the face's nodes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from fmu.formats.matrices.limits import Motions
from fmu.formats.models.edges import FACES, SOLID_EDGES
from fmu.formats.models.exported import DofName, Mesh
from fmu.formats.shown import names_shown
from fmu.types import FloatArray

_AXES = ("x", "y", "z")
_NEAREST = 16
"""Number of nearby faces tried for each node."""
_PRINTED = 1e-6
"""Displacement error allowed, relative to a mode's largest displacement: ten times the rounding to 7 digits."""
_STEPS = 30


class _Face(NamedTuple):
    """An element face: the indices in `Mesh.nodes` of its corners, and of any midside nodes in the same order."""

    corners: list[int]
    midsides: list[int]

    @property
    def rows(self) -> list[int]:
        return self.corners + self.midsides


def tied_motions(
    mesh: Mesh, dofs: Collection[DofName], modes: Mapping[int, FloatArray], known: Motions
) -> tuple[dict[DofName, dict[DofName, float]], list[str]]:
    """Return the displacements of tied nodes as weighted sums of degrees of freedom, and a list of notes.

    Parameters
    ----------
    mesh : Mesh
        Mesh of the whole model.
    dofs : collection of (node id, direction)
        Row names of the matrices.
    modes : mapping of int to ndarray, shape (n_modes, 3)
        Printed displacements along global axes, keyed by node id. They are needed for the tied nodes and for the
        nodes of the faces to which these are tied.
    known : mapping
        Motions of degrees of freedom without rows that are known already, such as those of constraints.

    Returns
    -------
    motions : dict of (node id, direction) to dict of (node id, direction) to float
        For each tied degree of freedom, the weights of the face's degrees of freedom.
    notes : list of str
        A sentence that lists the tied nodes whose printed displacements no face reproduces, and one that lists
        the tied nodes on faces with a displacement that is not zero, but has neither a row nor a known motion.
        Sentences without nodes are left out.

    Raises
    ------
    ValueError
        If `modes` is empty, the mesh has no faces, or no node is tied because every node of the mesh that moves
        has rows in the matrices.
    """
    if not modes:
        raise ValueError("has no displacements along global axes: print them with GLOBAL=YES")
    with_rows = {node for node, _ in (*dofs, *known)}
    row_of = {node: i for i, node in enumerate(mesh.nodes.tolist())}
    largest = np.max([np.abs(u).max(axis=1) for u in modes.values()], axis=0)[:, None]
    moving = [
        n
        for n, u in modes.items()
        if n in row_of and n not in with_rows and np.any(np.abs(u) > _PRINTED * largest)
    ]
    if not moving:
        raise ValueError("has no node that moves and has no rows in the matrices: nothing is tied")
    faces = list(_faces(mesh, row_of))
    if not faces:
        raise ValueError("needs a mesh with faces, to which nodes may be tied (this one has none)")
    centres = np.array([mesh.coordinates[face.corners].mean(axis=0) for face in faces])
    _, near = KDTree(centres).query(mesh.coordinates[[row_of[n] for n in moving]], k=min(_NEAREST, len(faces)))
    motions: dict[DofName, dict[DofName, float]] = {}
    unknown, lost = [], []
    for node, nearest in zip(moving, np.atleast_2d(near), strict=True):
        weights = _weights(node, row_of[node], [faces[k] for k in nearest], mesh, modes, largest)
        if weights is None:
            unknown.append(str(node))
            continue
        followed = [(other, k) for other, w in weights.items() for k in range(3) if w]
        if any(
            not known.get((other, _AXES[k]), (other, _AXES[k]) in dofs)
            and np.any(np.abs(modes[other][:, k, None]) > _PRINTED * largest)
            for other, k in followed
        ):
            lost.append(str(node))
            continue
        for k, d in enumerate(_AXES):
            seen: dict[DofName, float] = {}
            for other in (other for other, axis in followed if axis == k):
                own = known.get((other, d), {(other, d): 1.0} if (other, d) in dofs else {})
                for name, w in own.items():
                    seen[name] = seen.get(name, 0.0) + weights[other] * w
            motions |= {(node, d): seen} if seen else {}
    notes = [
        f"No sensors can be at tied nodes {what}: {names_shown(which)}."
        for what, which in (
            ("whose face is not known", unknown),
            ("that follow others without rows", lost),
        )
        if which
    ]
    return motions, notes


def _faces(mesh: Mesh, row_of: Mapping[int, int]) -> Iterator[_Face]:
    for kind, element in zip(mesh.kinds, mesh.elements, strict=True):
        base = kind.rstrip("0123456789")
        around = FACES.get(base, ())
        sides = SOLID_EDGES.get(base) or tuple(zip(*_ring(around[0]), strict=True)) if around else ()
        n_corners = 1 + max((max(face) for face in around), default=-1)
        rows = [row_of[node] for node in element]
        midside = {frozenset(side): row for side, row in zip(sides, rows[n_corners:], strict=False)}
        for face in around:
            first, second = _ring(face)
            found = [midside.get(frozenset(side)) for side in zip(first, second, strict=True)]
            yield _Face([rows[k] for k in first], [row for row in found if row is not None])


def _ring(face: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the distinct corners of a face in order, and the same corners shifted by one."""
    corners = tuple(dict.fromkeys(face))
    return corners, (*corners[1:], corners[0])


def _weights(
    node: int, row: int, faces: list[_Face], mesh: Mesh, modes: Mapping[int, FloatArray], largest: FloatArray
) -> dict[int, float] | None:
    """Return nodal weights on the nearest face that reproduces a node's printed displacements.

    Return None if no nearby face does.
    """
    found: list[tuple[float, dict[int, float]]] = []
    for face in faces:
        ids = mesh.nodes[face.rows].tolist()
        if row in face.rows or any(one not in modes for one in ids):
            continue
        weights = _projection(mesh.coordinates[row], mesh.coordinates[face.rows], len(face.corners))
        expected = sum(w * modes[one] for w, one in zip(weights, ids, strict=True))
        if np.all(np.abs(expected - modes[node]) <= _PRINTED * largest):
            gap = float(np.linalg.norm(weights @ mesh.coordinates[face.rows] - mesh.coordinates[row]))
            found.append((gap, dict(zip(ids, weights.tolist(), strict=True))))
    return min(found, key=lambda one: one[0])[1] if found else None


def _projection(point: FloatArray, corners: FloatArray, n_corners: int) -> FloatArray:
    """Return the shape functions (n,) at a face's closest point to `point` (3,), found by Gauss–Newton steps."""
    at = np.full(2, 1.0 / 3.0) if n_corners == 3 else np.zeros(2)
    for _ in range(_STEPS):
        N, dN = _shape_functions(at, len(corners), n_corners)
        step = np.linalg.lstsq((dN @ corners).T, point - N @ corners, rcond=None)[0]
        to = _inside(at + step, n_corners)
        if np.max(np.abs(to - at)) < 1e-14:
            break
        at = to
    return _shape_functions(at, len(corners), n_corners)[0]


def _inside(at: FloatArray, n_corners: int) -> FloatArray:
    """Return the point (2,) of the reference triangle or square that is nearest to `at`."""
    if n_corners == 4:
        return np.clip(at, -1.0, 1.0)
    beyond = max(float(np.maximum(at, 0.0).sum()) - 1.0, 0.0)
    return np.clip(at - 0.5 * beyond, 0.0, 1.0)


def _shape_functions(at: FloatArray, n: int, n_corners: int) -> tuple[FloatArray, FloatArray]:
    """Return the shape functions (n,) of a face with 3, 4, 6 or 8 nodes, and their derivatives (2, n).

    Corners come first, then midside nodes; the serendipity functions are from Zienkiewicz & Taylor, chapter 8.
    """
    r, s = at
    if n_corners == 3:
        L = np.array([1.0 - r - s, r, s])
        dL = np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
        if n == 3:
            return L, dL
        following = np.array([1, 2, 0])
        sides, dsides = 4.0 * L * L[following], 4.0 * (dL * L[following] + L * dL[:, following])
        return np.concatenate([L * (2.0 * L - 1.0), sides]), np.hstack([dL * (4.0 * L - 1.0), dsides])
    R, S = np.array([-1.0, 1.0, 1.0, -1.0]), np.array([-1.0, -1.0, 1.0, 1.0])
    a, b = 1.0 + r * R, 1.0 + s * S
    if n == 4:
        return 0.25 * a * b, 0.25 * np.array([R * b, S * a])
    c = r * R + s * S - 1.0
    corner = 0.25 * a * b * c
    dcorner = 0.25 * np.array([R * b * (c + a), S * a * (c + b)])
    side = 0.5 * np.array(
        [(1 - r * r) * (1 - s), (1 - s * s) * (1 + r), (1 - r * r) * (1 + s), (1 - s * s) * (1 - r)]
    )
    dside = 0.5 * np.array(
        [
            [-2 * r * (1 - s), 1 - s * s, -2 * r * (1 + s), -(1 - s * s)],
            [-(1 - r * r), -2 * s * (1 + r), 1 - r * r, -2 * s * (1 - r)],
        ]
    )
    return np.concatenate([corner, side]), np.hstack([dcorner, dside])
