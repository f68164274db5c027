"""Which computed mode answers to which measured one."""

from functools import partial
from itertools import permutations

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import fmu
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.full_block import full_blocks
from fmu.fem.modes.modal import assign, frequency_hz, solve_spectrum
from fmu.fem.modes.separable import SeparableModel, selection
from fmu.fem.modes.terms import Term
from fmu.fem.pairing.reference_modes import reference_modes
from fmu.fem.pairing.rules import IndexPairing, RankPairing, ShapePairing
from tests import cantilever
from tests.gradients import differences

STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)


def crossing():
    """Two blocks with λ = θ, 3θ and λ = 3, 5: the spectra cross at θ = 1, 5/3, 3 and 5."""
    A = np.zeros((4, 4))
    A[:2, :2] = [[2.0, -1.0], [-1.0, 2.0]]
    B = np.zeros((4, 4))
    B[2:, 2:] = [[4.0, -1.0], [-1.0, 4.0]]
    K_terms = [Term(sp.csr_array(A), (1.0,)), Term(sp.csr_array(B), (0.0,))]
    return full_blocks(SeparableModel(K_terms, [Term(sp.csr_array(sp.eye_array(4)), (0.0,))]))


def test_spectrum_merges_the_blocks():
    theta = np.array([[2.0], [4.0], [0.5]])
    modes = solve_spectrum(crossing(), theta, 4, gradient=True)
    assert_allclose(modes.eigenvalues, [[2, 3, 5, 6], [3, 4, 5, 12], [0.5, 1.5, 3, 5]], rtol=1e-14)
    assert_array_equal(modes.block, [[0, 1, 1, 0], [1, 0, 1, 0], [0, 0, 1, 1]])
    assert_array_equal(modes.rank, [[0, 0, 1, 1], [0, 0, 1, 1], [0, 1, 0, 1]])
    assert_allclose(modes.gradient[..., 0], [[1, 0, 0, 3], [0, 1, 0, 3], [1, 3, 0, 0]], atol=1e-14)


def test_pairing_by_number_changes_blocks_where_spectra_cross():
    theta = np.array([[2.0], [4.0], [0.5]])
    modes = IndexPairing((4, 1)).solve(crossing(), theta, gradient=True)
    assert_allclose(modes.eigenvalues, [[6, 2], [12, 3], [5, 0.5]], rtol=1e-14)
    assert_array_equal(modes.block, [[0, 0], [0, 1], [1, 0]])
    assert_allclose(modes.gradient[..., 0], [[3, 1], [3, 0], [0, 1]], atol=1e-14)
    plain = IndexPairing((4, 1)).solve(crossing(), theta)
    assert_array_equal(plain.eigenvalues, modes.eigenvalues)
    assert plain.gradient is None


def test_pairing_by_rank_stays_in_its_block():
    theta = np.array([[2.0], [4.0], [0.5]])
    modes = RankPairing(block=(1, 0, 0), rank=(0, 1, 0)).solve(crossing(), theta, gradient=True)
    assert_allclose(modes.eigenvalues, [[3, 6, 2], [3, 12, 4], [3, 1.5, 0.5]], rtol=1e-14)
    assert_allclose(modes.gradient[..., 0], [[0, 3, 1]] * 3, atol=1e-14)
    assert_array_equal(modes.block, [[1, 0, 0]] * 3)


def test_one_failed_block_leaves_no_row_of_the_spectrum_to_trust():
    """Where one part of the structure cannot be solved, no number in the sorted spectrum means anything."""
    eye = np.eye(4)
    masses = [
        Term(sp.csr_array(np.diag(eye[0] + eye[1])), (1.0,)),
        Term(sp.csr_array(np.diag(eye[2] + eye[3])), (0.0,)),
    ]
    stiffness = sp.csr_array(np.array([[2.0, -1, 0, 0], [-1, 2.0, 0, 0], [0, 0, 4.0, -1], [0, 0, -1, 4.0]]))
    model = full_blocks(SeparableModel([Term(stiffness, (0.0,))], masses))
    modes = IndexPairing((1, 2)).solve(model, np.array([[-1.0], [1.0]]))
    assert np.all(np.isnan(modes.eigenvalues[0]))
    assert_allclose(modes.eigenvalues[1], [1.0, 3.0], rtol=1e-14)


