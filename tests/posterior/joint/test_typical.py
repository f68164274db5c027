"""The typical point of a population, and how its scores are centred, against closed forms."""

import numpy as np
import pytest
from scipy.optimize import minimize

from fmu.posterior.joint.typical import typical_point
from fmu.posterior.scaled import ScaledDensity
from tests.posterior.joint.test_outliers import posed_springs

NOISE = 0.015
VALUES = 1.0 + 0.07 * np.random.default_rng(4).standard_normal(14)
OWN = (2.0 * NOISE * VALUES) ** 2
"""Variance of each stiffness given its own test: f² is proportional to it."""


def likeliest():
    """Return the mean and the standard deviation of the population that make the measured values most probable."""

    def misfit(x):
        variance = x[1] ** 2 + OWN
        return 0.5 * np.sum((VALUES - x[0]) ** 2 / variance + np.log(variance))

    return minimize(misfit, [1.0, 0.05], method="Nelder-Mead", options={"xatol": 1e-7}).x


def test_the_typical_population_is_the_likeliest_without_the_values_of_the_tests():
    problem = posed_springs(VALUES, None, NOISE)
    theta = ScaledDensity(problem).to_theta(typical_point(problem))
    found = [theta[problem.names.index(name)] for name in ("k mean", "k sd")]
    mean, sd = likeliest()
    assert found[0] == pytest.approx(mean, abs=0.03 * sd)
    assert found[1] == pytest.approx(sd, rel=0.05)


def test_scores_are_centred_for_the_smallest_probable_standard_deviation():
    problem = posed_springs(VALUES, None, NOISE)
    w = likeliest()[1] ** 2 / (likeliest()[1] ** 2 + OWN)
    smallest = np.exp(-4.0 / np.sqrt(2.0 * np.sum(w**2)))
    expected = smallest * w / (smallest * w + 1.0 - w)
    assert np.all(expected < w - 0.1)
    (drawn,) = problem.layout.drawn
    np.testing.assert_allclose(drawn.centring, expected, atol=0.05)
