"""The errors of a model as parameters: the same posterior, and tests that are independent given the errors."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

import fmu
from fmu.posterior.discrepancy.given_errors import with_errors_as_parameters
from fmu.posterior.joint.conditional.expansion import expand
from fmu.posterior.joint.varies.base import sum_by_test
from tests.gradients import assert_gradient
from tests.posterior.discrepancy.test_discrepancy_in_several_tests import points, posed

pytestmark = pytest.mark.usefixtures("all_half_centred")

KINDS = {
    "scatter": fmu.Discrepancy(by="group"),
    "correlated scatter": fmu.Discrepancy(correlation="inferred"),
    "errors of modes": fmu.Discrepancy("modes", correlation="inferred"),
}


EVERY_DAY = {("scatter", "both"), ("correlated scatter", "frequencies"), ("errors of modes", "both")}


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((kind, errors), marks=[pytest.mark.validate] * ((kind, errors) not in EVERY_DAY))
        for kind in KINDS
        for errors in ("frequencies", "both")
    ],
)
def pair(request, all_half_centred):
    """Return a problem, the same problem with the errors as parameters, and three points with errors."""
    kind, errors = request.param
    problem = posed("population", errors, KINDS[kind])
    theta = points(problem)
    theta[:, problem.n_structural :] = 0.05
    given = with_errors_as_parameters(problem)
    z = np.random.default_rng(0).standard_normal((3, given.likelihood.n_errors))
    return problem, given, np.concatenate([theta, z], axis=1)


def test_the_integral_over_the_errors_is_the_density(pair):
    """The Gaussian p(z | θ) is found by differences of slopes."""
    problem, given, both = pair
    n, L = problem.ndim, given.ndim - problem.ndim
    for theta in both[:, :n]:
        row = np.concatenate([theta, np.zeros(L)])
        slopes = given.log_prob_and_grad(np.concatenate([row[None], row + np.eye(given.ndim)[n:]]))[1][:, n:]
        precision = slopes[0] - slopes[1:]
        precision = 0.5 * (precision + precision.T)
        mean = np.linalg.solve(precision, slopes[0])
        at_mean = np.concatenate([theta, mean])
        log_p = given.log_prob(at_mean) + 0.5 * L * np.log(2.0 * np.pi) - 0.5 * np.linalg.slogdet(precision)[1]
        assert_allclose(log_p, problem.log_prob(theta), rtol=1e-8)
        model = problem.layout.of_model(theta[None])
        assert_allclose(given.likelihood.likeliest(model)[0], mean, rtol=1e-6, atol=1e-8)


def test_errors_are_drawn_from_their_distribution_given_the_data(pair):
    problem, given, both = pair
    n, draws, of = problem.ndim, 150, given.likelihood
    model = np.repeat(problem.layout.of_model(both[:1, :n]), draws, axis=0)
    z = of.draw(np.random.default_rng(1), of.observed(model), model)
    log_p = given.log_prob(np.concatenate([np.repeat(both[:1, :n], draws, axis=0), z], axis=1))
    row = np.concatenate([both[0, :n], of.likeliest(model[:1])[0]])
    below = 2.0 * (given.log_prob(row) - log_p)
    assert stats.kstest(below, stats.chi2(z.shape[1]).cdf).pvalue > 1e-4


def test_gradients(pair):
    _, given, both = pair
    step = 1e-3 * np.maximum(np.abs(both), 0.1)
    gradient = given.log_prob_and_grad(both)[1]
    assert_gradient(gradient, given.log_prob, both, step, order=4, rtol=1e-6, of_largest=1e-6)


def test_each_test_is_independent_and_expanded_about_any_errors(pair):
    """The slope is exact at the expansion point, for other errors than those that it was made with."""
    _, given, both = pair
    layout, of = given.layout, given.likelihood
    model = layout.of_model(both)
    assert of.terms(model).shape == (3, len(of.group))
    moved = model.copy()
    moved[:, 3:6] *= 1.1  # the second test alone
    same = of.terms(moved) == of.terms(model)
    assert np.array_equal(same.all(axis=0), of.test_of_terms != 1)
    one = np.repeat(both[:1], 3, axis=0)
    one[:, -of.n_errors :] = both[:, -of.n_errors :]
    known = expand(layout, of, one[0]).given_errors(one[:, len(layout.parameters) :])
    slopes = of.terms_and_gradient(layout.of_model(one))[1][..., : len(layout.structural)]
    expected = sum_by_test(slopes, of.test_of_terms, len(layout.tests))
    assert_allclose(known.slope, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    assert np.all(np.linalg.eigvalsh(known.information) > -1e-9 * np.abs(known.information).max())


@pytest.mark.parametrize("kind", KINDS)
def test_a_frequency_given_the_errors_has_its_density(kind):
    problem = posed("population", "frequencies", KINDS[kind])
    given, theta = with_errors_as_parameters(problem), points(problem)
    of = given.likelihood
    z = np.random.default_rng(0).standard_normal((len(theta), of.n_errors))
    noise = np.concatenate([np.full_like(theta[:, problem.n_structural :], 0.05), z], axis=1)
    at = np.concatenate([given.layout.of_model(theta)[:, : of.model.n_parameters], noise], axis=1)
    seen = of.observed(at)
    mean, sd = of.frequency_term.given_others(seen.frequencies, noise)
    for k, measured in enumerate(problem.data.frequencies_hz):
        shift, variance = of.error_given_others(seen, at, k)
        assert np.all(variance == 0.0)
        assert np.all(np.abs(shift) > 0.0)
        assert_allclose(of.terms(at)[:, k], stats.norm(mean[:, k] + shift, sd[:, k]).logpdf(measured), rtol=1e-9)
