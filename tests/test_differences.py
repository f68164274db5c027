"""Points of differences: on both sides, on a wall where there is one, and never beyond it."""

import numpy as np
import pytest

from fmu.differences import both_sides


def test_points_are_on_both_sides_or_on_the_wall():
    centre = np.array([[0.0, 5.0], [1.0, 9.9]])
    points, distance = both_sides(centre, np.array([0.1, 1.0]), np.array([0.0, -np.inf]), np.array([np.inf, 10.0]))
    assert points[:, 0, 0].tolist() == [[0.1, 5.0], [0.0, 5.0]]  # at the lower wall
    assert points[:, 1, 1].tolist() == [[1.0, 10.0], [1.0, 8.9]]  # close to the upper one
    assert distance == pytest.approx(np.array([[0.1, 2.0], [0.2, 1.1]]))


def test_differences_of_a_skewed_function_are_its_gradient():
    def value(x):
        return np.exp(x[..., 0]) * x[..., 1] ** 3

    centre = np.array([[0.3, 0.7], [0.0, 1.0]])
    points, distance = both_sides(centre, np.full(2, 1e-5), np.array([0.0, -1.0]), np.array([1.0, 1.0]))
    found = (value(points[0]) - value(points[1])) / distance
    x, y = centre.T
    assert found == pytest.approx(np.stack([np.exp(x) * y**3, np.exp(x) * 3 * y**2], axis=1), rel=1e-4)


def test_a_centre_outside_the_box_is_a_side_of_itself():
    points, distance = both_sides(np.array([[2.0]]), np.array([0.5]), np.array([0.0]), np.array([1.0]))
    assert points.ravel().tolist() == [2.0, 1.5]
    assert distance.tolist() == [[0.5]]
