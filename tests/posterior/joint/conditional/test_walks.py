"""Random walks of populations given the values in the tests: they leave the prior, and the values, as they are."""

import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose

import fmu
from fmu.posterior.joint.conditional.both import conditionals
from fmu.posterior.joint.conditional.walks import WalksGivenValues
from tests.posterior.joint.conditional.test_conditional_densities import campaign

pytestmark = pytest.mark.usefixtures("all_half_centred")

CAMPAIGNS = {
    "near bounds": {"correlation": 2.0},
    "log-normal": {"distribution": "log-normal", "bounds": (0.2, 5.0), "correlation": 1.0},
    "wide": {"distribution": "log-normal", "bounds": (0.1, 9.0), "sd": fmu.LogNormal(0.9, 0.2)},
    "sd by group": {"sd_by_group": True, "distribution": "log-normal", "bounds": (0.2, 5.0)},
    "outlying": {"bounds": (0.2, 5.0), "outliers": fmu.Outliers()},
}


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param(settings, id=name, marks=[pytest.mark.validate] * (name == "log-normal"))
        for name, settings in CAMPAIGNS.items()
    ],
)
def test_the_prior_is_left_as_it_is(settings):
    """Draws from the prior are draws from it after the steps, with the values that they had."""
    problem = campaign(**settings)
    plain = problem.with_layout(problem.layout.remove_centring())
    walks, rng, n = WalksGivenValues(plain.layout, plain.parameters), np.random.default_rng(4), 3000
    before = plain.sample_prior(rng, n)
    after = walks.move(rng, before)
    scored = np.stack([one.scored for one in plain.layout.drawn], axis=1)
    assert_allclose(plain.values(after)[:, scored], plain.values(before)[:, scored], rtol=1e-9)
    main = [k for k, role in enumerate(plain.roles) if role.kind != "score"]
    share = (after[:, main] != before[:, main]).mean(axis=0)
    assert np.all((share > 0.1) & (share < 0.9))
    fresh = plain.sample_prior(rng, n)
    for k in range(plain.ndim):
        assert scipy.stats.ks_2samp(after[:, k], fresh[:, k]).pvalue > 1e-4, plain.names[k]
    for k in main:
        for power in (1, 2):
            change = after[:, k] ** power - before[:, k] ** power
            assert abs(np.mean(change)) < 4.5 * np.std(change) / np.sqrt(n), plain.names[k]


def test_populations_with_other_candidates_take_none_unless_these_are_rarely_accepted():
    assert conditionals(campaign("log-normal", bounds=(0.2, 5.0))).walks is None
    assert conditionals(campaign("log-normal", bounds=(0.7, 1.6))).walks is not None
    assert conditionals(campaign(correlation=1.0)).walks is not None
    assert conditionals(campaign(sd_by_group=True)).walks is not None
