"""The modal residual of eq. (2): zero at the model's own modes, with an exact gradient."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fmu.fem.condensation import guyan
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.modal import frequency_hz
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.residual import ModalResidual
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.problem import UpdatingProblem
from tests.gradients import assert_gradient, differences

SENSORS = tuple((node, "z") for node in (2, 4, 6, 8))
THETA = np.array([2.1e11, 4e-6, 7850.0])


@pytest.fixture(scope="module")
def beam():
    nodes = np.linspace(0, 1.2, 9)[:, None] * [1.0, 0.0, 0.0]
    elements = np.stack([np.arange(8), np.arange(1, 9)], axis=1)
    section, steel = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6), Material(E=2.1e11, nu=0.3, rho=7850.0)
    groups = [ElementGroup(str(g), part, section, steel) for g, part in enumerate(np.split(elements, 2))]
    updates = {"E": [("E", "0")], "I": [("Iy", "1"), ("Iy", "0")], "rho": [("rho", "1")]}
    return Frame(nodes, groups, {0: DIRECTIONS}).separable(updates)


def condensed_modes(model, theta, count):
    sensors = np.array([model.dof(*sensor) for sensor in SENSORS])
    reduced = guyan(model.K(theta), model.M(theta), sensors)
    lam, shapes = reduced.eigen(count)
    return frequency_hz(lam), shapes[sensors], reduced


@pytest.fixture(scope="module")
def data(beam):
    """Return three modes of the condensed model at THETA, each in a scale of its own."""
    frequencies, shapes, _ = condensed_modes(beam, THETA, 3)
    return ModalData(frequencies, sensors=SENSORS, shapes=shapes * [1.0, -20.0, 0.3])


def test_residual_vanishes_at_the_modes_of_the_condensed_model(beam, data):
    residual = ModalResidual(beam, data, THETA * 1.1, beta=[1.0, 2.0, 1e8])
    # what is left is the normaliser of eq. (5), four sensors each
    assert_allclose(residual.terms(THETA[None])[0], 2.0 * np.log(np.array([1.0, 2.0, 1e8]) / np.pi), rtol=1e-7)
    moved = residual.terms(THETA[None] * [0.9, 1.1, 1.0])[0]
    assert np.all(moved < residual.terms(THETA[None])[0])


def test_residual_is_eq_2_on_the_condensed_matrices(beam, data):
    reference, theta, beta = THETA * [1.1, 0.9, 1.0], THETA * [0.8, 1.2, 1.1], np.array([1.0, 3.0, 0.5])
    _, _, at_theta = condensed_modes(beam, theta, 1)
    _, _, at_reference = condensed_modes(beam, reference, 1)
    expected = []
    for i in range(3):
        lam, phi = (2 * np.pi * data.frequencies_hz[i]) ** 2, data.shapes[:, i]
        force = at_theta.K @ phi - lam * (at_theta.M @ phi)
        size = np.linalg.norm(force) / np.linalg.norm(at_reference.K @ phi)
        expected.append(2.0 * np.log(beta[i] / np.pi) - beta[i] * size**2)
    terms = ModalResidual(beam, data, reference, beta=beta).terms(theta[None])
    assert_allclose(terms[0], expected, rtol=1e-8)


def test_scale_of_a_measured_shape_does_not_matter(beam, data):
    scaled = ModalData(data.frequencies_hz, sensors=SENSORS, shapes=data.shapes * [-3.0, 1e-3, 100.0])
    theta = THETA[None] * [0.8, 1.2, 1.1]
    expected = ModalResidual(beam, data, THETA).terms(theta)
    assert_allclose(ModalResidual(beam, scaled, THETA).terms(theta), expected, rtol=1e-10)


def test_gradient_against_differences(beam, data):
    residual = ModalResidual(beam, data, THETA * 1.1, beta=[1.0, 3.0, 0.5])
    theta = THETA * [0.8, 1.2, 1.1]
    terms, gradient = residual.terms_and_gradient(np.stack([theta, THETA]))
    assert_allclose(terms, residual.terms(np.stack([theta, THETA])), rtol=1e-12)
    largest = np.abs(gradient[0]).max(axis=0)
    slopes = differences(residual.terms, theta[None], 0.01 * theta, order=6)[0]
    assert_allclose(gradient[0] / largest, slopes / largest, rtol=1e-6, atol=1e-7)


def parameters(**changes):
    names, units = ("E", "I", "rho"), ("N/m²", "m⁴", "kg/m³")
    return [
        Parameter(n, start=t, lower=0.6 * t, upper=1.6 * t, prior=Normal(t, mean=t), unit=u, **changes)
        for n, t, u in zip(names, THETA, units, strict=True)
    ]


def test_problem_with_the_modal_residual(beam, data):
    problem = UpdatingProblem(beam, data, parameters(), error="modal-residual", beta=50.0)
    theta = THETA * [0.8, 1.2, 1.1]
    value, gradient = problem.log_prob_and_grad(theta)
    assert value == pytest.approx(problem.log_likelihood(theta) + problem.log_prior(theta), rel=1e-12)
    assert problem.log_prob(theta) == pytest.approx(value, rel=1e-12)
    assert problem.log_likelihood(THETA) > problem.log_likelihood(theta)
    assert_gradient(gradient, problem.log_prob, theta, 1e-4 * problem.scale, of_largest=1e-5)
    assert problem.configuration()["likelihood"]["error"] == "modal-residual"
    with pytest.raises(ValueError, match=r"^error: must be a distribution of the frequencies to simulate them$"):
        problem.simulate_data(np.random.default_rng(0), problem.frequencies(theta))


def test_measured_shapes_pair_by_shape(beam, data):
    """In the order of the measurement, whatever the order of the spectrum."""
    order = [2, 0, 1]
    swapped = ModalData(data.frequencies_hz[order], sensors=SENSORS, shapes=data.shapes[:, order])
    problem = UpdatingProblem(beam, swapped, parameters())
    assert_allclose(problem.frequencies(THETA), data.frequencies_hz[order], rtol=0.05)


def test_a_theta_without_stiffness_is_no_exception(beam, data):
    unbounded = [
        Parameter(n, start=t, prior=Normal(t, mean=t)) for n, t in zip(("E", "I", "rho"), THETA, strict=True)
    ]
    problem = UpdatingProblem(beam, data, unbounded, error="modal-residual")
    assert problem.log_prob(np.array([0.0, 0.0, 1.0])) == -np.inf
    assert problem.log_prob_and_grad(np.array([0.0, 0.0, 1.0]))[0] == -np.inf
    assert problem.n_failures == 2
    assert [failed.reason for failed in problem.failures] == [
        "the structure can still move when the sensors are held"
    ]


def test_wrong_input(beam, data):
    bare = ModalData(data.frequencies_hz, sensors=SENSORS)
    with pytest.raises(
        ValueError, match=r"^data\.shapes: the modal residual needs measured shapes at the sensors \(got none\)$"
    ):
        ModalResidual(beam, bare, THETA)
    # with a sensor that is counted twice, no residual vanishes at the model's own modes
    twice = ModalData(data.frequencies_hz, sensors=(*SENSORS, SENSORS[1]), shapes=data.shapes[[0, 1, 2, 3, 1]])
    with pytest.raises(ValueError, match=r"sensors: .* different degrees of freedom; .* \(got \(4, 'z'\)\)$"):
        ModalResidual(beam, twice, THETA)
    for beta, message in (
        ([1.0], r"beta: must be a number or 3 numbers \(got shape \(1,\)\)"),
        ([1.0, 1.0, -1.0], r"beta: must be positive and finite \(got \[1\.0, 1\.0, -1\.0\]\)"),
    ):
        with pytest.raises(ValueError, match=f"^{message}$"):
            ModalResidual(beam, data, THETA, beta=beta)
    with pytest.raises(
        ValueError,
        match=r"^error: must be one of \('frequency', 'modal-residual'\), or error models \(got 'mac'\)$",
    ):
        UpdatingProblem.reduced(beam, data, parameters(), error="mac")


def test_structure_that_moves_with_its_sensors_held(beam, data):
    free = Frame(
        [[0.0, 0, 0], [1.0, 0, 0]],
        [ElementGroup("0", [(0, 1)], Section(3e-3, 4e-6, 9e-6, 7e-6), Material(2e11, 0.3, 7850.0))],
    )
    model = free.separable({"E": [("E", "0")]})
    one = ModalData([100.0], sensors=((0, "x"),), shapes=[[1.0]])
    moving = ModalData([100.0], sensors=((0, "z"),), shapes=[[1.0]])
    with pytest.raises(ValueError, match=r"^sensors: the structure can still move when they are held$"):
        ModalResidual(model, moving, np.array([2e11]))
    assert ModalResidual(model, one, np.array([2e11])) is not None


def test_residual_needs_a_structure(oscillators, data):
    with pytest.raises(
        ValueError, match=r"^error: the modal residual needs a SeparableModel \(got Oscillators\)$"
    ):
        UpdatingProblem.reduced(oscillators(3), data, parameters(), error="modal-residual")
