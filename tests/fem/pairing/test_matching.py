"""Points of a test on a mesh: turned, moved, in other units, mirrored, and mistaken in ways that must be told."""

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.spatial.transform import Rotation

import fmu
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.separable import Geometry, RigidArm
from fmu.fem.pairing import alignment
from fmu.fem.pairing.alignment import Mesh, kabsch
from fmu.fem.pairing.matching import match, match_points
from fmu.formats.models.edges import inside
from fmu.formats.models.exported import mesh_of

STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)
rng = np.random.default_rng(5)


def bracket():
    """Return nodes and places of an L of two plates with a fin: no rotation carries it to itself."""
    grid = np.arange(0.0, 1.01, 0.1)
    x, y = np.meshgrid(grid, np.arange(0.0, 0.61, 0.1), indexing="ij")
    floor = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    wall = np.stack([0 * x.ravel(), y.ravel(), 0.8 * x.ravel()], axis=1)
    fin = np.stack([grid, 0 * grid, 0.1 + 0 * grid], axis=1)
    places = np.unique(np.round(np.concatenate([floor, wall, fin]), 9), axis=0)
    return [int(k) for k in 100 + rng.permutation(len(places))], places


NODES, PLACES = bracket()
PICKED = rng.choice(len(PLACES), 15, replace=False)
AXIAL = list(Rotation.create_group("O"))
SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.validate) for seed in (1, 2))]


@pytest.fixture
def few_starts(monkeypatch):
    """Search from fewer turns: those about axes are enough where a test is of what is said, or of such a turn."""
    monkeypatch.setattr(alignment, "_OTHERS", 20)


def points_of(rotation, shift, noise=0.0, factor=1.0):
    """Return the points in the axes of a test: the inverse of the alignment that is to be found."""
    moved = (PLACES[PICKED] - shift) @ rotation.as_matrix()  # Rᵀ (y − t)
    moved = factor * (moved + noise * np.random.default_rng(6).normal(size=moved.shape))
    return {f"P{k}": place for k, place in enumerate(moved)}


def expected():
    return tuple(NODES[k] for k in PICKED)


def test_kabsch_finds_the_rotation_and_no_reflection():
    x = rng.normal(size=(6, 3))
    R = Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix()
    found = kabsch(x, x @ R.T + [1.0, 2.0, 3.0])
    assert found[0] == pytest.approx(R, abs=1e-9)
    assert found[1] == pytest.approx([1.0, 2.0, 3.0], abs=1e-9)
    assert np.linalg.det(kabsch(x, x * [1.0, 1.0, -1.0])[0]) == pytest.approx(1.0)


def test_points_on_a_line_are_not_turned_about_it():
    x = np.outer(np.arange(5.0), [1.0, 0.0, 0.0])
    R = kabsch(x, np.outer(np.arange(5.0), [0.0, 1.0, 0.0]))[0]
    assert np.allclose(R, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-6)
    along = np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
    turned = Rotation.from_rotvec([0.3, -0.2, 0.4]).apply(along)
    R = kabsch(np.outer(np.arange(5.0), along), np.outer(np.arange(5.0), turned))[0]
    assert Rotation.from_matrix(R).magnitude() == pytest.approx(np.arccos(along @ turned), abs=1e-4)


@pytest.mark.parametrize(
    "k", [pytest.param(k, marks=() if k % 10 == 3 else pytest.mark.validate) for k in range(24)]
)
def test_every_turn_of_axes_is_found_with_the_sensors_turned_too(k):
    rotation = AXIAL[k]
    found = match(points_of(rotation, [3.0, -2.0, 0.5]), NODES, PLACES)
    assert found.nodes == expected()
    assert found.rotation == pytest.approx(rotation.as_matrix(), abs=1e-6)
    assert found.distances == pytest.approx(np.zeros(len(PICKED)), abs=1e-9)
    for axis, direction in enumerate("xyz"):
        node, turned = found.sensor("P3", direction)
        column = rotation.as_matrix()[:, axis]
        at = int(np.argmax(np.abs(column)))
        assert (node, turned) == (expected()[3], ("-" if column[at] < 0 else "") + "xyz"[at])
        assert found.sensor("P3", f"-{direction}")[1] == (turned[1:] if turned.startswith("-") else f"-{turned}")
        assert found.sensor("P3", f"r{direction}")[1].replace("r", "") == turned


