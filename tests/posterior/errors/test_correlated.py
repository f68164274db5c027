"""Correlated frequency errors: a density of the data whose terms are conditional on the modes before."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import multivariate_normal

from fmu.analysis.identifiability import identifiability
from fmu.analysis.maxima.search import hessian_at
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.ascent import GaussNewton
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.frequency import BetaFrequencyErrors, CorrelatedFrequencyTerm, FrequencyTerm
from fmu.posterior.maxima import local_maxima
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.problem import UpdatingProblem
from tests.gradients import assert_gradient

MEASURED = np.array([10.0, 25.0, 41.0, 60.0])
SD = np.array([0.1, 0.3, 0.2, 0.5])
CORRELATION = np.array([[1.0, 0.8, 0.5, 0.3], [0.8, 1.0, 0.6, -0.2], [0.5, 0.6, 1.0, 0.1], [0.3, -0.2, 0.1, 1.0]])
COVARIANCE = CORRELATION * np.outer(SD, SD)


def gradient_of(term, frequencies, slopes):
    """Return the gradients of the terms, shape (n, n_modes, k), for slopes of the frequencies of that shape."""
    seen = term.project(ModalPrediction(frequencies, np.empty((len(frequencies), 0, 4)), slopes))
    return (
        term.evaluate(seen, np.empty((len(frequencies), 0)), True).by_frequency[..., None] * seen.frequency_slopes
    )


@pytest.fixture(scope="module")
def error():
    return CorrelatedFrequencyTerm(MEASURED, COVARIANCE)


@pytest.fixture(scope="module")
def computed():
    return MEASURED + np.random.default_rng(0).normal(0.0, 2.0 * SD, (50, 4))


def test_terms_sum_to_the_joint_density(error, computed):
    expected = [multivariate_normal(f, COVARIANCE).logpdf(MEASURED) for f in computed]
    assert_allclose(error.log_prob_terms(computed).sum(axis=1), expected, rtol=1e-10)


def test_a_term_is_the_density_given_the_modes_before(error, computed):
    marginal = [multivariate_normal(f[:3], COVARIANCE[:3, :3]).logpdf(MEASURED[:3]) for f in computed]
    assert_allclose(error.log_prob_terms(computed)[:, :3].sum(axis=1), marginal, rtol=1e-10)


def test_density_given_all_others(error, computed):
    joint = np.array([multivariate_normal(f, COVARIANCE).logpdf(MEASURED) for f in computed])
    for i in range(4):
        rest = np.delete(np.arange(4), i)
        others = [
            multivariate_normal(f[rest], COVARIANCE[np.ix_(rest, rest)]).logpdf(MEASURED[rest]) for f in computed
        ]
        assert_allclose(error.log_prob_given_others(computed)[:, i], joint - others, rtol=1e-8)


def test_without_correlations_it_is_the_independent_error(computed):
    one, other = CorrelatedFrequencyTerm(MEASURED, np.diag(SD**2)), FrequencyTerm.of_beta(MEASURED, 0.5 / SD**2)
    slopes = np.random.default_rng(1).normal(size=(50, 4, 3))
    assert_allclose(one.log_prob_terms(computed), other.log_prob_terms(computed), rtol=1e-12)
    assert_allclose(one.log_prob_given_others(computed), other.log_prob_terms(computed), rtol=1e-12)
    assert_allclose(gradient_of(one, computed, slopes), gradient_of(other, computed, slopes), rtol=1e-12)
    assert_allclose(one.sd, other.sd)
    assert_allclose(one.beta, other.beta)


def test_gradient_against_differences(error, computed):
    gradient = gradient_of(error, computed, np.broadcast_to(np.eye(4), (50, 4, 4)))
    assert_gradient(gradient, error.log_prob_terms, computed, 1e-4, rtol=1e-6, atol=1e-6)


def test_any_leading_dimensions(error, computed):
    stacked = computed.reshape(5, 10, 4)
    for method in (error.log_prob_terms, error.log_prob_given_others):
        assert_array_equal(method(stacked).reshape(50, 4), method(computed))


def test_the_same_bits_in_any_batch_and_memory_order():
    rng = np.random.default_rng(2)
    root = rng.normal(size=(20, 20))
    error = CorrelatedFrequencyTerm(rng.uniform(10, 20, 20), root @ root.T + np.eye(20))
    frequencies = rng.uniform(10, 20, (64, 20))
    alone = np.array([error.log_prob_terms(f[None]).sum(axis=1)[0] for f in frequencies])
    for batch in (frequencies, np.asfortranarray(frequencies)):
        assert_array_equal(error.log_prob_terms(batch).sum(axis=1), alone)
    slopes = rng.normal(size=(64, 20, 5))
    together = gradient_of(error, frequencies, slopes).sum(axis=1)
    one = [gradient_of(error, f[None], s[None]).sum(axis=1)[0] for f, s in zip(frequencies, slopes, strict=True)]
    assert_array_equal(together, one)


def test_simulated_noise_has_the_covariance(error):
    noise = (
        error.simulate(np.random.default_rng(4), np.tile(MEASURED, (40000, 1)), np.empty((40000, 0))) - MEASURED
    )
    # the standard error of a correlation is at most 1/200, of a relative variance 0.7 %; five of them
    assert_allclose(np.corrcoef(noise.T), CORRELATION, atol=5 * 0.005)
    assert_allclose(noise.var(axis=0), SD**2, rtol=5 * 0.0071)
    assert_allclose(noise.mean(axis=0) / SD, 0.0, atol=5 * 0.005)


def test_absurd_frequencies_have_no_probability_and_no_warning(error):
    assert error.log_prob_terms(np.full((1, 4), 1e200)).sum() == -np.inf
    assert not np.isfinite(error.log_prob_terms(np.full((1, 4), np.inf))).any()


def test_description(error):
    assert error.as_dict() == {"error": "frequency", "covariance_hz2": COVARIANCE.tolist()}


def bound(data, beta=None):
    return BetaFrequencyErrors(beta).bind(data, lambda parameter: 0)


def test_the_uncertainty_of_the_data_is_the_default():
    assert_array_equal(bound(ModalData(MEASURED)).beta, 1.0)
    assert_array_equal(bound(ModalData(MEASURED), 3.0).beta, 3.0)
    assert_allclose(bound(ModalData(MEASURED, sd_hz=SD)).sd, SD)
    correlated = bound(ModalData(MEASURED, covariance_hz2=COVARIANCE))
    assert isinstance(correlated, CorrelatedFrequencyTerm)
    assert_array_equal(correlated.covariance_hz2, COVARIANCE)


@pytest.mark.parametrize(("own", "value"), [("sd_hz", 0.1), ("covariance_hz2", COVARIANCE)])
def test_two_uncertainties_are_an_error(own, value):
    with pytest.raises(ValueError, match=rf"^beta: must not be given, as the data have {own} \(got 1\.0\)$"):
        bound(ModalData(MEASURED, **{own: value}), 1.0)


class Linear:
    """A ModalModel f = a + Bθ."""

    def __init__(self, a, B):
        self.a, self.B = a, B
        self.n_modes, self.n_parameters = B.shape

    def frequencies(self, theta):
        return self.a + np.sum(self.B * theta[:, None, :], axis=2)

    def frequencies_and_gradient(self, theta):
        return self.frequencies(theta), np.broadcast_to(self.B, (len(theta), *self.B.shape)).copy()


PRIOR_SD = np.array([0.05, 0.1])


@pytest.fixture(scope="module")
def linear():
    """A problem with a Gaussian posterior, its bounds far away, and that posterior's mean and covariance."""
    a, B = MEASURED - [0.05, 0.2, 0.1, 0.1], np.array([[1.0, 0.2], [0.5, 2.0], [-0.3, 1.0], [1.5, -1.0]])
    parameters = [Parameter(f"x{k}", 0.1, -9.0, 9.0, Normal(float(sd))) for k, sd in enumerate(PRIOR_SD)]
    problem = UpdatingProblem(Linear(a, B), ModalData(MEASURED, covariance_hz2=COVARIANCE), parameters)
    precision = B.T @ np.linalg.solve(COVARIANCE, B) + np.diag(PRIOR_SD**-2.0)
    mean = np.linalg.solve(precision, B.T @ np.linalg.solve(COVARIANCE, MEASURED - a))
    return problem, mean, np.linalg.inv(precision)


