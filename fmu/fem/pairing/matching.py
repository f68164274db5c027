"""Matching of measurement points to mesh nodes: a rigid alignment, then the nearest node for each point.

Points that fit the mesh as they are given are not moved. Otherwise `fmu.fem.pairing.alignment` finds the alignment
R x + t. Points are never scaled or mirrored, but a message says if another unit or mirrored points would fit. A
warning says if other alignments fit as well, as on a symmetric structure. If the nodes of three or more points are
given, these points alone determine the alignment.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fmu.arguments import check_arguments
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.pairing.alignment import Alignment, Mesh, align_points, kabsch, turn_of
from fmu.formats.models.edges import inside
from fmu.numbers import listed, names_in_words, significant
from fmu.tables import data_frame
from fmu.types import DIRECTIONS, Dof, FloatArray

if TYPE_CHECKING:
    import pandas as pd

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254, "ft": 0.3048}
"""Size of each length unit in m."""
DISTANT = 0.5
"""Distance of a point from its node, in units of the local mesh spacing, above which a warning is given."""
CLOSE_RIVAL = 0.1
"""A warning is also given if the second-nearest node is farther by less than this, in the same units."""
SNAPPED = 2.0
"""Largest angle, in degrees, between test axes and model axes that count as parallel."""
_MOST_NAMED = 5
_FAR_SMALLER = 0.1
"""Extent of points, relative to the mesh, below which their unit is doubted if they share a node."""
_ROUGH, _BETTER = 0.1, 0.3
"""Mirrored points are tried if the distances exceed `_ROUGH` spacings, and reported if their distances are less
than `_BETTER` times as large.
"""
_AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class Matching:
    """Measurement points, each matched to the nearest model node.

    Attributes
    ----------
    points : tuple of str
        Point names.
    nodes : tuple
        Node of each point, as named in the model's degrees of freedom.
    distances : ndarray, shape (n_points,), m
        Distance of each point from its node, after the alignment.
    spacing : ndarray, shape (n_points,), m
        Distance from each point's node to the nearest other node of the mesh.
    rotation : ndarray, shape (3, 3)
        R in the alignment x → R x + t.
    shift : ndarray, shape (3,), m
        t.
    notes, doubts : tuple of str
        Sentences on what was done, and warnings.
    """

    points: tuple[str, ...]
    nodes: tuple[Hashable, ...]
    distances: FloatArray
    spacing: FloatArray
    rotation: FloatArray
    shift: FloatArray
    notes: tuple[str, ...]
    doubts: tuple[str, ...]

    def sensor(self, point: Hashable, direction: str) -> Dof:
        """Return the model node and direction for a sensor at `point`; `direction` is in the test's axes.

        Raises
        ------
        ValueError
            If there is no such point, the direction is unknown, or it is more than 2° off the nearest axis of the
            model.
        """
        if str(point) not in self.points:
            raise ValueError(f"must be a point of the geometry (got {point!r})")
        if direction.removeprefix("-") not in DIRECTIONS:
            raise ValueError(
                f"must have a direction, {', '.join(DIRECTIONS)} or one with a minus (got {direction!r})"
            )
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
        """Whether the test's axes are parallel to the model's axes to within 2°."""
        return bool(np.all(np.max(np.abs(self.rotation), axis=0) >= np.cos(np.radians(SNAPPED))))

    def turned(
        self, sensors: Sequence[Dof], shapes: ArrayLike | None = None
    ) -> tuple[tuple[Dof, ...], FloatArray | None]:
        """Return the sensors as (node, direction) in the model's axes, and the shapes there, (n_sensors, n_modes).

        If the test's axes are not parallel to the model's, the three components at each point are rotated
        together. The shapes are None if no shapes are given.

        Raises
        ------
        ValueError
            If a point does not exist, or the axes are not parallel and a point does not have a sensor along each
            of the three axes exactly once.
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
                self.sensor(*sensors[rows[0]])  # raises the error that says what is wrong
                raise ValueError(f"must be along all three axes of the test at every point (got {point})")
            sign = np.array([-1.0 if sensors[i][1].startswith("-") else 1.0 for i in rows])
            if values is not None:
                values[rows] = self.rotation[:, axes] @ (sign[:, None] * values[rows])
            for i, axis in zip(rows, _AXES, strict=True):
                found[i] = self.nodes[self.points.index(point)], f"{kind}{axis}"
        return tuple(found), values

    def table(self) -> pd.DataFrame:
        """Return a table with one row per point: ``node``, and ``distance`` and ``spacing`` in m."""
        columns = {"node": list(self.nodes), "distance": self.distances, "spacing": self.spacing}
        return data_frame(columns, "point", self.points)


