"""Rigid alignment of points to a mesh, by iterative closest points (ICP) from many starting alignments.

Each step (Besl & McKay 1992) is the least-squares alignment with the nearest nodes (Kabsch 1976). The iterations
start from the 24 rotations that map axes to axes, from the principal axes of points and mesh, and from hundreds of
other rotations. On a regular mesh every shift by the node spacing is a local minimum, so alignments one node away
from the best ones are tried too.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from itertools import product

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from fmu.types import FloatArray, IntArray

_FIRST_STEPS, _STEPS, _BEST = 6, 40, 48
"""Largest numbers of steps from a starting and from a best alignment, and number of best alignments kept."""
_FEW, _ROUNDS = 8, 10
"""Number of alignments whose neighbours are tried, and the largest number of rounds."""
_OTHERS = 600
"""Number of random starting rotations; two neighbours differ by some 20°."""
_AS_GOOD = 1.2
"""An alignment fits about as well as the best if its RMS distance is at most this many times as large."""
_EXACT = 1e-3
"""RMS distances below this, in units of the median spacing, all count as zero."""
_ELSEWHERE = 5.0
"""Smallest angle in degrees between two alignments that count as different."""
_MOST_FAR = 0.2
"""Points fit a mesh if at most this share is farther from the nearest node than the mesh spacing there."""
_KEEPS = 1e-10
"""Relative weight of the identity in `kabsch`. It decides the rotation of collinear points about their line."""


Alignment = tuple[FloatArray, FloatArray]
"""Rotation R and shift t in x → R x + t."""


def kabsch(points: FloatArray, targets: FloatArray) -> Alignment:
    """Return the rotation R and shift t that minimise Σ |R x + t − y|² for each set of n points (Kabsch 1976).

    If several rotations fit equally well, as for collinear points, R is the one with the smallest angle.

    Parameters
    ----------
    points, targets : ndarray, shape (..., n, 3)

    Returns
    -------
    R : ndarray, shape (..., 3, 3)
        Rotations with determinant +1; a mirrored set is not matched by a reflection.
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


class Mesh:
    """Distinct node positions of a mesh, and the spacing between them.

    Raise ValueError if there are fewer than two nodes, if all are at one point, or if their coordinates are not
    finite or not of shape (n, 3).
    """

    def __init__(self, nodes: Sequence[Hashable], coordinates: ArrayLike) -> None:
        given = np.asarray(coordinates, dtype=float)
        if given.shape != (len(nodes), 3) or len(nodes) < 2 or not np.all(np.isfinite(given)):
            raise ValueError(f"coordinates: must be finite, for two nodes or more (got shape {given.shape})")
        self.size = float(np.ptp(given, axis=0).max())
        if self.size == 0.0:
            raise ValueError(f"coordinates: must differ (all {len(nodes)} nodes are at {given[0].tolist()})")
        _, first, self._place_of = np.unique(
            np.round(given / (1e-9 * self.size)), axis=0, return_index=True, return_inverse=True
        )
        self._nodes, self.places = list(nodes), given[first]
        self.index = {str(node): k for k, node in enumerate(nodes)}
        self.given = given
        self.tree = KDTree(self.places)
        self.spacing = self.tree.query(self.places, k=2)[0][:, 1]
        self.usual = float(np.median(self.spacing))

    def at(self, place: int) -> list[Hashable]:
        """Return the nodes at the position with index `place`; several nodes may coincide."""
        return [self._nodes[k] for k in np.flatnonzero(self._place_of.ravel() == place)]

    def rms(self, x: FloatArray) -> float:
        """Return the root-mean-square distance of points (n, 3) from their nearest nodes."""
        return float(np.sqrt(np.mean(self.tree.query(x)[0] ** 2)))

    def fits(self, x: FloatArray) -> bool:
        """Return True if at least 80 % of the points (n, 3) are within the local mesh spacing of a node."""
        distance, place = self.tree.query(x)
        return bool(np.mean(distance > self.spacing[place]) <= _MOST_FAR)


def align_points(x: FloatArray, mesh: Mesh) -> tuple[FloatArray, FloatArray, list[Alignment]]:
    """Return the rotation R (3, 3) and shift t (3,) of an alignment, and a list of others that fit about as well.

    `x` contains the points, shape (n, 3). Of all alignments that fit about as well as the best one, R and t belong
    to the one with the smallest rotation. The others differ from it and from each other; see `_differ`.
    """
    R, t = _best(x, mesh, *_closest(x, mesh, *_starts(x, mesh), _FIRST_STEPS), _BEST)
    R, t = _closest(x, mesh, R, t, _STEPS)
    # on a regular mesh every shift by its spacing is close to a minimum
    shifts = mesh.usual * np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))
    for _ in range(_ROUNDS):
        least = _rms(x, mesh, R, t).min()
        near = _best(x, mesh, R, t, _FEW)
        beside = (near[1][:, None] + shifts).reshape(-1, 3)
        others = _closest(x, mesh, np.repeat(near[0], len(shifts), axis=0), beside, _FIRST_STEPS)
        R, t = _best(x, mesh, np.concatenate([R, others[0]]), np.concatenate([t, others[1]]), _BEST)
        if _rms(x, mesh, R, t).min() > 0.999 * least:
            break
    R, t = _closest(x, mesh, R, t, _STEPS)
    rms = _rms(x, mesh, R, t)
    good = np.flatnonzero(rms <= max(_AS_GOOD * float(rms.min()), _EXACT * mesh.usual))
    turn = np.round(Rotation.from_matrix(R[good]).magnitude(), 3)
    moved = np.linalg.norm(x @ np.swapaxes(R[good], -1, -2) + t[good][:, None] - x, axis=2).mean(axis=1)
    kept: list[int] = []
    for k in good[np.lexsort((moved, turn))].tolist():
        if all(_differ(x, mesh, (R[k], t[k]), (R[other], t[other])) for other in kept):
            kept.append(k)
    return R[kept[0]], t[kept[0]], [(R[k], t[k]) for k in kept[1:]]


