"""Scatter of the parameters over the modes: its density, and its derivatives against differences."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

import fmu
from fmu.fem.pairing.modal_model import ModalModel
from fmu.posterior.discrepancy.embedded import Discrepancy
from tests.gradients import assert_gradient
from tests.shear_building import shear_building

START = np.array([1.0, 1.3, 0.9, 1.1])
MEASURED = np.array([0.09, 0.25, 0.38])
SENSORS = ((0, "x"), (1, "x"), (3, "x"))
SHAPES = np.array([[0.3, -0.8, 0.7], [0.6, -0.7, -0.9], [1.0, 1.0, 0.4]])
SIGMA = fmu.Parameter("sigma", start=0.1, lower=1e-3, upper=2.0)
ERRORS = {
    "absolute": [fmu.FrequencyErrors("absolute", sd=0.01)],
    "relative, weighted": [fmu.FrequencyErrors("relative", sd=[0.02, 0.03, 0.01], weights=[1.0, 0.5, 2.0])],
    "eigenvalue": [fmu.FrequencyErrors("eigenvalue", sd=1 / 16)],
    "inferred": [fmu.FrequencyErrors("relative", sd=SIGMA)],
    "shapes too": [fmu.FrequencyErrors("relative", sd=0.02), fmu.ShapeErrors(sd=0.1)],
}
SCATTERS = {
    "common": [Discrepancy()],
    "given": [Discrepancy(tau=0.07)],
    "by group": [Discrepancy(by="group")],
    "some": [Discrepancy(groups=("k2",)), Discrepancy(tau=0.05, groups=("lower",))],
}


def problem_of(scatter, errors="relative, weighted", lower=0.2):
    names = ["k1", "k2", "k3", "k4"]
    parameters = [
        fmu.Parameter(name, start, lower, 3.0, group="lower" if name in ("k3", "k4") else "")
        for name, start in zip(names, START, strict=True)
    ]
    model = shear_building(names, mass=[1.0, 1.5, 1.2, 0.8])
    data = fmu.ModalData(MEASURED, sensors=SENSORS, shapes=SHAPES)
    return fmu.UpdatingProblem(
        model, data, parameters, pairing="index", error=ERRORS[errors], discrepancy=SCATTERS.get(scatter, ())
    )


def points(problem, n=3):
    return problem.start * np.random.default_rng(3).uniform(0.8, 1.2, (n, problem.ndim))


@pytest.mark.parametrize("errors", ERRORS)
@pytest.mark.parametrize("scatter", SCATTERS)
def test_gradient_against_differences(scatter, errors):
    problem = problem_of(scatter, errors)
    theta = points(problem)
    terms, gradient = problem.likelihood.terms_and_gradient(theta)
    assert_allclose(terms, problem.likelihood.terms(theta), rtol=1e-10)
    assert_gradient(gradient, problem.likelihood.terms, theta, 1e-3 * theta, order=4, rtol=1e-6, of_largest=1e-7)


@pytest.mark.parametrize("lower", [0.2, -1.0])
def test_the_density_is_gaussian_with_the_sum_of_the_variances(lower):
    """Relative scatter if a parameter is never 0, else in units of its start."""
    problem = problem_of("by group", lower=lower)
    theta = points(problem)
    tau = dict(zip(problem.names[4:], theta[:, 4:].T, strict=True))
    tau = np.stack([tau[f"tau {name}"] for name in ("k1", "k2", "lower", "lower")], axis=1)
    f, J = problem.model.frequencies_and_gradient(theta[:, :4])
    unit = theta[:, :4] if lower > 0 else START
    sd = np.array([0.02, 0.03, 0.01]) / np.sqrt([1.0, 0.5, 2.0]) * MEASURED
    V = sd**2 + np.sum((J * (tau * unit)[:, None]) ** 2, axis=2)
    assert_allclose(problem.likelihood.terms(theta), stats.norm.logpdf(MEASURED, f, np.sqrt(V)), rtol=1e-12)


def test_rows_of_a_batch_are_those_of_single_points():
    problem = problem_of("by group", "inferred")
    theta = points(problem, 7)
    assert [problem.log_prob(one) for one in theta] == problem.log_prob(theta).tolist()


def test_without_scatter_the_density_is_that_of_the_errors_alone():
    plain, problem = problem_of("none"), problem_of("common")
    theta = np.array([[*START, 1e-9]])
    assert_allclose(problem.likelihood.terms(theta), plain.likelihood.terms(theta[:, :4]), rtol=1e-10)


@pytest.mark.parametrize("errors", ["absolute", "relative, weighted", "inferred"])
def test_simulated_data_have_the_scatter_and_the_information_is_that_of_their_scores(errors):
    """Fisher's information is the covariance of the gradient over data that are simulated at theta."""
    problem = problem_of("common", errors)
    theta, rng, n = points(problem, 1), np.random.default_rng(1), 20_000
    seen = problem.likelihood.observed(theta, True)
    term = problem.likelihood.frequency_term
    noise = theta[:, 4:]
    V = (seen.frequency_variance + term.spread.variance(noise))[0]
    drawn = problem.simulate_data(rng, np.repeat(seen.frequencies, n, axis=0), np.repeat(theta, n, axis=0))
    assert_allclose(drawn.var(axis=0), V, rtol=6 * np.sqrt(2 / n))
    score = (drawn - seen.frequencies) / V
    slopes = seen.frequency_variance_by_noise[0].copy()
    for k, slope in term.spread.slopes(noise).items():
        slopes[:, k] += slope[0]
    of_theta = (
        score[..., None] * seen.frequency_slopes[0]
        + (score**2 - 1 / V)[..., None] / 2 * (seen.frequency_variance_slopes[0])
    )
    of_noise = (score**2 - 1 / V)[..., None] / 2 * slopes
    gradient = np.concatenate([of_theta, of_noise], axis=2).sum(axis=1)
    information = problem.likelihood.quadratic(theta)[2][0]
    size = np.sqrt(np.diag(information))
    assert_allclose(np.cov(gradient.T) / np.outer(size, size), information / np.outer(size, size), atol=0.1)