@pytest.mark.parametrize("seed", SEEDS)
def test_any_turn_is_found_with_inaccurate_points(seed):
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    found = match(points_of(rotation, [10.0, 20.0, -5.0], noise=0.01), NODES, PLACES)
    assert found.nodes == expected()
    assert (Rotation.from_matrix(found.rotation) * rotation.inv()).magnitude() < np.radians(2)
    assert 0.005 < found.distances.max() < 0.05
    assert "turned by" in found.notes[0]
    with pytest.raises(ValueError, match=r"must be along an axis of the model .* off in the alignment"):
        found.sensor("P0", "x")


def test_three_components_at_a_point_are_turned_together():
    rotation = Rotation.from_rotvec([0.4, -0.9, 1.7])
    found = match(points_of(rotation, [1.0, 2.0, 3.0]), NODES, PLACES)
    motion = np.random.default_rng(3).normal(size=(2, 3, 4))  # of two nodes in the axes of the model, four modes
    seen = np.einsum("ba,nbm->nam", rotation.as_matrix(), motion)  # along those of the test
    sensors = [("P3", "x"), ("P3", "-z"), ("P8", "y"), ("P3", "y"), ("P8", "-x"), ("P8", "z")]
    read = np.stack([seen[0, 0], -seen[0, 2], seen[1, 1], seen[0, 1], -seen[1, 0], seen[1, 2]])
    turned, shapes = found.turned(sensors, read)
    nodes = expected()
    assert turned == tuple(
        (nodes[k], axis) for k, axis in ((3, "x"), (3, "y"), (8, "x"), (3, "z"), (8, "y"), (8, "z"))
    )
    wanted = [motion[0 if node == nodes[3] else 1]["xyz".index(axis)] for node, axis in turned]
    assert shapes == pytest.approx(np.array(wanted), abs=1e-6)
    with pytest.raises(ValueError, match=r"or each point must have sensors along all three axes of the test"):
        found.turned(sensors[:5], read[:5])
    with pytest.raises(ValueError, match=r"must be a point of the geometry \(got 'Q'\)"):
        found.turned([("Q", "x")])


@pytest.mark.usefixtures("few_starts")
def test_points_in_the_axes_of_the_model_are_left_alone():
    found = match(points_of(Rotation.identity(), 0.0, noise=0.01), NODES, PLACES)
    assert found.nodes == expected()
    assert np.array_equal(found.rotation, np.eye(3))
    assert not np.any(found.shift)
    assert found.doubts == ()
    assert len(found.notes) == 1
    assert found.sensor("P7", "-y") == (expected()[7], "-y")
    assert found.table().loc["P7", "node"] == expected()[7]


@pytest.mark.usefixtures("few_starts")
@pytest.mark.parametrize("known", [None, {"14": "box", "a": 0, "c": 2}])
def test_places_at_an_offset_from_a_node_are_matched(known):
    nodes = np.array([[0.0, 0.0, 0.0], [0.3, 0.2, 3.0], [3.0, 1.0, 3.5]])
    group = ElementGroup("g", np.array([[0, 1], [1, 2]]), Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6), STEEL)
    model = Frame(nodes, [group], {0: DIRECTIONS}, arms={"box": RigidArm(1, (0.3, -0.2, 0.5))}).separable({})
    points = {"14": nodes[1] + [0.3, -0.2, 0.5], "a": nodes[0], "c": nodes[2]}
    found = match_points(points, model, known=known)
    assert found.nodes == ("box", 0, 2)
    assert found.distances == pytest.approx(0.0, abs=1e-12)
    assert model.sees(found.sensor("14", "z"))


def test_nodes_in_another_order_are_the_same_nodes():
    order = rng.permutation(len(NODES))
    points = points_of(AXIAL[5], [1.0, 0.0, 0.0])
    assert match(points, [NODES[k] for k in order], PLACES[order]).nodes == expected()


