"""Constraint equations for rigid links, and for points that follow the weighted mean motion of others (RBE3).

A small rigid-body motion x = (u, θ) at a reference point moves another point by u + θ × r and rotates it by θ,
where r is the vector from the reference point to the other point. In an RBE3, the reference point has the
rigid-body motion x that best fits the motions u_i in the followed degrees of freedom i, with weights w_i,

    minimise Σ_i w_i (u_i − H_iᵀ x)²    ⇒    Σ_i w_i H_i H_iᵀ x = Σ_i w_i H_i u_i,

where H_iᵀ x is the motion that x causes in degree of freedom i (MYSTRAN, *User's reference manual*, appendix E).
Since version 70.7, the result in Nastran does not depend on the units (MSC Nastran, *Quick reference guide*,
RBE3). For Nastran, the weights of rotations are therefore multiplied by L², where L is the mean distance of the
followed points from the reference point; for MYSTRAN, they are not. L has no effect if no rotations are followed.
The result has not been compared with Nastran itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fmu.formats.constraints.equations import RANK, Equation, equations_of, show_name
from fmu.formats.matrices.limits import DofName, RefusedError
from fmu.formats.shown import names_shown
from fmu.types import DIRECTIONS, FloatArray


class Point(NamedTuple):
    """A node in a constraint.

    Attributes
    ----------
    node : int
    place : ndarray, shape (3,)
        Global coordinates.
    axes : ndarray, shape (3, 3)
        Unit vectors (rows) along the node's degrees of freedom.
    """

    node: int
    place: FloatArray
    axes: FloatArray

    def names(self, components: Sequence[int]) -> list[DofName]:
        """Return the (node, direction) names for the given components, which are numbered from 1 to 6."""
        return [(self.node, DIRECTIONS[k - 1]) for k in components]


ALL = (1, 2, 3, 4, 5, 6)


def rigid_motion(point: Point, reference: Point) -> FloatArray:
    """Return the matrix S in u_point = S u_reference for two points on a rigid body, shape (6, 6).

    The components of each motion are along the axes of its own node.
    """
    x, y, z = point.place - reference.place
    turned = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # θ × r = turned θ
    own, other = point.axes, reference.axes.T
    S = np.zeros((6, 6))
    S[:3, :3] = S[3:, 3:] = own @ other
    S[:3, 3:] = own @ turned @ other
    return S


def rigid_link(
    reference: Point, points: Sequence[Point], components: Sequence[int], source: str
) -> list[Equation]:
    """Return equations that tie the given components (1 to 6) of all `points` rigidly to the reference point."""
    rows = [k - 1 for k in components]
    found: list[Equation] = []
    for point in points:
        S = rigid_motion(point, reference)[rows]
        found += equations_of(point.names(components), reference.names(ALL), S, source)
    return found


def rigid_body(
    independent: Sequence[tuple[Point, Sequence[int]]],
    dependent: Sequence[tuple[Point, Sequence[int]]],
    source: str,
) -> list[Equation]:
    """Return the equations of a rigid body (RBAR) whose motion is determined by six independent components.

    `independent` and `dependent` list points with their components, numbered from 1 to 6.

    Raises
    ------
    RefusedError
        If there are not six independent components, or they do not determine the body's motion.
    """
    origin = independent[0][0]
    names = [name for point, which in independent for name in point.names(which)]
    B = np.concatenate([_rows(point, which, origin) for point, which in independent])
    scale = _length([point for point, _ in [*independent, *dependent]], origin)
    B = B * scale
    if len(B) != 6 or np.linalg.cond(B) > 1.0 / RANK:
        which = names_shown([show_name(name) for name in names])
        raise RefusedError(
            f"must have six independent components that determine how a rigid body moves ({source} has {which})"
        )
    found: list[Equation] = []
    for point, components in dependent:
        S = _rows(point, components, origin) * scale
        found += equations_of(point.names(components), names, np.linalg.solve(B.T, S.T).T, source)
    return found


def mean_motion(
    reference: Point,
    components: Sequence[int],
    followed: Sequence[tuple[Point, Sequence[int], float]],
    source: str,
    *,
    by_length: bool = True,
) -> list[Equation]:
    """Return the equations for a reference point that follows the weighted mean motion of other points (RBE3).

    Parameters
    ----------
    reference : Point
    components : sequence of int
        Components (1 to 6) of the reference point that follow the other points.
    followed : sequence of (Point, components, weight)
        Each followed point, its followed components, and the weight of each component.
    source : str
        The file entry, for messages.
    by_length : bool
        Whether the weights of rotations are multiplied by L² as in Nastran, where L is the mean distance of the
        followed points from the reference point. MYSTRAN does not do this.

    Raises
    ------
    RefusedError
        If a weight is negative or not finite, all weights are zero, or the followed components do not determine
        the components of the reference point.
    """
    names = [name for point, which, _ in followed for name in point.names(which)]
    H = np.concatenate([_rows(point, which, reference) for point, which, _ in followed])
    weight = np.concatenate([np.full(len(which), w) for _, which, w in followed])
    if not np.all(np.isfinite(weight) & (weight >= 0.0)) or not np.any(weight > 0.0):
        raise RefusedError(f"must have weights that are not negative ({source} has others)")
    points = [point for point, _, _ in followed]
    mean = float(np.mean([np.linalg.norm(point.place - reference.place) for point in points]))
    turns = np.concatenate([np.array(which) > 3 for _, which, _ in followed])
    if by_length and mean > 0.0:
        weight = np.where(turns, weight * mean**2, weight)
    scale = _length(points, reference)  # makes metres and radians in x comparable
    root = np.sqrt(weight)[:, None]
    U, size, Vt = np.linalg.svd(root * H * scale, full_matrices=False)
    rank = int(np.sum(size > RANK * size[0]))
    unknown = np.eye(6) - Vt[:rank].T @ Vt[:rank]
    rows = [k - 1 for k in components]
    if np.max(np.abs(unknown[rows])) > np.sqrt(RANK):
        which = names_shown([show_name(name) for name in reference.names(components)])
        raise RefusedError(f"must follow components that determine {which} ({source} does not)")
    X = scale[:, None] * (Vt[:rank].T / size[:rank]) @ (U[:, :rank] * root).T
    return equations_of(reference.names(components), names, X[rows], source)


def _rows(point: Point, components: Sequence[int], reference: Point) -> FloatArray:
    return rigid_motion(point, reference)[[k - 1 for k in components]]


def _length(points: Sequence[Point], reference: Point) -> FloatArray:
    """Return scale factors for a rigid motion, shape (6,): 1 for displacements and 1/L for rotations.

    L is the largest distance between the reference and the points, or 1 if they coincide.
    """
    size = max(float(np.linalg.norm(point.place - reference.place)) for point in points)
    return np.array([1.0] * 3 + [1.0 / size if size > 0.0 else 1.0] * 3)
