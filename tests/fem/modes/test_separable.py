"""Coefficients and their derivatives, the split into blocks, and wrong terms."""

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from fmu.fem.modes.separable import Geometry, SeparableModel
from fmu.fem.modes.static import MassMoments, uniform_motion
from fmu.fem.modes.terms import ParametricMatrix, Term, coefficient_gradients, coefficients, monomial

EYE = sp.csr_array(sp.eye_array(2))
POWERS = [
    (0.0, 0.0, 0.0),
    (1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0),
    (3.0, 0.0, 0.0),
    (2.0, 1.0, 0.0),
    (1.0, 1.0, -1.0),
    (1.0, 0.5, -0.5),
    (0.0, -2.0, 0.0),
    (0.5, 0.0, 9.0),
]


def test_monomials_and_their_gradients():
    theta = np.random.default_rng(0).uniform(0.5, 2.0, size=(7, 3))
    terms = [Term(EYE, p) for p in POWERS]
    value = coefficients(terms, theta)
    assert_allclose(value, np.prod(theta[:, None] ** np.array(POWERS), axis=2), rtol=1e-14)
    expected = value[..., None] * np.array(POWERS) / theta[:, None]
    assert_allclose(coefficient_gradients(terms, theta), expected, rtol=1e-13)


@pytest.mark.parametrize("powers", [POWERS, POWERS[1:3], POWERS[:3], POWERS[:1], POWERS[5:7]], ids=len)
def test_coefficient_map_agrees_with_the_plain_formulas(powers):
    rng = np.random.default_rng(1)
    theta = rng.uniform(0.5, 2.0, size=(6, 3))
    terms = [Term(EYE, p) for p in powers]
    forms = rng.standard_normal((6, len(terms), 4))
    mapping = ParametricMatrix(terms)
    assert_allclose(mapping.coefficients(theta), coefficients(terms, theta), rtol=1e-15)
    expected = np.einsum("nkm,nkj->nmj", forms, coefficient_gradients(terms, theta))
    assert_allclose(mapping.contract(theta, forms), expected, rtol=1e-13, atol=1e-14)


def test_coefficient_map_without_parameters():
    mapping = ParametricMatrix([Term(EYE, ()), Term(EYE, ())])
    assert_array_equal(mapping.coefficients(np.empty((3, 0))), np.ones((3, 2)))
    assert mapping.contract(np.empty((3, 0)), np.ones((3, 2, 5))).shape == (3, 5, 0)


@pytest.mark.parametrize("powers", POWERS)
def test_a_batch_changes_no_bit(powers):
    theta = np.random.default_rng(2).uniform(0.5, 2.0, size=(37, 3)) * [1e11, 1e-9, 1e-4]
    batch = monomial(theta, powers)
    assert_array_equal(batch, [monomial(row[None], powers)[0] for row in theta])
    mapping = ParametricMatrix([Term(EYE, powers)])
    assert_array_equal(mapping.coefficients(theta), [mapping.coefficients(row[None])[0] for row in theta])


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=3, max_size=3), st.sampled_from(POWERS))
def test_no_finite_theta_is_an_exception(theta, powers):
    point = np.array([theta])
    assert monomial(point, powers).shape == (1,)
    assert coefficient_gradients([Term(EYE, powers)], point).shape == (1, 1, 3)


def test_powers_that_do_not_exist_are_not_finite():
    points = np.array([[0.0], [-1.0], [1e200]])
    assert_array_equal(np.isfinite(monomial(points, (-1.0,))), [False, True, True])
    assert_array_equal(np.isfinite(monomial(points, (0.5,))), [True, False, True])
    assert_array_equal(np.isfinite(monomial(points, (2.0,))), [True, True, False])
    assert_array_equal(monomial(np.array([[-2.0]]), (-3.0,)), [-0.125])


def matrix(rows):
    return sp.csr_array(np.array(rows, dtype=float))


def test_powers_that_overflow_keep_their_sign():
    values = [monomial(np.array([[-1e200]]), (power,))[0] for power in (3.0, 9.0, 10.0)]
    assert_array_equal(values, [-np.inf, -np.inf, np.inf])


def test_matrices_at_theta():
    K1, K2, M = matrix([[2, 1], [1, 3]]), matrix([[1, 0], [0, 0]]), matrix([[4, 0], [0, 5]])
    model = SeparableModel([Term(K1, (1, 0)), Term(K2, (2, 1))], [Term(M, (0, 3))])
    assert_allclose(model.K([2.0, 5.0]).toarray(), [[24.0, 2.0], [2.0, 6.0]])
    assert_allclose(model.M([2.0, 5.0]).toarray(), [[500.0, 0.0], [0.0, 625.0]])
    assert (model.n_dof, model.n_parameters) == (2, 2)
    assert model.dofs == ((0, "x"), (1, "x"))
    assert_array_equal(model.translations, [0, 1])