def match(
    points: Mapping[Any, ArrayLike],
    nodes: Sequence[Hashable],
    coordinates: ArrayLike,
    unit: str = "m",
    known: Mapping[Any, Any] | None = None,
) -> Matching:
    """Match each measurement point to the nearest mesh node, after a rigid alignment if one is needed.

    Parameters
    ----------
    points : mapping of name to array_like, shape (3,)
        Coordinates in `unit`, in the test's axes.
    nodes : sequence
        Names of the mesh nodes.
    coordinates : array_like, shape (n_nodes, 3), m
    unit : {"m", "mm", "cm", "in", "ft"}
    known : mapping of point to node, optional
        Nodes of three or more points that are not on one line; these points alone then determine the alignment.

    Raises
    ------
    ValueError
        If the unit is unknown, there are no points, a coordinate is not finite, there are fewer than two nodes,
        `known` names a point or node that does not exist, `known` has fewer than three points or all of them are
        on one line, or the points do not fit the mesh. If points do not fit, the message says if they would fit in
        another unit, or mirrored. Without `known`, points that fit much better mirrored are an error too.
    """
    if unit not in UNITS:
        raise ValueError(f"unit: must be one of {', '.join(UNITS)} (got {unit!r})")
    mesh, names = Mesh(nodes, coordinates), tuple(map(str, points))
    given = np.array([np.asarray(place, dtype=float) for place in points.values()])
    if given.ndim != 2 or given.shape[1] != 3 or not np.all(np.isfinite(given)):
        raise ValueError(
            f"points: must be one or more, with three finite coordinates each (got shape {given.shape})"
        )
    x, doubts = UNITS[unit] * given, []
    if known:
        R, t = _by_known(dict(zip(names, x, strict=True)), mesh, known)
    elif mesh.fits(x):
        R, t = np.eye(3), np.zeros(3)
    else:
        R, t, others = align_points(x, mesh)
        doubts = _of_alignments(others)
    placed = x @ R.T + t
    if not mesh.fits(placed):
        raise ValueError(
            f"{_no_fit(x, mesh, placed)}{_in_another_unit(given, mesh, unit)}{_describe_mirror(x, mesh, placed)}"
        )
    if not known and mesh.rms(placed) > _ROUGH * mesh.usual and _describe_mirror(x, mesh, placed):
        raise ValueError(f"{_no_fit(x, mesh, placed)}{_describe_mirror(x, mesh, placed)}")
    distance, place = mesh.tree.query(placed)
    at = [mesh.at(k) for k in place]
    found = Matching(names, tuple(those[0] for those in at), distance, mesh.spacing[place], R, t, (), ())
    sharing = len(set(found.nodes)) < len(names)
    cause = _cause_of_sharing(x, given, mesh, unit) if sharing else ""
    doubts += [*_of_places(found, at, cause), *_of_distances(found, mesh.tree.query(placed, k=2)[0][:, 1])]
    return replace(found, notes=tuple(_notes(found)), doubts=tuple(doubts))


@check_arguments
def match_points(
    points: Mapping[Any, ArrayLike],
    model: SeparableModel,
    unit: str = "m",
    known: Mapping[Any, Any] | None = None,
) -> Matching:
    """Match each measurement point to the nearest model node, after a rigid alignment if one is needed.

    If `found` is the result, ``ModalData(…, sensors=[found.sensor("P1", "z"), …], points=found)`` has its sensors
    at the matched nodes, in the model directions that correspond to the test's axes. Places at an offset from a
    node, `SeparableModel.arms`, count as nodes. Nodes inside solids, and nodes that neither move nor are plotted,
    are not used. `fmu.fem.pairing.alignment` describes the alignment.

    Parameters
    ----------
    points : mapping of name to array_like, shape (3,)
        Coordinates in `unit`, in the test's axes.
    model : SeparableModel
        The model; it must have a geometry.
    unit : {"m", "mm", "cm", "in", "ft"}
    known : mapping of point to node, optional
        Nodes of three or more points that are not on one line; these points alone then determine the alignment.

    Returns
    -------
    Matching
        The node of each point with its distance, the alignment, notes and warnings.

    Raises
    ------
    ValueError
        As for `match`, or if the model has no geometry.
    """
    if model.geometry is None:
        raise ValueError("model: must know the coordinates of its nodes (it has no geometry)")
    geometry = model.geometry
    moving = {row for row, *_ in model.locate_motions()}  # skips nodes that the mesh has for other purposes
    within = () if geometry.mesh is None else inside(geometry.mesh).tolist()
    rows = sorted(moving.union(geometry.drawn.tolist()).difference(within))
    row_of = geometry.row_of
    names = list(row_of)
    places = np.asarray(geometry.nodes, dtype=float)
    tips = {name: places[row_of[arm.node]] + arm.offset for name, arm in model.arms.items() if arm.node in row_of}
    return match(
        points, [*(names[row] for row in rows), *tips], np.array([*places[rows], *tips.values()]), unit, known
    )


