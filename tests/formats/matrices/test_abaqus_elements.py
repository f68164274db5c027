"""Matrices of elements that Abaqus writes: their sum is that of the structure, supports and constraints follow."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.config import read
from fmu.formats.matrices.limits import RefusedError
from fmu.formats.matrices.read import read_labelled

RNG = np.random.default_rng(4)
ELEMENTS = {11: (3, 1), 12: (1, 7), 13: (7, 3)}


def element(number, nodes, dofs, matrices, step=1):
    """Return the text of an element, four entries a line, each row of a lower triangle on lines of its own."""
    lines = ["**", f"** ELEMENT NUMBER {number} STEP NUMBER {step} INCREMENT NUMBER 1", "** ELEMENT TYPE B21"]
    lines += [
        f"*USER ELEMENT, NODES= {len(nodes)}, LINEAR",
        "** ELEMENT NODES",
        "** " + ", ".join(map(str, nodes)),
    ]
    lines += dofs
    for kind, matrix in matrices.items():
        lines.append(f"*MATRIX,TYPE={kind}")
        for i, row in enumerate(matrix.tolist()):
            words = [repr(x) for x in row[: i + 1]]
            lines += [" , ".join(words[k : k + 4]) for k in range(0, len(words), 4)]
    return "\n".join(lines) + "\n"


def spd(n):
    half = RNG.standard_normal((n, n))
    return half @ half.T


def structure(kinds=("STIFFNESS", "MASS"), elements=ELEMENTS):
    """Return the text of beams in a plane, the sums of their matrices, and the names of the rows of these."""
    order = [(node, d) for node in (1, 3, 7) for d in ("x", "y", "rz")]
    sums, text = {kind: np.zeros((9, 9)) for kind in kinds}, ""
    for number, nodes in elements.items():
        at = [order.index((node, d)) for node in nodes for d in ("x", "y", "rz")]
        own = {kind: spd(6) for kind in kinds}
        for kind, matrix in own.items():
            sums[kind][np.ix_(at, at)] += matrix
        text += element(number, nodes, ["1, 2, 6"], own)
    return text, sums, order


def test_sums_of_stiffness_and_mass(tmp_path):
    text, sums, order = structure()
    (tmp_path / "left.mtx").write_text(text)
    for kind, exact in sums.items():
        found = read_labelled(tmp_path / "left.mtx", kind.lower())
        assert list(found.dofs) == order
        assert_allclose(found.matrix.toarray(), exact, rtol=1e-13)
    model = fmu.read_model(tmp_path / "left.mtx")  # both, as it names them
    assert_allclose(model.mass.toarray(), sums["MASS"], rtol=1e-13)


@pytest.mark.parametrize("kind", ["STIFFNESS", "MASS"])
def test_the_only_kind_in_a_file_needs_no_name(tmp_path, kind):
    text, sums, _ = structure((kind,))
    (tmp_path / "a.mtx").write_text(text)
    assert_allclose(read_labelled(tmp_path / "a.mtx").matrix.toarray(), sums[kind], rtol=1e-13)


@pytest.mark.parametrize("kinds", [("STIFFNESS", "MASS"), ("MASS", "STIFFNESS")])
def test_two_kinds_in_a_file_need_a_name(tmp_path, kinds):
    (tmp_path / "a.mtx").write_text(structure(kinds)[0])
    with pytest.raises(ValueError, match="variable: must be given, one of stiffness, mass"):
        read_labelled(tmp_path / "a.mtx")


def test_directions_that_change_within_an_element_and_nodes_twice(tmp_path):
    """The second line of directions holds from the third node on."""
    K = spd(7)
    text = element(1, (4, 9, 5), ["1, 2, 6", "3, 3"], {"STIFFNESS": K})
    (tmp_path / "a.mtx").write_text(text)
    found = read_labelled(tmp_path / "a.mtx")
    names = [(4, "x"), (4, "y"), (4, "rz"), (9, "x"), (9, "y"), (9, "rz"), (5, "z")]
    order = [found.dofs.index(name) for name in names]
    assert_allclose(found.matrix.toarray()[np.ix_(order, order)], K, rtol=1e-14)
    (tmp_path / "a.mtx").write_text(element(1, (4, 4), ["1"], {"STIFFNESS": np.array([[2.0, 1.0], [1.0, 5.0]])}))
    assert_allclose(read_labelled(tmp_path / "a.mtx").matrix.toarray(), [[9.0]])


DECK = """\
*NODE, NSET=ALL
1, 0., 0., 0.
3, 1., 0., 0.
7, 1., 1., 0.
*ELEMENT, TYPE=B21, ELSET=LEFT
11, 3, 1
12, 1, 7
13, 7, 3
*NSET, NSET=FEET
1,
*EQUATION
2
7, 1, 1., 3, 1, -1.
*BOUNDARY
FEET, PINNED
"""
PROBLEM = """
name = "frame"
pairing = "index"
[model]
type = "matrices"
mesh = "frame.inp"
stiffness = [{ file = "left.mtx", variable = "stiffness", factor = 0.5, powers = { E1 = 1 } },
             { file = "right.mtx", variable = "stiffness", powers = { E2 = 1 } }]
