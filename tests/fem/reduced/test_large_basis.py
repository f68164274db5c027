"""What is done otherwise where a structure or its basis is large gives what is done where they are small."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.reduced import basis as reduced_basis
from fmu.fem.reduced import reduced_structure, residuals, space, training
from fmu.fem.reduced.basis import ReducedBlock
from fmu.fem.reduced.learning import Learner, _fewest, balance_directions
from fmu.fem.reduced.points import affordable, box_points, mass_orthonormal, most_trial_vectors
from fmu.fem.reduced.training import Training

PARTS, ELEMENTS = 10, 40


def cantilever():
    """Return a cantilever of ten groups with moduli of their own, not along an axis of its section: one block."""
    turned = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    nodes = np.linspace(0.0, 1.0, ELEMENTS + 1)[:, None] * turned[0]
    elements = np.stack([np.arange(ELEMENTS), np.arange(1, ELEMENTS + 1)], axis=1)
    section, steel = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6), Material(E=2.1e11, nu=0.3, rho=7850.0)
    groups = [
        ElementGroup(str(g), part, section, steel, (0.3, 1.0, 0.2))
        for g, part in enumerate(np.split(elements, PARTS))
    ]
    model = Frame(nodes, groups, {0: DIRECTIONS}).separable({f"E{g}": [("E", str(g))] for g in range(PARTS)})
    return model, np.full(PARTS, 1.6e11), np.full(PARTS, 2.6e11)


@pytest.fixture(scope="module")
def solved():
    model, lower, upper = cantilever()
    (dofs,) = model.blocks
    block = FullBlock(model, dofs)
    learner = Learner(block, lower, upper, 6, block.size)
    learner.visit(box_points(lower, upper, 16, seed=1), np.full(6, 1e-6))
    return block, learner, 0.5 * (lower + upper)


def test_corrections_in_parts_lead_to_the_same_accuracy(solved, monkeypatch):
    """Where memory is short, fewer points are visited at once."""
    block, whole, _ = solved
    monkeypatch.setattr(residuals, "BUDGET", 8 * 3 * block.size * 6 * 3)
    _, lower, upper = cantilever()
    assert residuals.at_once(block, 6) == 3
    in_parts = Learner(block, lower, upper, 6, block.size)
    in_parts.visit(whole.theta, np.full(6, 1e-6))
    assert in_parts.space.size != whole.space.size
    theta = box_points(lower, upper, 8, seed=3)
    exact = block.eigenvalues(theta, 6)
    for learner in (whole, in_parts):
        assert_allclose(learner.space.modes(theta, 6)[0], exact, rtol=1e-4)


def test_a_term_is_projected_by_its_own_rows(solved, monkeypatch):
    block, learner, _ = solved
    basis = learner.space.V[:, :20]
    whole = ReducedBlock(block, basis, 6)._K
    monkeypatch.setattr(reduced_basis, "_LARGE", 10)
    assert_allclose(ReducedBlock(block, basis, 6)._K, whole, rtol=1e-9, atol=1e-12 * np.abs(whole).max())
    # and piece by piece as the space grew, of which the lower triangles are kept
    for few in (learner.space.truncate(20), learner.space.restrict(np.eye(learner.space.size, 20))):
        unit = np.eye(PARTS)
        assert_allclose(
            np.tril(few.assemble(unit)[0]), np.tril(whole), rtol=1e-7, atol=1e-12 * np.abs(whole).max()
        )


def test_lanczos_finds_the_modes_of_a_large_space(solved, monkeypatch):
    _, learner, _ = solved
    _, lower, upper = cantilever()
    theta = box_points(lower, upper, 4, seed=3)[:6]
    lam, y = learner.space.modes(theta, 6)
    monkeypatch.setattr(space, "_LANCZOS", 10)
    few_lam, few_y = learner.space.modes(theta, 6)
    assert_allclose(few_lam, lam, rtol=1e-9)
    lower = np.tril(learner.space.assemble(theta)[1])
    M = lower + np.swapaxes(np.tril(lower, -1), 1, 2)
    assert_allclose(np.abs(np.sum(few_y * (M @ y), axis=1)), 1.0, rtol=1e-8)


def test_the_few_lowest_modes_are_those_of_all(solved, monkeypatch):
    block, learner, centre = solved
    reduced = ReducedBlock(block, mass_orthonormal(block, learner.space.V[:, :32], centre), 6)
    theta = centre * np.random.default_rng(2).uniform(0.8, 1.2, size=(7, PARTS))
    lam, phi = reduced.modes(theta, 6)
    monkeypatch.setattr(reduced_basis, "_PARTIAL", 32)
    theta[3] = np.nan
    few_lam, few_phi = reduced.modes(theta, 6)
    rest = np.arange(7) != 3
    assert np.isnan(few_lam[3]).all()
    assert np.isnan(few_phi[3]).all()
    assert_allclose(few_lam[rest], lam[rest], rtol=1e-10)
    assert_allclose(np.abs(np.sum(few_phi[rest] * phi[rest], axis=1)), 1.0, rtol=1e-8)
    for i in np.flatnonzero(rest):
        one = reduced.modes(theta[i : i + 1], 6)
        assert_array_equal(one[0][0], few_lam[i])
        assert_array_equal(one[1][0], few_phi[i])
    all_modes = reduced.modes(theta[:1], 32)
    assert all_modes[1].shape == (1, 32, 32)


def paired(**options):
    model, lower, upper = cantilever()
    reference = 0.5 * (lower + upper)
    truth = PairedStructure.of(model, pairing="index", numbers=(1, 2, 3, 4), sensors=(), reference=reference)
    return *reduced_structure.train(truth, lower, upper, **options), lower, upper


def test_a_batch_in_parts_changes_no_bit(monkeypatch):
    whole, state, lower, upper = paired(tolerance=1e-3)
    monkeypatch.setattr(reduced_structure, "_MOST_NUMBERS", 3 * max(b.size for b in whole.cheap.blocks) ** 2)
    parts = reduced_structure.restore(whole.truth, state)
    assert 1 <= parts._at_once <= 3 < whole._at_once
    theta = box_points(lower, upper, 8, seed=5)
    for gradient in (False, True):
        one, other = whole.modes(theta, gradient), parts.modes(theta, gradient)
        assert_array_equal(one.eigenvalues, other.eigenvalues)
        assert_array_equal(one.rank, other.rank)
        assert (one.gradient is None) == (other.gradient is None) == (not gradient)
        if gradient:
            assert_array_equal(one.gradient, other.gradient)


def test_training_ends_where_more_vectors_do_not_pay(monkeypatch):
    checked = []
    monkeypatch.setattr(Training, "_verify", lambda self, round_: checked.append(round_))
    monkeypatch.setattr(training, "DENSE_LIMIT", 10)
    monkeypatch.setattr(training, "affordable", lambda n_dof: 12)
    cut, *_ = paired(inaccurate_points=lambda _: (np.full((1, PARTS), 2e11), 3.0))
    assert not cut.confirmed
    assert checked == []
    assert [b.size for b in cut.cheap.blocks] == [12]


def test_trial_vectors_keep_to_their_memory():
    assert most_trial_vectors(400) == 400
    assert most_trial_vectors(10_000) == 2000
    assert 8 * 1_000_000 * most_trial_vectors(1_000_000) <= 2**31


@pytest.mark.parametrize("fewest", [3, 17, 18, 40, 99, 100])
@pytest.mark.parametrize("guess", [4, 18, 100])
def test_the_fewest_vectors_are_found_from_any_guess(fewest, guess):
    tried = []
    assert _fewest(lambda size: tried.append(size) or size >= fewest, 2, 100, guess) == fewest
    assert len(tried) == len(set(tried)) < 20


def test_weights_make_fewer_vectors_enough_for_the_worst_column():
    rng = np.random.default_rng(3)
    Z = 0.6 ** np.arange(20)[:, None] * rng.standard_normal((20, 600))
    Z[:, 0] = 0.03 * np.eye(20)[17]  # a column that no other one is like
    Q, left = balance_directions(Z, 1e-5, 1, 20)
    assert_allclose(Q.T @ Q, np.eye(Q.shape[1]), atol=1e-12)
    assert_allclose(left[7], np.sum(Z**2, axis=0) - np.sum((Q[:, :8].T @ Z) ** 2, axis=0), atol=1e-12)
    plain = np.linalg.eigh(Z @ Z.T)[1][:, ::-1]
    left_by_plain = np.sum(Z**2, axis=0) - np.cumsum((plain.T @ Z) ** 2, axis=0)
    assert np.sum(left.max(axis=1) > 2e-5) < np.sum(left_by_plain.max(axis=1) > 2e-5)


def test_what_pays():
    assert affordable(400) == 400
    assert affordable(2500) == 600
    assert affordable(10_000) == affordable(1_000_000) == 1000
