"""Constraints in decks of CalculiX: equations, rigid bodies and axes, and what is refused."""

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.formats.models.inp import nodes_of_face

DECK = """\
*NODE, NSET=ALL
1, 0., 0., 0.
2, 1., 0., 0.
3, 1., 1., 0.
4, 0., 1., 0.
5, 0.5, 0.5, 2.
6, 3., 3., 3.
*ELEMENT, TYPE=S4, ELSET=PLATE
7, 1, 2, 3, 4
*NSET, NSET=CORNERS, GENERATE
1, 4
"""
STORED = "*STEP\n*FREQUENCY, SOLVER=MATRIXSTORAGE\n4\n*END STEP\n"


def read(folder, text):
    (folder / "job.inp").write_text(DECK + text)
    return fmu.read_mesh(folder / "job.inp")


def equations(folder, text):
    return {one.dependent: dict(one.weights) for one in read(folder, text).equations}


def test_an_equation_over_several_lines(tmp_path):
    text = "*EQUATION\n5\n1,1,-2.,2,1,1.,3,2,.5,\n4,3,1.D0,\n2,1,1.\n** a comment\n1\n3,3,4.\n"
    assert equations(tmp_path, text) == {(1, "x"): {(2, "x"): 1.0, (3, "y"): 0.25, (4, "z"): 0.5}, (3, "z"): {}}


def test_a_node_set_of_an_element_set(tmp_path):
    text = "*NSET, NSET=BASE, ELSET=LATER\n6\n*BOUNDARY\nBASE, 1\n*ELSET, ELSET=LATER\nPLATE, 99\n"
    assert read(tmp_path, text).held == {(node, "x") for node in (1, 2, 3, 4, 6)}


def test_a_rigid_body_of_nodes_or_of_elements(tmp_path):
    by_nodes = equations(tmp_path, "*RIGID BODY, NSET=CORNERS, REF NODE=5, ROT NODE=6\n")
    assert by_nodes == equations(tmp_path, "*RIGID BODY, ELSET=PLATE, REF NODE=5, ROT NODE=6\n")
    # u = u_5 + u_6 × r with r = (0.5, 0.5, -2) for node 3
    assert by_nodes[3, "x"] == pytest.approx({(5, "x"): 1.0, (6, "ry"): -2.0, (6, "rz"): -0.5})
    assert by_nodes[3, "z"] == pytest.approx({(5, "z"): 1.0, (6, "rx"): 0.5, (6, "ry"): -0.5})


def test_a_node_for_the_rotation_turns_in_supports_and_equations_too(tmp_path):
    body = "*RIGID BODY, NSET=CORNERS, REF NODE=5, ROT NODE=6\n"
    mesh = read(tmp_path, f"*BOUNDARY\n6, 1, 2\n*EQUATION\n2\n6, 3, 1., 5, 1, 2.\n{body}")
    assert mesh.held == {(6, "rx"), (6, "ry")}
    assert mesh.equations[0].dependent == (6, "rz")
    assert mesh.equations[0].weights == {(5, "x"): -2.0}


def test_supports_and_equations_along_axes_of_a_node(tmp_path):
    text = "*TRANSFORM, NSET=CORNERS\n0., 1., 0., -1., 0., 0.\n*BOUNDARY\n1, 1, 2\n2, 3\n"
    text += "*EQUATION\n2\n3, 1, 1., 5, 1, 2.\n"
    mesh = read(tmp_path, text)
    found = {one.dependent: dict(one.weights) for one in mesh.equations}
    assert found == {(1, "y"): {}, (1, "x"): {}, (2, "z"): {}, (3, "y"): {(5, "x"): -2.0}}
    assert not mesh.held


FIRST = "*BOUNDARY\n1, 1\n"
NEW = "*BOUNDARY, OP=NEW\n2, 1\n"


@pytest.mark.parametrize(
    ("text", "nodes"),
    [
        (f"{FIRST}*STEP\n{NEW}*BOUNDARY\n3, 1\n", {2, 3}),
        (f"{FIRST}*STEP\n{NEW.replace('NEW', 'MOD')}", {1, 2}),
        (f"{FIRST}{NEW}", {1, 2}),  # in no step
        (f"{FIRST}*STEP\n*BOUNDARY\n3, 1\n{NEW}", {1, 2, 3}),  # not the first of its step
        (f"{FIRST}*STEP\n*BOUNDARY\n3, 1\n*END STEP\n*STEP\n{NEW}", {2}),
        (f"{FIRST}{STORED}*STEP\n{NEW}", {1}),  # the program ends with the matrices
    ],
)
def test_a_step_may_remove_earlier_supports(tmp_path, text, nodes):
    assert read(tmp_path, text).held == {(node, "x") for node in nodes}
    turned = read(tmp_path, f"*TRANSFORM, NSET=CORNERS\n0., 1., 0., -1., 0., 0.\n{text}")
    assert {one.dependent for one in turned.equations} == {(node, "y") for node in nodes}


