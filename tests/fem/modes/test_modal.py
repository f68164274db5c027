"""The eigensolver, MAC and eigenvalue derivatives."""

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes import eigensolver
from fmu.fem.modes.eigensolver import DENSE_LIMIT, SingularMassError, eigen
from fmu.fem.modes.full_block import FullBlock, full_blocks
from fmu.fem.modes.modal import (
    fix_sign,
    frequency_gradient,
    frequency_hz,
    join_shapes,
    mac,
    solve_spectrum,
)
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import ParametricMatrix, Term, weighted_sum
from tests.gradients import differences

STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)


def grid_frame(supports):
    """Return a spatial frame of three legs with 74 nodes, 444 degrees of freedom when free."""
    leg = np.linspace(0.0, 1.0, 25)[1:]
    ends = np.array([[1.0, 0.2, 0.1], [-0.3, 0.9, 0.2], [0.2, -0.4, 1.1]])
    nodes = np.concatenate([[[0.0, 0.0, 0.0]], *(np.outer(leg, end) for end in ends), [[1.5, 0.3, 0.6]]])
    elements = [(0 if i == 0 else 24 * k + i, 24 * k + i + 1) for k in range(3) for i in range(24)] + [(24, 73)]
    section = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6)
    return Frame(nodes, [ElementGroup("g", elements, section, STEEL, (0.3, 0.5, -0.7))], supports).separable()


@pytest.mark.parametrize("supports", [{}, {0: DIRECTIONS, 48: ("x", "y", "z")}], ids=["free", "supported"])
def test_sparse_and_dense_solvers_agree(monkeypatch, supports):
    model = grid_frame(supports)
    assert model.n_dof > DENSE_LIMIT
    K, M = model.K([]), model.M([])
    rigid = 0 if supports else 6
    sparse, sparse_shapes = eigen(K, M, 16)
    monkeypatch.setattr(eigensolver, "DENSE_LIMIT", 10**6)
    dense, dense_shapes = eigen(K, M, 16)
    highest = np.max(K.diagonal() / M.diagonal())  # a Rayleigh quotient: the true maximum lies above
    assert np.all(np.abs(sparse[:rigid]) < 1e-10 * highest)
    assert np.all(np.abs(dense[:rigid]) < 1e-10 * highest)
    assert np.all(np.isfinite(frequency_hz(sparse)))
    assert_allclose(sparse[rigid:], dense[rigid:], rtol=1e-6)
    assert np.all(np.diff(sparse) >= 0.0)
    for shapes in (sparse_shapes, dense_shapes):
        assert_allclose(shapes.T @ (M @ shapes), np.eye(16), atol=1e-8)
    similarity = mac(sparse_shapes[:, rigid:], dense_shapes[:, rigid:])
    assert_allclose(np.diag(similarity), 1.0, atol=1e-8)


def test_sparse_solver_repeats_its_bits():
    model = grid_frame({})
    first, second = (eigen(model.K([]), model.M([]), 8) for _ in range(2))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])


def test_the_sum_on_one_pattern_has_the_bits_of_added_matrices():
    rng = np.random.default_rng(4)
    terms = [Term(sp.random_array((9, 9), density=d, rng=rng, format="csr"), (1,)) for d in (0.1, 0.3, 0.0, 0.9)]
    for weights in (*rng.lognormal(sigma=20.0, size=(20, 4)), np.full(4, 1.7e308)):
        added = weighted_sum(terms, weights).toarray()
        np.testing.assert_array_equal(ParametricMatrix(terms).add_up(weights, dense=True), added)
        np.testing.assert_array_equal(ParametricMatrix(terms).add_up(weights, dense=False).toarray(), added)
    assert np.isinf(added).any()


def diagonal(values):
    return sp.csr_array(sp.diags_array(np.asarray(values, dtype=float)))


SPARSE = pytest.param(450, id="sparse")


@pytest.mark.parametrize("n", [pytest.param(5, id="dense"), SPARSE])
def test_mass_that_is_negative(n):
    mass = np.ones(n)
    mass[2] = -1.0
    with pytest.raises(SingularMassError, match=r"^the mass matrix is not positive semidefinite$"):
        eigen(diagonal(np.arange(1.0, n + 1)), diagonal(mass), 3)


