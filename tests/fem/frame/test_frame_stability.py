"""Mechanisms: what can move without strain is found and named, what is only soft is not."""

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from fmu.fem.frame.components import DIRECTIONS, ElementGroup, JointSpring, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.frame.stability import free_motions, require_stable
from fmu.fem.modes import eigensolver
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.modal import frequency_hz
from fmu.fem.modes.separable import Geometry, SeparableModel
from fmu.fem.modes.terms import Term
from fmu.formats.models.exported import mesh_of

STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)
TUBE = Section.tube(0.1, 0.005)
LINE = [(float(x), 0, 0) for x in range(5)]
PORTAL = [(0, 0, 0), (0, 0, 1), (0, 0, 1), (1, 0, 1), (1, 0, 0)]
LEGS = [(0, 1), (2, 3), (3, 4)]
HINGE = JointSpring("hinge", (1, 2), {}, tied=("x", "y", "z"))


def frame(nodes, supports, springs=(), elements=None, section=TUBE):
    nodes = np.array(nodes, float)
    elements = elements or [(k, k + 1) for k in range(len(nodes) - 1)]
    return Frame(nodes, [ElementGroup("g", elements, section, STEEL)], supports, springs=springs).separable()


def complaint(model, **options):
    with pytest.raises(ValueError, match=r"^the structure is a mechanism: it can move without strain ") as caught:
        require_stable(model, [], **options)
    return str(caught.value).removeprefix("the structure is a mechanism: it can move without strain ")


RIGID = {
    "nothing holds it": (
        {},
        "in 6 ways (every point along x, y and z; the whole turning about x, y and z)",
    ),
    "a roller": ({0: ("y", "z", "rx", "ry", "rz")}, "in 1 way (every point along x)"),
    "no stop along x or z": ({0: ("y", "rx", "ry", "rz")}, "in 2 ways (every point along x and z)"),
    "a shaft in bearings": ({0: ("x", "y", "z"), 4: ("y", "z")}, "in 1 way (the whole turning about x)"),
    "a pin": ({0: ("x", "y", "z")}, "in 3 ways (the whole turning about x, y and z)"),
}


@pytest.mark.parametrize("name", RIGID)
def test_a_structure_that_moves_as_a_whole(name):
    supports, expected = RIGID[name]
    assert complaint(frame(LINE, supports)) == expected


def test_a_direction_that_is_no_axis_is_given_by_its_components():
    along = [(3.0 * k, 4.0 * k, 0) for k in range(4)]
    pins = {0: ("x", "y", "z"), 3: ("x", "y", "z")}
    assert complaint(frame(along, pins)) == "in 1 way (the whole turning about (0.6, 0.8, 0))"


def test_a_part_that_moves_is_named_by_what_moves_most():
    held = {0: DIRECTIONS, 4: ("x", "y", "z")}
    words = complaint(frame(PORTAL, held, [HINGE], LEGS), label=lambda node: f"n{node}")
    assert words.startswith("in 1 way (n")
    assert words.endswith(" move most)")
    assert "n0" not in words
    assert "n1 " not in words
    # the leg beyond the hinge turns about the line through both its ends
    motion = free_motions(frame(PORTAL, held, [HINGE], LEGS), [])
    assert motion.count == 1
    assert motion.rigid.shape == (6, 0)


def test_a_spinning_member_is_named_alone():
    """A strut between two hinges turns about itself."""
    nodes = [(0, 0, 0), (0, 0, 1), (0, 0, 1), (1, 0, 1), (1, 0, 1), (1, 0, 0)]
    hinges = [HINGE, JointSpring("other", (3, 4), {}, tied=("x", "y", "z"))]
    model = frame(nodes, {0: DIRECTIONS, 5: DIRECTIONS}, hinges, [(0, 1), (2, 3), (4, 5)])
    assert complaint(model) == "in 1 way (2 rx, 3 rx move most)"


