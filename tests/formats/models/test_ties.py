"""Tied nodes: projection onto faces, and weights that the printed modes confirm."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fmu.formats.models.exported import mesh_of
from fmu.formats.models.ties import _projection, _shape_functions, tied_motions

SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
TRIANGLE = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])


def with_midsides(corners):
    return np.concatenate([corners, 0.5 * (corners + np.roll(corners, -1, axis=0))])


@pytest.mark.parametrize("places", [TRIANGLE, with_midsides(TRIANGLE), SQUARE, with_midsides(SQUARE)])
def test_shape_functions(places):
    n, n_corners = len(places), 3 if len(places) in (3, 6) else 4
    at = np.array([0.31, 0.17])
    N, dN = _shape_functions(at, n, n_corners)
    for k, place in enumerate(places):
        assert_allclose(_shape_functions(place, n, n_corners)[0], np.eye(n)[k], atol=1e-14)
    assert_allclose(N.sum(), 1.0, rtol=1e-14)
    assert_allclose(N @ places, at, rtol=1e-14)
    for j, step in enumerate(1e-6 * np.eye(2)):
        ends = [_shape_functions(at + sign * step, n, n_corners)[0] for sign in (1, -1)]
        assert_allclose(dN[j], (ends[0] - ends[1]) / 2e-6, atol=1e-9)
    if n > n_corners:  # complete quadratics
        assert_allclose(N @ (places[:, 0] * places[:, 1]), at[0] * at[1], rtol=1e-14)
        assert_allclose(N @ places[:, 0] ** 2, at[0] ** 2, rtol=1e-13)


@pytest.mark.parametrize("flat", [TRIANGLE, SQUARE, with_midsides(SQUARE)])
def test_a_point_off_a_warped_face_is_projected(flat):
    n_corners = 3 if len(flat) == 3 else 4
    places = np.column_stack([flat @ np.array([[2.0, 0.3], [-0.4, 1.5]]), 0.1 * flat[:, 0] * flat[:, 1]])
    weights = _projection(np.array([0.5, 0.4, 0.2]), places, n_corners)

    def nearest(around, half):
        """Return the point of a grid on the face that is nearest, and its distance."""
        steps = half * np.linspace(-1.0, 1.0, 31)
        every = [np.clip(around + np.array([r, s]), -1.0, 1.0) for r in steps for s in steps]
        inside = [at for at in every if n_corners == 4 or (at.min() >= 0 and at.sum() <= 1)]
        found = [_shape_functions(at, len(flat), n_corners)[0] @ places for at in inside]
        distances = np.linalg.norm(np.array(found) - [0.5, 0.4, 0.2], axis=1)
        return inside[int(np.argmin(distances))], distances.min()

    _, least = nearest(nearest(np.zeros(2), 1.0)[0], 0.1)  # a fine grid about the best point of a coarse one
    assert np.linalg.norm(weights @ places - [0.5, 0.4, 0.2]) <= least + 1e-3


def two_cubes(seed=0):
    """Return a mesh of two cubes with a common face, and modes in which the second is tied to the first."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1.0]])
    small = corners * [1.0, 0.5, 0.5] + [1.0, 0.2, 0.3]
    places = dict(enumerate([*corners, *small], 1))
    mesh = mesh_of(places, [tuple(range(1, 9)), tuple(range(9, 17))], ["hexahedron"] * 2)
    rng = np.random.default_rng(seed)
    modes = {node: rng.standard_normal((4, 3)) for node in places}
    face = [2, 3, 7, 6]
    tied = [9, 12, 16, 13]
    for node in tied:
        _, y, z = places[node]
        weights = [(1 - y) * (1 - z), y * (1 - z), y * z, (1 - y) * z]
        modes[node] = sum(w * modes[one] for w, one in zip(weights, face, strict=True))
    dofs = [(node, d) for node in places if node not in tied for d in "xyz"]
    return mesh, dofs, modes


def test_tied_nodes_follow_the_face_that_gives_their_printed_motion():
    mesh, dofs, modes = two_cubes()
    printed = {node: np.array([[float(f"{x:.6e}") for x in row] for row in u]) for node, u in modes.items()}
    motions, notes = tied_motions(mesh, frozenset(dofs), printed, {})
    assert not notes
    assert {node for node, _ in motions} == {9, 12, 13, 16}
    expected = {(2, "y"): 0.8 * 0.7, (3, "y"): 0.2 * 0.7, (7, "y"): 0.2 * 0.3, (6, "y"): 0.8 * 0.3}
    assert motions[9, "y"] == pytest.approx(expected, rel=1e-12)


def test_a_motion_that_no_face_gives_has_no_weights():
    mesh, dofs, modes = two_cubes()
    modes[9] = modes[9] + 1e-4
    motions, notes = tied_motions(mesh, frozenset(dofs), modes, {})
    assert {node for node, _ in motions} == {12, 13, 16}
    assert notes == ["No sensors can be at tied nodes whose face is not known: 9."]


def test_a_face_with_a_node_that_follows_another():
    """Node 6 has no row in z: it follows node 7 by an equation, is held, or moves in a way that is not known."""
    mesh, dofs, modes = two_cubes()
    own = {(7, "z"): 0.2 * 0.3, (3, "z"): 0.2 * 0.7, (2, "z"): 0.8 * 0.7}  # of node 9
    dofs = frozenset(dofs) - {(6, "z")}
    z = [0.0, 0.0, 1.0]
    for at_6, known, expected in (
        (2.0 * modes[7] * z, {(6, "z"): {(7, "z"): 2.0}}, own | {(7, "z"): 0.2 * 0.3 + 0.8 * 0.3 * 2.0}),
        (0.0 * modes[7], {}, own),
        (modes[6] * z, {}, None),
    ):
        change = at_6 - modes[6] * z
        moved = modes | {6: modes[6] + change}
        moved |= {
            n: modes[n] + w * change
            for n, w in ((9, 0.8 * 0.3), (12, 0.3 * 0.3), (16, 0.3 * 0.8), (13, 0.8 * 0.8))
        }
        motions, notes = tied_motions(mesh, dofs, moved, known)
        assert motions.get((9, "z")) == (None if expected is None else pytest.approx(expected, rel=1e-12))
        lost = ["No sensors can be at tied nodes that follow others without rows: 9, 12, 13, 16."]
        assert notes == (lost if expected is None else [])


def test_nothing_is_tied():
    mesh, _, modes = two_cubes()
    every = frozenset((node, d) for node in modes for d in "xyz")
    with pytest.raises(ValueError, match="has no node that moves and has no rows"):
        tied_motions(mesh, every, modes, {})


def test_what_tied_nodes_need_is_said():
    mesh, modes, dofs = two_cubes()[0], {}, [(1, "x")]
    with pytest.raises(ValueError, match=r"no displacements along global axes: print them with GLOBAL=YES"):
        tied_motions(mesh, dofs, modes, {})
    line = mesh_of({1: np.zeros(3), 2: np.ones(3)}, [(1, 2)], ["line"])
    with pytest.raises(ValueError, match=r"needs a mesh with faces"):
        tied_motions(line, dofs, {1: np.ones((2, 3)), 2: np.ones((2, 3))}, {})