@pytest.mark.parametrize("n", [pytest.param(5, id="dense"), SPARSE])
def test_what_has_no_mass_has_no_mode(n):
    K, mass = diagonal(np.arange(1.0, n + 1)), np.zeros(n)
    mass[[0, 2, 4]] = 1.0
    lam, shapes = eigen(K, diagonal(mass), 3)
    assert_allclose(lam, [1.0, 3.0, 5.0], rtol=1e-12)
    assert_allclose(np.abs(shapes[[0, 2, 4]]), np.eye(3), atol=1e-12)
    with pytest.raises(SingularMassError, match=r"^M gives 3 modes of finite frequency, 4 are needed$"):
        eigen(K, diagonal(mass), 4)


@pytest.mark.parametrize("count", [0, 4, -1])
def test_count_of_modes(count):
    with pytest.raises(ValueError, match=rf"^count: must lie in 1\.\.3, the degrees of freedom \(got {count}\)$"):
        eigen(diagonal([1.0, 2.0, 3.0]), diagonal([1.0, 1.0, 1.0]), count)


def test_frequency_of_a_rigid_body_mode_is_zero_not_nan():
    lam = np.array([-1e-7, 0.0, (2 * np.pi) ** 2, np.nan])
    frequency = frequency_hz(lam)
    np.testing.assert_array_equal(frequency[:2], 0.0)
    assert frequency[2] == pytest.approx(1.0, rel=1e-15)
    assert np.isnan(frequency[3])


def test_frequency_gradient():
    """f = √θ/2π for λ = θ; at a rigid-body mode the slope does not exist and no warning is given."""
    theta = np.array([[4.0, 9.0, 0.0]])
    gradient = frequency_gradient(frequency_hz(theta), np.ones((1, 3, 1)))
    assert_allclose(gradient[0, :2, 0], 1 / (4 * np.pi * np.sqrt(theta[0, :2])), rtol=1e-14)
    assert not np.isfinite(gradient[0, 2, 0])


shapes = st.lists(st.lists(st.floats(-1, 1), min_size=4, max_size=4), min_size=1, max_size=3).map(
    lambda rows: np.array(rows).T
)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(shapes, shapes, st.floats(0.01, 100.0), st.booleans())
def test_mac_lies_in_0_1_and_ignores_scale_and_sign(phi, psi, factor, flip):
    phi, psi = (np.where(np.abs(s) < 1e-3, 0.0, s) for s in (phi, psi))
    value = mac(phi, psi)
    assert value.shape == (psi.shape[1], phi.shape[1])
    assert np.all((value >= 0.0) & (value <= 1.0 + 1e-12))
    assert_allclose(mac(phi * (-factor if flip else factor), psi), value, rtol=1e-9, atol=1e-12)
    assert_allclose(mac(psi, phi), value.T, rtol=1e-12, atol=1e-15)


def test_the_sign_of_a_shape_is_not_the_solvers():
    shapes = np.array([[-1.0, 0.2, 0.0, np.nan], [0.5, -0.7, 0.0, 1.0], [1.0 + 1e-13, 0.1, 0.0, 2.0]])
    expected = shapes * [-1.0, -1.0, 1.0, 1.0]
    rng = np.random.default_rng(1)
    for flipped in (np.ones(4), -np.ones(4)):
        rounded = shapes * flipped * (1.0 + 1e-12 * rng.standard_normal(shapes.shape))
        found = fix_sign(np.stack([rounded, -rounded]))
        for one in found[:, :, :3]:
            assert_allclose(one, expected[:, :3], rtol=1e-11)
    assert_allclose(fix_sign(shapes)[:, 3], shapes[:, 3])


def test_shapes_of_a_structure_are_the_same_from_a_solver_of_other_signs(monkeypatch):
    blocks, point = full_blocks(random_model([(0,)], [(0,)])), np.ones((1, 1))
    spectrum = solve_spectrum(blocks, point, 6)
    shapes = join_shapes(blocks, point, spectrum)
    plain = FullBlock.modes
    monkeypatch.setattr(FullBlock, "modes", lambda *of: (plain(*of)[0], -plain(*of)[1]))
    np.testing.assert_array_equal(join_shapes(blocks, point, spectrum), shapes)
    assert np.all(shapes.max(axis=0) >= -shapes.min(axis=0))


def test_mac_of_known_shapes():
    phi = np.array([[1.0, 0.0, 1.0, 0.0], [0.0, 2.0, 1.0, 0.0]])
    expected = [[1.0, 0.0, 0.5, 0.0], [0.0, 1.0, 0.5, 0.0], [0.5, 0.5, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0]]
    assert_allclose(mac(phi, phi), expected, atol=1e-15)
    stacked = mac(np.stack([phi, 3 * phi]), phi[:, :2])
    assert stacked.shape == (2, 2, 4)
    assert_allclose(stacked, [expected[:2]] * 2, atol=1e-15)