def test_a_mode_that_a_block_may_hold_back_makes_the_row_doubtful():
    """A block that gives one mode of two shows completeness only of what lies below that one."""
    blocks = crossing()
    blocks[0].n_trained = 1
    lowest = solve_spectrum(blocks, np.array([[0.5], [2.0], [4.0], [6.0]]), 2)
    assert_array_equal(np.isnan(lowest.eigenvalues).all(axis=1), [True, True, True, False])
    assert_allclose(lowest.eigenvalues[3], [3.0, 5.0], rtol=1e-14)


@pytest.mark.parametrize("failing", [0, 1])
def test_a_failed_block_does_not_hand_its_measured_modes_to_another(failing):
    """Pairing by shape where the block of a reference cannot be solved: NaN, not the next best mode elsewhere."""
    eye = np.eye(4)
    masses = [
        Term(sp.csr_array(np.diag(eye[i] + eye[i + 1])), power)
        for i, power in ((0, (1.0 - failing,)), (2, (1.0 * failing,)))
    ]
    stiffness = sp.csr_array(np.array([[2.0, -1, 0, 0], [-1, 2.0, 0, 0], [0, 0, 4.0, -1], [0, 0, -1, 4.0]]))
    model = full_blocks(SeparableModel([Term(stiffness, (0.0,))], masses))
    shapes = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    modes = ShapePairing(selection(np.arange(4), 4), shapes).solve(model, np.array([[1.0], [-1.0]]))
    assert_allclose(modes.eigenvalues[0], [1.0, 3.0], rtol=1e-14)
    assert np.isnan(modes.eigenvalues[1, failing])


scores = st.integers(1, 4).flatmap(
    lambda rows: st.integers(rows, 6).flatmap(
        lambda columns: st.lists(
            st.lists(
                st.sampled_from([0.0, 0.25, 0.5, 0.9, 1.0]) | st.floats(0, 1), min_size=columns, max_size=columns
            ),
            min_size=rows,
            max_size=rows,
        )
    )
)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(scores)
def test_assignment_against_brute_force(rows):
    similarity = np.array(rows)
    n_modes, n_candidates = similarity.shape
    column = assign(similarity[None])[0]
    assert len(set(column)) == n_modes
    best = max(sum(similarity[i, c] for i, c in enumerate(p)) for p in permutations(range(n_candidates), n_modes))
    assert similarity[np.arange(n_modes), column].sum() == pytest.approx(best, abs=1e-12)


def test_assignment_of_a_batch_is_row_by_row():
    similarity = np.random.default_rng(0).uniform(size=(50, 4, 6))
    together = assign(similarity)
    assert_array_equal(together, np.concatenate([assign(row[None]) for row in similarity]))
    assert np.any(together != np.argmax(similarity, axis=2))


