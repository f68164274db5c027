"""The box in which a reduced model is trained: that of the priors, and up to bounds that are near."""

import numpy as np
import pytest

import fmu
from fmu.posterior.parameters import Parameter, box
from fmu.posterior.reduction.region import training_box


def ends(prior, lower, upper):
    found = training_box([Parameter("k", start=1.0, lower=lower, upper=upper, prior=prior)])
    return tuple(float(end[0]) for end in found)


def test_a_bound_within_six_standard_deviations_of_a_normal_prior_belongs_to_it():
    prior = fmu.Normal(mean=1.0, sd=0.1)
    assert ends(prior, 0.45, 1.55) == (0.45, 1.55)
    assert ends(prior, 0.8, 1.55) == (0.8, 1.55)
    assert ends(prior, 0.3, 1.7) == pytest.approx((0.6, 1.4))
    assert ends(prior, -np.inf, np.inf) == pytest.approx((0.6, 1.4))


@pytest.mark.parametrize("lower", [0.0, 1e-9])
def test_a_bound_where_a_prior_has_no_density_does_not(lower):
    prior = fmu.LogNormal(median=1.0, sigma=0.8)  # its four standard deviations begin at 0.04 of 24.5
    parameter = Parameter("k", start=1.0, lower=lower, upper=np.inf, prior=prior)
    assert training_box([parameter]) == box([parameter])
    assert ends(prior, 0.03, 26.0) == (0.03, 26.0)


@pytest.mark.parametrize("name", ["cantilever-section", "cantilever-young", "garteur"])
def test_in_shipped_cases_with_bounds_no_point_within_them_needs_the_full_model(name):
    problem = fmu.cases.load(name)
    assert problem.model.within(np.stack([problem.lower, problem.upper])).all()


@pytest.mark.validate
@pytest.mark.parametrize("name", fmu.cases.names())
def test_no_draw_of_a_shipped_case_is_answered_by_the_full_model(name):
    trace = fmu.sample(fmu.cases.load(name), seed=1)
    assert trace.attrs["certificate_full_share"] == 0
