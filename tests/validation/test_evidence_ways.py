"""The methods for an evidence that only this study uses."""

import numpy as np
import pytest

import fmu
from tests.two_storeys import quadrature
from tests.validation.evidence import Estimate, Region, weighed
from tests.validation.evidence_page import PAGE


def test_importance_sampling_of_two_modes():
    problem = fmu.cases.load("shear-2dof")
    found = weighed(problem, list(fmu.find_map(problem)))
    assert 0.001 < found.error < 0.02
    assert found.agrees(Estimate(quadrature().log_evidence, 0.0))


def test_regions_are_told_apart_by_the_modes_that_answer(section, section_maxima):
    problem, maxima = section, section_maxima
    regions = [Region(problem, maximum.theta) for maximum in maxima[:3]]
    theta = problem.sample_prior(np.random.default_rng(1), 400)
    held = np.array([region.holds(theta) for region in regions])
    assert np.all(held.sum(axis=0) <= 1)
    assert np.all(held.any(axis=1))
    for region, own, maximum in zip(regions, held, maxima, strict=False):
        np.testing.assert_array_equal(np.isfinite(region.log_prob(theta)), own)
        np.testing.assert_array_equal(region.log_prob(theta)[own], problem.log_prob(theta)[own])
        assert region.log_likelihood(maximum.theta[None])[0] == problem.log_likelihood(maximum.theta)


def test_what_agrees():
    one = Estimate(-10.0, 0.1)
    assert one.agrees(Estimate(-10.3, 0.0))
    assert not one.agrees(Estimate(-10.5, 0.0))
    assert not one.agrees(Estimate(np.nan, 0.1))
    assert one.agrees(Estimate(-20.0, 0.1, warned=True))
    assert one.agrees(Estimate(-10.5, 0.2))


def test_a_region_needs_no_gradient(section):
    region = Region(section, section.start)
    with pytest.raises(AttributeError):
        region.log_prob_and_grad(section.start)


def test_the_factor_at_beta_one_stands_beside_that_at_one_percent():
    (sentence,) = (part for part in PAGE.split("\n- ") if "{by_shape" in part)
    assert "exp({at_one_percent:.1f})" in sentence
