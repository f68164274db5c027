"""Priors from histograms, whose density is constant between jumps and may vanish in an interval."""

import numpy as np
import pytest
from scipy import stats

import fmu


@pytest.fixture(scope="module")
def gap():
    """A problem with one datum and a prior without density from 0.4 to 0.8."""
    prior = fmu.ScipyPrior(stats.rv_histogram((np.array([3, 1, 0, 0, 6]), np.linspace(0, 1, 6)))())
    model = fmu.BlackBoxModel(lambda theta: 5.0 + theta, 1, batched=True)
    return fmu.UpdatingProblem(model, fmu.ModalData([5.4], sd_hz=0.4), [fmu.Parameter("x", 0.1, prior=prior)])


def shares(x, weight):
    """Return the fractions of `weight` in the three bins with density."""
    return np.histogram(x, [0.0, 0.2, 0.4, 1.0], weights=weight)[0] / np.sum(weight)


def test_the_slope_is_zero_in_a_bin_and_undefined_in_an_empty_one(gap):
    x = np.array([0.2 - 1e-6, 0.2 + 1e-6, 0.4 - 1e-6, 0.5, 0.8 + 1e-6])
    np.testing.assert_array_equal(gap.parameters[0].prior.log_pdf_gradient(x), [0.0, 0.0, 0.0, np.nan, 0.0])


def test_maxima_beside_an_empty_interval_have_masses_and_draws(gap):
    x = (np.arange(1000) + 0.5)[:, None] / 1000
    right = shares(x[:, 0], np.exp(gap.log_prob(x)))
    maxima = fmu.find_map(gap, starts=32)
    by_place = [m.share for m in sorted(maxima, key=lambda m: m.theta[0])]
    np.testing.assert_allclose(by_place, right, atol=0.1)
    draws = fmu.sample(gap, "mixture", draws=200, warmup=50, maxima=maxima).posterior["x"].to_numpy().ravel()
    np.testing.assert_allclose(shares(draws, np.ones_like(draws)), right, atol=0.08)
