"""Derivatives of a reduced structure at all candidates, and a model of some modes at some sensors."""

import numpy as np
import pytest

import fmu
from fmu.analysis.plan.sensitivities import SHAPE_ERROR, of_structure, paired_with_itself, pick_modes
from fmu.fem.pairing.modal_model import PartialModel
from tests.gradients import differences
from tests.shear_building import shear_building
from tests.validation.scale_model import E, Size, frame_model

START = np.full(4, E)


@pytest.fixture(scope="module")
def reduced():
    model = frame_model(Size(4, 3, 2), 4)
    sensors = [dof for dof in model.dofs if dof[1] in "xy"]
    theta = E * (1.0 + 0.07 * np.random.default_rng(0).standard_normal((8, 4)))
    paired = paired_with_itself(model, START, sensors, 4)
    return paired, theta, of_structure(paired, theta, START)


def test_shapes_of_the_reduced_structure_are_certified(reduced):
    paired, theta, found = reduced
    assert found.certificate is not None
    assert found.certificate.ok
    full = paired.observed(theta[-2:], True)
    sign = np.sign(np.sum(full.shapes * found.seen.shapes[-2:], axis=1, keepdims=True))
    largest = np.max(np.abs(full.shapes), axis=1, keepdims=True)
    assert np.max(np.abs(sign * found.seen.shapes[-2:] - full.shapes) / largest) < SHAPE_ERROR
    size = np.max(np.abs(full.shape_slopes))
    assert np.max(np.abs(sign[..., None] * found.seen.shape_slopes[-2:] - full.shape_slopes)) < 0.02 * size


def test_other_sensors_see_the_same_modes(reduced):
    paired, theta, found = reduced
    few = found.model.seen_by(paired.sensors[5:9])
    np.testing.assert_allclose(few.observed(theta).shapes, found.seen.shapes[:, 5:9], rtol=1e-9, atol=1e-12)


def test_a_partial_model_has_the_gradients_of_its_modes():
    model = shear_building(["a", "a", "b", "b"], 1e6, 100.0)
    whole = paired_with_itself(model, np.ones(2), [(i, "x") for i in range(4)], 3)
    part, theta = PartialModel(whole, [2, 0], [3, 1]), np.array([[1.1, 0.9]])
    seen, every = part.observed(theta, True), whole.observed(theta, True)
    np.testing.assert_array_equal(seen.shapes, every.shapes[:, [3, 1]][:, :, [2, 0]])
    slopes = differences(part.frequencies, theta, 1e-4)[0]
    np.testing.assert_allclose(part.frequencies_and_gradient(theta)[1][0], slopes, rtol=1e-5)
    np.testing.assert_allclose(seen.frequency_slopes[0], slopes, rtol=1e-5)


def test_the_lowest_modes_that_candidates_see_are_picked():
    model = frame_model(Size(2, 2, 2), 2)
    start, sides = np.full(2, E), [dof for dof in model.dofs if dof[1] == "x"]
    picked, paired = pick_modes(model, start, sides, 2)
    everywhere = paired.shapes(start)[model.translations]
    along = np.array([dof[1] == "x" for dof in model.dofs])[model.translations]
    for i in range(max(picked) + 1):
        moves = np.max(np.abs(everywhere[along, i])) > 1e-6 * np.max(np.abs(everywhere[:, i]))
        assert moves == (i in picked)


def test_expected_modes_of_a_structure_and_of_its_function():
    model = shear_building(["a", "b"], 1e6, 100.0)
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in ("a", "b")]
    data = fmu.expected_modes(model, parameters, 2, 0.01)
    np.testing.assert_allclose(data.sd_hz, 0.01 * data.frequencies_hz)
    paired = paired_with_itself(model, np.ones(2), [(0, "x"), (1, "x")], 2)

    def solve(theta):
        seen = paired.observed(theta[None])
        return seen.frequencies[0], seen.shapes[0]

    function = fmu.BlackBoxModel(solve, 2)
    other = fmu.expected_modes(function, parameters, 2, sensors=[(0, "x"), (1, "x")])
    np.testing.assert_allclose(other.frequencies_hz, data.frequencies_hz, rtol=1e-9)
    assert np.shape(other.shapes) == (2, 2)
    with pytest.raises(ValueError, match=r"sensors: must be one for each row of shapes"):
        fmu.expected_modes(function, parameters, 2, sensors=[(0, "x")])
    with pytest.raises(ValueError, match=r"n_modes: must be at most 2"):
        fmu.expected_modes(function, parameters, 3, sensors=[(0, "x"), (1, "x")])
