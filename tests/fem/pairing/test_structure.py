"""The paired structure behind its reduced model: as good as the full one inside the box, the full one outside."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.separable import SeparableModel, Term
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.reduced.reduced_structure import restore, train
from tests import cantilever

LOWER = np.array([3.5e-9, 3.5e-9, 4.5e-4, 4.5e-4])
UPPER = np.array([7.5e-9, 7.5e-9, 9e-4, 9e-4])
START = np.array([7e-9, 7e-9, 8e-4, 8e-4])


def beam_in_halves(pairing):
    """Return the paper's second structure, fast enough to train here."""
    model = cantilever.beam(2).separable(
        {"I1": [("Iy", "1")], "I2": [("Iy", "2")], "A1": [("A", "1")], "A2": [("A", "2")]}
    )
    return PairedStructure.of(
        model, pairing=pairing, numbers=(1, 3, 5, 7, 9), sensors=((49, "z"),), reference=START
    )


def coupled_frame(pairing):
    """Return an L that no plane of motion decouples."""
    leg = np.linspace(0.0, 1.0, 6)
    nodes = np.concatenate(
        [np.outer(leg, [1.2, 0.1, 0]), np.outer(leg[1:], [0.1, 0.7, 0.3]) + np.array([1.2, 0.1, 0])]
    )
    elements = np.stack([np.arange(10), np.arange(1, 11)], axis=1)
    section, steel = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6), Material(E=2.1e11, nu=0.3, rho=7850.0)
    groups = [
        ElementGroup(str(g), part, section, steel, (0, 0.3, 1)) for g, part in enumerate(np.split(elements, 2))
    ]
    model = Frame(nodes, groups, {0: DIRECTIONS}).separable({"E": [("E", "0")], "A": [("A", "1")]})
    reference = np.array([2.1e11, 3e-3])
    return PairedStructure.of(model, pairing=pairing, numbers=(1, 2, 4), sensors=(), reference=reference)


BUILD = {
    "halves, shape": (beam_in_halves, "shape", LOWER, UPPER),
    "halves, index": (beam_in_halves, "index", LOWER, UPPER),
    "frame, shape": (coupled_frame, "shape", np.array([1.7e11, 2e-3]), np.array([2.5e11, 4e-3])),
    "frame, index": (coupled_frame, "index", np.array([1.7e11, 2e-3]), np.array([2.5e11, 4e-3])),
}


EACH = [
    pytest.param(name, marks=() if name in ("halves, shape", "frame, index") else pytest.mark.validate)
    for name in BUILD
]


@pytest.fixture(scope="module", params=EACH)
def trained(request):
    build, pairing, lower, upper = BUILD[request.param]
    structure, state = train(build(pairing), lower, upper)
    return structure, (build(pairing), state), lower, upper


