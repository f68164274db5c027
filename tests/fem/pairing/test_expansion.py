"""Expansion of measured shapes: exact where theory says so, and wrong signs or sensors do not pass."""

import numpy as np
import pytest
import scipy.sparse as sp

import fmu
from fmu.fem.modes.modal import mac
from fmu.fem.pairing.expansion import dynamic, expand, serep

N = 30


@pytest.fixture(scope="module")
def beam():
    """A cantilever of beam elements, its modes and frequencies."""
    problem = fmu.cases.load("cantilever-young")
    structure = problem.model.structure
    theta = problem.start
    shapes = problem.model.truth.truth.shapes(theta)
    return structure, theta, shapes, problem.frequencies(theta)


def sensors_of(structure, count=8):
    moving = [(node, direction) for node, direction in structure.dofs if direction == "z"]
    return moving[:: max(1, len(moving) // count)]


def size_of(shapes):
    return np.abs(shapes).max()


@pytest.mark.parametrize("method", ["serep", "dynamic"])
def test_shapes_of_the_model_itself_are_expanded_to_themselves(beam, method):
    structure, theta, shapes, hz = beam
    sensors = sensors_of(structure)
    measured = structure.observation(sensors) @ shapes * np.array([3.0, -1.0, 0.2, 5.0, -7.0])
    found = expand(structure, theta, shapes, sensors, measured, hz, method)
    assert found.shapes == pytest.approx(
        shapes * [3.0, -1.0, 0.2, 5.0, -7.0], rel=1e-5, abs=1e-5 * np.abs(shapes).max()
    )
    assert found.kept == pytest.approx(np.ones(5), abs=1e-9)


def test_polarity_is_taken_off(beam):
    structure, theta, shapes, hz = beam
    sensors = sensors_of(structure)
    turned = [
        (node, f"-{direction}") if j % 2 else (node, direction) for j, (node, direction) in enumerate(sensors)
    ]
    measured = structure.observation(turned) @ shapes
    found = expand(structure, theta, shapes, turned, measured, hz)
    assert found.shapes == pytest.approx(shapes, abs=1e-8 * size_of(shapes))
    wrong = expand(structure, theta, shapes, sensors, measured, hz)  # as if all pointed the same way
    assert wrong.kept.min() < 0.9


def test_sensors_in_another_order_are_told_by_what_is_kept(beam):
    structure, theta, shapes, hz = beam
    sensors = sensors_of(structure)
    measured = structure.observation(sensors) @ shapes
    assert expand(structure, theta, shapes, sensors[::-1], measured, hz).kept.min() < 0.9


def test_serep_averages_noise_that_dynamic_expansion_keeps(beam):
    structure, theta, shapes, hz = beam
    sensors = sensors_of(structure, 20)
    rows = structure.observation(sensors)
    measured = rows @ shapes
    noise = np.random.default_rng(1).normal(size=measured.shape)
    measured = measured + 0.05 * np.abs(measured).max(axis=0) * noise
    smooth = expand(structure, theta, shapes, sensors, measured, hz).shapes
    exact = expand(structure, theta, shapes, sensors, measured, hz, "dynamic").shapes
    assert rows @ exact == pytest.approx(measured, abs=1e-6 * np.abs(measured).max())
    own = [
        np.diag(mac(found[structure.translations], shapes[structure.translations])) for found in (smooth, exact)
    ]
    assert np.all(own[0] > 0.99)
    assert np.all(own[0] > own[1])


def test_dynamic_expansion_solves_the_equations_of_motion_off_the_sensors():
    rng = np.random.default_rng(2)
    ends = np.eye(N) - np.eye(N, k=-1)
    K, M = sp.csr_array(1e4 * ends.T @ ends), sp.csr_array(np.diag(rng.uniform(1, 2, N)))
    rows = sp.csr_array(np.eye(N)[[4, 12, 21, 29]])
    measured = rng.normal(size=(4, 2))
    found = dynamic(measured, [1.0, 3.0], rows, K, M)
    for k, hz in enumerate([1.0, 3.0]):
        force = (K - (2 * np.pi * hz) ** 2 * M) @ found[:, k]
        force[[4, 12, 21, 29]] = 0.0
        assert np.abs(force).max() < 1e-8 * 1e4
    assert rows @ found == pytest.approx(measured, rel=1e-9)


def test_a_sensor_beside_a_node_is_one_like_others():
    """SEREP takes any rows: here the mean of two nodes."""
    modes = np.random.default_rng(3).normal(size=(10, 2))
    rows = sp.csr_array(np.array([[0.5, 0.5] + [0.0] * 8, [0.0] * 5 + [1.0] + [0.0] * 4, [0.0] * 9 + [-1.0]]))
    assert serep(rows @ modes @ [[2.0], [1.0]], rows, modes)[:, 0] == pytest.approx(modes @ [2.0, 1.0])


def test_what_cannot_be_expanded(beam):
    structure, theta, shapes, hz = beam
    sensors = sensors_of(structure)[:3]
    measured = structure.observation(sensors) @ shapes
    with pytest.raises(ValueError, match=r"sensors: must tell 5 modes apart to expand shapes \(they tell 3\)"):
        expand(structure, theta, shapes, sensors, measured, hz)
    with pytest.raises(ValueError, match="method: must be one of serep, dynamic"):
        expand(structure, theta, shapes, sensors, measured, hz, "guyan")
    twice = [sensors[0], sensors[0], sensors[2]]
    with pytest.raises(ValueError, match=r"sensors: must be distinct.*use method='serep'"):
        expand(structure, theta, shapes, twice, measured, hz, "dynamic")
