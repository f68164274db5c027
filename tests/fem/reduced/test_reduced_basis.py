"""The reduced block: above the exact eigenvalues, the same bits in any batch, failures kept apart."""

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_allclose, assert_array_equal

from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, PointMass, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.block import shapes_at
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.separable import SeparableModel, selection
from fmu.fem.modes.terms import Term
from fmu.fem.reduced.basis import ReducedBlock
from fmu.fem.reduced.learning import Learner
from fmu.fem.reduced.points import mass_orthonormal
from tests.gradients import differences

COUNT = 4
SIZES = (1, 2, 3, 16, 64, 513)
PLANE = ("z", "ry")


def beam(updates, supports=None):
    """Return a cantilever of two groups with a tip mass, and its block of bending in x-z."""
    nodes = np.linspace(0, 1.0, 25)[:, None] * [1.0, 0.0, 0.0]
    elements = np.stack([np.arange(24), np.arange(1, 25)], axis=1)
    section, steel = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6), Material(E=2.1e11, nu=0.3, rho=7850.0)
    groups = [ElementGroup(str(g), part, section, steel) for g, part in enumerate(np.split(elements, 2))]
    supports = {0: DIRECTIONS} if supports is None else supports
    model = Frame(nodes, groups, supports, [PointMass(24, 2.0)]).separable(updates)
    (bending,) = (b for b in model.blocks if {model.dofs[i][1] for i in b} == set(PLANE))
    return model, bending


def moduli():
    """K linear, M constant."""
    model, dofs = beam({"E0": [("E", "0")], "E1": [("E", "1")]})
    return FullBlock(model, dofs), np.array([1.4e11, 1.4e11]), np.array([2.8e11, 2.8e11])


def sections():
    """K and M linear in two parameters each."""
    model, dofs = beam({"I0": [("Iy", "0")], "A1": [("A", "1")]})
    return FullBlock(model, dofs), np.array([2e-6, 1.5e-3]), np.array([8e-6, 6e-3])


def thicknesses():
    """A strip: K goes with the cube of the thickness, M with the thickness, each half with its own."""
    model, dofs = beam({"E0": [("E", "0")], "E1": [("E", "1")], "rho0": [("rho", "0")], "rho1": [("rho", "1")]})
    K = {t.powers: t.matrix for t in model.K_terms}
    M = {t.powers: t.matrix for t in model.M_terms}
    K_terms = [
        Term(K[1.0, 0, 0, 0] * 2.1e11, (3.0, 0.0)),
        Term(K[0, 1.0, 0, 0] * 2.1e11, (0.0, 3.0)),
    ]
    M_terms = [
        Term(M[0, 0, 1.0, 0] * 7850.0, (1.0, 0.0)),
        Term(M[0, 0, 0, 1.0] * 7850.0, (0.0, 1.0)),
        Term(M[0, 0, 0, 0], (0.0, 0.0)),
    ]
    strip = SeparableModel(K_terms, M_terms, model.dofs)
    return FullBlock(strip, dofs), np.array([0.6, 0.6]), np.array([1.5, 1.5])


@pytest.fixture(scope="module", params=[moduli, sections, thicknesses])
def trained(request):
    """Return a full block, its POD to rounding, and the box."""
    block, lower, upper = request.param()
    unit = np.vstack([np.random.default_rng(0).uniform(size=(40, 2)), [[0, 0], [0, 1], [1, 0], [1, 1]]])
    return block, learnt(block, lower, upper, lower + (upper - lower) * unit), lower, upper


def learnt(block, lower, upper, theta, tolerance=1e-11):
    """Return the POD of the modes at theta, strongest direction first, as a reduced block."""
    learner = Learner(block, lower, upper, COUNT, block.size)
    for _ in range(4):
        learner.visit(theta, np.full(COUNT, tolerance))
    cut, _ = learner.cut(COUNT, tolerance, 1, block.size)
    return ReducedBlock(block, mass_orthonormal(block, cut.V, 0.5 * (lower + upper)), COUNT)


def sample(lower, upper, n, seed=7):
    return lower + (upper - lower) * np.random.default_rng(seed).uniform(size=(n, len(lower)))