def box_sample(lower, upper, n, seed):
    """Return points inside the box, on its faces and in its corners."""
    rng = np.random.default_rng(seed)
    unit = rng.uniform(size=(n, len(lower)))
    unit[n // 3 :] = np.where(
        rng.uniform(size=unit[n // 3 :].shape) < 0.4, np.round(unit[n // 3 :]), unit[n // 3 :]
    )
    unit[2 * n // 3 :] = np.round(unit[2 * n // 3 :])
    return lower + (upper - lower) * unit


def test_reduced_frequencies_are_within_the_tolerance_over_the_box(trained):
    structure, _, lower, upper = trained
    theta = box_sample(lower, upper, 90, seed=99)
    solves = structure.full_solves
    reduced, full = structure.frequencies(theta), np.sqrt(structure.truth.modes(theta).eigenvalues) / (2 * np.pi)
    # trained to 1e-6 at other points: a fresh one may exceed it, but not by much
    assert_allclose(reduced, full, rtol=2e-6)
    # Rayleigh: a subspace cannot lie below, save for the full solver's rounding in the lowest frequency
    assert np.all(reduced >= full * (1 - 1e-7))
    assert structure.full_solves - solves <= 0.1 * len(theta)
    pairs = zip(structure.cheap.blocks, structure.truth.blocks, strict=True)
    assert sum(r.size for r, f in pairs if r.size < f.size) < 0.5 * structure.structure.n_dof


def test_reduced_modes_carry_the_labels_of_the_full_ones(trained):
    structure, _, lower, upper = trained
    theta = box_sample(lower, upper, 30, seed=5)[:20]
    reduced, exact = (
        structure.modes(theta, gradient=True),
        structure.truth.solve(theta, gradient=True),
    )
    assert_array_equal(reduced.block, exact.block)
    assert_array_equal(reduced.rank, exact.rank)
    # relative change of λ over the box; a mode in a subspace is good to the square root of its frequency
    error = np.abs(reduced.gradient - exact.gradient) * (upper - lower) / exact.eigenvalues[..., None]
    assert error.max() < 2e-3


def test_outside_the_box_the_full_model_answers(trained):
    structure, _, lower, upper = trained
    theta = upper + 0.05 * (upper - lower) * np.arange(1, 4)[:, None]
    before = structure.full_solves
    assert_array_equal(structure.modes(theta).eigenvalues, structure.truth.modes(theta).eigenvalues)
    assert structure.full_solves == before + 3
    mixed = np.vstack([theta[:1], (lower + upper)[None] / 2, theta[1:]])
    together = structure.modes(mixed, gradient=True)
    for i, row in enumerate(mixed):
        alone = structure.modes(row[None], gradient=True)
        assert_array_equal(together.eigenvalues[i], alone.eigenvalues[0])
        assert_array_equal(together.block[i], alone.block[0])
        assert_allclose(together.gradient[i], alone.gradient[0], rtol=1e-12)


def test_batch_changes_no_bit(trained):
    structure, _, lower, upper = trained
    theta = box_sample(lower, upper, 33, seed=1)
    batch = structure.frequencies(theta)
    assert_array_equal(batch, np.concatenate([structure.frequencies(row[None]) for row in theta]))


def test_restored_structure_repeats_its_bits(trained):
    structure, (truth, state), lower, upper = trained
    again = restore(truth, state)
    theta = box_sample(lower, upper, 20, seed=2)
    assert_array_equal(again.frequencies(theta), structure.frequencies(theta))
    assert repr(again) == repr(structure)
    assert " vectors" in repr(again)


def test_where_the_reduced_model_cannot_be_sure_the_full_one_answers():
    structure, _ = train(beam_in_halves("index"), LOWER, UPPER)
    weak = max(structure.cheap.blocks, key=lambda block: block.n_trained)
    weak.n_trained = 3  # of the five that the numbers ask for
    theta = box_sample(LOWER, UPPER, 6, seed=4)
    assert_array_equal(structure.modes(theta).eigenvalues, structure.truth.modes(theta).eigenvalues)
    assert structure.full_solves == 6


def test_fingerprint_tells_structures_apart():
    prints = [beam_in_halves("shape"), beam_in_halves("index"), coupled_frame("index"), coupled_frame("shape")]
    assert len({p.fingerprint() for p in prints}) == 4
    assert beam_in_halves("shape").fingerprint() == prints[0].fingerprint()
    heavier = cantilever.beam(2)
    heavier = Frame(heavier.nodes, heavier.groups, heavier.supports).separable(
        {"I1": [("Iy", "1")], "I2": [("Iy", "2")], "A1": [("A", "1")], "A2": [("A", "2")]}
    )
    other = PairedStructure.of(heavier, pairing="index", numbers=(1, 3, 5, 7, 9), sensors=(), reference=START)
    assert other.fingerprint() != prints[1].fingerprint()


def test_unknown_pairing_and_sensor():
    model = cantilever.beam(1).separable({"E": [("E", "1")]})
    options = {"numbers": (1,), "reference": np.array([2.1e11])}
    with pytest.raises(ValueError, match=r"^pairing: must be one of \('shape', 'index', 'soft'\) \(got 'mac'\)$"):
        PairedStructure.of(model, pairing="mac", sensors=(), **options)
    with pytest.raises(ValueError, match=r"^sensor: the model has no free degree of freedom \(got node 0, 'z'\)$"):
        PairedStructure.of(model, pairing="shape", sensors=((0, "z"),), **options)


@pytest.mark.parametrize("pairing", ["shape", "index"])
@pytest.mark.parametrize("build", [beam_in_halves, coupled_frame])
def test_full_shapes_are_those_of_the_paired_modes(build, pairing):
    structure = build(pairing)
    theta = 0.95 * (START if build is beam_in_halves else np.array([2.1e11, 3e-3]))
    shapes, K, M = structure.truth.shapes(theta), structure.structure.K(theta), structure.structure.M(theta)
    lam = structure.truth.modes(theta[None]).eigenvalues[0]
    assert_allclose(shapes.T @ (M @ shapes), np.eye(len(lam)), atol=1e-9)
    assert_allclose(np.sum(shapes * (K @ shapes), axis=0), lam, rtol=1e-8)
    residual = K @ shapes - (M @ shapes) * lam
    assert np.all(np.linalg.norm(residual, axis=0) < 1e-5 * np.linalg.norm(K @ shapes, axis=0))


def test_a_mode_of_one_plane_moves_nothing_out_of_it():
    structure = beam_in_halves("shape")
    moved = np.any(structure.truth.shapes(START) != 0.0, axis=1)
    assert {d for (_, d), m in zip(structure.structure.dofs, moved, strict=True) if m} == {"z", "ry"}


def test_shapes_of_modes_that_cannot_be_solved_are_nan():
    """The stiffness of the first of two oscillators overflows; the frequencies of all modes are then unknown."""
    model = SeparableModel(
        [Term(np.diag([1.0, 0.0]), (2,)), Term(np.diag([0.0, 2e4]), (0,))], [Term(np.eye(2), (0,))]
    )
    structure = PairedStructure.of(model, pairing="index", numbers=(1, 2), sensors=(), reference=np.array([100.0]))
    assert np.isfinite(structure.shapes(np.array([100.0]))).all()
    overflowing = np.array([1e200])
    assert np.isnan(structure.frequencies(overflowing[None])).all()
    assert np.isnan(structure.shapes(overflowing)).all()
