"""Modes as sensors see them: derivatives against differences, full against reduced, rows against a batch."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, PointMass, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.derivatives import by_bordered_system
from fmu.fem.modes.separable import RigidArm
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.reduced.reduced_structure import train
from tests.gradients import differences

START = np.array([2.1e11, 2.0e11, 8e-4])
SENSORS = ((4, "x"), (8, "-z"), ("skin", "y"), ("skin", "z"))


def bracket():
    """An L of two different members in space, so that every plane is coupled with every other."""
    steel, section = Material(2.1e11, 0.3, 7850.0), Section(A=8e-4, Iy=6e-8, Iz=9e-8, J=1e-7)
    nodes = [(0.2 * k, 0, 0) for k in range(5)] + [(0.8, 0.15 * k, 0.05 * k) for k in range(1, 5)]
    elements = [(k, k + 1) for k in range(8)]
    groups = [
        ElementGroup("arm", elements[:4], section, steel),
        ElementGroup("tip", elements[4:], section, steel, y_direction=(0.3, 0.0, 1.0)),
    ]
    return Frame(
        np.array(nodes, dtype=float),
        groups,
        {0: DIRECTIONS},
        [PointMass(6, 0.5)],
        arms={"skin": RigidArm(8, (0.0, 0.02, 0.05))},
    )


def paired(pairing, **options):
    model = bracket().separable({"E arm": [("E", "arm")], "E tip": [("E", "tip")], "A tip": [("A", "tip")]})
    return PairedStructure.of(
        model, pairing=pairing, numbers=(1, 2, 3, 4), sensors=SENSORS, reference=START, **options
    )


@pytest.fixture(scope="module", params=["shape", "index"])
def full(request):
    return paired(request.param)


@pytest.fixture(scope="module", params=["shape", "index"])
def trained(request):
    return train(paired(request.param), 0.8 * START, 1.2 * START, tolerance=1e-9)[0]


def points(n):
    return START * np.random.default_rng(5).uniform(0.85, 1.15, (n, 3))


def aligned(shapes, reference):
    """Shapes (n, q, m) with the signs of a reference."""
    return shapes * np.where(np.sum(shapes * reference, axis=1, keepdims=True) < 0, -1.0, 1.0)


def check_derivatives(structure):
    theta = points(3)
    here = structure.observed(theta, gradient=True)

    def shapes(theta):
        return aligned(structure.observed(theta).shapes, np.tile(here.shapes, (len(theta) // 3, 1, 1)))

    slopes = differences(shapes, theta, 1e-3 * START, order=4)
    slopes_hz = differences(lambda theta: structure.observed(theta).frequencies, theta, 1e-3 * START, order=4)
    for k in range(3):
        largest = np.abs(slopes[..., k]).max()
        assert_allclose(here.shape_slopes[..., k], slopes[..., k], rtol=0, atol=1e-6 * largest)
        largest = np.abs(slopes_hz[..., k]).max()
        assert_allclose(here.frequency_slopes[..., k], slopes_hz[..., k], rtol=0, atol=1e-6 * largest)


def test_derivatives_of_the_full_model(full):
    check_derivatives(full)


def test_derivatives_of_the_reduced_model(trained):
    check_derivatives(trained)


def test_frequencies_are_those_of_the_model(full, trained):
    theta = points(3)
    for structure in (full, trained):
        assert_allclose(structure.observed(theta).frequencies, structure.frequencies(theta), rtol=1e-9)


def test_reduced_shapes_are_close_to_the_full_ones(trained):
    theta = points(10)
    seen, exact = trained.observed(theta, gradient=True), trained.truth.observed(theta)
    reference = trained.truth.observed(theta, gradient=True)
    size = np.abs(exact.shapes).max()
    assert_allclose(aligned(seen.shapes, exact.shapes), exact.shapes, rtol=0, atol=1e-4 * size)
    sign = np.sign(np.sum(seen.shapes * exact.shapes, axis=1))[:, None, :, None]
    for k in range(3):
        slopes, exact_slopes = sign[..., 0] * seen.shape_slopes[..., k], reference.shape_slopes[..., k]
        assert_allclose(slopes, exact_slopes, rtol=0, atol=5e-3 * np.abs(exact_slopes).max())


def test_beyond_the_trained_box_the_full_model_answers(trained):
    theta = np.stack([START, 1.5 * START])
    before = trained.full_solves
    seen, exact = trained.observed(theta, gradient=True), trained.truth.observed(theta, gradient=True)
    assert trained.full_solves == before + 1
    assert_array_equal(seen.shapes[1], exact.shapes[1])
    assert_array_equal(seen.shape_slopes[1], exact.shape_slopes[1])
    assert not np.array_equal(seen.shapes[0], exact.shapes[0])


def test_rows_do_not_depend_on_their_batch(trained):
    theta = points(7)
    together = trained.observed(theta, gradient=True)
    for i in range(7):
        alone = trained.observed(theta[i : i + 1], gradient=True)
        for name in ("frequencies", "shapes", "frequency_slopes", "shape_slopes"):
            assert_array_equal(getattr(alone, name)[0], getattr(together, name)[i], err_msg=name)


def test_arms_and_signs():
    """A rigid-body rotation moves a sensor on an arm by θ × r; a minus before a direction counts the other way."""
    model = bracket().separable({})
    rotation, about = np.array([0.3, -0.2, 0.5]), np.zeros(3)
    nodes = model.geometry.nodes
    motion = np.array(
        [
            (np.cross(rotation, nodes[node] - about) if d in "xyz" else rotation)[DIRECTIONS.index(d) % 3]
            for node, d in model.dofs
        ]
    )
    place = nodes[8] + [0.0, 0.02, 0.05]
    seen = model.observation(
        [("skin", "x"), ("skin", "y"), ("skin", "z"), ("skin", "-z"), (8, "-x"), ("skin", "ry")]
    )
    moved = np.cross(rotation, place)
    expected = [*moved, -moved[2], -np.cross(rotation, nodes[8])[0], rotation[1]]
    assert_allclose(seen @ motion, expected, rtol=1e-12)
    assert model.sees(("skin", "z"))
    assert not model.sees((0, "z"))
    with pytest.raises(ValueError, match=r"no free degree of freedom \(got node 0, 'z'\)"):
        model.observation([(0, "z")])


def test_in_one_block_a_number_is_a_rank(monkeypatch):
    """No further solve to sort the spectrum: there is nothing to sort it with."""
    structure, _ = train(paired("index"), 0.8 * START, 1.2 * START, tolerance=1e-9)
    assert len(structure.cheap.blocks) == 1
    expected = structure.frequencies(points(4))
    monkeypatch.setattr("fmu.fem.pairing.rules.solve_spectrum", None)
    assert_allclose(structure.observed(points(4)).frequencies, expected, rtol=1e-9)


def test_derivatives_overflow_in_silence_where_pieces_all_but_float():
    """A search that starts at a stiffness of 1e-305 N/m goes on from elsewhere."""
    terms = [np.zeros((5, 5)) for _ in range(5)]
    for i, one in enumerate(terms):
        ends = np.ix_(*[[i - 1, i]] * 2) if i else np.ix_([0], [0])
        one[ends] = [[1.0, -1.0], [-1.0, 1.0]] if i else 1.0
    K = np.tensordot([1e8, 1e-305, 1e8, 1e-305, 1e8], terms, 1)
    phi = np.array([0.0, 0.0, 0.0, 1.0, 1.0]) / np.sqrt(2e5)
    dK_phi = np.stack([one @ phi for one in terms], axis=1)
    slopes = by_bordered_system(K, 1e5 * np.eye(5), 0.0, phi, dK_phi, np.zeros((5, 5)))[1]
    assert not np.isfinite(slopes).all()