def test_reduced_eigenvalues_fall_onto_the_exact_ones_as_the_basis_grows(trained):
    block, reduced, lower, upper = trained
    theta = sample(lower, upper, 25)
    exact = block.eigenvalues(theta, COUNT)
    errors = np.array(
        [reduced.truncate(size).eigenvalues(theta, COUNT) / exact - 1.0 for size in (4, 6, 8, 10, 12, 16)]
    )
    # Rayleigh and Courant–Fischer, but for the full solver's rounding
    assert np.all(errors > -1e-7)
    assert np.all(np.diff(errors, axis=0) < 1e-7)
    worst = errors.max(axis=(1, 2))
    assert worst[0] > 1e-5  # otherwise the rest says nothing
    assert worst[-1] < 1e-7


def test_gradient_is_that_of_the_full_model(trained):
    block, reduced, lower, upper = trained
    theta = sample(lower, upper, 12)
    exact = block.eigenvalue_gradient(theta, *block.modes(theta, COUNT))
    gradient = reduced.eigenvalue_gradient(theta, *reduced.modes(theta, COUNT))
    assert exact.shape == (12, COUNT, 2)
    assert_allclose(gradient, exact, rtol=1e-5, atol=1e-5 * np.abs(exact * theta[:, None]).max() / theta.max())


def test_gradient_is_that_of_the_reduced_eigenvalue_however_coarse_the_basis(trained):
    """∂λ/∂θ of the small problem itself, exactly: a sampler must see the slope of what it is given."""
    _, reduced, lower, upper = trained
    coarse = reduced.truncate(6)
    (theta,) = sample(lower, upper, 1)
    (gradient,) = coarse.eigenvalue_gradient(theta[None], *coarse.modes(theta[None], COUNT))
    largest = np.abs(gradient).max(axis=0)
    (slopes,) = differences(lambda theta: coarse.eigenvalues(theta, COUNT), theta[None], 0.01 * theta, order=6)
    assert_allclose(gradient / largest, slopes / largest, rtol=1e-7, atol=1e-8)


def test_shapes_are_orthonormal_in_the_mass_matrix(trained):
    block, reduced, lower, upper = trained
    theta = sample(lower, upper, 3)
    lam, phi = reduced.modes(theta, COUNT)
    assert_allclose(lam, reduced.eigenvalues(theta, COUNT), rtol=1e-9)
    weights = block._M_map.coefficients(theta)
    for shape, weight in zip(phi, weights, strict=True):
        M = sum(w * t.matrix for w, t in zip(weight, block.M_terms, strict=True))
        physical = reduced.basis @ shape
        assert_allclose(physical.T @ (M @ physical), np.eye(COUNT), atol=1e-9)


