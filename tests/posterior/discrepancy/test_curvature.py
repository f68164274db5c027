"""Derivatives by differences with respect to the parameters of each test."""

import numpy as np
from numpy.testing import assert_allclose

from fmu.posterior.discrepancy.curvature import by_parameters


def test_differences_are_slopes_and_stay_within_the_limits():
    """Of a function of the first test, whose first parameter is at its limit, and of one of the second."""
    values = np.array([[[0.2, 1.0], [0.5, 3.0]]])
    bounds = np.stack([np.full((2, 2), 0.2), np.full((2, 2), 3.0)])

    def function(points):
        assert points.shape == (1, 4, 2, 2)
        assert points.min() >= 0.2
        assert points.max() <= 3.0
        return np.stack([points[:, :, 0, 0] ** 2 + points[:, :, 0, 1], points[:, :, 1, 1] ** 2], axis=2)

    found = by_parameters(function, values, np.ones_like(values), bounds, np.array([0, 1]))
    assert_allclose(found, [[[0.4, 1.0], [0.0, 6.0]]], atol=1e-3)
