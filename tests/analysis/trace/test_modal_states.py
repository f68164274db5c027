"""Modes before and after updating: frequencies, MAC, and displacements for drawings."""

import numpy as np
import pytest
import xarray as xr

import fmu
from fmu.analysis.trace.conversion import save_trace
from fmu.analysis.trace.modal_states import modal_states, sketch_of
from fmu.fem.frame.drawing import draw_svg, drawing
from fmu.fem.modes.modal import mac


@pytest.fixture(scope="module")
def young():
    return fmu.cases.load("cantilever-young")


@pytest.fixture(scope="module")
def states(young):
    return modal_states(young, {"start": young.start, "soft tip": [2.4e11, 2.4e11, 2.4e11, 1.8e11, 1.8e11]})


def test_frequencies_are_those_of_the_problem(young, states):
    np.testing.assert_array_equal(states["frequency"], young.frequencies(states["theta"].to_numpy()))
    assert list(states["state"].to_numpy()) == ["start", "soft tip"]


def test_mac_is_with_the_first_state_where_no_shapes_were_measured(states):
    alike = states["mac"].to_numpy()
    np.testing.assert_allclose(np.diag(alike[0]), 1.0, rtol=1e-12)
    assert np.all(np.diag(alike[1]) < 1.0)
    assert np.all(np.diag(alike[1]) > 0.9)
    assert states["mac"].attrs["reference"] == "modes before updating, at all translations"
    w = states["displacement"].sel(direction="z").to_numpy()
    np.testing.assert_allclose(alike[1], mac(w[1].T, w[0].T), rtol=1e-12, atol=1e-15)


def test_displacements_are_those_of_a_clamped_beam(states):
    moved = states["displacement"]
    assert np.all(moved.isel(node=0) == 0)
    assert np.all(moved.sel(direction=["x", "y"]) == 0)
    np.testing.assert_allclose(np.abs(moved).max(("node", "direction")), 1.0)
    w = moved.sel(direction="z").to_numpy()
    # mode k of a clamped beam has k − 1 nodes, and both states have it with one sign
    crossings = np.sum(np.diff(np.sign(w[..., 1:]), axis=-1) != 0, axis=-1)
    np.testing.assert_array_equal(crossings, [range(5)] * 2)
    assert np.all(np.sum(w[0] * w[1], axis=-1) > 0)
    np.testing.assert_allclose(states["coordinates"].sel(direction="x"), np.linspace(0, 0.5, 51), atol=1e-15)
    np.testing.assert_array_equal(states["ends"][0], [0, 1])


def test_pairing_by_number_shows_a_mode_that_no_sensor_sees(section, section_maxima):
    found = modal_states(section, {"start": section.start, "maximum": section_maxima[0].theta})
    alike = found["mac"].sel(state="maximum").to_numpy()
    assert alike[:, 1].max() < 1e-6  # the second of the paired modes is in the other plane
    assert alike[0, 0] > 0.99


def test_measured_shapes_are_the_reference(young):
    structure = young.model.structure
    sensors = [*((node, "z") for node in (10, 20, 30, 40, 49)), (40, "ry")]
    at = [structure.dof(*sensor) for sensor in sensors]
    shapes = -3.0 * young.model.truth.shapes(young.start)[at]
    data = fmu.ModalData([31.9, 197.9, 553.0, 1082.2, 1781.5], sensors=sensors, shapes=shapes)
    problem = fmu.UpdatingProblem(structure, data, young.parameters)
    found = modal_states(problem, {"start": young.start})
    assert found["mac"].attrs["reference"] == "measured shapes, at the sensors"
    np.testing.assert_allclose(found["mac"][0], mac(shapes, shapes), rtol=1e-9, atol=1e-12)
    ratio = found["measured"] / found["component"].sel(state="start")
    np.testing.assert_allclose(ratio, ratio[:, :1] * np.ones(6), rtol=1e-9)
    np.testing.assert_allclose(found["site"].sel(direction="x"), [0.1, 0.2, 0.3, 0.4, 0.49, 0.4])


def test_a_model_without_shapes_has_frequencies_alone(problem):
    found = modal_states(problem, {"start": problem.start})
    assert set(found.data_vars) == {"theta", "frequency"}


def test_matrices_without_a_place_have_no_drawing(young):
    structure = young.model.structure
    bare = fmu.SeparableModel(structure.K_terms, structure.M_terms, structure.dofs)
    problem = fmu.UpdatingProblem(bare, young.data, young.parameters)
    found = modal_states(problem, {"start": problem.start})
    assert set(found.data_vars) == {"theta", "frequency", "mac"}  # too many translations to list


def test_a_trace_keeps_what_is_drawn_of_the_structure(young, tmp_path):
    """The drawing from a file is that of the problem."""
    maxima = fmu.find_map(young, starts=1)
    trace = fmu.sample(young, "hmc", draws=5, warmup=5, chains=2, init="start", maxima=maxima)
    found = sketch_of(fmu.load_trace(save_trace(trace, tmp_path / "hmc.nc")))
    assert draw_svg(found) == drawing(young.model.structure, young.data.sensors)
    assert sketch_of(xr.DataTree()) is None


def test_no_state(problem):
    with pytest.raises(ValueError, match="states: at least one"):
        modal_states(problem, {})


def test_a_trace_keeps_start_mean_and_maximum(problem):
    maxima = fmu.find_map(problem)
    trace = fmu.sample(problem, "hmc", draws=5, warmup=5, chains=2, maxima=maxima)
    kept = trace["modes"]
    assert list(kept["state"].to_numpy()) == ["start", "posterior mean", "maximum"]
    mean = trace["posterior"].to_dataset().mean().to_array().to_numpy()
    np.testing.assert_allclose(kept["theta"][1], mean, rtol=1e-12)
    np.testing.assert_array_equal(kept["theta"][2], maxima[0].theta)
