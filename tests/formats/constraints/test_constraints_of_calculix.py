"""Constraints in decks of CalculiX: equations, rigid bodies and axes, and what is refused."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu

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


def read(folder, text):
    (folder / "job.inp").write_text(DECK + text)
    return fmu.read_mesh(folder / "job.inp")


def equations(folder, text):
    return {one.dependent: dict(one.weights) for one in read(folder, text).equations}


def test_an_equation_over_several_lines(tmp_path):
    text = "*EQUATION\n5\n1,1,-2.,2,1,1.,3,2,.5,\n4,3,1.D0,\n2,1,1.\n** a comment\n1\n3,3,4.\n"
    assert equations(tmp_path, text) == {(1, "x"): {(2, "x"): 1.0, (3, "y"): 0.25, (4, "z"): 0.5}, (3, "z"): {}}


def test_a_rigid_body_of_nodes_or_of_elements(tmp_path):
    by_nodes = equations(tmp_path, "*RIGID BODY, NSET=CORNERS, REF NODE=5, ROT NODE=6\n")
    assert by_nodes == equations(tmp_path, "*RIGID BODY, ELSET=PLATE, REF NODE=5, ROT NODE=6\n")
    # u = u_5 + u_6 × r with r = (0.5, 0.5, -2) for node 3
    assert by_nodes[3, "x"] == pytest.approx({(5, "x"): 1.0, (6, "y"): -2.0, (6, "z"): -0.5})
    assert by_nodes[3, "z"] == pytest.approx({(5, "z"): 1.0, (6, "x"): 0.5, (6, "y"): -0.5})


def test_supports_and_equations_along_axes_of_a_node(tmp_path):
    text = "*TRANSFORM, NSET=CORNERS\n0., 1., 0., -1., 0., 0.\n*BOUNDARY\n1, 1, 2\n2, 3\n"
    text += "*EQUATION\n2\n3, 1, 1., 5, 1, 2.\n"
    mesh = read(tmp_path, text)
    found = {one.dependent: dict(one.weights) for one in mesh.equations}
    assert found == {(1, "y"): {}, (1, "x"): {}, (2, "z"): {}, (3, "y"): {(5, "x"): -2.0}}
    assert not mesh.held


def test_cylindrical_axes(tmp_path):
    text = "*TRANSFORM, NSET=CORNERS, TYPE=C\n0.5, 0.5, -9., 0.5, 0.5, 9.\n*BOUNDARY\n3, 1, 1\n"
    ((dependent, weights),) = equations(tmp_path, text).items()
    assert dependent == (3, "x")  # radial at 45°: x + y = 0
    assert_allclose([weights[3, "y"]], [-1.0], rtol=1e-14)


def test_what_is_not_read_is_told(tmp_path):
    text = "*MPC\nBEAM, 1, 2\n*RIGID BODY, NSET=CORNERS, REF NODE=5\n*COUPLING, REF NODE=5, SURFACE=S\n"
    notes = " ".join(read(tmp_path, text).notes)
    assert "*MPC in line" in notes
    assert "no ROT NODE: no sensors can be" in notes
    assert "*COUPLING in line" in notes


REFUSED = {
    "no factor": ("*EQUATION\n2\n1,1,0.,2,1,1.\n", r"the factor of node 1 x is zero"),
    "terms cut short": ("*EQUATION\n3\n1,1,1.,2,1,1.\n", r"must have 3 terms .*\(got 6 words\)"),
    "no number of terms": ("*EQUATION\nmany\n", r"the number of terms must be a whole number"),
    "absurd number": ("*EQUATION\n99999999999999\n", r"the number of terms must be a whole number"),
    "unknown node": ("*EQUATION\n2\n1,1,1.,99,1,1.\n", r"no node 99"),
    "direction": ("*EQUATION\n2\n1,7,1.,2,1,1.\n", r"a direction must be 1 to 6"),
    "factor": ("*EQUATION\n2\n1,1,one,2,1,1.\n", r"a factor must be a number"),
    "infinite": ("*EQUATION\n2\n1,1,1e999,2,1,1.\n", r"a factor must be finite"),
    "set": ("*EQUATION\n2\nCORNERS,1,1.,2,1,1.\n", r"one node per term"),
    "unknown set": ("*EQUATION\n2\nNOWHERE,1,1.,2,1,1.\n", r"a node or a node set \(got 'NOWHERE'"),
    "no reference": ("*RIGID BODY, NSET=CORNERS, ROT NODE=6\n", r"REF NODE must be a whole number"),
    "no body": ("*RIGID BODY, REF NODE=5, ROT NODE=6\n", r"its body has none"),
    "unknown body": ("*RIGID BODY, NSET=NONE, REF NODE=5, ROT NODE=6\n", r"a node or a node set"),
    "axes on a line": ("*TRANSFORM, NSET=CORNERS\n1.,0.,0.,2.,0.,0.\n", r"axes of three directions"),
    "half the axes": ("*TRANSFORM, NSET=CORNERS\n1.,0.,0.\n", r"six coordinates \(got 3\)"),
    "node on the axis": (
        "*TRANSFORM, NSET=CORNERS, TYPE=C\n0.,0.,0.,0.,0.,1.\n", r"axes of three directions .*at node 1",
    ),
    "endless set": ("*NSET, NSET=A, GENERATE\n1, 9999999999, 1\n", r"at most \d+ members"),
    "support three times": (
        "*TRANSFORM, NSET=CORNERS\n0.,1.,0.,-1.,0.,0.\n*EQUATION\n1\n1,1,1.\n2\n1,1,1.,2,1,1.\n",
        r"determine their dependents .*node 1",
    ),
}  # fmt: skip


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