@pytest.mark.usefixtures("few_starts")
@pytest.mark.usefixtures("few_starts")
def test_points_in_a_smaller_unit_than_the_mesh_are_not_only_said_to_be_on_one_node():
    """Points in mm on a mesh in mm, whose numbers are taken as m, all shrink to the node at the origin."""
    points = points_of(Rotation.identity(), 0.0, factor=1000.0)
    doubts = match(points, NODES, 1000.0 * PLACES, unit="mm").doubts
    assert len(doubts) == 1
    assert doubts[0].endswith(
        ": the points extend over 0.9 m, the mesh over 1000 m; they fit in m: unit = 'm' "
        "(lengths of the mesh are taken as m)."
    )
    one_spot = {"a": [0.0, 0.0, 0.0], "b": [0.01, 0.0, 0.0]}
    assert match(one_spot, NODES, PLACES).doubts[0].endswith(f"are on one node, {NODES[0]}.")


def test_units_are_told_and_not_applied():
    points = points_of(AXIAL[3], [0.5, 0.0, 0.0], factor=1e3)
    with pytest.raises(ValueError, match=r"must fit the mesh .* extend over .* they fit in mm: unit = 'mm'"):
        match(points, NODES, PLACES)
    assert match(points, NODES, PLACES, "mm").nodes == expected()


@pytest.mark.usefixtures("few_starts")
def test_a_mirrored_geometry_is_no_rigid_motion():
    points = {name: place * [1.0, -1.0, 1.0] for name, place in points_of(AXIAL[3], [5.0, 0.0, 0.0]).items()}
    with pytest.raises(ValueError, match="they fit mirrored: the axes of the test must be right-handed"):
        match(points, NODES, PLACES)


@pytest.mark.usefixtures("few_starts")
def test_other_points_do_not_fit():
    points = {str(k): place for k, place in enumerate(np.random.default_rng(1).normal(size=(20, 3)))}
    with pytest.raises(ValueError, match=r"must fit the mesh \(the nearest nodes are up to"):
        match(points, NODES, PLACES)


@pytest.mark.parametrize("seed", SEEDS)
def test_points_on_the_surface_of_a_solid_in_any_position(seed):
    """A regular mesh has a minimum at every shift by its spacing, and nodes inside that no sensor is at."""
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])
    within = [(i, j, k) for i in range(12) for j in range(8) for k in range(6) if i < 5 or j < 3 or k < 2]
    places, elements = np.unique((np.array(within)[:, None] + corners).reshape(-1, 3), axis=0, return_inverse=True)
    mesh = mesh_of(
        dict(enumerate((0.05 * places).tolist(), 1)),
        [tuple(int(node) + 1 for node in element) for element in elements.reshape(-1, 8)],
        ["hexahedron"] * len(within),
    )
    dofs = [(int(node), axis) for node in mesh.nodes for axis in "xyz"]
    unit = sp.eye_array(len(dofs), format="csr")
    model = fmu.SeparableModel.from_terms(["k"], [(unit, "k")], [unit], dofs, Geometry.of_mesh(mesh))
    outside = np.setdiff1d(np.arange(len(mesh.nodes)), inside(mesh))
    picked = np.random.default_rng(seed).choice(outside, 25, replace=False)
    turn = Rotation.random(rng=np.random.default_rng(10 + seed))
    points = dict(enumerate((mesh.coordinates[picked] - [1.0, 2.0, 3.0]) @ turn.as_matrix()))
    found = match_points(points, model)
    assert found.nodes == tuple(mesh.nodes[picked].tolist())
    assert found.rotation == pytest.approx(turn.as_matrix(), abs=1e-6)


def plate():
    x, y = np.meshgrid(np.arange(0.0, 1.01, 0.1), np.arange(0.0, 0.61, 0.1), indexing="ij")
    return list(range(x.size)), np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)