def test_modes_of_one_shape_are_paired_by_frequency_wherever_theta_is():
    """At two sensors all modes of one symmetry of a chain look alike; the third and fourth modes were measured."""
    wall = np.diag([1e4, 0, 0, 0, 0, 0, 1e4])
    inner = 1e4 * (2 * np.eye(7) - np.eye(7, k=1) - np.eye(7, k=-1)) - wall
    theta = np.random.default_rng(0).uniform(0.9, 1.1, (40, 2))
    for measured, of_chain in (([16.8, 6.164], [2, 0]), ([12.04, 6.164], [1, 0]), ([21.5, 12.0], [3, 1])):
        problem = fmu.UpdatingProblem(
            fmu.SeparableModel.from_terms(["w", "i"], stiffness=[(wall, "w"), (inner, "i")], mass=[np.eye(7)]),
            fmu.ModalData(measured, sensors=((1, "x"), (5, "x")), shapes=SEEN[of_chain].T, sd_hz=0.01),
            [fmu.Parameter(name, 1.0, 0.5, 2.0) for name in "wi"],
        )
        f = [np.sqrt(np.linalg.eigvalsh(w * wall + i * inner)) / (2 * np.pi) for w, i in theta]
        assert_allclose(problem.model.frequencies(theta), np.array(f)[:, of_chain], rtol=1e-9)
        assert_array_equal(problem.log_prob(theta), [problem.log_prob(point) for point in theta])


SEEN = np.array([[1.0, 1.0], [1.0, -1.0], [1.01, 1.0], [1.0, -0.99]])
"""Shapes of the modes of a chain at two sensors that are mirror images."""


CASES = {
    "young": (cantilever.beam(5), {f"E{g}": [("E", str(g))] for g in range(1, 6)}, [2.4e11] * 5, 1.7e11, 2.5e11),
    "section": (
        cantilever.beam(2),
        {"I1": [("Iy", "1")], "I2": [("Iy", "2")], "A1": [("A", "1")], "A2": [("A", "2")]},
        [7e-9, 7e-9, 8e-4, 8e-4],
        np.array([3.5e-9, 3.5e-9, 4.5e-4, 4.5e-4]),
        np.array([7.5e-9, 7.5e-9, 9e-4, 9e-4]),
    ),
}


@pytest.mark.parametrize("case", list(CASES))
def test_rank_in_the_weak_plane_is_the_assignment_by_shape(case):
    frame, updates, start, lower, upper = CASES[case]
    model = frame.separable(updates)
    full = full_blocks(model)
    sensors = np.array([model.dof(cantilever.SENSOR_NODE, "z")])
    everywhere = selection(model.translations, model.n_dof)
    by_shape = reference_modes(full, np.array(start), selection(sensors, model.n_dof), everywhere, 5)
    theta = np.random.default_rng(3).uniform(lower, upper, size=(40, len(start)))
    shape = by_shape.solve(full, theta, gradient=True)
    weak = next(b for b, block in enumerate(full) if sensors[0] in block.dofs)
    assert_array_equal(shape.block, weak)
    assert_array_equal(shape.rank, [range(5)] * 40)
    rank = RankPairing((weak,) * 5, tuple(range(5))).solve(full, theta, gradient=True)
    assert_allclose(rank.eigenvalues, shape.eigenvalues, rtol=1e-6)
    assert_allclose(rank.gradient, shape.gradient, rtol=1e-6, atol=1e-9 * np.abs(shape.gradient).max())
    numbers = IndexPairing((1, 3, 5, 7, 9)).solve(full, theta)
    assert np.any(numbers.block != weak)


def turned_cantilever(quotient):
    """Return a cantilever in general orientation, Iy = θ·Iz, and the frequencies of its two planes at θ."""
    R = Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix()
    Iz, A = 4e-8, 4e-4
    nodes = np.linspace(0, 1, 11)[:, None] * R[:, 0]
    elements = np.stack([np.arange(10), np.arange(1, 11)], axis=1)
    group = ElementGroup("b", elements, Section(A, 0.8 * Iz, Iz, 2e-7), STEEL, tuple(R[:, 1]))
    model = Frame(nodes, [group], {0: DIRECTIONS}).separable({"Iy": [("Iy", "b")]})
    slender = 1.8751040687**2 * np.sqrt(2.1e11 / (7850 * A)) / (2 * np.pi)
    return model, slender * np.sqrt(quotient * Iz), slender * np.sqrt(Iz)