def test_posterior_is_the_gaussian_of_closed_form(linear):
    problem, mean, covariance = linear
    theta = np.random.default_rng(5).multivariate_normal(mean, 4.0 * covariance, 30)
    expected = multivariate_normal(mean, covariance).logpdf(theta)
    given = problem.log_prob(theta)
    assert_allclose(given - given[0], expected - expected[0], rtol=1e-9, atol=1e-9)
    assert_array_equal(given, [problem.log_prob(t) for t in theta])


def test_gradient_of_the_posterior(linear):
    problem, mean, covariance = linear
    theta = np.random.default_rng(6).multivariate_normal(mean, 4.0 * covariance, 30)
    expected = -(theta - mean) @ np.linalg.inv(covariance)
    assert_allclose(problem.log_prob_and_grad(theta)[1], expected, rtol=1e-9, atol=1e-8)


def test_gauss_newton_finds_the_maximum_and_its_curvature(linear):
    problem, mean, covariance = linear
    found = local_maxima(problem, starts=4)
    assert len(found) == 1
    assert_allclose(found[0].theta, mean, atol=1e-6)
    u = ((mean - problem.offset) / problem.scale)[None]
    hessian = GaussNewton(problem)(u)[2][0] / np.outer(problem.scale, problem.scale)
    assert_allclose(hessian, np.linalg.inv(covariance), rtol=1e-6)
    by_differences = hessian_at(problem, mean)[0] / np.outer(problem.scale, problem.scale)
    assert_allclose(by_differences, np.linalg.inv(covariance), rtol=1e-6)