@pytest.mark.parametrize("size", [4, 16, *(pytest.param(size, marks=pytest.mark.validate) for size in (1, 7))])
def test_a_batch_changes_no_bit(trained, size):
    _, reduced, lower, upper = trained
    block, count = reduced.truncate(size), min(size, COUNT)
    theta = sample(lower, upper, max(SIZES))
    alone = [block.eigenvalues(row[None], count)[0] for row in theta]
    modes = [block.modes(row[None], count) for row in theta]
    slopes = [block.eigenvalue_gradient(row[None], *mode)[0] for row, mode in zip(theta, modes, strict=True)]
    for n in SIZES:
        for first in sorted({0, (max(SIZES) - n) // 2, max(SIZES) - n}):
            rows = slice(first, first + n)
            batch = theta[rows]
            assert_array_equal(block.eigenvalues(batch, count), alone[rows])
            lam, phi = block.modes(batch, count)
            assert_array_equal(lam, [mode[0][0] for mode in modes[rows]])
            assert_array_equal(phi, [mode[1][0] for mode in modes[rows]])
            assert_array_equal(block.eigenvalue_gradient(batch, lam, phi), slopes[rows])


def test_a_matrix_that_fails_takes_only_its_own_row(trained):
    _, reduced, lower, upper = trained
    theta = sample(lower, upper, 6)
    expected, modes = reduced.eigenvalues(theta, COUNT), reduced.modes(theta, COUNT)
    spoilt = theta.copy()
    spoilt[2] = np.nan if reduced.constant_mass else -theta[2]  # no stiffness, or no positive mass
    good = np.arange(6) != 2
    with np.errstate(invalid="ignore"):
        values, (lam, phi) = reduced.eigenvalues(spoilt, COUNT), reduced.modes(spoilt, COUNT)
        only = reduced.eigenvalues(spoilt[2:3], COUNT)
    assert_array_equal(values[good], expected[good])
    assert_array_equal(lam[good], modes[0][good])
    assert_array_equal(phi[good], modes[1][good])
    for failed in (values[2], lam[2], phi[2], only[0]):
        assert np.all(np.isnan(failed))


@pytest.mark.parametrize("n_dofs", [3, 30])
def test_shapes_compare_at_the_sensors_as_they_do_in_full(trained, n_dofs):
    """Products and norms are all that MAC needs; more sensors than basis vectors are compressed without a loss."""
    _, reduced, lower, upper = trained
    block = reduced.truncate(9)
    rng = np.random.default_rng(3)
    dofs = np.sort(rng.permutation(len(block.dofs))[:n_dofs])
    reference = rng.standard_normal((n_dofs, 2))
    _, phi = block.modes(sample(lower, upper, 4), COUNT)
    rows, there = block.observe(selection(dofs, len(block.dofs)), reference)
    seen, expected = shapes_at(rows, phi), (block.basis @ phi)[:, dofs]
    assert seen.shape[1] == min(n_dofs, 9)
    assert_allclose(np.sum(seen**2, axis=1), np.sum(expected**2, axis=1), rtol=1e-10)
    product = np.swapaxes(expected, 1, 2) @ reference
    assert_allclose(np.swapaxes(seen, 1, 2) @ there, product, rtol=1e-9, atol=1e-10 * np.abs(product).max())


@pytest.mark.parametrize("points", [4, 60])
def test_the_basis_is_the_pod_of_the_modes(points):
    block, lower, upper = sections()
    centre, theta = 0.5 * (lower + upper), sample(lower, upper, points)
    reduced = learnt(block, lower, upper, theta)
    basis = reduced.basis
    weights = block._M_map.coefficients(centre[None])[0]
    M = sum(w * t.matrix.toarray() for w, t in zip(weights, block.M_terms, strict=True))
    assert_allclose(basis.T @ M @ basis, np.eye(basis.shape[1]), atol=1e-9)
    assert basis.shape[1] < 40
    X = np.concatenate(list(block.modes(theta, COUNT)[1]), axis=1)
    assert_allclose(basis @ (basis.T @ (M @ X)), X, atol=1e-4 * np.abs(X).max())
    left = [np.linalg.norm(X - basis[:, :r] @ (basis[:, :r].T @ (M @ X))) for r in (2, 4, 6, 8)]
    assert np.all(np.diff(left) < 0)
    # a direction counts by what it does to a relative frequency: the lowest mode is not left to the last
    exact = block.eigenvalues(theta, COUNT)
    errors = np.max(reduced.truncate(8).eigenvalues(theta, COUNT) / exact - 1.0, axis=0)
    assert errors[0] < 10 * errors[-1]


def test_rigid_body_modes_are_rigid_in_the_basis():
    model, dofs = beam({"E0": [("E", "0")], "E1": [("E", "1")]}, supports={})
    block, lower, upper = FullBlock(model, dofs), np.full(2, 1.4e11), np.full(2, 2.8e11)
    theta = sample(lower, upper, 5)
    reduced = learnt(block, lower, upper, theta, 1e-7)
    exact, lam = block.eigenvalues(theta, COUNT), reduced.eigenvalues(theta, COUNT)
    assert np.all(np.abs(lam[:, :2]) < 1e-9 * lam[:, -1:])
    assert_allclose(lam[:, 2:], exact[:, 2:], rtol=1e-6)


def test_a_structure_of_one_degree_of_freedom():
    model = SeparableModel([Term(sp.csr_array([[2.0]]), (1.0,))], [Term(sp.csr_array([[0.5]]), (1.0,))])
    block = FullBlock(model, np.array([0]))
    reduced = ReducedBlock(block, np.array([[np.sqrt(2.0)]]), 1)
    theta = np.linspace(0.5, 2.0, 9)[:, None]
    assert_allclose(reduced.eigenvalues(theta, 1), np.full((9, 1), 4.0), rtol=1e-14)
    lam, phi = reduced.modes(theta, 1)
    assert_allclose(reduced.eigenvalue_gradient(theta, lam, phi), np.zeros((9, 1, 1)), atol=1e-13)