def test_terms_that_cancel_at_one_theta_still_couple():
    """The graph is that of all terms: K₁ and −K₁ would cancel at θ = (1, 1), not elsewhere."""
    coupling = matrix([[1, 0.5, 0], [0.5, 1, 0], [0, 0, 1]])
    model = SeparableModel(
        [Term(coupling, (1, 0)), Term(-0.5 * coupling, (0, 1))], [Term(matrix(np.eye(3)), (0, 0))]
    )
    assert [list(b) for b in model.blocks] == [[0, 1], [2]]


def test_mass_couples_too_and_rounding_does_not():
    M = matrix([[1, 0, 1e-3], [0, 1, 0], [1e-3, 0, 1]])
    K = matrix([[1e9, 1e-5, 0], [1e-5, 1e9, 0], [0, 0, 1e9]])
    model = SeparableModel([Term(K, ())], [Term(M, ())])
    assert [list(b) for b in model.blocks] == [[0, 2], [1]]


def test_coupling_without_a_diagonal_counts():
    K = matrix([[0, 1], [1, 0]])
    model = SeparableModel([Term(K, ()), Term(matrix(np.eye(2)), ())], [Term(matrix(np.eye(2)), ())])
    assert [list(b) for b in model.blocks] == [[0, 1]]


GOOD = Term(matrix(np.eye(2)), (1.0,))
WRONG = {
    "no stiffness": (
        [],
        [GOOD],
        None,
        r"K_terms, M_terms: must have at least one stiffness and one mass term \(got . and .\)",
    ),
    "no mass": (
        [GOOD],
        [],
        None,
        r"K_terms, M_terms: must have at least one stiffness and one mass term \(got . and .\)",
    ),
    "names": ([GOOD], [GOOD], [(0, "x")], r"dofs: must name 2 degrees of freedom \(got 1\)"),
    "shape": (
        [GOOD, Term(matrix(np.eye(3)), (1.0,))],
        [GOOD],
        None,
        r"K_terms\.1: must have shape \(2, 2\) \(got \(3, 3\)\)",
    ),
    "powers": ([GOOD], [Term(matrix(np.eye(2)), ())], None, r"M_terms\.0: must have 1 powers \(got 0\)"),
    "symmetry": (
        [Term(matrix([[1, 0.5], [0, 1]]), (1.0,))],
        [GOOD],
        None,
        r"K_terms\.0: must be symmetric and finite \(asymmetry 0\.5\)",
    ),
    "NaN": (
        [GOOD],
        [GOOD, Term(matrix([[1, 0], [0, np.nan]]), (1.0,))],
        None,
        r"M_terms\.1: must be symmetric and finite \(asymmetry nan\)",
    ),
    "infinite": (
        [Term(matrix([[np.inf, 0], [0, 1]]), (1.0,))],
        [GOOD],
        None,
        r"K_terms\.0: must be symmetric and finite \(asymmetry nan\)",
    ),
}


def test_a_power_is_finite():
    with pytest.raises(ValueError, match=r"^powers\.0: must be a finite number \(got nan\)$"):
        Term(matrix(np.eye(2)), (np.nan,))


@pytest.mark.parametrize("case", list(WRONG))
def test_wrong_terms(case):
    K_terms, M_terms, dofs, message = WRONG[case]
    with pytest.raises(ValueError, match=f"^{message}$"):
        SeparableModel(K_terms, M_terms, dofs)