def test_identifiability_is_the_information_of_the_covariance(linear):
    problem, _, covariance = linear
    found = identifiability(problem)
    information = np.linalg.inv(covariance) - np.diag(PRIOR_SD**-2.0)
    assert_allclose(found.fisher_information, information, rtol=1e-9)
    # the standard deviation of a prior is computed within four of them
    assert_allclose(found.remaining_sd * PRIOR_SD, np.sqrt(np.diag(covariance)), rtol=1e-3)


@pytest.mark.usefixtures("refits")
def test_draws_have_the_moments_of_closed_form(linear):
    from fmu import find_map, sample
    from fmu.analysis.convergence.diagnostics import summary
    from fmu.analysis.held_out.modes import leave_one_out
    from fmu.analysis.trace.reading import parameter_draws

    problem, mean, covariance = linear
    trace = sample(problem, draws=400, warmup=60, chains=4, seed=3, maxima=find_map(problem, starts=2))
    table = summary(trace)
    draws = parameter_draws(trace).reshape(-1, 2)
    assert np.all(table["ess_bulk"] > 1000)
    assert_allclose(draws.mean(axis=0), mean, atol=5 * table["mcse_mean"].max())
    sd = np.sqrt(np.diag(covariance))
    # a correlation and a relative standard deviation from 1000 effective draws, five standard errors
    assert_allclose(np.cov(draws.T) / np.outer(sd, sd), covariance / np.outer(sd, sd), atol=5 * np.sqrt(2 / 1000))
    assert_allclose(trace["constant_data"]["covariance_hz2"], COVARIANCE)
    terms = trace["log_likelihood"]["frequency"].to_numpy()
    assert_allclose(terms.sum(axis=2).ravel(), problem.log_likelihood(draws), rtol=1e-9)
    _check_leave_one_out(leave_one_out(trace), problem)