mass = [{ file = "left.mtx", variable = "mass" }, { file = "right.mtx", variable = "mass" }]
[measurement]
frequencies = [0.1, 0.3]
sd = [0.01, 0.01]
[[parameters]]
name = "E1"
start = 2.0
lower = 1.0
upper = 4.0
[[parameters]]
name = "E2"
start = 1.0
lower = 0.5
upper = 2.0
"""


def test_a_property_group_per_file_with_supports_and_constraints(tmp_path):
    parts = {}
    for name, which in (("left", (11, 12)), ("right", (13,))):
        text, sums, order = structure(elements={number: ELEMENTS[number] for number in which})
        (tmp_path / f"{name}.mtx").write_text(text)
        parts[name] = sums
    (tmp_path / "frame.inp").write_text(DECK)
    (tmp_path / "frame.toml").write_text(PROBLEM)
    file = read(tmp_path / "frame.toml")
    model = file.model.build(tmp_path, file.parameters).model
    T = np.zeros((9, 6))
    for k, name in enumerate([(1, "rz"), (3, "x"), (3, "y"), (3, "rz"), (7, "y"), (7, "rz")]):
        T[order.index(name), k] = 1.0
    T[order.index((7, "x")), 1] = 1.0
    K = T.T @ (1.5 * 0.5 * parts["left"]["STIFFNESS"] + 0.7 * parts["right"]["STIFFNESS"]) @ T
    assert_allclose(model.K([1.5, 0.7]).toarray(), K, rtol=1e-12)
    assert_allclose(model.M([1.5, 0.7]).toarray(), T.T @ sum(p["MASS"] for p in parts.values()) @ T, rtol=1e-12)


@pytest.mark.parametrize(
    ("constraint", "name"),
    [
        ("*TIE, NAME=T\nB, A\n", r"\*TIE in line 14 not read"),
        ("*MPC\nPIN, 3, 7\n", r"\*MPC in line 14"),
        ("*SHELL TO SOLID COUPLING\nB, A\n", r"\*SHELLTOSOLIDCOUPLING in line 14"),
        ("*RELEASE\n12, S1, ALLM\n", r"\*RELEASE in line 14"),
        ("*PRE-TENSION SECTION, NODE=7, ELEMENT=11\n", r"\*PRE-TENSIONSECTION in line 14"),
        ("*FASTENER, INTERACTION NAME=F, PROPERTY=P\n", r"\*FASTENER in line 14"),
        ("*CONNECTOR SECTION, ELSET=C\nBEAM,\n", r"\*CONNECTORSECTION in line 14"),
        ("*CONNECTOR SECTION, ELSET=C\nCartesian, Constant Velocity\n", r"\*CONNECTORSECTION in line 14"),
        ("*CONNECTOR SECTION, ELSET=C\nBUSHING,\n*CONNECTOR MOTION\nC, 1\n", r"\*CONNECTORMOTION in line 16"),
        ("*RIGID BODY, REF NODE=7, NSET=FEET\n", r"\*RIGID BODY in line 14"),
        (
            "*SURFACE, NAME=S, TYPE=NODE\n3\n*COUPLING, REF NODE=7, SURFACE=S\n*KINEMATIC\n1, 3\n",
            r"\*COUPLING in line 16",
        ),
        ("*SURFACE, NAME=S, TYPE=NODE\n3\n*COUPLING, REF NODE=7, SURFACE=S\n*DISTRIBUTING\n1, 3\n", r"\*COUPLING"),
    ],
)
def test_constraints_that_are_not_read_are_refused(tmp_path, constraint, name):
    """Matrices of elements include no constraint: without one of the deck the frequencies would be others'."""
    (tmp_path / "frame.mtx").write_text(structure()[0])
    (tmp_path / "frame.inp").write_text(DECK.replace("*BOUNDARY\n", f"{constraint}*BOUNDARY\n"))
    with pytest.raises(ValueError, match=rf"^mesh: must have only constraints that fmu reads.*{name}"):
        fmu.read_model(tmp_path / "frame.mtx", mesh=tmp_path / "frame.inp")


