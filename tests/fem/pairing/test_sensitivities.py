"""Second derivatives of frequencies and of shapes, against differences and closed forms."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu.fem.modes.full_block import full_blocks
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import Term
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.pairing.rules import RankPairing
from fmu.fem.pairing.sensitivities import Steps, StructureSensitivities
from fmu.fem.reduced.basis import ReducedBlock
from fmu.fem.reduced.reduced_structure import train
from tests.fem.modes import massless_bridge
from tests.fem.modes.test_observed import bracket
from tests.gradients import differences
from tests.shear_building import shear_building
from tests.veering import veering_problem

START = np.array([2.1e11, 2.0e11, 1.0])
SENSORS = ((4, "x"), (8, "-z"), ("skin", "y"), ("skin", "z"))


def plate_like():
    """The bracket, whose tip has a thickness t: it bends by E t³, and its axial stiffness and mass are as t."""
    model = bracket().separable({"E arm": [("E", "arm")], "E tip": [("E", "tip")], "t": [("A", "tip")]})
    terms = []
    for of_matrix in (model.K_terms, model.M_terms):
        bends = of_matrix is model.K_terms
        terms.append(
            [
                Term(t.matrix * 8e-4 ** t.powers[2], (*t.powers[:2], t.powers[2] or 3 * bends * t.powers[1]))
                for t in of_matrix
            ]
        )
    return SeparableModel(*terms, model.dofs, model.geometry, model.arms)


def structure(kind):
    """A full or reduced model with its start."""
    where, pairing = kind.split(" by ")
    massless = where.startswith("massless")
    start = massless_bridge.START if massless else START
    model = massless_bridge.bridge(5) if massless else plate_like()
    sensors = ((2, "z"), (7, "z"), (3, "y"), (6, "ry")) if massless else SENSORS
    paired = PairedStructure.of(model, pairing=pairing, numbers=(1, 2, 3, 4), sensors=sensors, reference=start)
    return (train(paired, 0.8 * start, 1.2 * start, tolerance=1e-8)[0] if "reduced" in where else paired), start


KINDS = [
    "full by index",
    "full by shape",
    "reduced by shape",
    "massless reduced by index",
    *(pytest.param(kind, marks=pytest.mark.validate) for kind in ("reduced by index", "massless by index")),
]


@pytest.fixture(scope="module", params=KINDS)
def model_and_start(request):
    return structure(request.param)


def points(start, n):
    return start * np.random.default_rng(5).uniform(0.85, 1.15, (n, len(start)))


def directions(theta, m):
    """Directions of lengths that differ as those of a discrepancy do."""
    return theta[:, None] * np.random.default_rng(6).standard_normal((len(theta), m, theta.shape[1]))


def steps_of(theta, start):
    return Steps(np.abs(theta), np.array([0.5 * start, 2.0 * start]))


def test_second_derivatives_against_differences_of_the_gradients(model_and_start):
    model, start = model_and_start
    theta = points(start, 2)
    d = directions(theta, model.n_modes)
    found = model.sensitivities(theta, steps_of(theta, start))
    f, J = model.frequencies_and_gradient(theta)
    assert_allclose(found.frequencies, f, rtol=1e-9)
    unit = theta[:, None]
    assert_allclose(found.gradient * unit, J * unit, atol=1e-7 * np.abs(J * unit).max())
    H = differences(lambda x: model.frequencies_and_gradient(x)[1], theta, 1e-3 * start, order=6)
    expected = np.einsum("nmkl,nml->nmk", H, d) * unit
    assert_allclose(found.curvature(d) * unit, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def weights_of(model, theta):
    """Weights of the second derivatives of the shapes at the sensors, of sizes that make all parts matter."""
    seen = model.observed(theta[:1])
    shape = (len(theta), *seen.shapes.shape[1:], theta.shape[1])
    size = np.max(np.abs(seen.shapes), axis=(0, 1))[:, None]
    return theta[:, None, None] * np.random.default_rng(7).standard_normal(shape) / size


def test_second_derivatives_of_shapes_against_differences_of_their_slopes(model_and_start):
    model, start = model_and_start
    theta = points(start, 2)
    found = model.sensitivities(theta, steps_of(theta, start), True)
    weights, seen = weights_of(model, theta), model.observed(theta, True)
    assert_allclose(found.shapes, seen.shapes, atol=1e-9 * np.abs(seen.shapes).max())
    unit = theta[:, None, None]
    size = np.abs(seen.shape_slopes * unit).max()
    assert_allclose(found.shape_slopes * unit, seen.shape_slopes * unit, atol=1e-7 * size)

    def slopes(x):
        there = model.observed(x, True)
        at = np.linalg.norm(x[:, None] / start - theta / start, axis=2).argmin(axis=1)
        sign = np.sign(np.sum(there.shapes * seen.shapes[at], axis=1))
        return np.sum(weights[at] * sign[:, None, :, None] * there.shape_slopes, axis=(1, 3))

    expected = differences(slopes, theta, 1e-3 * start, order=6) * theta[:, None]
    directions_of_none = np.zeros((2, model.n_modes, len(start)))
    bent = found.curvature(directions_of_none, weights) * theta[:, None]
    assert_allclose(bent, expected, rtol=0, atol=1e-5 * np.abs(expected).max())


def test_a_row_does_not_depend_on_its_batch(model_and_start):
    model, start = model_and_start
    theta = points(start, 5)
    d = directions(theta, model.n_modes)
    together, weights = model.sensitivities(theta, steps_of(theta, start), True), weights_of(model, theta)
    curvature = together.curvature(d, weights)
    for i in range(5):
        alone = model.sensitivities(theta[i : i + 1], steps_of(theta[i : i + 1], start), True)
        assert_array_equal(alone.frequencies[0], together.frequencies[i])
        assert_array_equal(alone.gradient[0], together.gradient[i])
        assert_array_equal(alone.curvature(d[i : i + 1], weights[i : i + 1])[0], curvature[i])


def test_beyond_the_trained_box_the_full_model_answers():
    model, start = structure("reduced by shape")
    theta, before = np.stack([start, 1.5 * start, 1.01 * start]), model.full_solves
    d = directions(theta, 4)
    found = model.sensitivities(theta, steps_of(theta, start))
    assert model.full_solves == before + 1
    exact = model.truth.sensitivities(theta, steps_of(theta, start))
    assert_array_equal(found.curvature(d)[1], exact.curvature(d)[1])
    assert_array_equal(found.gradient[1], exact.gradient[1])
    assert not np.array_equal(found.gradient[0], exact.gradient[0])


def test_a_batch_that_is_solved_in_parts_is_the_whole():
    model, start = structure("reduced by index")
    theta = points(start, 5)
    d = directions(theta, 4)
    whole = model.sensitivities(theta, steps_of(theta, start)).curvature(d)
    model._at_once = 2
    assert_array_equal(model.sensitivities(theta, steps_of(theta, start)).curvature(d), whole)


def pair_of_modes(kind, coupling, turned):
    """K = θ₁ e₁e₁ᵀ + θ₂ e₂e₂ᵀ + c (e₁ − e₂)(e₁ − e₂)ᵀ + 10⁴ e₃e₃ᵀ in other coordinates: λ₁, λ₂ in closed form."""
    Q = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0] if turned else np.eye(3)
    first, second, third = Q.T[:, :, None] * Q.T[:, None]
    link = np.outer(Q[:, 0] - Q[:, 1], Q[:, 0] - Q[:, 1])
    K = [Term(first, (1, 0)), Term(second, (0, 1)), Term(coupling * link + 1e4 * third, (0, 0))]
    full = full_blocks(SeparableModel(K, [Term(np.eye(3), (0, 0))]))
    blocks = full if kind == "full" else (ReducedBlock(full[0], np.eye(3), 2),)
    pairing = RankPairing((0, 0), (0, 1))

    def sensitivities(theta):
        return StructureSensitivities(blocks, pairing.locate(blocks, theta, True), pairing.counts(blocks), theta)

    return sensitivities


def closed_form(theta, coupling, d):
    """f of both modes and H d: with h = (θ₁ − θ₂)/2 and R = √(h² + c²), λ = (θ₁ + θ₂)/2 + c ∓ R."""
    h = 0.5 * (theta[:, 0] - theta[:, 1])
    R = np.hypot(h, coupling)
    lam = 0.5 * (theta[:, 0] + theta[:, 1]) + coupling + np.array([[-1.0], [1.0]]) * R
    J = 0.5 + np.array([-0.5, 0.5])[:, None, None] * (h / R)[:, None] * np.array([1.0, -1.0])
    H = (
        np.array([-0.25, 0.25])[:, None, None, None]
        * (coupling**2 / R**3)[:, None, None]
        * [[1.0, -1.0], [-1.0, 1.0]]
    )
    f = np.sqrt(lam) / (2 * np.pi)
    Hf = H / (8 * np.pi**2 * f[..., None, None]) - J[..., None] * J[..., None, :] / (
        64 * np.pi**4 * f[..., None, None] ** 3
    )
    return f.T, np.einsum("mnkl,nml->nmk", Hf, d)


@pytest.mark.parametrize("kind", ["full", "reduced"])
@pytest.mark.parametrize("gap", [1e-2, 1e-4, 1e-6])
def test_close_roots_against_the_closed_form(kind, gap):
    """The second derivatives grow as 1/gap; their relative rounding is that of the shapes, 1e4 · 1e-16 / gap."""
    coupling = 0.3 * gap
    theta = np.array([[1.0, 1.0 + 0.8 * gap]])
    d = np.array([[[1.0, 0.4], [-0.2, 0.7]]])
    found = pair_of_modes(kind, coupling, turned=True)(theta)
    f, expected = closed_form(theta, coupling, d)
    assert_allclose(found.frequencies, f, rtol=1e-11)
    assert_allclose(found.curvature(d), expected, rtol=1e-11 / gap)
    assert np.abs(expected).max() > 0.005 / gap


@pytest.mark.parametrize("kind", ["full", "reduced"])
def test_modes_that_cross_without_coupling_do_not_see_each_other(kind):
    """f = √θ/2π of each: f'' = −f/4θ². Where they are equal, any rotation of the shapes would do."""
    for gap, tolerance in ((1e-3, 1e-7), (1e-5, 1e-4)):
        theta = np.array([[1.0, 1.0 + gap]])
        found = pair_of_modes(kind, 0.0, turned=True)(theta)
        d = np.ones((1, 2, 2))
        expected = np.eye(2) * (-found.frequencies[0] / (4 * theta[0] ** 2))[:, None]
        assert_allclose(found.curvature(d)[0], expected, rtol=0, atol=tolerance * 0.04)
    for gap in (1e-8, 1e-11, 0.0):
        found = pair_of_modes(kind, 0.0, turned=True)(np.array([[1.0, 1.0 + gap]]))
        assert np.all(np.abs(found.curvature(np.ones((1, 2, 2)))) < 0.2)


def test_a_pair_by_shape_where_modes_veer():
    problem = veering_problem(c=0.02)
    theta = np.array([[0.95, 1.05], [1.04, 1.05], [1.2, 1.0]])
    d = directions(theta, 2)
    model = problem.model
    found = model.sensitivities(theta, steps_of(theta, np.ones(2)))
    H = differences(lambda x: model.frequencies_and_gradient(x)[1], theta, 1e-4, order=6)
    expected = np.einsum("nmkl,nml->nmk", H, d)
    assert_allclose(found.curvature(d), expected, rtol=0, atol=1e-7 * np.abs(expected).max())


def test_each_of_several_tests_has_directions_of_its_own():
    """The third test always has the parameters of the first: one solve serves both."""
    names = ["k1", "k2", "k3"]
    tests = [
        fmu.Test(name, fmu.ModalData(f), group)
        for name, f, group in (
            ("a", [0.08, 0.2], "intact"),
            ("b", [0.07, 0.2, 0.3], "worn"),
            ("c", [0.08], "intact"),
        )
    ]
    parameters = [fmu.Parameter(name, 1.0, 0.5, 2.0) for name in names]
    problem = fmu.JointProblem(
        shear_building(names), tests, parameters, varies={"k2": fmu.Damage()}, pairing="index"
    )
    model = problem.model
    theta = problem.model_parameters(problem.sample_prior(np.random.default_rng(1), 2))
    n, m, p = 2, model.n_modes, 3
    d = np.random.default_rng(2).standard_normal((n, m, p))
    bounds = np.array([[0.4] * p, [2.5] * p])
    found = model.sensitivities(theta, Steps(np.abs(theta), bounds))
    assert_array_equal(found.gradient, model.frequencies_and_gradient(theta)[1])
    H = differences(lambda x: model.frequencies_and_gradient(x)[1], theta, 1e-3, order=6)
    H = H.reshape(n, m, p, 3, p).sum(axis=3)  # by the parameters of the test, wherever it is solved
    expected = np.einsum("nmkl,nml->nmk", H, d)
    assert_allclose(found.curvature(d), expected, rtol=1e-8, atol=1e-9 * np.abs(expected).max())