def random_model(powers_K, powers_M, n=6, seed=0):
    """Return a model of random positive definite terms."""
    rng = np.random.default_rng(seed)

    def definite():
        A = rng.standard_normal((n, n))
        return sp.csr_array(A @ A.T + n * np.eye(n))

    return SeparableModel([Term(definite(), p) for p in powers_K], [Term(definite(), p) for p in powers_M])


@pytest.mark.parametrize(
    ("powers_K", "powers_M"),
    [
        ([(3, 0), (1, 0), (0, 1)], [(1, 0), (0, 0)]),  # a plate's thickness and a spring
        ([(2, 1), (0, 0)], [(0, 2)]),
        ([(0.5, -1), (1, 0)], [(0, 0), (-1, 1)]),
        ([(1, 0), (0, 1)], [(0, 0)]),
    ],
)
def test_eigenvalue_gradient_against_differences(powers_K, powers_M):
    model = random_model(powers_K, powers_M)
    block = FullBlock(model, np.arange(6))
    theta = np.array([1.3, 0.7])
    lam, phi = block.modes(theta[None], 6)
    gradient = block.eigenvalue_gradient(theta[None], lam, phi)
    assert gradient.shape == (1, 6, 2)
    expected = differences(lambda theta: block.eigenvalues(theta, 6), theta[None], 0.003 * theta, order=6)
    assert_allclose(gradient, expected, rtol=1e-7, atol=1e-8 * lam.max())


def test_eigenvalue_gradient_of_a_plate_thickness():
    """K ∝ t³ and M ∝ t make every frequency proportional to t."""
    model = random_model([(3,)], [(1,)])
    block = FullBlock(model, np.arange(6))
    theta = np.array([[0.7], [2.0]])
    lam, phi = block.modes(theta, 6)
    frequency = frequency_hz(lam)
    gradient = frequency_gradient(frequency, block.eigenvalue_gradient(theta, lam, phi))
    assert_allclose(gradient[..., 0], frequency / theta, rtol=1e-11)
    assert_allclose(frequency[1] / frequency[0], 2.0 / 0.7, rtol=1e-12)


def test_modes_of_a_block_are_normalised_and_solve_the_problem():
    model = random_model([(1, 0), (0, 1)], [(1, 0), (0, 0)])
    block = FullBlock(model, np.arange(6))
    theta = np.array([[1.0, 2.0], [0.3, 0.9]])
    lam, phi = block.modes(theta, 4)
    for i, point in enumerate(theta):
        K, M = model.K(point).toarray(), model.M(point).toarray()
        assert_allclose(phi[i].T @ M @ phi[i], np.eye(4), atol=1e-12)
        assert_allclose(K @ phi[i], M @ phi[i] * lam[i], rtol=1e-9, atol=1e-10 * np.abs(K).max())
    np.testing.assert_array_equal(block.eigenvalues(theta, 4), lam)


def test_failed_solve_gives_nan_at_that_theta_alone():
    model = random_model([(1, 0)], [(0, 1)])
    block = FullBlock(model, np.arange(6))
    theta = np.array([[1.0, 1.0], [1.0, -1.0], [1.0, np.inf], [np.nan, 1.0], [2.0, 1.0]])
    lam, phi = block.modes(theta, 3)
    assert np.all(np.isfinite(lam[[0, 4]]))
    assert np.all(np.isfinite(phi[[0, 4]]))
    assert np.all(np.isnan(lam[1:4]))
    assert np.all(np.isnan(phi[1:4]))
    assert_allclose(lam[4], 2 * lam[0], rtol=1e-12)


def test_overflow_inside_the_eigensolver_gives_nan():
    block = FullBlock(random_model([(1, 0)], [(0, 1)]), np.arange(6))
    assert np.all(np.isnan(block.eigenvalues(np.array([[1e300, 1e-300]]), 3)))


def test_block_without_stiffness_moves_as_a_rigid_body():
    """A degree of freedom that nothing holds is a block of its own with a zero frequency."""
    K, M = diagonal([4.0, 0.0]), diagonal([1.0, 3.0])
    model = SeparableModel([Term(K, (1.0,))], [Term(M, (0.0,))])
    loose = FullBlock(model, model.blocks[1])
    lam, phi = loose.modes(np.array([[2.0]]), 1)
    assert lam[0, 0] == 0.0
    assert abs(phi[0, 0, 0]) == pytest.approx(3**-0.5)
    assert loose.eigenvalue_gradient(np.array([[2.0]]), lam, phi)[0, 0, 0] == 0.0