@pytest.mark.parametrize("types", ["BUSHING,", "Projection Cartesian, CARDAN", ", ROTATION", "axial\n*NSET\n3"])
def test_connectors_without_constraints_are_not_refused(tmp_path, types):
    (tmp_path / "frame.mtx").write_text(structure()[0])
    section = f"*CONNECTOR SECTION, ELSET=C\n{types}\n"
    (tmp_path / "frame.inp").write_text(DECK.replace("*BOUNDARY\n", f"{section}*BOUNDARY\n"))
    model = fmu.read_model(tmp_path / "frame.mtx", mesh=tmp_path / "frame.inp")
    (tmp_path / "frame.inp").write_text(DECK)
    assert model.dofs == fmu.read_model(tmp_path / "frame.mtx", mesh=tmp_path / "frame.inp").dofs


GOOD = element(1, (4, 9), ["1, 2"], {"STIFFNESS": spd(4)})


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("** 4, 9", "** 4", r"must have the nodes that it names \(got 1 of 2\)"),
        ("NODES= 2", "NODES= two", r"whole numbers .*got 'TWO'"),
        ("NODES= 2", "NODES= 101", r"the nodes that it names"),
        ("NODES= 2, ", "", r"whole numbers .*got ''"),
        ("** 4, 9", "** 4, 0", r"whole numbers from 1 .*got '0'"),
        ("** 4, 9", "** 4, 99999999999", r"whole numbers from 1"),
        ("\n1, 2\n", "\n1, 8\n", r"degrees of freedom must be 1 to 6"),
        ("\n1, 2\n", "\n", r"degrees of freedom must be 1 to 6"),
        ("\n1, 2\n", "\n1, 2, 3\n", r"an element of 6 degrees of freedom must have 21 entries \(got 10\)"),
        ("TYPE=STIFFNESS", "TYPE=VISCOUS DAMPING", r"types STIFFNESS and MASS"),
        ("TYPE=STIFFNESS", "TYPE=MASS", r"must be one of mass"),
        ("LINEAR", "LINEAR, UNSYMM", r"symmetric matrices"),
        (GOOD, GOOD + GOOD, r"element 1 is there twice"),
        ("*MATRIX", "*MATRX", r"holds? (none|a matrix)|must hold a matrix"),
    ],
)
def test_broken_elements_are_refused(old, new, message, tmp_path):
    assert old in GOOD
    (tmp_path / "a.mtx").write_text(GOOD.replace(old, new, 1))
    with pytest.raises((ValueError, RefusedError), match=message):
        read_labelled(tmp_path / "a.mtx", "stiffness")


def test_an_entry_that_is_no_number_is_refused(tmp_path):
    (tmp_path / "a.mtx").write_text(GOOD.rstrip()[:-4] + "x\n")
    with pytest.raises(ValueError, match=r"a\.mtx: could not convert"):
        read_labelled(tmp_path / "a.mtx")


def test_global_matrices_have_no_names(tmp_path):
    (tmp_path / "K_STIF1.mtx").write_text("1,1, 1,1, 2.0\n")
    with pytest.raises(ValueError, match=r"variable: a \.mtx file has one matrix, without a name \(got 'K'\)"):
        read_labelled(tmp_path / "K_STIF1.mtx", "K")
