"""Points of a test on the nodes of a mesh: a rigid alignment, then the nearest node of each point.

Where the points are given in the axes of the model, they are taken as they are. Otherwise the alignment R x + t is
found by iterative closest points (Besl & McKay 1992), each step the least-squares rotation of Kabsch (1976), from
the 24 rotations that carry axes to axes, and from the principal axes of points and mesh. Nothing is scaled or
mirrored: that either would fit is told. So is every other alignment that fits as well, as on a symmetric
structure; three points whose nodes are known decide it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from fmu.fem.modes.separable import SeparableModel
from fmu.numbers import listed, names_in_words, significant
from fmu.tables import data_frame
from fmu.types import FloatArray, IntArray

if TYPE_CHECKING:
    import pandas as pd

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254, "ft": 0.3048}
"""Lengths in m."""
DISTANT = 0.5
"""A point farther from its node than this, in units of the mesh's spacing there, is told."""
CLOSE_RIVAL = 0.1
"""So is one whose second node is farther by less than this, in the same unit."""
SNAPPED = 2.0
"""Axes turned by at most so many degrees against those of the model count as parallel to them."""
_FIRST_STEPS, _STEPS, _BEST = 6, 40, 48
"""Steps from every start, and from the best of them."""
_MOST_NAMED = 5
_AS_GOOD = 1.2
"""An alignment fits as well as the best if its distances are at most so many times as large."""
_EXACT = 1e-3
"""Distances below this, in units of the spacing, are all as good as zero."""
_ELSEWHERE = 5.0
"""Degrees by which two alignments differ at least that count as two."""
_MOST_FAR = 0.2
"""Points fit a mesh if at most this share of them is farther from it than its spacing."""
_ROUGH, _BETTER = 0.1, 0.3
"""Mirrored points are tried where distances exceed so many spacings, and told if theirs are so much smaller."""
_KEEPS = 1e-10
"""Weight of the rotation so far, about an axis that points on one line leave free."""
_AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class Matching:
    """Points of a test, each with the node of the model nearest to it.

    Attributes
    ----------
    points : tuple of str
    nodes : tuple
        Node of each point, as named in the model's degrees of freedom.
    distances : ndarray, shape (n_points,), m
        After the alignment.
    spacing : ndarray, shape (n_points,), m
        From that node to the next one of the mesh.
    rotation : ndarray, shape (3, 3)
        R of the alignment x → R x + t.
    shift : ndarray, shape (3,), m
        t.
    notes, doubts : tuple of str
        What was done, and what to look at, a sentence each.
    """

    points: tuple[str, ...]
    nodes: tuple[Any, ...]
    distances: FloatArray
    spacing: FloatArray
    rotation: FloatArray
    shift: FloatArray
    notes: tuple[str, ...]
    doubts: tuple[str, ...]

    def sensor(self, point: Any, direction: str) -> tuple[Any, str]:
        """Return node and direction in the model of a sensor at a point, its direction in the axes of the test.

        Raises
        ------
        ValueError
            If there is no such point, or the axes of the test are not parallel to those of the model.
        """
        if str(point) not in self.points:
            raise ValueError(f"must be a point of the geometry (got {point!r})")
        sign, kind, axis = direction.startswith("-"), direction.lstrip("-")[:-1], _AXES.index(direction[-1])
        along = self.rotation[:, axis]
        k = int(np.argmax(np.abs(along)))
        if along[k] ** 2 < np.cos(np.radians(SNAPPED)) ** 2:
            angle = significant(np.degrees(np.arccos(abs(along[k]))), 2)
            raise ValueError(
                f"must be along an axis of the model (got {point} {direction}, whose axis is {angle}° off in the "
                "alignment), or each point must have sensors along all three axes of the test"
            )
        turned = "-" if sign != (along[k] < 0) else ""
        return self.nodes[self.points.index(str(point))], f"{turned}{kind}{_AXES[k]}"

    @property
    def is_parallel(self) -> bool:
        """Whether the axes of the test are parallel to those of the model."""
        return bool(np.all(np.max(np.abs(self.rotation), axis=0) >= np.cos(np.radians(SNAPPED))))

    def turned(
        self, sensors: Sequence[tuple[Any, str]], shapes: ArrayLike | None = None
    ) -> tuple[tuple[tuple[Any, str], ...], FloatArray | None]:
        """Return sensors at nodes along the axes of the model, and shapes (n_sensors, n_modes) as they read them.

        Where the axes of the test are not parallel to those of the model, the three components at each point are
        turned together.

        Raises
        ------
        ValueError
            If there is no such point; or the axes are not parallel, and a point has not all three components once.
        """
        values = None if shapes is None else np.array(shapes, dtype=float)
        if self.is_parallel:
            return tuple(self.sensor(*sensor) for sensor in sensors), values
        found = list(sensors)
        groups: dict[tuple[str, str], list[int]] = {}
        for i, (point, direction) in enumerate(sensors):
            groups.setdefault((str(point), direction.lstrip("-")[:-1]), []).append(i)
        for (point, kind), rows in groups.items():
            axes = [_AXES.index(sensors[i][1][-1]) for i in rows]
            if point not in self.points or sorted(axes) != [0, 1, 2]:
                self.sensor(*sensors[rows[0]])  # says what is wrong
                raise ValueError(f"must be along all three axes of the test at every point (got {point})")
            sign = np.array([-1.0 if sensors[i][1].startswith("-") else 1.0 for i in rows])
            if values is not None:
                values[rows] = self.rotation[:, axes] @ (sign[:, None] * values[rows])
            for i, axis in zip(rows, _AXES, strict=True):
                found[i] = self.nodes[self.points.index(point)], f"{kind}{axis}"
        return tuple(found), values

    def table(self) -> pd.DataFrame:
        """Return one row per point: ``node``, ``distance`` and ``spacing`` in m."""
        columns = {"node": list(self.nodes), "distance": self.distances, "spacing": self.spacing}
        return data_frame(columns, "point", self.points)