def test_cylindrical_axes(tmp_path):
    text = "*TRANSFORM, NSET=CORNERS, TYPE=C\n0.5, 0.5, -9., 0.5, 0.5, 9.\n*BOUNDARY\n3, 1, 1\n"
    ((dependent, weights),) = equations(tmp_path, text).items()
    assert dependent == (3, "x")  # radial at 45°: x + y = 0
    assert_allclose([weights[3, "y"]], [-1.0], rtol=1e-14)


def test_what_is_not_read_is_told(tmp_path):
    text = "*MPC\nBEAM, 1, 2\n*RIGID BODY, NSET=CORNERS, REF NODE=5\n"
    text += "*COUPLING, REF NODE=5, SURFACE=S\n*DISTRIBUTING\n1,3\n"
    notes = " ".join(read(tmp_path, text).notes)
    assert "*MPC in line" in notes
    assert "no ROT NODE: no sensors can be" in notes
    assert "*COUPLING in line 15 with *DISTRIBUTING is not read." in notes
    assert "*KINEMATICCOUPLING in line 13 is not read." in " ".join(
        read(tmp_path, "*MPC\n*KINEMATIC COUPLING\n").notes
    )


@pytest.mark.parametrize(
    "text", ["*NSET, NSET=A\n*BOUNDARY\nA, 1, 3\n", "*NSET, NSET=A, ELSET=NONE\n*BOUNDARY\nA, PINNED\n"]
)
def test_supports_at_a_set_without_known_nodes_are_told(tmp_path, text):
    """As of elements of a type that is not read: matrices without the constraints are then refused."""
    mesh = read(tmp_path, text)
    assert any("is at the set 'A', of which no nodes are known" in note for note in mesh.notes)
    assert mesh.unread[0].startswith("*BOUNDARY in line")
    assert not mesh.held


CUBE = """\
*NODE
1, 0., 0., 0.
2, 1., 0., 0.
3, 1., 1., 0.
4, 0., 1., 0.
5, 0., 0., 1.
6, 1., 0., 1.
7, 1., 1., 1.
8, 0., 1., 1.
9, 3., 0., 0.
*ELEMENT, TYPE=C3D8, ELSET=CUBE
1, 1, 2, 3, 4, 5, 6, 7, 8
"""
COUPLING = "*SURFACE, NAME=S\nCUBE, S4\n*COUPLING, REF NODE=9, SURFACE=S, CONSTRAINT NAME=C\n*KINEMATIC\n1, 3\n"


def test_a_coupling_of_a_face(tmp_path):
    """The added node that rotates has the number 10; a rotation of the reference node is its displacement."""
    (tmp_path / "job.inp").write_text(f"{CUBE}{COUPLING}*BOUNDARY\n9, 5\n{STORED}")
    mesh = fmu.read_mesh(tmp_path / "job.inp")
    found = {one.dependent: dict(one.weights) for one in mesh.equations}
    assert {node for node, _ in found} == {2, 3, 6, 7, 9}
    # r = (-2, 1, 1) for node 7
    assert found[7, "x"] == pytest.approx({(9, "x"): 1.0, (10, "ry"): 1.0, (10, "rz"): -1.0})
    assert found[9, "rx"] == {(10, "rx"): 1.0}
    assert mesh.held == {(10, "ry")}
    assert mesh.turning == {10}


def test_a_coupling_without_known_numbers_is_told(tmp_path):
    (tmp_path / "job.inp").write_text(CUBE + COUPLING)
    mesh = fmu.read_mesh(tmp_path / "job.inp")
    assert not mesh.equations
    assert re.match(r"\*COUPLING in line \d+ is not read: no sensors can be at its nodes", mesh.notes[0])


OF_ABAQUS = {
    "a set as reference node": "*COUPLING, REF NODE=REF, SURFACE=S\n*KINEMATIC\n1, 3\n",
    "all directions": "*COUPLING, REF NODE=9, SURFACE=S\n*KINEMATIC\n",
    "rotations": "*COUPLING, REF NODE=9, SURFACE=S\n*KINEMATIC\n4, 6\n",
    "the edge of a shell": "*SURFACE, NAME=T\nPLATE, S4\n*COUPLING, REF NODE=9, SURFACE=T\n*KINEMATIC\n1, 3\n",
    "nodes tied": "*RIGID BODY, REF NODE=9, TIE NSET=REF\n",
    "nodes pinned to a set": "*RIGID BODY, REF NODE=REF, PIN NSET=REF\n",
    "a body of elements that are not read": "*RIGID BODY, REF NODE=REF, ELSET=STRANGE\n",
}