@pytest.mark.usefixtures("few_starts")
def test_on_a_symmetric_structure_every_alignment_is_told_and_known_points_decide():
    nodes, places = plate()
    picked = [0, 6, 12, 38, 70, 76]  # three corners among them, but the plate has four
    turn = AXIAL[
        next(k for k, R in enumerate(AXIAL) if np.allclose(R.as_matrix(), [[0, -1, 0], [1, 0, 0], [0, 0, 1]]))
    ]
    points = {f"P{k}": (places[k] - [4.0, 4.0, 0.0]) @ turn.as_matrix() for k in picked}
    found = match(points, nodes, places)
    assert any(
        "other alignments fit the mesh as well" in doubt or "Another alignment" in doubt for doubt in found.doubts
    )
    known = match(points, nodes, places, known={"P0": 0, "P6": 6, "P70": "70"})
    assert known.nodes == tuple(picked)
    assert known.doubts == ()


@pytest.mark.usefixtures("few_starts")
def test_points_far_from_nodes_between_nodes_and_on_one_node_are_named():
    points = points_of(Rotation.identity(), 0.0)
    points["far"] = np.array([0.5, 0.3, 0.07])
    points["between"] = np.array([0.45, 0.3, 0.0])
    points["twin"] = points["P4"] + [0.01, 0.0, 0.0]
    doubts = match(points, NODES, PLACES).doubts
    assert any(doubt.startswith("Point far is 0.07 m from the nearest node") for doubt in doubts)
    assert any(doubt.startswith("Point between is nearly as near to another node") for doubt in doubts)
    assert any(doubt.startswith("Points P4 and twin are on one node") for doubt in doubts)
    assert len(doubts) == 3


def test_nodes_at_one_place_are_named():
    found = match(points_of(Rotation.identity(), 0.0), [*NODES, 999], np.concatenate([PLACES, PLACES[PICKED[:1]]]))
    assert any(f"is at nodes {expected()[0]} and 999, which are at one place" in doubt for doubt in found.doubts)
    assert found.spacing.min() > 0.01


def test_a_beam_may_turn_about_its_axis():
    """Sensors along a line say nothing of the directions across it; the least turn is taken, and told."""
    places = np.outer(np.linspace(0, 2, 21), [1.0, 0.0, 0.0])
    points = {str(k): [0.0, 5.0 + places[k, 0], 0.0] for k in (0, 3, 9, 20)}
    found = match(points, range(21), places)
    assert found.nodes == (0, 3, 9, 20)
    assert found.sensor(3, "z") == (3, "z")
    assert found.sensor("3", "x") == (3, "-y")
    assert any("alignment" in doubt for doubt in found.doubts)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"unit": "km"}, r"unit: must be one of m, mm, cm, in, ft \(got 'km'\)"),
        (
            {"known": {"P0": 1, "Q": 2, "P2": 3}},
            r"nodes: must be points of the test and nodes of the model \(got Q, 1",
        ),
        (
            {"known": {"P0": NODES[0], "P1": NODES[1]}},
            r"nodes: must be of three points, not on one line \(got P0, P1\)",
        ),
        ({"coordinates": PLACES[:-1]}, r"coordinates: must be finite"),
        ({"points": {"a": [0.0, np.nan, 0.0]}}, "points: must be one or more, with three finite coordinates"),
        ({"points": {}}, "points: must be one or more"),
        ({"points": {"a": [1.0, 2.0]}}, "points: must be one or more"),
    ],
)
def test_what_cannot_be_matched(change, message):
    given = {"points": points_of(Rotation.identity(), 0.0), "nodes": NODES, "coordinates": PLACES} | change
    with pytest.raises(ValueError, match=message):
        match(**given)


@pytest.mark.parametrize("direction", ["", "-", "q", "xq", "--x"])
def test_a_direction_that_does_not_exist_is_named(direction):
    found = match(points_of(Rotation.identity(), [0.0, 0.0, 0.0]), NODES, PLACES)
    with pytest.raises(ValueError, match=rf"must have a direction, x, y, .* \(got '{direction}'\)"):
        found.sensor("P3", direction)


def test_nodes_at_one_place_are_no_mesh():
    with pytest.raises(ValueError, match=r"coordinates: must differ \(all 3 nodes are at \[1\.0, 2\.0, 3\.0\]\)"):
        Mesh([1, 2, 3], np.tile([1.0, 2.0, 3.0], (3, 1)))
