"""The normal distribution that is closest to a density: a normal density, and one with its maximum at a bound."""

import numpy as np
from numpy.testing import assert_allclose

from fmu.posterior.joint.conditional.regression import fit_normal


def test_a_normal_density_is_found_exactly():
    rng, d = np.random.default_rng(1), 5
    mean, root = rng.standard_normal(d), rng.standard_normal((d, d)) + 2.0 * np.eye(d)
    covariance, far = root @ root.T, np.full(d, np.inf)
    precision = np.linalg.inv(covariance)
    found = fit_normal(lambda w: (mean - w) @ precision, np.zeros(d), 0.1 * np.eye(d), -far, far)
    assert_allclose(found.mean, mean, rtol=1e-8)
    assert_allclose(found.covariance, covariance, rtol=1e-8, atol=1e-8)


def test_a_density_with_its_maximum_at_a_bound_is_continued_by_reflection():
    """exp(−w⁴) for w > 0 has no curvature at its maximum."""
    found = fit_normal(lambda w: -4.0 * w**3, np.zeros(1), np.eye(1), np.zeros(1), np.full(1, np.inf))
    w = found.draws(20_000, np.zeros(1), np.full(1, np.inf))
    assert np.all(w >= 0.0)
    # E[12 w²] = 1/σ² for the closest normal distribution about zero: σ = 12^(−1/4)
    assert_allclose(np.mean(w**2), 12.0**-0.5, rtol=0.1)