def test_a_member_that_spins_is_not_the_whole_though_all_else_is_held():
    hinges = [HINGE, JointSpring("other", (3, 4), {}, tied=("x", "y", "z"))]
    nodes = [(0, 0, 0), (0, 0, 1), (0, 0, 1), (1, 0, 1), (1, 0, 1), (1, 0, 0)]
    held = dict.fromkeys((0, 1, 4, 5), DIRECTIONS)
    assert complaint(frame(nodes, held, hinges, [(0, 1), (2, 3), (4, 5)])) == "in 1 way (2 rx, 3 rx move most)"


@pytest.mark.parametrize("n", [1, 8, 60])
def test_a_slender_structure_is_none(n):
    """Sixty elements of 17 mm, a millimetre thick and inclined, are soft by 1e-9 of their axial stiffness."""
    nodes = np.linspace(0, 1, n + 1)[:, None] * [0.6, 0.5, 0.62]
    require_stable(frame(nodes, {0: DIRECTIONS}, section=Section.rectangle(0.001, 0.002)), [])


@pytest.mark.parametrize("stiffness", [1e-2, 1e2, 1e12])
def test_springs_hold(stiffness):
    clamp = JointSpring("clamp", (0, None), dict.fromkeys(DIRECTIONS, stiffness))
    require_stable(frame(LINE, {}, [clamp]), [])
    slipping = JointSpring("clamp", (0, None), dict.fromkeys(DIRECTIONS[1:], stiffness))
    assert complaint(frame(LINE, {}, [slipping])) == "in 1 way (every point along x)"


quaternions = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(quaternions, st.floats(0.1, 30.0), st.floats(-5, 5))
def test_a_free_structure_has_six_motions_wherever_it_is(quaternion, scale, offset):
    nodes = Rotation.from_quat(quaternion).apply(np.array(PORTAL)[[0, 1, 3, 4]] * scale) + offset
    model = frame(nodes, {})
    motions = free_motions(model, [])
    assert motions.count == motions.rigid.shape[1] == 6
    require_stable(model, [], free=True)


def test_a_free_structure_must_hold_together_all_the_same():
    words = complaint(frame(PORTAL, {}, [HINGE], LEGS), free=True)
    assert words.startswith("in 3 ways beside those of a free body (")
    require_stable(frame(LINE, {0: ("y", "z", "rx", "ry", "rz")}), [], free=True)  # on rails, on purpose


def test_large_and_small_blocks_agree(monkeypatch):
    shaft = [(x / 30, 0.1 * x / 30, 0) for x in range(31)]
    models = [frame(shaft, {0: ("x", "y", "z"), 30: ("y", "z")}), frame(shaft, {0: DIRECTIONS}), frame(shaft, {})]
    dense = [free_motions(model, []) for model in models]
    monkeypatch.setattr(eigensolver, "DENSE_LIMIT", 20)
    for model, known in zip(models, dense, strict=True):
        found = free_motions(model, [])
        assert (found.count, found.rigid.shape) == (known.count, known.rigid.shape)
        Q = np.linalg.qr(known.shapes)[0]
        assert_allclose(Q @ (Q.T @ found.shapes), found.shapes, atol=1e-5 * np.abs(found.shapes).max(initial=0))


def matrices(K, M, dofs=None):
    return SeparableModel([Term(sp.csr_array(K), (1.0,))], [Term(sp.csr_array(M), (0.0,))], dofs)


NAMES = [("floor 1", "x"), ("floor 2", "x"), ("floor 3", "x")]
CHAIN = np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
FREE_CHAIN = np.array([[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]])


def test_matrices_of_a_structure_that_holds():
    require_stable(matrices(CHAIN, np.eye(3), NAMES), [1e7])
    require_stable(matrices(FREE_CHAIN, np.eye(3), NAMES), [1e7], free=True)


