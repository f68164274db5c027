"""The line drawing of a structure: what is changed by what, and where it is held."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fmu.fem.frame.changed_elements import changed_elements
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, JointSpring, Material, PointMass, Section
from fmu.fem.frame.drawing import COLOURS, UNCHANGED, drawing, parameter_colours, sketch
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.separable import RigidArm, SeparableModel
from tests import cantilever

SVG = "{http://www.w3.org/2000/svg}"
SECTION, STEEL = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6), Material(E=2.1e11, nu=0.3, rho=7850.0)


def halves():
    return cantilever.beam(2).separable({"A1": [("A", "1")], "I2": [("Iy", "2")], "A2": [("A", "2")]})


def frame(nodes, supports):
    """Return a chain of elements through nodes; the last of its three groups is updated."""
    elements = np.stack([np.arange(len(nodes) - 1), np.arange(1, len(nodes))], axis=1)
    parts = np.array_split(elements, 3)
    groups = [ElementGroup(str(g), part, SECTION, STEEL, (0.3, 1.0, 0.2)) for g, part in enumerate(parts)]
    return Frame(nodes, groups, supports).separable({"E": [("E", "2")]})


def lines(svg):
    return [
        (e.get("stroke"), [float(e.get(k)) for k in ("x1", "y1", "x2", "y2")])
        for e in ET.fromstring(svg).iter(f"{SVG}line")
    ]


def test_which_parameter_changes_which_element():
    changed = changed_elements(halves())
    assert_array_equal(changed[:25], np.tile([True, False, False], (25, 1)))
    assert_array_equal(changed[25:], np.tile([False, True, True], (25, 1)))


def test_torsion_of_an_element_with_a_clamped_end():
    """It causes no force under a translation; the beam at its free end is of another group."""
    nodes = np.array([[0.0, 0.0, 0.0], [0.2, 0.1, 1.5], [1.0, 0.0, 1.5]])
    groups = [
        ElementGroup(name, np.array([[k, k + 1]]), SECTION, STEEL, (0.3, 1.0, 0.2))
        for k, name in enumerate(("post", "arm"))
    ]
    targets = {"J post": [("J", "post")], "J arm": [("J", "arm")], "J": [("J", "post"), ("J", "arm")]}
    model = Frame(nodes, groups, {0: DIRECTIONS})
    alone = model.separable({name: targets[name] for name in ("J post", "J arm")})
    assert_array_equal(changed_elements(alone), np.eye(2, dtype=bool))
    assert changed_elements(model.separable({"J": targets["J"]})).all()


def test_elements_have_the_colour_of_their_first_parameter():
    model = halves()
    assert parameter_colours(sketch(model)) == [COLOURS[0], COLOURS[1], COLOURS[1]]
    drawn = [colour for colour, _ in lines(drawing(model))]
    assert drawn == [COLOURS[0]] * 25 + [COLOURS[1]] * 25


def test_what_no_parameter_changes_is_grey():
    model = frame(np.outer(np.arange(7.0), [1.0, 0.0, 0.0]), {0: DIRECTIONS})
    assert [colour for colour, _ in lines(drawing(model))] == [UNCHANGED] * 4 + [COLOURS[0]] * 2


@pytest.mark.parametrize(
    ("nodes", "rises"),
    [
        ([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]], False),
        ([[0, 0, 0], [0, 1, 0], [0, 2, 0], [0, 3, 0]], False),
        ([[0, 0, 0], [0, 0, 1], [0, 0, 2], [0, 0, 3]], True),  # a tower
        ([[0, 0, 0], [1, 1, 0], [2, 3, 0], [3, 3, 0]], True),  # seen from above
        ([[0, 0, 0], [0, 1, 1], [0, 3, 2], [0, 3, 3]], True),
        ([[0, 0, 0], [1, 0, 1], [2, 0, 3], [2, 0, 4]], True),
        ([[0, 0, 0], [1, 1, 1], [2, 0, 2], [2, 1, 4]], True),
    ],
)
def test_the_drawing_fits_its_frame_and_its_axes_point_the_usual_way(nodes, rises):
    root = ET.fromstring(svg := drawing(frame(np.array(nodes, float), {0: DIRECTIONS})))
    width, height = map(float, root.get("viewBox").split()[2:])
    points = np.array([xy for _, xy in lines(svg)]).reshape(-1, 2)
    assert np.all((points > 0) & (points < [width, height]))
    assert np.ptp(points, axis=0).max() > 200
    first, last = points[0], points[-1]
    assert (last[1] < first[1] - 20) == rises  # down the page is up in y of SVG
    assert last[0] >= first[0]


def test_supports_and_sensors_are_marked():
    model = halves()
    root = ET.fromstring(drawing(model, [(49, "z"), (20, "y"), (30, "rz")]))
    (held,) = root.iter(f"{SVG}rect")
    assert float(held.get("x")) + 7 == pytest.approx(lines(drawing(model))[0][1][0], abs=0.1)
    assert len(list(root.iter(f"{SVG}polygon"))) == 3  # an arrow upwards; one with two heads about the vertical
    assert [e.get("r") for e in root.iter(f"{SVG}circle")] == ["6", "4"]  # the mass; one that points away
    assert "51 nodes, 50 elements, 3 sensors" in root.get("aria-label")


def heads(direction):
    """Return the places of the arrowheads' tips in a view of x and z, with their node at the origin, y upwards."""
    root = ET.fromstring(drawing(halves(), [(20, direction)]))
    at = np.array([float(word) for word in lines(drawing(halves()))[20][1][:2]])
    points = [e.get("points").split()[0].split(",") for e in root.iter(f"{SVG}polygon")]
    return np.round((np.array(points, float) - at) * (1, -1)).tolist(), [
        e.get("d") for e in root.iter(f"{SVG}path")
    ]