def test_shape_is_followed_through_a_crossing_inside_one_block():
    """Where Iy grows beyond Iz the first two modes change places in the spectrum, but not as shapes."""
    model, *_ = turned_cantilever(1.0)
    assert len(model.blocks) == 1
    full = full_blocks(model)
    reference = np.array([0.8 * 4e-8])
    everywhere = selection(model.translations, model.n_dof)
    pairing = reference_modes(full, reference, everywhere, everywhere, 2)
    solve = partial(pairing.solve, full)
    for quotient, ranks in ((0.7, [0, 1]), (0.95, [0, 1]), (1.05, [1, 0]), (1.4, [1, 0])):
        _, soft, stiff = turned_cantilever(quotient)
        modes = solve(np.array([[quotient * 4e-8]]), gradient=True)
        assert_allclose(frequency_hz(modes.eigenvalues[0]), [soft, stiff], rtol=2e-3)
        assert_array_equal(modes.rank[0], ranks)
        # λ of the soft plane is proportional to Iy but for rotary inertia; that of the other does not know it
        slope = modes.gradient[0, :, 0] * quotient * 4e-8 / modes.eigenvalues[0]
        assert_allclose(slope, [1.0, 0.0], atol=2e-3)


def test_gradient_of_pairing_by_shape_in_a_coupled_frame():
    leg = np.linspace(0.0, 1.0, 6)
    nodes = np.concatenate(
        [np.outer(leg, [1.2, 0.1, 0]), np.outer(leg[1:], [0.1, 0.7, 0.3]) + np.array([1.2, 0.1, 0])]
    )
    elements = np.stack([np.arange(10), np.arange(1, 11)], axis=1)
    section = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6)
    groups = [
        ElementGroup(str(g), part, section, STEEL, (0, 0.3, 1)) for g, part in enumerate(np.split(elements, 2))
    ]
    model = Frame(nodes, groups, {0: DIRECTIONS}).separable(
        {"E": [("E", "0")], "A": [("A", "1")], "I": [("Iy", "0")]}
    )
    assert len(model.blocks) == 1
    full, start = full_blocks(model), np.array([2.1e11, 3e-3, 4e-6])
    everywhere = selection(model.translations, model.n_dof)
    solve = partial(reference_modes(full, start, everywhere, everywhere, 5).solve, full)
    theta = start * [1.1, 0.9, 1.05]
    gradient = solve(theta[None], gradient=True).gradient[0]
    largest = np.abs(gradient).max(axis=0)
    slopes = differences(lambda theta: solve(theta).eigenvalues, theta[None], 0.01 * theta, order=6)[0]
    assert_allclose(gradient / largest, slopes / largest, rtol=1e-6, atol=1e-7)


def test_more_modes_than_the_structure_has():
    with pytest.raises(ValueError, match=r"^count: must lie in 1\.\.4, the modes of the structure \(got 5\)$"):
        solve_spectrum(crossing(), np.array([[2.0]]), 5)


@pytest.mark.parametrize("numbers", [(), (0, 1), (-1,), (2, 2)])
def test_numbers_of_modes(numbers):
    with pytest.raises(ValueError, match=r"^numbers: must be distinct and count from 1 \(got \("):
        IndexPairing(numbers)


def test_constant_assignment_is_told_from_one_that_changes():
    model, *_ = turned_cantilever(1.0)
    full = full_blocks(model)
    everywhere = selection(model.translations, model.n_dof)
    pairing = reference_modes(full, np.array([3.2e-8]), everywhere, everywhere, 2)

    def at(quotients):
        theta = 4e-8 * np.array(quotients)[:, None]
        lam, phi = full[0].modes(theta, pairing.n_candidates(full, 0))
        return pairing.constant(full, {0: lam}, {0: phi})

    assert at([0.7, 0.8, 0.95]) == RankPairing((0, 0), (0, 1))
    assert at([1.1, 1.3]) == RankPairing((0, 0), (1, 0))
    assert at([0.7, 1.3]) is None