def _check_leave_one_out(table, problem):
    """Each mode left out of the data: its density given the posterior of the others, in closed form."""
    B, a = problem.model.given.B, problem.model.given.a
    joint = multivariate_normal(a, COVARIANCE + B @ np.diag(PRIOR_SD**2) @ B.T)
    for i in range(4):
        rest = np.delete(np.arange(4), i)
        others = multivariate_normal(joint.mean[rest], joint.cov[np.ix_(rest, rest)])
        expected = joint.logpdf(MEASURED) - others.logpdf(MEASURED[rest])
        assert_allclose(table["elpd"].iloc[i], expected, atol=0.1)
    assert table["method"].isin(["refit", "importance weights"]).all()


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        (np.eye(2), r"covariance_hz2: must have shape \(4, 4\), modes x modes \(got \(2, 2\)\)"),
        (np.full((4, 4), np.nan), r"covariance_hz2: must be finite .*"),
        (np.diag([1.0, 0.0, 1.0, 1.0]), r"covariance_hz2\.1\.1: must be positive, a variance \(got 0\.0 Hz²\)"),
        (
            np.eye(4) + 0.5 * np.eye(4, k=1),
            r"covariance_hz2: must be symmetric \(got 0\.5 at 0\.1 and 0\.0 at 1\.0\)",
        ),
        (np.ones((4, 4)), r"covariance_hz2: must be positive definite \(got a lowest eigenvalue .*\)"),
    ],
)
def test_wrong_covariance(covariance, message):
    for make in (
        lambda: CorrelatedFrequencyTerm(MEASURED, covariance),
        lambda: ModalData(MEASURED, covariance_hz2=covariance),
    ):
        with pytest.raises(ValueError, match=f"^{message}$"):
            make()


def test_each_mode_given_the_others_where_shapes_have_errors_too():
    from fmu import FrequencyErrors, SeparableModel, ShapeErrors, find_map, sample
    from fmu.analysis.held_out.modes import leave_one_out

    K = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
    model = SeparableModel.from_terms(["k"], stiffness=[(1e4 * K, "k")], mass=[np.eye(3)])
    eigenvalues, shapes = np.linalg.eigh(1e4 * K)
    frequencies = np.sqrt(eigenvalues) / (2.0 * np.pi)
    measured = {"sensors": tuple((i, "x") for i in range(3)), "shapes": shapes + 0.05}
    data = ModalData(frequencies + 0.1, covariance_hz2=COVARIANCE[:3, :3], **measured)
    parameters, of_shapes = [Parameter("k", 1.0, 0.5, 2.0)], ShapeErrors(sd=0.1)
    problem = UpdatingProblem(model, data, parameters, error=[FrequencyErrors("absolute"), of_shapes])
    trace = sample(problem, "mh", draws=200, warmup=50, chains=2, seed=1, maxima=find_map(problem, starts=2))
    theta = trace["posterior"]["k"].to_numpy().reshape(-1, 1)
    error = CorrelatedFrequencyTerm(frequencies + 0.1, COVARIANCE[:3, :3])
    alone = UpdatingProblem(model, ModalData(frequencies, **measured), parameters, error=of_shapes)
    expected = error.log_prob_given_others(problem.frequencies(theta)) + alone.log_likelihood_terms(theta)
    found = trace["log_likelihood"]["frequency_given_others"].to_numpy().reshape(-1, 3)
    assert_allclose(found, expected, rtol=1e-9)
    joint = trace["log_likelihood"]["modes"].to_numpy().reshape(-1, 3)
    assert_allclose(joint.sum(axis=1), problem.log_likelihood(theta), rtol=1e-9)
    assert_allclose(leave_one_out(trace)["elpd"], np.log(np.mean(np.exp(-expected), axis=0)) * -1.0, atol=0.3)