def test_sensor_off_the_model():
    model = SeparableModel([GOOD], [GOOD], [(7, "x"), (7, "rz")])
    assert model.dof(7, "rz") == 1
    with pytest.raises(ValueError, match=r"^sensor: the model has no free degree of freedom \(got node 7, 'y'\)$"):
        model.dof(7, "y")


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"dofs": [(1, "x"), (1, "x")]}, r"dofs: must be distinct \(got \(1, 'x'\) more than once\)"),
        ({"ties": {(5, "x"): (9, "x")}}, r"ties: must be of names in dofs \(got \(9, 'x'\) for \(5, 'x'\)\)"),
        (
            {"motions": {(5, "x"): {(0, "x"): 0.5, (9, "x"): 0.5}}},
            r"motions: must be of names in dofs \(got \(9, 'x'\) for \(5, 'x'\)\)",
        ),
    ],
)
def test_names_that_are_twice_or_unknown(names, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        SeparableModel([GOOD], [GOOD], **names)


def test_a_motion_may_be_of_a_tied_degree_of_freedom():
    model = SeparableModel([GOOD], [GOOD], ties={(5, "x"): (1, "x")}, motions={(6, "x"): {(5, "x"): 2.0}})
    assert_array_equal(model.observation([(6, "x")]).toarray(), [[0.0, 2.0]])


@pytest.mark.parametrize("lines", [{"elements": [[0, 2]]}, {"masses": [-1]}, {"springs": [(0, None), (1, 2)]}])
def test_lines_between_nodes_that_do_not_exist(lines):
    nodes = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    with pytest.raises(ValueError, match=r"^\w+: must be at rows of nodes, 0 to 1 \(got (2|-1)\)$"):
        Geometry(nodes, **{"elements": [[0, 1]]} | lines)


@pytest.mark.parametrize("ids", [None, [1, 2]])
def test_a_node_that_is_free_along_a_skew_axis_moves_by_the_part_along_it(ids):
    """Two nodes of 2 kg, of which the second slides along (0.6, 0.8, 0), and a third that follows the first."""
    nodes = [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]
    geometry = Geometry(nodes, [[0, 1]], ids=ids) if ids else None
    skew = {(2, "x"): {(2, "x"): 0.6}, (2, "y"): {(2, "x"): 0.8}}
    follower = {(3, "x"): {(1, "x"): 1.0, (2, "x"): 0.5}}
    model = SeparableModel(
        [Term(np.eye(3), (0.0,))], [Term(2.0 * np.eye(3), (0.0,))], [(1, "x"), (1, "y"), (2, "x")],
        geometry, motions=follower | skew,
    )  # fmt: skip
    expected = [[1.0, 0.0, 0.6], [0.0, 1.0, 0.8], [0.0, 0.0, 0.0]]
    assert_array_equal([uniform_motion(model, d) for d in ("x", "y", "z")], expected)
    moments = MassMoments(model, np.ones(1), with_centre=False)
    assert moments.direction == "y"
    assert_allclose(moments(np.ones((1, 1)))[0], [[2.0 + 2.0 * 0.8**2]], rtol=1e-14)


def test_a_rotation_that_a_node_follows_carries_no_mass():
    """Node 2 of the mesh is on a rigid body of 3 kg at node 1, which turns with node 7, no node of the mesh."""
    geometry = Geometry([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]], [[0, 1]], ids=[1, 2])
    motions = {(2, "y"): {(1, "y"): 1.0, (7, "rz"): 2.0}, (1, "rz"): {(7, "rz"): 1.0}}
    model = SeparableModel(
        [Term(np.eye(2), (0.0,))], [Term(np.diag([3.0, 40.0]), (0.0,))], [(1, "y"), (7, "rz")],
        geometry, motions=motions,
    )  # fmt: skip
    assert_array_equal([uniform_motion(model, d) for d in ("x", "y", "rz")], [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    assert_array_equal(
        MassMoments(model, np.ones(1), with_centre=True)(np.ones((1, 1)))[0], [[3.0, 0.0, 0.0, 0.0]]
    )


def test_a_dense_matrix_is_a_term_too():
    rows = [[2, -1], [-1, 2]]
    for given_as in (rows, np.array(rows), sp.coo_array(np.array(rows, dtype=np.float32))):
        term = Term(given_as, [1, 0])
        assert isinstance(term.matrix, sp.csr_array)
        assert term.matrix.dtype == np.float64
        assert_array_equal(term.matrix.toarray(), rows)
        assert term.powers == (1, 0)


@pytest.mark.parametrize("wrong", [[1.0, 2.0], [[1j, 0.0], [0.0, 1.0]], [["a"]]])
def test_a_term_that_is_no_real_matrix(wrong):
    with pytest.raises(ValueError, match=r"matrix: must be a real matrix \(got "):
        Term(wrong, (0,))


def test_terms_by_the_names_of_the_parameters():
    K0, K1, K2, M = ([[a, -1.0], [-1.0, a]] for a in (2.0, 3.0, 4.0, 5.0))
    model = SeparableModel.from_terms(["k1", "t"], stiffness=[K0, (K1, "k1"), (K2, {"t": 3, "k1": 1})], mass=[M])
    assert model.names == ("k1", "t")
    theta = np.array([1.5, 0.5])
    expected = np.array(K0) + 1.5 * np.array(K1) + 1.5 * 0.5**3 * np.array(K2)
    assert_allclose(model.K(theta).toarray(), expected, rtol=1e-15)
    assert_array_equal(model.M(theta).toarray(), M)


def test_terms_by_names_that_are_wrong():
    M = np.eye(2)
    with pytest.raises(ValueError, match=r"^stiffness.1: must name parameters among k1 \(got k2\)$"):
        SeparableModel.from_terms(["k1"], [(M, "k1"), (M, {"k2": 1})], [M])
    with pytest.raises(ValueError, match=r"^mass.0.matrix: must be a real matrix"):
        SeparableModel.from_terms(["k1"], [(M, "k1")], [[1.0, 2.0]])