@pytest.mark.parametrize("kind", OF_ABAQUS)
def test_what_no_equations_are_needed_of_is_told_alone(tmp_path, kind):
    shell = "*ELEMENT, TYPE=S4, ELSET=PLATE\n2, 1, 2, 3, 4\n*ELEMENT, TYPE=RB3D2, ELSET=STRANGE\n3, 9, 8\n"
    sets = "*NSET, NSET=REF\n9\n*SURFACE, NAME=S, TYPE=NODE\nREF, 1.\n"
    (tmp_path / "job.inp").write_text(CUBE + shell + sets + OF_ABAQUS[kind])
    mesh = fmu.read_mesh(tmp_path / "job.inp")
    assert not mesh.equations
    assert mesh.notes[-1].endswith("except in decks of solids for CalculiX with SOLVER=MATRIXSTORAGE.")
    assert len(mesh.unread) == 1


def test_rigid_bodies_of_sets(tmp_path):
    """With a ROT NODE, its number is known; a set names the nodes of a body in three ways."""
    sets = "*NSET, NSET=REF\n5\n*NSET, NSET=TURN\n6\n*RIGID BODY, REF NODE=REF, ROT NODE=TURN, "
    found = equations(tmp_path, f"{sets}NSET=CORNERS\n")
    assert found == equations(tmp_path, "*RIGID BODY, NSET=CORNERS, REF NODE=5, ROT NODE=6\n")
    assert found == equations(tmp_path, f"{sets}TIE NSET=CORNERS\n")
    assert found == equations(tmp_path, f"{sets}PIN NSET=CORNERS, ELSET=PLATE\n")


@pytest.mark.parametrize(
    ("name", "kind", "nodes", "found"),
    [
        ("S6", "hexahedron", range(1, 9), {4, 8, 5, 1}),
        ("S2", "hexahedron20", range(1, 21), {5, 8, 7, 6, 13, 14, 15, 16}),
        ("S4", "hexahedron20", range(1, 21), {2, 6, 7, 3, 10, 14, 18, 19}),
        ("S3", "tetra10", range(1, 11), {2, 4, 3, 9, 10, 6}),
        ("S5", "wedge15", range(1, 16), {3, 1, 4, 6, 9, 13, 12, 15}),
        ("S6", "wedge", range(1, 7), set()),
        ("SPOS", "hexahedron", range(1, 9), set()),
        ("S1", "quad", range(1, 5), set()),
    ],
)
def test_nodes_of_faces(name, kind, nodes, found):
    """As in CalculiX's manual, of *DLOAD."""
    assert set(nodes_of_face(kind, list(nodes), name)) == found


COUPLED = "*COUPLING, REF NODE=5, SURFACE=S\n*KINEMATIC\n1,3\n"
ON_NODE = f"*SURFACE, NAME=S, TYPE=NODE\n1\n{COUPLED}".removesuffix("1,3\n")
REFUSED = {
    "no factor": ("*EQUATION\n2\n1,1,0.,2,1,1.\n", r"the factor of node 1 x is zero"),
    "terms cut short": ("*EQUATION\n3\n1,1,1.,2,1,1.\n", r"must have 3 terms .*\(got 6 words\)"),
    "no number of terms": ("*EQUATION\nmany\n", r"the number of terms must be a whole number"),
    "absurd number": ("*EQUATION\n99999999999999\n", r"the number of terms must be a whole number"),
    "unknown node": ("*EQUATION\n2\n1,1,1.,99,1,1.\n", r"no node 99"),
    "direction": ("*EQUATION\n2\n1,7,1.,2,1,1.\n", r"a direction must be 1 to 6"),
    "factor": ("*EQUATION\n2\n1,1,one,2,1,1.\n", r"a factor must be a number"),
    "infinite": ("*EQUATION\n2\n1,1,1e999,2,1,1.\n", r"a factor must be finite"),
    "set": ("*EQUATION\n2\nCORNERS,1,1.,2,1,1.\n", r"must name one node"),
    "unknown set": ("*EQUATION\n2\nNOWHERE,1,1.,2,1,1.\n", r"a node or a node set \(got 'NOWHERE'"),
    "no reference": ("*RIGID BODY, NSET=CORNERS, ROT NODE=6\n", r"REF NODE must name a node"),
    "set as reference": (
        "*RIGID BODY, NSET=CORNERS, REF NODE=CORNERS, ROT NODE=6\n", r"one node .*'CORNERS' has 4",
    ),
    "no body": ("*RIGID BODY, REF NODE=5, ROT NODE=6\n", r"its body has none"),
    "unknown body": ("*RIGID BODY, NSET=NONE, REF NODE=5, ROT NODE=6\n", r"a node or a node set"),
    "axes on a line": ("*TRANSFORM, NSET=CORNERS\n1.,0.,0.,2.,0.,0.\n", r"axes of three directions"),
    "half the axes": ("*TRANSFORM, NSET=CORNERS\n1.,0.,0.\n", r"six coordinates \(got 3\)"),
    "node on the axis": (
        "*TRANSFORM, NSET=CORNERS, TYPE=C\n0.,0.,0.,0.,0.,1.\n", r"axes of three directions .*at node 1",
    ),
    "set without an end": ("*NSET, NSET=A, GENERATE\n7\n", r"GENERATE needs a first and a last number \(got 7\)"),
    "endless set": ("*NSET, NSET=A, GENERATE\n1, 9999999999, 1\n", r"at most \d+ members"),
    "support three times": (
        "*TRANSFORM, NSET=CORNERS\n0.,1.,0.,-1.,0.,0.\n*EQUATION\n1\n1,1,1.\n2\n1,1,1.,2,1,1.\n",
        r"determine their dependents .*node 1",
    ),
}  # fmt: skip