def test_no_gradient_asks_for_a_frequency_beyond_the_bounds():
    """There a surrogate is not trained. The differences are close to exact second derivatives."""
    problem = problem_of("common")
    problem.likelihood.model = model = Watched(problem.model)
    inside = np.array([[0.2, 3.0, 0.2, 1.1, 0.05], [0.2 + 1e-6, 1.0, 3.0 - 1e-9, 3.0, 0.2]])
    gradient = problem.likelihood.terms_and_gradient(inside)[1]
    assert model.lowest >= 0.2
    assert model.highest <= 3.0
    exact = problem_of("common").likelihood.terms_and_gradient(inside)[1]
    assert_allclose(gradient, exact, rtol=0, atol=1e-3 * np.abs(exact).max())
    theta = points(problem)
    exact = problem_of("common").likelihood.terms_and_gradient(theta)[1]
    assert_allclose(
        problem.likelihood.terms_and_gradient(theta)[1], exact, rtol=0, atol=1e-7 * np.abs(exact).max()
    )


class Watched(ModalModel):
    """A model without exact second derivatives that keeps the range of the parameters that it was solved at."""

    def __init__(self, model):
        self.model, self.lowest, self.highest = model, np.inf, -np.inf
        self.n_parameters, self.n_modes = model.n_parameters, model.n_modes

    def frequencies_and_gradient(self, theta):
        self.lowest, self.highest = min(self.lowest, theta.min()), max(self.highest, theta.max())
        return self.model.frequencies_and_gradient(theta)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"discrepancy": Discrepancy(groups=("k9",))}, "discrepancy.groups: must be of"),
        ({"error": "modal-residual"}, "discrepancy: needs errors of frequencies of one test"),
        ({"pairing": "soft"}, "discrepancy: needs errors of frequencies of one test"),
        ({"error": fmu.StudentErrors("relative", sd=0.01)}, "discrepancy: needs Gaussian errors"),
        ({"error": fmu.ShapeErrors(sd=0.1)}, "discrepancy: needs errors of frequencies"),
        ({"discrepancy": [Discrepancy(), Discrepancy()]}, "discrepancy.name: must be different"),
    ],
)
def test_wrong_settings_are_refused(change, message):
    names = ["k1", "k2", "k3", "k4"]
    parameters = [fmu.Parameter(name, 1.0, 0.2, 3.0) for name in names]
    data = fmu.ModalData(MEASURED, sensors=SENSORS, shapes=SHAPES)
    arguments = {"pairing": "index", "discrepancy": Discrepancy()} | change
    with pytest.raises(ValueError, match=message):
        fmu.UpdatingProblem(shear_building(names), data, parameters, **arguments)
