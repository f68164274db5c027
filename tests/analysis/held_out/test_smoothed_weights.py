"""The standard error of a left-out density is its scatter over independent sets of draws."""

import numpy as np
import pytest
from scipy.stats import norm

from fmu.analysis.held_out.weights import smooth

VALUE, SD = 4.0, 3.0
"""A datum, and the sd of its error. Given all data the parameter is standard normal."""
DRAWS, SETS = 1000, 400


@pytest.mark.parametrize("repeated", [1, 4])
def test_the_standard_error_is_the_scatter_over_sets_of_draws(repeated):
    rng = np.random.default_rng(5)
    found = []
    for _ in range(SETS):
        theta = np.repeat(rng.standard_normal(DRAWS // repeated), repeated)
        log_p = norm.logpdf(VALUE, theta, SD)
        found.append(smooth(-log_p, log_p, 1.0 / repeated))
    elpd, mcse = np.array([(one.elpd, one.mcse) for one in found]).T
    # without the datum: precision 1 - 1/SD², mean so that the product with its density is standard normal
    variance = 1.0 / (1.0 - SD**-2)
    exact = norm.logpdf(VALUE, -variance * VALUE / SD**2, np.sqrt(variance + SD**2))
    assert elpd.mean() == pytest.approx(exact, abs=4.0 * elpd.std() / np.sqrt(SETS))
    assert np.sqrt(np.mean(mcse**2)) == pytest.approx(elpd.std(), rel=0.2)


def test_weights_beyond_the_range_of_floating_point_numbers_are_not_good():
    """As of a chain that begins far away: one draw outweighs the others by some 308 decades.

    The scale of the fitted distribution was not positive, the weights were NaN, and k said that they are
    good.
    """
    log_p = np.concatenate([[-2000.0], np.linspace(-1300.0, -1256.0, 29), np.zeros(120)])
    found = smooth(-log_p, log_p, 1.0)
    assert not found.is_good
    assert found.pareto_k == np.inf
    assert np.isclose(np.sum(np.exp(found.log_weight)), 1.0)