REFUSED_COUPLINGS = {
    "no surface": (COUPLED, r"must name a surface \(got 'S'"),
    "unknown set of a surface": (
        f"*SURFACE, NAME=S\nNONE, S1\n{COUPLED}", r"an element set \(got 'NONE'",
    ),
    "face of no solid": (
        f"*SURFACE, NAME=S\nCUBE, SPOS\n{COUPLED}", r"faces of solids .*no 'SPOS'",
    ),
    "surface without faces": (
        f"*SURFACE, NAME=S\nCUBE\n{COUPLED}", r"a face in each line",
    ),
    "node of no surface": (
        f"*SURFACE, NAME=S, TYPE=NODE\n77\n{COUPLED}", r"no node 77",
    ),
    "empty surface": (
        f"*SURFACE, NAME=S, TYPE=NODE\n{COUPLED}", r"its body has none",
    ),
    "no reference of a coupling": (
        "*SURFACE, NAME=S, TYPE=NODE\n1\n*COUPLING, SURFACE=S\n*KINEMATIC\n1,3\n", r"REF NODE must name a node",
    ),
    "directions from last to first": (
        f"{ON_NODE}3,1\n", r"directions must be 1 to 6",
    ),
    "rotations alone": (
        f"{ON_NODE}4,6\n", r"directions 1 to 3",
    ),
    "no directions": (
        ON_NODE, r"directions 1 to 3",
    ),
    "no number of a direction": (
        f"{ON_NODE}X\n", r"a direction must be a whole",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED_COUPLINGS)
def test_broken_couplings_are_refused_where_equations_are_needed(tmp_path, kind):
    text, message = REFUSED_COUPLINGS[kind]
    (tmp_path / "job.inp").write_text(f"{CUBE}{text}{STORED}")
    with pytest.raises(ValueError, match=message):
        fmu.read_mesh(tmp_path / "job.inp")


@pytest.mark.parametrize("kind", REFUSED)
def test_broken_constraints_are_refused(tmp_path, kind):
    text, message = REFUSED[kind]
    with pytest.raises(ValueError, match=message):
        read(tmp_path, text)


def test_a_set_that_is_repeated_in_sets_is_bounded(tmp_path):
    """Each set has the one before ten times, 10^9 members in all, but each member once."""
    text = "*NSET, NSET=S0\n1, 2\n" + "".join(
        f"*NSET, NSET=S{k}\n" + f"S{k - 1}," * 10 + "\n" for k in range(1, 10)
    )
    found = equations(tmp_path, f"{text}*RIGID BODY, NSET=S9, REF NODE=5, ROT NODE=6\n")
    assert len(found) == 2 * 3


def test_many_equations_are_read_in_linear_time(tmp_path):
    n = 20_000
    nodes = "".join(f"{100 + k},{k}.,0.,0.\n" for k in range(n))
    mesh = read(tmp_path, f"*NODE\n{nodes}*EQUATION\n" + "".join(f"2\n{100 + k},2,1.,1,2,-1.\n" for k in range(n)))
    assert len(mesh.equations) == n
    assert np.all([one.weights == {(1, "y"): 1.0} for one in mesh.equations])
