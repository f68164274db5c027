"""The densities with exact moments: draws, moments, gradients and normalisation agree with each other."""

import numpy as np
import pytest

from tests import densities
from tests.gradients import assert_gradient

N = 100_000

# a Gaussian within each density, narrower than it
WITHIN = {
    "banana": ([0.0, -1.5, 0.0, -0.8], [0.15, 0.1, 0.4, 0.2]),
    "helix": ([0.0, 0.0, 1.0], [0.02, 0.025, 0.025]),
    "ridges": ([0.0, 0.0, 0.6], [0.014, 0.014, 0.014]),
    "three-widths": ([0.0, -2.0, 1.0, -1.0, -1.0], [0.4] * 5),
    "shell": ([0.0, 0.0, 1.0], [0.08, 0.08, 0.012]),
    "beta-half": ([0.5, 0.5, 0.5], [0.1] * 3),
    "neal-funnel": ([0.0] * 8, [0.3, *7 * [0.7]]),
    "student-t": ([0.0] * 4, [0.7] * 4),
}

# coordinates whose tails are light
LIGHT = {"neal-funnel": [0], "student-t": []}


@pytest.fixture(scope="module", params=densities.ALL, ids=lambda one: one.name)
def drawn(request):
    density = request.param()
    return density, density.draw(N, np.random.default_rng(5))


def test_draws_lie_in_the_box(drawn):
    density, x = drawn
    assert x.shape == (N, density.ndim)
    assert np.isfinite(density.log_prob(x)).mean() > 1 - 1e-4
    outside = density.upper + 1.0
    assert density.log_prob(outside) == -np.inf


def test_moments_are_those_of_the_draws(drawn):
    """Variances only where the fourth moment is finite and small enough to be seen in so many draws."""
    density, x = drawn
    z = (x - density.mean) / density.sd
    assert np.all(np.abs(z.mean(axis=0)) < 5 / np.sqrt(N))
    square = z[:, LIGHT.get(density.name, slice(None))] ** 2
    assert np.all(np.abs(square.mean(axis=0) - 1.0) < 5 * square.std(axis=0) / np.sqrt(N))


def test_gradient_is_that_of_differences(drawn):
    density, x = drawn
    x = x[:50]
    h = 1e-6 * np.minimum(density.sd, 1.0)
    inside = np.all((x - h > density.lower) & (x + h < density.upper), axis=1)
    if density.name == "beta-half":
        inside &= np.all((x > 1e-3) & (x < 1 - 1e-3), axis=1)
    if density.name == "neal-funnel":
        inside &= x[:, 0] > -3.0
    x = x[inside]
    value, slope = density.log_prob_and_grad(x)
    assert np.array_equal(value, density.log_prob(x))
    assert_gradient(slope, density.log_prob, x, h, rtol=1e-4, atol=1e-4 * np.abs(slope).max())


def test_density_is_normalised(drawn):
    """E[g/p] = 1 over draws from p, for a normalised g within p."""
    density, x = drawn
    centre, sd = (np.array(one) for one in WITHIN[density.name])
    log_g = np.sum(densities.log_normal(x, centre, sd)[0], axis=1)
    ratio = np.exp(log_g - density.log_prob(x))
    error = ratio.std() / np.sqrt(N)
    assert error < 0.1
    assert abs(ratio.mean() - np.exp(density.log_evidence)) < 5 * error