WRONG = {
    "free": (
        FREE_CHAIN,
        np.eye(3),
        "the structure is a mechanism: it can move without strain in 1 way "
        "(floor 1 x, floor 2 x, floor 3 x move most)",
    ),
    "a loose floor": (
        np.diag([1.0, 0.0, 2.0]),
        np.eye(3),
        "the structure is a mechanism: it can move without strain in 1 way (floor 2 x moves most)",
    ),
    "negative": (
        np.diag([1.0, 2.0, -3.0]),
        np.eye(3),
        "the stiffness matrix must be positive semidefinite (it is not where floor 3 x moves most)",
    ),
    "no mass": (CHAIN, np.zeros((3, 3)), "the mass matrix must have entries (all of it is zero)"),
    "negative mass": (
        CHAIN,
        np.array([[1.0, 2.0, 0], [2.0, 1.0, 0], [0, 0, 1.0]]),
        "the mass matrix must be positive semidefinite (it is not where floor 1 x, floor 2 x move most)",
    ),
    "a loose part without mass": (
        np.diag([1.0, 0.0, 2.0]),
        np.diag([1.0, 0.0, 1.0]),
        "the structure is a mechanism: degrees of freedom with neither stiffness nor mass can move "
        "(floor 2 x moves most)",
    ),
}


def test_hourglass_motions_of_reduced_integration_are_named():
    K = np.diag([1.0, 0.0])
    for kind, n, ending in (("hexahedron20", 20, r"; .* \(C3D20R\).* use full .*"), ("hexahedron", 8, "")):
        mesh = mesh_of({k: [k, k % 3, k % 7] for k in range(n)}, [tuple(range(n))], [kind])
        model = SeparableModel.from_terms(["k"], [(K, "k")], [K], [(0, "x"), (1, "x")], Geometry.of_mesh(mesh))
        with pytest.raises(ValueError, match=rf"neither stiffness nor mass can move \(1 x moves most{ending}\)$"):
            require_stable(model, [1e7])


@pytest.mark.parametrize("name", WRONG)
def test_matrices_of_no_structure(name):
    K, M, expected = WRONG[name]
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        require_stable(matrices(K, M, NAMES), [1e7])
    assert str(caught.value) == expected


def test_more_than_six_motions_are_too_many_for_a_free_structure_of_unknown_shape():
    with pytest.raises(ValueError, match=r"^the structure is a mechanism: .* in 2 ways beside those of a free"):
        require_stable(matrices(np.zeros((8, 8)), np.eye(8)), [1.0], free=True)


def test_large_matrices_that_are_negative_somewhere():
    diagonal = np.ones(450)
    diagonal[7] = -0.5
    coupled = sp.diags_array([diagonal, np.full(449, 1e-3), np.full(449, 1e-3)], offsets=[0, 1, -1])
    model = matrices(coupled, sp.eye_array(450), [(f"p{k}", "x") for k in range(450)])
    with pytest.raises(ValueError, match=r"positive semidefinite \(it is not where p7 x moves most\)$"):
        require_stable(model, [1.0])


@pytest.mark.parametrize(("part", "theta"), [("stiffness", [np.inf]), ("stiffness", [np.nan])])
def test_matrices_that_are_not_finite(part, theta):
    with pytest.raises(ValueError, match=f"^the {part} matrix must be finite$"):
        require_stable(matrices(CHAIN, np.eye(3)), theta)


def test_a_clearly_negative_eigenvalue_is_no_frequency():
    one = (2 * np.pi) ** 2
    lam = np.array(
        [[-1e-7, 0.0, one], [-1e-3, one, 4 * one], [-one, one, 4 * one], [-2.0, -1.0, -3.0], [np.nan] * 3]
    )
    expected = [[0, 0, 1], [np.nan, 1, 2], [np.nan, 1, 2], [np.nan] * 3, [np.nan] * 3]
    assert_allclose(frequency_hz(lam), expected, rtol=1e-12)
    assert_array_equal(np.isnan(frequency_hz(lam)), np.isnan(expected))
    assert frequency_hz(np.array([])).shape == (0,)


def test_a_theta_that_makes_a_spring_negative_has_no_frequencies():
    model = matrices(np.diag([1.0, 2.0]), np.eye(2))
    lam = [FullBlock(model, block).eigenvalues(np.array([[4.0], [-4.0]]), 1)[:, 0] for block in model.blocks]
    f = frequency_hz(np.stack(lam, axis=1))
    assert np.all(np.isfinite(f[0]))
    assert np.all(np.isnan(f[1]))