def _best(x: FloatArray, mesh: Mesh, R: FloatArray, t: FloatArray, count: int) -> Alignment:
    """Return up to `count` of the best-fitting alignments, without duplicates.

    Duplicates match the points to the same nodes with nearly equal rotations.
    """
    places = mesh.tree.query(x @ np.swapaxes(R, -1, -2) + t[:, None])[1]
    which = np.concatenate([places, np.round(4.0 * R.reshape(-1, 9))], axis=1)
    once = np.unique(which, axis=0, return_index=True)[1]
    best = once[np.argsort(_rms(x, mesh, R[once], t[once]), kind="stable")[:count]]
    return R[best], t[best]


def _starts(x: FloatArray, mesh: Mesh) -> Alignment:
    """Return starting rotations (n, 3, 3) and shifts (n, 3).

    Rotations that map axes or principal axes onto each other are combined with shifts that superpose the centres,
    the corners or the origins. Random rotations are combined only with shifts that superpose the centres. The
    centre is either the mean of the points or the middle of their bounding box.
    """
    axes = Rotation.create_group("O").as_matrix()
    V, W = (np.linalg.svd(part - part.mean(axis=0), full_matrices=False)[2] for part in (_three(x), mesh.places))
    likely = np.concatenate([axes, W.T @ axes @ V * np.linalg.det(W.T @ V)])
    others = Rotation.random(_OTHERS, rng=np.random.default_rng(0)).as_matrix()
    R, t = [], []
    low, high = mesh.places.min(axis=0), mesh.places.max(axis=0)
    for k, turn in enumerate(np.concatenate([likely, others])):
        turned = x @ turn.T
        first, last = turned.min(axis=0), turned.max(axis=0)
        shifts = [mesh.places.mean(axis=0) - turned.mean(axis=0), 0.5 * (low + high - first - last)]
        if k < len(likely):
            corners = product((True, False), repeat=3)
            shifts += [np.zeros(3), *(np.where(corner, high - last, low - first) for corner in corners)]
        R += [turn] * len(shifts)
        t += shifts
    return np.array(R), np.array(t)


def _three(x: FloatArray) -> FloatArray:
    """Return the points, with the last one repeated until there are three, which an SVD needs."""
    return x if len(x) >= 3 else np.concatenate([x, np.repeat(x[-1:], 3 - len(x), axis=0)])


def _closest(x: FloatArray, mesh: Mesh, R: FloatArray, t: FloatArray, steps: int) -> Alignment:
    """Run at most `steps` ICP iterations from n starting alignments; return n alignments, (n, 3, 3) and (n, 3)."""
    for _ in range(steps):
        placed = x @ np.swapaxes(R, -1, -2) + t[:, None]
        turn, shift = kabsch(placed, mesh.places[mesh.tree.query(placed)[1]])
        R, before = turn @ R, t
        t = (turn @ t[..., None])[..., 0] + shift
        if np.abs(t - before).max() < 1e-12 * mesh.size and np.abs(turn - np.eye(3)).max() < 1e-12:
            break
    return R, t


def _rms(x: FloatArray, mesh: Mesh, R: FloatArray, t: FloatArray) -> FloatArray:
    distance = mesh.tree.query(x @ np.swapaxes(R, -1, -2) + t[:, None])[0]
    return np.asarray(np.sqrt(np.mean(distance**2, axis=1)))


def _differ(x: FloatArray, mesh: Mesh, one: Alignment, other: Alignment) -> bool:
    """Return True if two alignments match a point to different nodes, or differ by a rotation of more than 5°."""
    places: list[IntArray] = [mesh.tree.query(x @ R.T + t)[1] for R, t in (one, other)]
    return bool(np.any(places[0] != places[1])) or turn_of(one[0] @ other[0].T)[0] > _ELSEWHERE


def turn_of(R: FloatArray) -> tuple[float, FloatArray]:
    """Return the angle in degrees and the axis (3,) of the rotation R. The axis of the identity is zero."""
    vector = Rotation.from_matrix(R).as_rotvec()
    angle = float(np.linalg.norm(vector))
    return np.degrees(angle), vector / angle if angle > 0 else vector
