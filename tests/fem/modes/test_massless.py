"""Degrees of freedom without mass: as a condensed model that keeps only what has mass, to the last digits."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_allclose, assert_array_equal

from fmu.fem.condensation import craig_bampton
from fmu.fem.frame.stability import require_stable
from fmu.fem.modes import eigensolver, full_block
from fmu.fem.modes.eigensolver import DENSE_LIMIT, SingularMassError, eigen
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import Term
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.reduced.basis import ReducedBlock
from fmu.fem.reduced.reduced_structure import train
from tests.fem.modes.massless_bridge import LOWER, START, UPPER, bridge, condensed
from tests.gradients import differences

ROTATIONS = ((3, "ry"), (8, "rx"), (4, "z"), (9, "y"))


def paired(model, count=6, pairing="index", sensors=()):
    numbers = tuple(range(1, count + 1))
    return PairedStructure.of(model, pairing=pairing, numbers=numbers, sensors=sensors, reference=START)


def assert_same_modes(model, theta, count, rtol):
    lam, shapes, slopes = condensed(model, theta, count)
    posed = paired(model, count)
    found = posed.truth.solve(theta[None], gradient=True)
    assert_allclose(found.eigenvalues[0], lam, rtol=rtol)
    assert_allclose(found.gradient[0] * theta / lam[:, None], slopes * theta / lam[:, None], rtol=0, atol=rtol)
    full = posed.truth.shapes(theta)
    full *= np.sign(np.sum(full * shapes, axis=0))
    assert_allclose(full, shapes, rtol=0, atol=10 * rtol * np.abs(shapes).max())


# 40 stations: more degrees of freedom than the dense solver takes
@pytest.mark.parametrize("stations", [7, 16, 40])
def test_modes_and_their_gradients_are_those_of_the_condensed_model(stations):
    model = bridge(stations)
    (dofs,) = model.blocks
    posed = paired(model).truth.blocks[0]
    assert (len(dofs) > DENSE_LIMIT) == (stations == 40)
    assert posed.n_modes == int(np.sum(model.M(START).diagonal() > 0.0)) < 0.55 * len(dofs)
    assert_same_modes(model, START, 8, 1e-10)
    assert_same_modes(model, UPPER, 8, 1e-10)


def test_lanczos_iterations_too(monkeypatch):
    for module in (eigensolver, full_block):
        monkeypatch.setattr(module, "DENSE_LIMIT", 60)
    assert_same_modes(bridge(12), START, 8, 1e-10)


def test_a_batch_changes_no_bit():
    posed = paired(bridge(7))
    theta = LOWER + (UPPER - LOWER) * np.random.default_rng(1).random((5, 3))
    together = posed.modes(theta, gradient=True)
    for i, row in enumerate(theta):
        alone = posed.modes(row[None], gradient=True)
        assert_array_equal(together.eigenvalues[i], alone.eigenvalues[0])
        assert_array_equal(together.gradient[i], alone.gradient[0])


def test_shapes_move_as_differences_say():
    posed = paired(bridge(7), sensors=ROTATIONS)

    def shapes(theta):
        shapes = posed.truth.observed(theta).shapes
        return shapes * np.sign(shapes[:, :1])

    sign = np.sign(posed.truth.observed(START[None]).shapes[0, 0])
    slopes = posed.observed(START[None], gradient=True).shape_slopes[0] * sign[:, None]
    (expected,) = differences(shapes, START[None], 1e-4 * START)
    largest = np.abs(expected).max(axis=(0, 1))
    assert_allclose(slopes / largest, expected / largest, rtol=0, atol=1e-5)


@pytest.fixture(scope="module", params=["index", "shape"])
def trained(request):
    return train(paired(bridge(7), pairing=request.param, sensors=ROTATIONS), LOWER, UPPER)[0]


def test_the_reduced_model_answers_for_it(trained):
    (block,) = trained.cheap.blocks
    assert trained.confirmed
    assert block.size < 0.7 * trained.structure.n_dof
    theta = LOWER + (UPPER - LOWER) * np.random.default_rng(3).random((40, 3))
    exact = np.array([np.sqrt(condensed(trained.structure, row, 6)[0]) / (2 * np.pi) for row in theta])
    reduced = trained.frequencies(theta)
    ascending = np.argsort(reduced, axis=1)  # by shape, modes cross
    assert_allclose(np.take_along_axis(reduced, ascending, axis=1), exact, rtol=2e-6)
    assert_array_equal(reduced, np.concatenate([trained.frequencies(row[None]) for row in theta]))
    assert trained.full_solves <= 4
    slopes = trained.frequencies_and_gradient(theta)[1] * theta[:, None] / reduced[..., None]
    slopes = np.take_along_axis(slopes, ascending[..., None], axis=1)
    for row, of_row, f in zip(theta, slopes, exact, strict=True):
        lam_slopes = condensed(trained.structure, row, 6)[2] * row
        assert_allclose(of_row, lam_slopes / (8 * np.pi**2 * f[:, None] ** 2), rtol=0, atol=1e-3)


def test_sensors_see_what_has_no_mass_in_the_reduced_model(trained):
    theta = np.array([START, 0.95 * START])
    reduced, full = trained.observed(theta, gradient=True), trained.truth.observed(theta)
    sign = np.sign(np.sum(reduced.shapes * full.shapes, axis=1, keepdims=True))
    assert_allclose(reduced.shapes * sign, full.shapes, rtol=0, atol=1e-3 * np.abs(full.shapes).max())
    fresh = paired(trained.structure, sensors=ROTATIONS)
    slopes = fresh.observed(theta, gradient=True).shape_slopes * theta[:, None, None]
    seen = fresh.observed(theta).shapes
    turn = np.sign(np.sum(seen * reduced.shapes, axis=1, keepdims=True))[..., None]
    found = reduced.shape_slopes * theta[:, None, None] * turn
    assert_allclose(found, slopes, rtol=0, atol=2e-2 * np.abs(slopes).max())


def test_the_few_lowest_modes_of_a_large_basis_are_those_of_all(monkeypatch):
    block = paired(bridge(40)).truth.blocks[0]
    rng = np.random.default_rng(4)
    reduced = ReducedBlock(block, np.linalg.qr(rng.standard_normal((block.size, 140)))[0], 6)
    theta = LOWER + (UPPER - LOWER) * rng.random((3, 3))
    lam, phi = reduced.modes(theta, 140)
    monkeypatch.setattr(np.linalg, "eigh", None)  # which finds all
    few_lam, few_phi = reduced.modes(theta, 6)
    assert_allclose(few_lam, lam[:, :6], rtol=1e-10)
    assert_allclose(
        few_phi * np.sign(np.sum(few_phi * phi[:, :, :6], axis=1, keepdims=True)), phi[:, :, :6], atol=1e-7
    )


def test_a_free_structure():
    model = bridge(7, free=True)
    require_stable(model, START, free=True)
    lam, shapes = eigen(model.K(START), model.M(START), 10)
    assert_array_equal(lam[:6], 0.0)
    K, M = model.K(START), model.M(START)
    assert_allclose(shapes.T @ (M @ shapes), np.eye(10), atol=1e-10)
    residual = K @ shapes - (M @ shapes) * lam
    assert np.all(np.abs(residual) < 1e-9 * np.abs(K) @ np.abs(shapes).max(axis=1, keepdims=True))
    # held by springs so soft that they change nothing else
    soft = K + sp.diags_array(1e-6 * M.diagonal())
    assert_allclose(eigen(soft, M, 10)[0][6:], lam[6:], rtol=1e-6)


def test_a_mass_matrix_that_is_singular_in_no_coordinate():
    """The same structure in turned coordinates has the same modes."""
    model = bridge(7)
    K, M = model.K(START).toarray(), model.M(START).toarray()
    Q = np.linalg.qr(np.random.default_rng(0).standard_normal(K.shape))[0]
    expected = condensed(model, START, 6)[0]
    lam, _ = eigen(sp.csr_array(Q @ K @ Q.T), sp.csr_array(Q @ M @ Q.T), 6)
    assert_allclose(lam, expected, rtol=1e-7)
    assert eigensolver.rank(sp.csr_array(Q @ M @ Q.T)) == int(np.sum(np.diag(M) > 0.0))


def test_too_few_modes_of_finite_frequency():
    model = bridge(7)
    few = np.zeros(model.n_dof)
    few[[5, 30]] = 100.0
    light = SeparableModel(model.K_terms, [Term(sp.diags_array(few), (0, 0, 1))], model.dofs, model.geometry)
    with pytest.raises(ValueError, match=r"^mass: the 3 measured modes .*: the mass matrix gives 2;"):
        paired(light, 3)
    assert paired(light, 2).frequencies(START[None]).shape == (1, 2)


def test_what_has_neither_mass_nor_stiffness_is_named():
    """A hinge that lets a rotation without mass turn freely."""
    model = bridge(7, free=True)
    turns = model.dof(3, "ry")
    loose = []
    for term in model.K_terms:
        matrix = term.matrix.tolil()
        matrix[turns, :], matrix[:, turns] = 0.0, 0.0
        loose.append(replace(term, matrix=matrix.tocsr()))
    hinged = SeparableModel(loose, model.M_terms, model.dofs, model.geometry)
    message = r"degrees of freedom with neither stiffness nor mass can move \(3 ry moves most\)$"
    for free in (False, True):
        with pytest.raises(ValueError, match=message):
            require_stable(hinged, START, free=free)
    with pytest.raises(SingularMassError, match=r"^a motion without strain moves no mass$"):
        eigen(hinged.K(START), hinged.M(START), 3)


def test_craig_bampton_keeps_the_modes_that_there_are():
    model = bridge(7)
    K, M = model.K(START), model.M(START)
    boundary = [model.dof(node, direction) for node in (3, 10) for direction in ("x", "y", "z", "rx", "ry", "rz")]
    reduced = craig_bampton(K, M, boundary, 100)
    assert len(reduced.K) == len(boundary) + eigensolver.rank(M) - 6
    assert_allclose(reduced.eigen(6)[0], condensed(model, START, 6)[0], rtol=1e-9)


@pytest.mark.parametrize(("second", "once"), [(1.0, True), (-1e-3, False)], ids=["semidefinite", "indefinite"])
def test_the_rank_of_masses_that_only_scale_is_found_once(second, once, monkeypatch):
    """Sums of semidefinite terms with positive weights have one null space; not so if a term takes mass away."""
    K = 2.0 * np.eye(4) - np.eye(4, k=1) - np.eye(4, k=-1)
    masses = [np.diag([1.0, 2.0, 0.0, 0.0]), np.diag([0.0, second, 1.0, 0.0])]
    model = SeparableModel.from_terms(["a", "b"], [K], list(zip(masses, ("a", "b"), strict=True)))
    block = full_block.FullBlock(model, np.arange(4))
    theta = np.array([[1.0, 1.0], [2.0, 0.5], [0.3, 4.0]])
    alone = [block.modes(one[None], 3)[0][0] for one in theta]
    asked = []
    rank = full_block.rank
    monkeypatch.setattr(full_block, "rank", lambda M: asked.append(1) or rank(M))
    found = full_block.FullBlock(model, np.arange(4)).modes(theta, 3)[0]
    assert_allclose(found, alone, rtol=1e-12)
    for values, weights in zip(found, theta, strict=True):
        M = weights[0] * masses[0] + weights[1] * masses[1]
        compliance = np.sort(np.linalg.eigvals(np.linalg.solve(K, M)).real)[::-1][:3]
        assert_allclose(values, 1.0 / compliance, rtol=1e-10)
    assert (len(asked) <= 4) == once