def _by_known(points: Mapping[str, FloatArray], mesh: Mesh, known: Mapping[Any, Any]) -> Alignment:
    wrong = [str(point) for point in known if str(point) not in points]
    wrong += [str(node) for node in known.values() if str(node) not in mesh.index]
    if wrong:
        raise ValueError(f"nodes: must be points of the test and nodes of the model (got {', '.join(wrong)})")
    x = np.array([points[str(point)] for point in known])
    if len(x) < 3 or np.linalg.svd(x - x.mean(axis=0), compute_uv=False)[1] < 1e-3 * np.ptp(x, axis=0).max():
        raise ValueError(f"nodes: must be of three points, not on one line (got {', '.join(map(str, known))})")
    return kabsch(x, mesh.given[[mesh.index[str(node)] for node in known.values()]])


def _in_words(R: FloatArray, t: FloatArray) -> str:
    angle, axis = turn_of(R)
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


def _of_alignments(others: Sequence[Alignment]) -> list[str]:
    """Return a list with a warning if other alignments fit equally well; otherwise return an empty list."""
    if not others:
        return []
    many = f"{len(others)} other alignments fit" if len(others) > 1 else "Another alignment fits"
    return [
        f"{many} the mesh as well as the one that turns the points of the test least, such as "
        f"{_in_words(*others[0])}: give the nodes of three points."
    ]


def _of_places(found: Matching, at: Sequence[Sequence[Hashable]], cause: str) -> list[str]:
    """Return at most five warnings about points at several coincident nodes, or about points that share a node.

    `cause` is a phrase on why they share it, or empty.
    """
    doubts = [
        f"Point {name} is at nodes {names_in_words([str(node) for node in those])}, which are at one place: "
        f"{those[0]} is taken."
        for name, those in zip(found.points, at, strict=True)
        if len(those) > 1
    ]
    sharing: dict[Hashable, list[str]] = {}
    for name, node in zip(found.points, found.nodes, strict=True):
        sharing.setdefault(node, []).append(name)
    doubts += [
        f"Points {names_in_words(those)} are on one node, {n}{cause}."
        for n, those in sharing.items()
        if len(those) > 1
    ]
    return doubts[:_MOST_NAMED]


def _of_distances(found: Matching, second: FloatArray) -> list[str]:
    """Return warnings about points that are far from their nodes, or almost as close to another node.

    `second` is the distance of each point from its second-nearest node, in m. After five warnings, the others are
    only counted.
    """
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


def _no_fit(x: FloatArray, mesh: Mesh, placed: FloatArray) -> str:
    """Return a phrase for the error message that says how far the points are from the mesh."""
    distance = float(mesh.tree.query(placed)[0].max())
    return f"must fit the mesh (the nearest nodes are up to {significant(distance)} m off; {_extents(x, mesh)})"


def _extents(x: FloatArray, mesh: Mesh) -> str:
    size = float(np.ptp(x, axis=0).max())
    return f"the points extend over {significant(size)} m, the mesh over {significant(mesh.size)} m"


def _cause_of_sharing(x: FloatArray, given: FloatArray, mesh: Mesh, unit: str) -> str:
    """Return a phrase that says if points fit a far larger mesh in another unit, or an empty string."""
    if np.ptp(x, axis=0).max() > _FAR_SMALLER * mesh.size:
        return ""
    fits = _in_another_unit(given, mesh, unit)
    return f": {_extents(x, mesh)}{fits} (lengths of the mesh are taken as m)" if fits else ""


def _in_another_unit(given: FloatArray, mesh: Mesh, unit: str) -> str:
    """Return a phrase that names the first other unit in which the points fit, or an empty string if none does."""
    for other, factor in UNITS.items():
        if other != unit and 0.2 <= np.ptp(factor * given, axis=0).max() / mesh.size <= 1.5:
            R, t, _ = align_points(factor * given, mesh)
            if mesh.fits(factor * given @ R.T + t):
                return f"; they fit in {other}: unit = {other!r}"
    return ""


def _describe_mirror(x: FloatArray, mesh: Mesh, placed: FloatArray) -> str:
    """Return a phrase saying that mirrored points would fit much better; an empty string if they would not."""
    mirrored = x * [-1.0, 1.0, 1.0]
    R, t, _ = align_points(mirrored, mesh)
    if mesh.rms(mirrored @ R.T + t) > _BETTER * mesh.rms(placed) or not mesh.fits(mirrored @ R.T + t):
        return ""
    return "; they fit mirrored: the axes of the test must be right-handed"
