"""Scatter of the parameters over the modes: its density, and its derivatives against differences."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from scipy.linalg import block_diag

import fmu
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.posterior.discrepancy.embedded import Discrepancy
from fmu.posterior.discrepancy.likelihood import DiscrepantLikelihood
from fmu.posterior.discrepancy.one_test import cholesky
from fmu.posterior.errors.slopes import residuals_of_term
from fmu.progress.phases import solves
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
    "shapes, each": [
        fmu.FrequencyErrors("eigenvalue", sd=0.04, weights=[1.0, 0.5, 2.0]),
        fmu.ShapeErrors(sd=[[0.1, 0.2, 0.15], [0.05, 0.1, 0.1], [0.1, 0.08, 0.3]], weights=[2.0, 1.0, 1.5]),
    ],
    "shapes alone": [fmu.ShapeErrors(sd=0.1)],
    "shapes, inferred": [
        fmu.FrequencyErrors("eigenvalue", sd=0.04),
        fmu.ShapeErrors(sd=[[0.1, 0.2, 0.15], [0.05, 0.1, 0.1], [0.1, 0.08, 0.3]], model_sd=SIGMA),
    ],
    "shapes alone, inferred": [fmu.ShapeErrors(sd=SIGMA)],
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


OF_ONE_TEST = [
    "absolute",
    "relative, weighted",
    "eigenvalue",
    "inferred",
    "shapes too",
    "shapes, each",
    "shapes alone",
]


@pytest.mark.parametrize("lower", [0.2, -1.0])
@pytest.mark.parametrize("errors", OF_ONE_TEST)
@pytest.mark.parametrize("scatter", SCATTERS)
def test_one_test_has_the_density_of_residuals_in_general(scatter, errors, lower):
    """The short way of one test against matrices that any number of tests and quantities could share."""
    problem = problem_of(scatter, errors, lower).using(["1", "3"])
    theta, likelihood = points(problem), problem.likelihood
    expected = likelihood.terms_of_observed(likelihood.observed(theta), theta)
    assert_allclose(likelihood.terms(theta), expected, rtol=1e-12)
    terms, slopes = likelihood.terms_and_gradient(theta)
    assert_allclose(terms, expected, rtol=1e-12)
    value, gradient, _ = likelihood.quadratic(theta)
    assert_allclose(value, expected.sum(axis=1), rtol=1e-12)
    assert_allclose(slopes.sum(axis=1), gradient, rtol=0, atol=1e-10 * np.abs(gradient).max())


@pytest.mark.parametrize("errors", ["relative, weighted", "shapes too"])
def test_without_scatter_tau_has_no_slope(errors):
    problem = problem_of("common", errors)
    theta = np.array([[*START, 0.0]])
    expected = problem_of("none", errors).likelihood.terms_and_gradient(theta[:, :4])
    terms, slopes = problem.likelihood.terms_and_gradient(theta)
    assert_allclose(terms, expected[0], rtol=1e-10)
    assert_allclose(slopes[..., :4], expected[1], rtol=0, atol=1e-8 * np.abs(expected[1]).max())
    assert np.all(slopes[..., 4] == 0.0)


def test_squares_beyond_the_digits_have_no_density():
    """Above 1e14 their rounding errors would exceed 0.01 in the log-density."""
    usual = problem_of("none", "shapes too")
    data = fmu.ModalData(usual.frequencies(usual.start), sensors=SENSORS, shapes=SHAPES)
    errors = [fmu.FrequencyErrors("absolute", sd=1e-9), fmu.ShapeErrors(sd=0.1)]
    problem = fmu.UpdatingProblem(
        usual.model.structure, data, usual.parameters, pairing="index", error=errors,
        discrepancy=Discrepancy(tau=1e-9),
    )  # fmt: skip
    assert np.isfinite(problem.log_prob(problem.start))
    terms = problem.likelihood.terms(points(problem))
    assert np.any(np.isneginf(terms))
    seen = problem.likelihood.observed(points(problem))
    assert_allclose(terms, problem.likelihood.terms_of_observed(seen, points(problem)))


def test_a_matrix_that_rounding_makes_indefinite_spoils_no_other():
    matrices = np.array([np.diag([4.0, 9.0]), [[1.0, 2.0], [2.0, 1.0]], np.eye(2)])
    found = cholesky(matrices)
    assert_allclose(found[[0, 2]], [np.diag([2.0, 3.0]), np.eye(2)])
    assert np.all(np.isnan(found[1]))


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


def dense(problem, theta, whitened=True):
    """Return the covariance of all residuals at theta, mode by mode, and their slopes by the parameters.

    The residuals are scaled by the deviations at theta, or by one of 1 %.
    """
    likelihood, noise = problem.likelihood, theta[None, 4:]
    seen = likelihood.observed(theta[None])
    parts = [residuals_of_term(term, seen, noise, within=True)[1][0] for term in likelihood.terms_of]
    sd = [np.sqrt(np.atleast_2d(term.spread.variance(noise)[0])).T / 0.01 for term in likelihood.terms_of]
    m = len(MEASURED)
    blocks, slopes = [], []
    T = np.zeros(4)
    T[likelihood.errors.of_mode] = np.sqrt(likelihood.errors.variances(noise)[0][0])
    T *= likelihood.errors.scale(theta[:4])
    for i in range(m):
        J = np.concatenate([part[i] for part in parts])
        unit = np.ones(len(J)) if whitened else np.concatenate([one[i] for one in sd])
        projection = np.eye(len(J))
        if likelihood.needs_shapes:
            term = next(term for term in likelihood.terms_of if term.needs_shapes)
            psi = np.zeros(len(J))
            psi[-3:] = seen.shapes[0, :, i] / np.sqrt(term.spread.variance(noise)[0, :, i])
            projection -= np.outer(psi, psi) / (psi @ psi)
        S = projection + (J * T**2) @ J.T
        blocks.append(S * np.outer(unit, unit))
        slopes.append(J * unit[:, None])
    slopes, k = np.concatenate(slopes), likelihood.errors.in_common
    common = slopes[:, k] * likelihood.errors.scale(theta[:4])[k]
    return block_diag(*blocks) + (common * likelihood.errors.variances(noise)[1][0]) @ common.T, slopes


@pytest.mark.parametrize("errors", [name for name in ERRORS if "shapes" in name])
def test_residuals_of_a_mode_share_its_parameters(errors):
    """Frequency and shape are jointly Gaussian in the q of q + 1 dimensions that their residuals can lie in."""
    problem = problem_of("some", errors)
    theta = points(problem)
    plain = problem_of("none", errors).likelihood
    keep = [problem.names.index(name) for name in (*problem.names[:4], *(p.name for p in plain.noise))]
    alone = plain.terms(theta[:, keep]).sum(axis=1)
    for i, one in enumerate(theta):
        S = dense(problem, one)[0]
        r = np.concatenate(
            [
                np.concatenate(
                    [
                        residuals_of_term(t, problem.likelihood.observed(one[None]), one[None, 4:])[0][0, k]
                        for t in problem.likelihood.terms_of
                    ]
                )
                for k in range(3)
            ]
        )
        values = np.linalg.eigvalsh(S)
        values = values[values > 1e-9]
        expected = (
            alone[i] + 0.5 * r @ r - 0.5 * r @ np.linalg.pinv(S, rcond=1e-9) @ r - 0.5 * np.sum(np.log(values))
        )
        assert_allclose(problem.likelihood.terms(one[None]).sum(), expected, rtol=1e-9)


def test_the_density_is_the_mean_over_the_parameters_of_each_mode():
    """Monte Carlo over θ(1 + τ z), with one z for the frequency and the shape of a mode."""
    plain, problem = problem_of("none", "shapes too"), problem_of("given", "shapes too")
    theta, rng, n = problem.start[None], np.random.default_rng(2), 1500
    seen = plain.model.observed(theta)
    data = dataclasses.replace(
        plain.data,
        frequencies_hz=seen.frequencies[0] * [1.025, 0.975, 1.03],
        shapes=seen.shapes[0] * [[1.02, 0.98, 1.0], [0.97, 1.03, 1.0], [1.0, 1.0, 1.03]],
    )
    errors = [fmu.FrequencyErrors("relative", sd=0.01), fmu.ShapeErrors(sd=0.01)]
    arguments = (plain.model.structure, data, plain.parameters)
    plain = fmu.UpdatingProblem(*arguments, pairing="index", error=errors)
    scatter = fmu.UpdatingProblem(*arguments, pairing="index", error=errors, discrepancy=Discrepancy(tau=0.02))
    z = 0.02 * rng.standard_normal((n, 4))
    drawn = plain.likelihood.terms(theta * (1.0 + np.concatenate([z, -z])))
    weights = np.exp(drawn - drawn.max(axis=0))
    mean = np.log(weights.mean(axis=0)) + drawn.max(axis=0)
    error = weights.std(axis=0) / weights.mean(axis=0) / np.sqrt(2 * n)
    change = scatter.likelihood.terms(theta)[0] - plain.likelihood.terms(theta)[0]
    assert np.all(np.abs(change) > 0.2)
    assert np.all(np.abs(scatter.likelihood.terms(theta)[0] - mean) < 4 * error)


@pytest.mark.parametrize("errors", ["inferred", "shapes too", "shapes, inferred"])
def test_rows_of_a_batch_are_those_of_single_points(errors):
    problem = problem_of("by group", errors)
    theta = points(problem, 7)
    assert [problem.log_prob(one) for one in theta] == problem.log_prob(theta).tolist()


def test_without_scatter_the_density_is_that_of_the_errors_alone():
    plain, problem = problem_of("none"), problem_of("common")
    theta = np.array([[*START, 1e-9]])
    assert_allclose(problem.likelihood.terms(theta), plain.likelihood.terms(theta[:, :4]), rtol=1e-10)


@pytest.mark.parametrize("errors", ["absolute", "inferred", "shapes too", "shapes alone, inferred"])
def test_the_information_is_that_of_the_means_and_fishers_of_the_deviations(errors):
    """JᵀS⁻¹J of theta, ½ tr(S⁻¹∂S S⁻¹∂S) of τ and of σ, from the dense covariance."""
    problem = problem_of("common", errors)
    theta = points(problem, 2)
    found = problem.likelihood.quadratic(theta)[2]

    def covariance(at):
        return dense(problem, at, whitened=False)

    for i, one in enumerate(theta):
        S, J = covariance(one)
        inverse = np.linalg.pinv(S, rcond=1e-9)
        assert_allclose(found[i, :4, :4], J.T @ inverse @ J, rtol=1e-6, atol=1e-7 * found[i, 0, 0])
        step = 1e-6 * one
        slopes = [
            (covariance(one + h)[0] - covariance(one - h)[0]) / (2 * step[k])
            for k, h in enumerate(np.diag(step))
            if k >= 4
        ]
        of_noise = [[0.5 * np.trace(inverse @ a @ inverse @ b) for a in slopes] for b in slopes]
        exact = slice(1, None) if "shapes alone" in errors else slice(None)  # of σ of shapes it is approximate
        assert_allclose(found[i, 4:, 4:][exact, exact], np.array(of_noise)[exact, exact], rtol=1e-4)


def test_simulated_data_have_the_scatter(monkeypatch):
    """The draws of a run repeat each other; each is solved once."""
    problem = problem_of("common", "inferred")
    theta, rng, n = points(problem, 1), np.random.default_rng(1), 2_000
    seen = problem.likelihood.observed(theta)
    scatter = np.sum((seen.frequency_slopes * theta[:, None, :4] * theta[0, -1]) ** 2, axis=2)
    V = (scatter + problem.likelihood.frequency_term.spread.variance(theta[:, 4:]))[0]
    solved, observed = [], DiscrepantLikelihood.observed
    monkeypatch.setattr(
        DiscrepantLikelihood, "observed", lambda self, at: solved.append(len(at)) or observed(self, at)
    )
    drawn = problem.simulate_data(rng, np.repeat(seen.frequencies, n, axis=0), np.repeat(theta, n, axis=0))
    assert solved == [1]
    assert_allclose(drawn.var(axis=0), V, rtol=6 * np.sqrt(2 / n))


@pytest.mark.parametrize("errors", ["inferred", "shapes too"])
def test_the_cost_of_a_gradient_is_counted(errors):
    """Matrices have exact second derivatives of frequencies and shapes."""
    problem = problem_of("common", errors)
    begun = solves()
    problem.log_prob_and_grad(points(problem, 5))
    assert solves() - begun == 5 == 5 * problem.solves_per_gradient


def test_without_second_derivatives_of_shapes_their_slopes_are_differenced(monkeypatch):
    """In each of four parameters."""
    exact = problem_of("common", "shapes, inferred")
    monkeypatch.setattr(PairedStructure, "gives_shape_curvature", False)
    problem = problem_of("common", "shapes, inferred")
    assert problem.solves_per_gradient == 9
    theta = points(problem)
    expected, begun = exact.log_prob_and_grad(theta)[1], solves()
    assert_allclose(problem.log_prob_and_grad(theta)[1], expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    assert solves() - begun == 3 * 9


def test_ascents_end_at_a_scatter_of_zero(monkeypatch):
    """Data without errors leave no scatter. Ascents used to bounce off τ = 0, where a prior has no density."""
    problem, calls = problem_of("by group"), []
    measured = problem.frequencies(problem.start)
    parameters = [dataclasses.replace(p, updated=p.name == "k1") for p in problem.parameters[:4]]
    exact = fmu.UpdatingProblem(
        problem.model.structure, fmu.ModalData(measured), parameters, pairing="index",
        error=ERRORS["relative, weighted"], discrepancy=SCATTERS["by group"],
    )  # fmt: skip
    quadratic = type(exact).quadratic
    monkeypatch.setattr(type(exact), "quadratic", lambda *given: calls.append(1) or quadratic(*given))
    found = fmu.find_map(exact, starts=8)
    assert len(found) == 1
    assert found[0].kind == "maximum"
    assert np.all(found[0].theta[1:] < 1e-9)
    assert len(calls) < 50


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
        ({"error": "modal-residual"}, "discrepancy: needs errors of frequencies or shapes"),
        ({"pairing": "soft"}, "discrepancy: needs errors of frequencies or shapes"),
        ({"error": fmu.StudentErrors("relative", sd=0.01)}, "discrepancy: needs Gaussian errors"),
        ({"error": fmu.MACErrors(sd=0.1)}, r"discrepancy: needs Gaussian errors .* \(got MACErrors\)"),
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