def kabsch(points: FloatArray, targets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rotations R and shifts t of the least Σ |R x + t − y|² (Kabsch 1976), for n points a set.

    About an axis that the points leave free, as those on one line do, nothing is turned.

    Parameters
    ----------
    points, targets : ndarray, shape (..., n, 3)

    Returns
    -------
    R : ndarray, shape (..., 3, 3)
        With determinant +1: a mirrored set is not met.
    t : ndarray, shape (..., 3)
    """
    centre, target = points.mean(axis=-2), targets.mean(axis=-2)
    H = np.swapaxes(points - centre[..., None, :], -1, -2) @ (targets - target[..., None, :])
    size = np.linalg.norm(H, axis=(-2, -1))[..., None, None]
    U, _, Vt = np.linalg.svd(H + (_KEEPS * size + np.finfo(float).tiny) * np.eye(3))
    flip = np.ones((*U.shape[:-2], 3))
    flip[..., 2] = np.sign(np.linalg.det(U @ Vt))
    R = np.swapaxes(Vt, -1, -2) * flip[..., None, :] @ np.swapaxes(U, -1, -2)
    return R, target - (R @ centre[..., None])[..., 0]


class _Mesh:
    """Places of nodes, each once, and the spacing between them."""

    def __init__(self, nodes: Sequence[Any], coordinates: ArrayLike) -> None:
        given = np.asarray(coordinates, dtype=float)
        if given.shape != (len(nodes), 3) or len(nodes) < 2 or not np.all(np.isfinite(given)):
            raise ValueError(f"coordinates: must be finite, for two nodes or more (got shape {given.shape})")
        self.size = float(np.ptp(given, axis=0).max())
        _, first, self._place_of = np.unique(
            np.round(given / (1e-9 * self.size)), axis=0, return_index=True, return_inverse=True
        )
        self._nodes, self.places = list(nodes), given[first]
        self.index = {str(node): k for k, node in enumerate(nodes)}
        self.given = given
        self.tree = KDTree(self.places)
        self.spacing = self.tree.query(self.places, k=2)[0][:, 1]
        self.usual = float(np.median(self.spacing))

    def at(self, place: int) -> list[Any]:
        """Return the nodes at a place."""
        return [self._nodes[k] for k in np.flatnonzero(self._place_of.ravel() == place)]

    def rms(self, x: FloatArray) -> float:
        """Return the root mean square of the distances of points (n, 3) from their nearest nodes."""
        return float(np.sqrt(np.mean(self.tree.query(x)[0] ** 2)))

    def fits(self, x: FloatArray) -> bool:
        """Say whether points (n, 3) lie on the mesh, most of them."""
        distance, place = self.tree.query(x)
        return bool(np.mean(distance > self.spacing[place]) <= _MOST_FAR)


def match(
    points: Mapping[Any, ArrayLike],
    nodes: Sequence[Any],
    coordinates: ArrayLike,
    unit: str = "m",
    known: Mapping[Any, Any] | None = None,
) -> Matching:
    """Return the node of a mesh nearest to each point of a test, after a rigid alignment if one is needed.

    Parameters
    ----------
    points : mapping of name to array_like, shape (3,)
        Coordinates in `unit`, in the axes of the test.
    nodes : sequence
        Names of the mesh's nodes.
    coordinates : array_like, shape (n_nodes, 3), m
    unit : {"m", "mm", "cm", "in", "ft"}
    known : mapping of point to node, optional
        Three points or more, not on one line, whose nodes are known: they alone give the alignment.

    Raises
    ------
    ValueError
        If a coordinate is not finite, a known point or node does not exist, or the points do not fit the mesh: the
        message says so if they would in another unit, or mirrored.
    """
    if unit not in UNITS:
        raise ValueError(f"unit: must be one of {', '.join(UNITS)} (got {unit!r})")
    mesh, names = _Mesh(nodes, coordinates), tuple(map(str, points))
    given = np.array([np.asarray(place, dtype=float) for place in points.values()])
    if given.ndim != 2 or given.shape[1] != 3 or not np.all(np.isfinite(given)):
        raise ValueError("points: must be one or more, with three finite coordinates each")
    x, doubts = UNITS[unit] * given, []
    if known:
        R, t = _by_known(dict(zip(names, x, strict=True)), mesh, known)
    elif mesh.fits(x):
        R, t = np.eye(3), np.zeros(3)
    else:
        R, t, others = _aligned(x, mesh)
        doubts = _of_alignments(others)
    placed = x @ R.T + t
    if not mesh.fits(placed):
        raise ValueError(
            f"{_no_fit(x, mesh, placed)}{_in_another_unit(given, mesh, unit)}{_mirrored(x, mesh, placed)}"
        )
    if not known and mesh.rms(placed) > _ROUGH * mesh.usual and _mirrored(x, mesh, placed):
        raise ValueError(f"{_no_fit(x, mesh, placed)}{_mirrored(x, mesh, placed)}")
    distance, place = mesh.tree.query(placed)
    at = [mesh.at(k) for k in place]
    found = Matching(names, tuple(those[0] for those in at), distance, mesh.spacing[place], R, t, (), ())
    doubts += [*_of_places(found, at), *_of_distances(found, mesh.tree.query(placed, k=2)[0][:, 1])]
    return replace(found, notes=tuple(_notes(found)), doubts=tuple(doubts))


def match_points(
    points: Mapping[Any, ArrayLike],
    model: SeparableModel,
    unit: str = "m",
    known: Mapping[Any, Any] | None = None,
) -> Matching:
    """Return the node of a model nearest to each point of a test, after a rigid alignment if one is needed.

    ``ModalData(…, sensors=[found.sensor("P1", "z"), …], points=found)`` then has the sensors at these nodes, in
    the directions that the axes of the test have in the model.

    Parameters
    ----------
    points : mapping of name to array_like, shape (3,)
        Coordinates in `unit`, in the axes of the test.
    model : SeparableModel
        With its geometry.
    unit : {"m", "mm", "cm", "in", "ft"}
    known : mapping of point to node, optional
        Three points or more, not on one line, whose nodes are known: they alone give the alignment.

    Returns
    -------
    Matching
        The node of each point with its distance, the alignment, and what to look at.

    Raises
    ------
    ValueError
        As `match`; or the model does not know where its nodes are.
    """
    if model.geometry is None:
        raise ValueError("model: must know the coordinates of its nodes (it has no geometry)")
    geometry = model.geometry
    moving = {row for row, *_ in model.located()}
    rows = sorted(moving.union(geometry.drawn.tolist()))  # no node that the mesh has for other purposes
    names = list(geometry.row_of)
    places = np.asarray(geometry.nodes, dtype=float)[rows]
    return match(points, [names[row] for row in rows], places, unit, known)


def _by_known(
    points: Mapping[str, FloatArray], mesh: _Mesh, known: Mapping[Any, Any]
) -> tuple[FloatArray, FloatArray]:
    wrong = [str(point) for point in known if str(point) not in points]
    wrong += [str(node) for node in known.values() if str(node) not in mesh.index]
    if wrong:
        raise ValueError(f"nodes: must be points of the test and nodes of the model (got {', '.join(wrong)})")
    x = np.array([points[str(point)] for point in known])
    if len(x) < 3 or np.linalg.svd(x - x.mean(axis=0), compute_uv=False)[1] < 1e-3 * np.ptp(x, axis=0).max():
        raise ValueError(f"nodes: must be of three points, not on one line (got {', '.join(map(str, known))})")
    return kabsch(x, mesh.given[[mesh.index[str(node)] for node in known.values()]])


def _aligned(x: FloatArray, mesh: _Mesh) -> tuple[FloatArray, FloatArray, list[tuple[FloatArray, FloatArray]]]:
    """Return the best alignment R, t, and others that fit as well; of all these the one that turns least."""
    R, t = _closest(x, mesh, *_starts(x, mesh), _FIRST_STEPS)
    which = np.concatenate([_places(x, mesh, R, t), np.round(4.0 * R.reshape(-1, 9))], axis=1)
    once = np.unique(which, axis=0, return_index=True)[1]
    best = once[np.argsort(_rms(x, mesh, R[once], t[once]), kind="stable")[:_BEST]]
    R, t = _closest(x, mesh, R[best], t[best], _STEPS)
    # the neighbours of a place on a regular mesh
    first = int(np.argmin(_rms(x, mesh, R, t)))
    step = mesh.usual * np.concatenate([np.eye(3), -np.eye(3)])
    beside = _closest(x, mesh, np.repeat(R[[first]], 6, axis=0), t[first] + step, _STEPS)
    R, t = np.concatenate([R, beside[0]]), np.concatenate([t, beside[1]])
    rms = _rms(x, mesh, R, t)
    good = np.flatnonzero(rms <= max(_AS_GOOD * float(rms.min()), _EXACT * mesh.usual))
    turn = np.round(Rotation.from_matrix(R[good]).magnitude(), 3)
    moved = np.linalg.norm(x @ np.swapaxes(R[good], -1, -2) + t[good][:, None] - x, axis=2).mean(axis=1)
    kept: list[int] = []
    for k in good[np.lexsort((moved, turn))].tolist():
        if all(_differ(x, mesh, (R[k], t[k]), (R[other], t[other])) for other in kept):
            kept.append(k)
    return R[kept[0]], t[kept[0]], [(R[k], t[k]) for k in kept[1:]]


def _starts(x: FloatArray, mesh: _Mesh) -> tuple[FloatArray, FloatArray]:
    """Return rotations and shifts to start from, shapes (n, 3, 3) and (n, 3)."""
    turns = np.array([np.eye(3)[list(order)] * sign for order in permutations(range(3)) for sign in _signs()])
    turns = turns[np.linalg.det(turns) > 0]
    V, W = (np.linalg.svd(part - part.mean(axis=0), full_matrices=False)[2] for part in (_three(x), mesh.places))
    turns = np.concatenate([turns, W.T @ turns @ V * np.linalg.det(W.T @ V)])
    R, t = [], []
    low, high = mesh.places.min(axis=0), mesh.places.max(axis=0)
    for turn in turns:
        turned = x @ turn.T
        ends = turned.min(axis=0), turned.max(axis=0)
        shifts = [
            np.zeros(3),
            mesh.places.mean(axis=0) - turned.mean(axis=0),
            0.5 * (low + high - ends[0] - ends[1]),
        ]
        shifts += [np.where(corner, high - ends[1], low - ends[0]) for corner in product((True, False), repeat=3)]
        R += [turn] * len(shifts)
        t += shifts
    return np.array(R), np.array(t)


def _signs() -> list[FloatArray]:
    return [np.array(signs) for signs in product((1.0, -1.0), repeat=3)]


def _three(x: FloatArray) -> FloatArray:
    """Return at least three points, for a singular value decomposition with three directions."""
    return x if len(x) >= 3 else np.concatenate([x, np.repeat(x[-1:], 3 - len(x), axis=0)])


def _closest(
    x: FloatArray, mesh: _Mesh, R: FloatArray, t: FloatArray, steps: int
) -> tuple[FloatArray, FloatArray]:
    """Return alignments (n, 3, 3) and (n, 3) after so many steps of iterative closest points."""
    for _ in range(steps):
        placed = x @ np.swapaxes(R, -1, -2) + t[:, None]
        turn, shift = kabsch(placed, mesh.places[mesh.tree.query(placed)[1]])
        R, before = turn @ R, t
        t = (turn @ t[..., None])[..., 0] + shift
        if np.abs(t - before).max() < 1e-12 * mesh.size and np.abs(turn - np.eye(3)).max() < 1e-12:
            break
    return R, t


def _places(x: FloatArray, mesh: _Mesh, R: FloatArray, t: FloatArray) -> IntArray:
    """Return the places nearest to the points after each alignment, shape (n, n_points)."""
    return np.asarray(mesh.tree.query(x @ np.swapaxes(R, -1, -2) + t[:, None])[1])


def _rms(x: FloatArray, mesh: _Mesh, R: FloatArray, t: FloatArray) -> FloatArray:
    distance = mesh.tree.query(x @ np.swapaxes(R, -1, -2) + t[:, None])[0]
    return np.asarray(np.sqrt(np.mean(distance**2, axis=1)))


def _differ(x: FloatArray, mesh: _Mesh, one: tuple[Any, Any], other: tuple[Any, Any]) -> bool:
    """Say whether two alignments give other nodes, or other directions."""
    places: list[IntArray] = [mesh.tree.query(x @ R.T + t)[1] for R, t in (one, other)]
    return bool(np.any(places[0] != places[1])) or _turn(one[0] @ other[0].T)[0] > _ELSEWHERE


def _turn(R: FloatArray) -> tuple[float, FloatArray]:
    """Return angle in degrees and axis of a rotation."""
    vector = Rotation.from_matrix(R).as_rotvec()
    angle = float(np.linalg.norm(vector))
    return np.degrees(angle), vector / angle if angle > 0 else vector


def _in_words(R: FloatArray, t: FloatArray) -> str:
    angle, axis = _turn(R)
    turned = f"turned by {significant(angle)}° about ({listed(np.round(axis, 2) + 0.0)}), " if angle > 0.05 else ""
    return f"{turned}moved by ({listed(np.round(t, 6) + 0.0)}) m"


def _notes(found: Matching) -> list[str]:
    notes, R, t = [], found.rotation, found.shift
    if np.any(np.eye(3) != R) or np.any(t):
        notes.append(f"To fit the mesh the points of the test were {_in_words(R, t)}.")
    k = int(np.argmax(found.distances))
    notes.append(
        f"{len(found.points)} points are on nodes of the mesh, the farthest {found.points[k]} at a distance of "
        f"{significant(found.distances[k])} m, where the spacing of the mesh is {significant(found.spacing[k])} m."
    )
    return notes


def _of_alignments(others: Sequence[tuple[FloatArray, FloatArray]]) -> list[str]:
    """Return a warning if other alignments fit as well."""
    if not others:
        return []
    many = f"{len(others)} other alignments fit" if len(others) > 1 else "Another alignment fits"
    return [
        f"{many} the mesh as well as the one that turns the points of the test least, such as "
        f"{_in_words(*others[0])}: give the nodes of three points."
    ]


def _of_places(found: Matching, at: Sequence[Sequence[Any]]) -> list[str]:
    """Return warnings on points at several nodes, and on points that share one."""
    doubts = [
        f"Point {name} is at nodes {names_in_words([str(node) for node in those])}, which are at one place: "
        f"{those[0]} is taken."
        for name, those in zip(found.points, at, strict=True)
        if len(those) > 1
    ]
    sharing: dict[Any, list[str]] = {}
    for name, node in zip(found.points, found.nodes, strict=True):
        sharing.setdefault(node, []).append(name)
    doubts += [
        f"Points {names_in_words(those)} are on one node, {n}." for n, those in sharing.items() if len(those) > 1
    ]
    return doubts[:_MOST_NAMED]


def _of_distances(found: Matching, second: FloatArray) -> list[str]:
    """Return warnings on points far from their nodes, or nearly as near to another; `second` is its distance."""
    far = found.distances / found.spacing
    doubts = [
        f"Point {found.points[k]} is {significant(found.distances[k])} m from the nearest node, {found.nodes[k]}, "
        f"where the spacing of the mesh is {significant(found.spacing[k])} m."
        for k in np.argsort(-far, kind="stable")
        if far[k] > DISTANT
    ]
    rivals = np.flatnonzero((second - found.distances < CLOSE_RIVAL * found.spacing) & (far <= DISTANT))
    doubts += [
        f"Point {found.points[k]} is nearly as near to another node as to {found.nodes[k]} "
        f"({significant(second[k])} m and {significant(found.distances[k])} m)."
        for k in rivals
    ]
    more = len(doubts) - _MOST_NAMED
    return doubts if more <= 0 else [*doubts[:_MOST_NAMED], f"So it is with {more} more points."]


def _no_fit(x: FloatArray, mesh: _Mesh, placed: FloatArray) -> str:
    """Return that points do not fit a mesh, and by how much."""
    size, distance = float(np.ptp(x, axis=0).max()), mesh.tree.query(placed)[0]
    return (
        f"must fit the mesh (the nearest nodes are up to {significant(float(distance.max()))} m off; the points "
        f"extend over {significant(size)} m, the mesh over {significant(mesh.size)} m)"
    )


def _in_another_unit(given: FloatArray, mesh: _Mesh, unit: str) -> str:
    """Return in which unit the points would fit; empty if in none."""
    for other, factor in UNITS.items():
        if other != unit and 0.2 <= np.ptp(factor * given, axis=0).max() / mesh.size <= 1.5:
            R, t, _ = _aligned(factor * given, mesh)
            if mesh.fits(factor * given @ R.T + t):
                return f"; they fit in {other}: unit = {other!r}"
    return ""


def _mirrored(x: FloatArray, mesh: _Mesh, placed: FloatArray) -> str:
    """Return that the mirrored points would fit, and much better; empty if they would not."""
    mirrored = x * [-1.0, 1.0, 1.0]
    R, t, _ = _aligned(mirrored, mesh)
    if mesh.rms(mirrored @ R.T + t) > _BETTER * mesh.rms(placed) or not mesh.fits(mirrored @ R.T + t):
        return ""
    return "; they fit mirrored: the axes of the test must be right-handed"
