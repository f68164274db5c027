import numpy as np
import pytest

from fmu.analysis.convergence.effective import energy_fraction, longest_stands


def test_longest_stand_by_hand():
    position = np.array([[0, 0, 1, 2, 2, 2, 3], [0, 1, 2, 3, 4, 5, 6], [5, 5, 5, 5, 5, 5, 5]], dtype=float)
    np.testing.assert_array_equal(longest_stands(position[..., None]), [[3], [1], [7]])


def test_a_move_in_one_coordinate_is_a_move():
    position = np.zeros((1, 6, 2))
    position[0, 3:, 1] = 1.0
    np.testing.assert_array_equal(longest_stands(position), [[3]])


def test_walkers_are_followed_step_by_step():
    # two walkers, step-major: the first moves always, the second stands at the last three of four steps
    position = np.array([[0, 10, 1, 11, 2, 11, 3, 11]], dtype=float)[..., None]
    np.testing.assert_array_equal(longest_stands(position, walkers=2), [[1, 3]])


def test_energy_fraction_by_hand():
    energy = np.array([[0.0, 1.0, 0.0, 3.0], [2.0, 2.0, 2.0, 2.0]])
    fraction = energy_fraction(energy)
    assert fraction[0] == pytest.approx((1 + 1 + 9) / (1 + 0 + 1 + 4))
    assert np.isnan(fraction[1])


def test_energy_fraction_of_one_draw_does_not_exist():
    np.testing.assert_array_equal(energy_fraction(np.array([[1.0], [2.0]])), [np.nan, np.nan])


def test_energy_fraction_of_independent_energies_is_two():
    energy = np.random.default_rng(0).standard_normal((3, 20_000))
    np.testing.assert_allclose(energy_fraction(energy), 2.0, atol=0.1)