@pytest.mark.parametrize(
    ("direction", "tips"),
    [
        ("z", [[0, 18]]),
        ("-x", [[-18, 0]]),
        ("rz", [[0, 24], [0, 18]]),
        ("-rx", [[-24, 0], [-18, 0]]),
        ("ry", [[-7, -9]]),  # y points away: clockwise from the left over the top, to the left at the bottom
        ("-ry", [[7, -9]]),
    ],
)
def test_rotations_have_two_heads_or_curved_arrows(direction, tips):
    found, arcs = heads(direction)
    assert found == tips
    assert len(arcs) == (direction in ("ry", "-ry"))
    assert not arcs or f" 0 1 {int(direction == 'ry')} " in arcs[0]  # 1: clockwise on the page


def test_no_drawing_without_a_geometry():
    model = halves()
    bare = SeparableModel(model.K_terms, model.M_terms, model.dofs)
    for draw in (drawing, changed_elements):
        with pytest.raises(ValueError, match="model: must have a geometry"):
            draw(bare)


def test_masses_springs_and_arms_are_drawn():
    nodes = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0], [2, 0, 1], [2, 0, 2]], float)
    groups = [ElementGroup("g", [(0, 1), (2, 3)], SECTION, STEEL)]
    springs = [
        JointSpring("foot", (0, None), {"z": 1e6}),
        JointSpring("knee", (1, 2), {"ry": 1e4}, tied=("x", "y", "z")),
        JointSpring("hanger", (3, 4), {"z": 1e4}),
    ]
    fixed = {4: ("x", "y", "rx", "ry", "rz")}
    model = Frame(
        nodes, groups, fixed, [PointMass(4, 1.0)], {"skin": RigidArm(3, (0.3, 0, 0))}, springs
    ).separable()
    bare = Frame(nodes[:4], groups, {}, springs=springs[1:2]).separable()
    drawn, less = (ET.fromstring(drawing(m, s)) for m, s in ((model, [("skin", "x")]), (bare, [])))

    def count(root, tag):
        return len(list(root.iter(f"{SVG}{tag}")))

    assert (count(drawn, "polyline"), count(less, "polyline")) == (2, 0)  # zigzags of foot and hanger
    assert (count(drawn, "circle"), count(less, "circle")) == (2, 1)  # the mass, and the ring of the knee
    assert count(drawn, "rect") == 0  # the tied node moves in all directions, though it owns but three
    (arm, *_) = lines(drawing(model))
    (arrow,) = (
        e for e in drawn.iter(f"{SVG}line") if e.get("stroke") == "currentColor" and e.get("stroke-width") == "1.5"
    )
    assert [float(arrow.get(k)) for k in ("x1", "y1")] == arm[1][2:]  # the sensor is at the end of its arm
    assert arm[1][2] > arm[1][0]


def test_springs_have_the_colour_of_their_parameter():
    nodes = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], float)
    groups = [ElementGroup("g", [(0, 1), (1, 2)], SECTION, STEEL)]
    springs = [JointSpring("left", (0, None), {"ry": 1e6}), JointSpring("right", (2, None), {"ry": 1e6})]
    held = {0: ("x", "y", "z", "rx", "rz"), 2: ("y", "z", "rx", "rz")}
    updates = {"E": [("E", "g")], "k": [("stiffness", "right")]}
    model = Frame(nodes, groups, held, springs=springs).separable(updates)
    found = sketch(model)
    springs_drawn = [e.get("stroke") for e in ET.fromstring(drawing(model)).iter(f"{SVG}polyline")]
    assert springs_drawn == ["currentColor", COLOURS[1]]
    assert parameter_colours(found) == [COLOURS[0], COLOURS[1]]
