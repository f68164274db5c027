"""Modes picked from frequency response functions."""

import numpy as np
import pytest

import fmu
from tests.measured_frfs import LINES, POINTS, TRUTH, building, simulate
from tests.shear_building import frequencies_hz


def test_the_modes_are_the_resonances_at_the_responses():
    found = fmu.pick_modes(simulate())
    assert np.allclose(found.frequencies_hz, frequencies_hz(building(), TRUTH)[0], rtol=0.01)
    assert np.allclose(found.sd_hz, 0.01 * np.asarray(found.frequencies_hz), rtol=1e-12)
    assert (found.sensors, found.counterparts, found.counts_rigid) == (POINTS, (), False)


def test_numbers_name_the_modes_of_the_model():
    band = simulate(band=(5.0, 16.0))  # without the first resonance
    found = fmu.pick_modes(band, numbers=(2, 3), sd=0.02)
    assert found.counterparts == found.numbers == (2, 3)
    assert np.allclose(found.frequencies_hz, frequencies_hz(building(), TRUTH)[0][1:], rtol=0.01)


def test_a_resonance_whose_lines_are_left_out_is_a_mode_too():
    found = fmu.pick_modes(simulate(use=(LINES < 7.0) | (LINES > 11.0)))
    assert np.allclose(found.frequencies_hz, frequencies_hz(building(), TRUTH)[0], rtol=0.01)


def test_wrong_numbers_and_frfs_without_a_resonance_are_told():
    with pytest.raises(ValueError, match=r"numbers: must be 3, one per resonance .* Hz \(got 4\)"):
        fmu.pick_modes(simulate(), numbers=(1, 2, 3, 4))
    flat = fmu.FRFData(LINES, np.ones((1, len(LINES))), ((2, "x"),), ((2, "x"),), "receptance", 0.1)
    with pytest.raises(ValueError, match="data: must have a resonance"):
        fmu.pick_modes(flat)
