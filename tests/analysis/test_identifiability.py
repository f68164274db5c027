"""Identifiability against the exact posterior of a linear model, and on the paper's beam."""

import numpy as np
import pytest
from scipy.stats import truncnorm

import fmu
from fmu.analysis.identifiability import (
    combination,
    identifiability,
    kept_identifiability,
    truncated_sd,
    with_identifiability,
)
from fmu.analysis.maxima.search import find_map
from fmu.analysis.trace.conversion import to_trace
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from tests.linear import SLOPES

BETA = np.array([0.5, 1.0, 2.0])


@pytest.fixture
def found(problem):
    return identifiability(problem)


def test_what_remains_is_the_exact_posterior_over_the_prior(problem, found):
    prior_sd = found.prior_sd
    covariance = np.linalg.inv(np.diag(prior_sd**-2) + SLOPES.T @ (2 * BETA[:, None] * SLOPES))
    np.testing.assert_allclose(found.remaining_sd, np.sqrt(np.diag(covariance)) / prior_sd, rtol=1e-12)
    np.testing.assert_allclose(
        found.fisher_information, SLOPES.T @ (2 * BETA[:, None] * SLOPES), rtol=1e-12, atol=1e-12
    )
    assert prior_sd == pytest.approx([truncnorm(-4, 4).std(), 2.0], rel=1e-3)


def test_directions_diagonalise_the_information(found):
    D, V, s = np.diag(found.prior_sd), found.directions, found.singular_values
    np.testing.assert_allclose(V @ V.T, np.eye(2), atol=1e-14)
    np.testing.assert_allclose(V @ D @ found.fisher_information @ D @ V.T, np.diag(s**2), rtol=1e-10, atol=1e-10)
    assert s[0] > s[1] > 0


def test_more_parameters_than_modes(problem):
    blind = identifiability(problem)
    one = type(blind)(("a", "b", "c"), ("",) * 3, ("1",), np.zeros(3), np.ones(3), np.array([[0.0, 3.0, -4.0]]))
    np.testing.assert_allclose(one.singular_values, [5.0, 0.0, 0.0])
    assert one.n_informed == 1
    np.testing.assert_allclose(one.remaining_sd**2, [1.0, 1 - 0.36 * 25 / 26, 1 - 0.64 * 25 / 26])
    assert one.sentences()[0].startswith(
        "Linearised, and without the bounds, the data constrain 1 of 3 directions "
    )
    assert len(one.sentences()) == 3
    assert "100 % of the prior standard deviation" in one.sentences()[1]
    assert combination(one.directions[0], one.names) == "0.80 c − 0.60 b"


def test_in_words_when_all_directions_are_constrained(found):
    first, least = found.sentences()
    assert first == (
        "Linearised, and without the bounds, the data constrain 2 of 2 directions of the parameter space more "
        "than the prior does."
    )
    assert least.startswith("The least constrained direction is ")
    left = 1 / np.sqrt(1 + found.singular_values[-1] ** 2)
    assert f"{100 * left:.2g} % of the prior standard deviation" in least
    assert " ".join(str(found).split()).startswith(first)
    assert "<table" in found._repr_html_()


def test_names_are_escaped(found):
    hostile = type(found)(("<b>", "&"), found.units, found.labels, found.theta, found.prior_sd, found.sensitivity)
    assert "<b>" not in hostile._repr_html_()


def test_four_of_five_directions_of_the_paper_are_constrained():
    problem = fmu.cases.load("cantilever-young")
    found = identifiability(problem)
    assert found.n_informed == 4
    # the spectrum scales with a common factor on all moduli: f ∝ √E, so ∂f/∂(log E) = f/2
    slopes = found.sensitivity * problem.likelihood.error.sd[:, None] / found.prior_sd
    np.testing.assert_allclose(slopes @ problem.start, problem.frequencies(problem.start) / 2, rtol=1e-6)


def test_the_prior_is_that_within_the_bounds():
    for a, b in ((-1.0, 1.0), (1.5, 4.0), (-0.2, 9.0)):
        parameter = Parameter("E", start=1.6 if a > 0 else 0.0, lower=a, upper=b, prior=Normal(1.0))
        assert truncated_sd(parameter) == pytest.approx(truncnorm(a, b).std(), rel=2e-3)
    assert truncated_sd(Parameter("k", start=1.0, lower=0.0, upper=6.0)) == pytest.approx(6 / np.sqrt(12))


@pytest.mark.parametrize("theta", [[5.0, 0.0], [0.0], [np.nan, 0.0]])
def test_theta_within_the_bounds(problem, theta):
    with pytest.raises(ValueError, match="theta: must be 2 numbers within the bounds"):
        identifiability(problem, theta)


def test_only_of_an_updating_problem(plain):
    with pytest.raises(ValueError, match="problem: must be an UpdatingProblem"):
        identifiability(plain)


def test_a_trace_keeps_it(problem):
    maxima = find_map(problem)
    trace = fmu.sample(problem, "hmc", draws=4, warmup=4, chains=2, maxima=maxima)
    kept = kept_identifiability(trace)
    assert list(kept) == ["start", "maximum"]
    for state, theta in (("start", problem.start), ("maximum", maxima[0].theta)):
        expected = identifiability(problem, theta)
        np.testing.assert_array_equal(kept[state].sensitivity, expected.sensitivity)
        np.testing.assert_array_equal(kept[state].theta, theta)
        assert (kept[state].names, kept[state].units) == (expected.names, expected.units)
    assert kept_identifiability(to_trace_without(trace)) == {}


def to_trace_without(trace):
    bare = trace.copy()
    del bare["identifiability"]
    return bare


def test_many_directions_are_counted(found):
    n = 9
    wide = type(found)(tuple("abcdefghi"), ("",) * n, ("1",), np.zeros(n), np.ones(n), np.eye(1, n) * 5)
    assert wide.sentences()[-1] == "The same holds for 5 more."
    assert len(wide.sentences()) == 5


def test_a_state_without_a_derivative_is_left_out(problem, make_result, monkeypatch):
    """The draws of a long run are not lost because the model cannot be linearised somewhere."""
    trace = to_trace(make_result(np.random.default_rng(1).normal(size=(2, 8, 2))), problem)
    monkeypatch.setattr(
        problem.model,
        "frequencies_and_gradient",
        lambda theta: (100.0 + theta @ SLOPES.T, np.full((1, 3, 2), np.nan)),
    )
    assert kept_identifiability(with_identifiability(trace, problem)) == {}
