"""Positions and axes in rectangular, cylindrical and spherical systems, of Nastran and of universal files.

CORD1x and CORD2x define a system by three points: the origin, a point on the z axis, and a point in the xz plane
(MSC Nastran, *Quick reference guide*); universal files give a point on the x axis instead of the z axis.
Cylindrical coordinates are r, θ and z. Spherical coordinates are r, θ from the z axis and φ about it. Angles are
in degrees. Where the direction of r or θ is undefined, θ = φ = 0 defines the axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from fmu.formats.matrices.limits import RefusedError
from fmu.types import FloatArray

Kind = Literal["R", "C", "S"]
_NOWHERE = 1e-12
DEEPEST = 200
"""Longest chain of systems that refer to each other."""


@dataclass(frozen=True, eq=False)
class Definition:
    """Coordinate system defined by three points.

    Attributes
    ----------
    kind : {"R", "C", "S"}
        Rectangular, cylindrical or spherical.
    points : ndarray, shape (3, 3), optional
        Coordinates of the points (rows) in the reference system.
    reference : int
        Number of the reference system; 0 is the basic system.
    nodes : tuple of int
        Ids of the nodes that define the points, if `points` is None.
    is_along_x : bool
        Whether the second point is on the x axis, as in universal files, and not on the z axis.
    """

    kind: Kind
    points: FloatArray | None = None
    reference: int = 0
    nodes: tuple[int, ...] = ()
    is_along_x: bool = False


@dataclass(eq=False)
class Systems:
    """Coordinate systems and nodes of a deck, converted to global axes on request.

    Attributes
    ----------
    definitions : mapping of int to Definition
    given : mapping of int to (system, ndarray of shape (3,))
        Coordinate system and coordinates of each node.
    """

    definitions: Mapping[int, Definition]
    given: Mapping[int, tuple[int, FloatArray]]
    _frames: dict[int, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    _places: dict[int, FloatArray] = field(default_factory=dict)

    def place(self, node: int, depth: int = 0) -> FloatArray:
        """Return a node's position in global coordinates, shape (3,).

        `depth` counts the references followed so far. Raise RefusedError if a node or system is not defined, the
        three points of a system are in line, or systems refer to themselves.
        """
        if node not in self._places:
            if node not in self.given:
                raise RefusedError(f"must have the node {node}, a point of a coordinate system (it has not)")
            system, coordinates = self.given[node]
            self._places[node] = self._from(system, coordinates, depth)
        return self._places[node]

    def axes(self, system: int, node: int) -> FloatArray:
        """Return a system's unit vectors at a node, as rows in global coordinates, shape (3, 3).

        Raise RefusedError under the same conditions as `place`.
        """
        if system == 0:
            return np.eye(3)
        origin, own = self._frame(system, 0)
        kind = self.definitions[system].kind
        if kind == "R":
            return own
        x, y, z = own @ (self.place(node) - origin)
        r = np.hypot(x, y)
        small = _NOWHERE * max(1.0, float(np.linalg.norm(self.place(node))))
        c, s = (x / r, y / r) if r > small else (1.0, 0.0)
        about_z = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        if kind == "C":
            return np.asarray(about_z @ own)
        length = np.hypot(r, z)
        sine, cosine = (r / length, z / length) if length > small else (0.0, 1.0)
        tilted = np.array([[sine, 0.0, cosine], [cosine, 0.0, -sine], [0.0, 1.0, 0.0]])
        return np.asarray(tilted @ about_z @ own)

    def _from(self, system: int, coordinates: FloatArray, depth: int) -> FloatArray:
        """Return the global coordinates (3,) of a point whose coordinates are given in a system."""
        if system == 0:
            return np.asarray(coordinates, dtype=float)
        origin, own = self._frame(system, depth + 1)
        a, b, c = coordinates
        match self.definitions[system].kind:
            case "R":
                local = np.array([a, b, c])
            case "C":
                angle = np.radians(b)
                local = np.array([a * np.cos(angle), a * np.sin(angle), c])
            case "S":
                theta, phi = np.radians(b), np.radians(c)
                local = a * np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
        return np.asarray(origin + local @ own)

    def _frame(self, system: int, depth: int) -> tuple[FloatArray, FloatArray]:
        """Return a system's origin (3,) and unit vectors (rows of a (3, 3) array) in global coordinates.

        Raise RefusedError under the same conditions as `place`.
        """
        if system in self._frames:
            return self._frames[system]
        if system not in self.definitions:
            raise RefusedError(f"must have the coordinate system {system} (it has not)")
        if depth > DEEPEST:
            raise RefusedError(f"must have coordinate systems that do not refer to themselves (got {system})")
        one = self.definitions[system]
        if one.points is None:
            points = [self.place(node, depth + 1) for node in one.nodes]
        else:
            points = [self._from(one.reference, point, depth + 1) for point in one.points]
        origin, second, in_xz = points
        along, across = second - origin, in_xz - origin
        y = np.cross(across, along) if one.is_along_x else np.cross(along, across)
        if not np.linalg.norm(y) > _NOWHERE * np.linalg.norm(along) * np.linalg.norm(across):
            raise RefusedError(f"must have coordinate systems of three points not in line (got {system})")
        own = np.array([along, y, np.cross(along, y)] if one.is_along_x else [np.cross(y, along), y, along])
        self._frames[system] = origin, own / np.linalg.norm(own, axis=1)[:, None]
        return self._frames[system]
