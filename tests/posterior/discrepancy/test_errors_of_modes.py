"""Errors of the modes themselves: correlated over the modes, and over the sensors."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

import fmu
from fmu.posterior.discrepancy.modes import _distances
from fmu.posterior.errors.slopes import residuals_of_term
from tests.gradients import assert_gradient
from tests.posterior.discrepancy import test_discrepancy_in_several_tests as several
from tests.posterior.discrepancy import test_embedded as embedded

KINDS = {
    "inferred": fmu.Discrepancy(kind="modes"),
    "given": fmu.Discrepancy(kind="modes", sd=0.05, correlation=0.6, shape_sd=0.2),
    "independent": fmu.Discrepancy(kind="modes", correlation=0.0),
    "both": (fmu.Discrepancy(by="group"), fmu.Discrepancy(kind="modes")),
}


def problem_of(kind, errors="relative, weighted"):
    return posed(KINDS[kind], errors)


def posed(discrepancy, errors):
    plain = embedded.problem_of("none", errors)
    return fmu.UpdatingProblem(
        plain.model.structure,
        plain.data,
        plain.parameters[:4],
        pairing="index",
        error=embedded.ERRORS[errors],
        discrepancy=discrepancy,
    )


@pytest.mark.parametrize("errors", embedded.ERRORS)
@pytest.mark.parametrize("kind", KINDS)
def test_gradient_against_differences(kind, errors):
    problem = problem_of(kind, errors)
    theta = embedded.points(problem)
    gradient = problem.log_prob_and_grad(theta)[1]
    assert_gradient(gradient, problem.log_prob, theta, 1e-3 * theta, order=4, rtol=1e-6, of_largest=1e-7)


def settings_at(problem, theta):
    """Return σ, ρ and σ_s at one point."""
    at = dict(zip(problem.names, theta, strict=True))
    return at.get("model error", 0.05), at.get("model error correlation", 0.6), at.get("model error shapes", 0.2)


@pytest.mark.parametrize("kind", ["inferred", "given"])
def test_frequencies_are_gaussian_with_the_sum_of_the_covariances(kind):
    problem = problem_of(kind)
    theta = embedded.points(problem)
    f = problem.frequencies(theta)
    measured = embedded.MEASURED
    sd = np.array([0.02, 0.03, 0.01]) / np.sqrt([1.0, 0.5, 2.0]) * measured
    for i in range(3):
        sigma, rho, _ = settings_at(problem, theta[i])
        error = sigma**2 * (rho + (1 - rho) * np.eye(3)) * np.outer(measured, measured)
        S = np.diag(sd**2) + error
        assert_allclose(problem.log_likelihood(theta[i]), stats.multivariate_normal.logpdf(measured, f[i], S))
        # the marginal density of two modes, and the third given them
        two = problem.using(["1", "3"])
        part = np.ix_([0, 2], [0, 2])
        expected = stats.multivariate_normal.logpdf(measured[[0, 2]], f[i, [0, 2]], S[part])
        assert_allclose(two.log_likelihood(theta[i]), expected)
        gain = np.linalg.solve(S[part], S[[0, 2], 1])
        shift, variance = (
            x[0] for x in two.likelihood.error_given_others(two.likelihood.observed(theta[[i]]), theta[[i]], 1)
        )
        assert_allclose(f[i, 1] + shift, f[i, 1] + gain @ (measured - f[i])[[0, 2]])
        assert_allclose(variance + sd[1] ** 2, S[1, 1] - gain @ S[[0, 2], 1])
        given = problem.likelihood.terms_given_others(theta[[i]])[0, 1]
        mean, deviation = f[i, 1] + shift, np.sqrt(variance + sd[1] ** 2)
        assert_allclose(given, stats.norm.logpdf(measured[1], mean, deviation))


@pytest.mark.parametrize("rho", [1e-9, 1e-150])
def test_the_information_on_a_correlation_near_zero_is_fishers(rho):
    """½ tr(S⁻¹∂S S⁻¹∂S), from the dense covariance S; at 1e-150 a search ends that meets the bound at 0."""
    problem, sigma = problem_of("inferred"), 0.05
    theta = np.array([*embedded.START, sigma, rho])
    found = problem.likelihood.quadratic(theta[None])[2][0, 4:, 4:]
    sd = np.array([0.02, 0.03, 0.01]) / np.sqrt([1.0, 0.5, 2.0])
    same, other = np.eye(3), 1.0 - np.eye(3)
    inverse = np.linalg.inv(np.diag(sd**2) + sigma**2 * (same + rho * other))
    slopes = (2.0 * sigma * (same + rho * other), sigma**2 * other)
    expected = [[0.5 * np.trace(inverse @ a @ inverse @ b) for a in slopes] for b in slopes]
    assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


def test_shapes_have_errors_at_the_sensors():
    problem, plain = problem_of("inferred", "shapes too"), embedded.problem_of("none", "shapes too")
    theta = embedded.points(problem)
    for one in theta:
        sigma, rho, of_shapes = settings_at(problem, one)
        seen = problem.likelihood.observed(one[None])
        f_term, s_term = problem.likelihood.terms_of
        r_f = residuals_of_term(f_term, seen, np.empty((1, 0)))[0][0, :, 0]
        S = np.eye(3) + (sigma / 0.02) ** 2 * (rho + (1 - rho) * np.eye(3))
        expected = plain.log_likelihood(one[:4]) - np.sum(stats.norm.logpdf(r_f))
        expected += stats.multivariate_normal.logpdf(r_f, cov=S)
        r_s = residuals_of_term(s_term, seen, np.empty((1, 0)))[0][0]
        for i in range(3):  # of unit length; orthogonal to the computed shape, so that there are two of three
            largest = np.max(np.abs(embedded.SHAPES[:, i])) / np.linalg.norm(embedded.SHAPES[:, i])
            V = 1 + (of_shapes * largest / 0.1) ** 2
            expected += 0.5 * np.sum(r_s[i] ** 2) * (1 - 1 / V) - np.log(V)
        assert_allclose(problem.log_likelihood(one), expected, rtol=1e-9)


def test_several_tests_have_the_errors_of_their_modes_in_common():
    problem = several.posed("damage", "frequencies", fmu.Discrepancy(kind="modes"))
    plain = several.posed("damage", "frequencies", ())
    theta = several.points(problem)
    labels = np.array([label.split(": ")[1] for label in problem.data.labels])
    same = labels[:, None] == labels
    alone = plain.likelihood.terms(problem.layout.of_model(theta)[:, :10]).sum(axis=1)
    for i, one in enumerate(theta):
        size, rho, _ = settings_at(problem, one)
        sd = one[problem.names.index("sigma")]
        r = (problem.frequencies(one) / np.asarray(problem.data.frequencies_hz) - 1.0) / sd
        S = np.eye(7) + (size / sd) ** 2 * (rho + (1 - rho) * same)
        expected = alone[i] - np.sum(stats.norm.logpdf(r)) + stats.multivariate_normal.logpdf(r, cov=S)
        assert_allclose(problem.log_likelihood(one), expected, rtol=1e-9)
    gradient = problem.log_prob_and_grad(theta)[1]
    step = 1e-3 * np.maximum(np.abs(theta), 0.1)
    assert_gradient(gradient, problem.log_prob, theta, step, order=4, rtol=1e-6, of_largest=1e-6)


def test_errors_that_are_all_known_need_no_names_of_their_own():
    """Those of shapes too, unless only frequencies were measured. The variances of equal errors add up."""
    one = KINDS["given"]
    sizes = {"sd": np.sqrt(2.0) * one.sd, "shape_sd": np.sqrt(2.0) * one.shape_sd}
    both, together = posed([one, one], "shapes too"), posed(replace(one, **sizes), "shapes too")
    theta = embedded.points(both)
    assert_allclose(both.log_likelihood(theta), together.log_likelihood(theta), rtol=1e-10)
    without = replace(one, shape_sd=None)
    assert posed([without, without], "relative, weighted").names == both.names
    with pytest.raises(ValueError, match=r"discrepancy.name: must be different .* \(got model error\)"):
        posed([without, without, fmu.Discrepancy()], "shapes too")


def test_simulated_data_have_the_covariance():
    problem = problem_of("given")
    theta, n = embedded.points(problem, 1), 3000
    f = problem.frequencies(theta)
    drawn = problem.simulate_data(np.random.default_rng(1), np.repeat(f, n, axis=0), np.repeat(theta, n, axis=0))
    relative = (drawn - f) / embedded.MEASURED
    noise = np.array([0.02, 0.03, 0.01]) / np.sqrt([1.0, 0.5, 2.0])
    expected = 0.05**2 * (0.6 + 0.4 * np.eye(3)) + np.diag(noise**2)
    assert_allclose(np.cov(relative.T), expected, atol=8e-2 * expected.max())


def test_sensors_close_to_one_another_have_alike_errors():
    problem = fmu.cases.load("cantilever-young")
    structure = problem.model.parts[0].structure
    nodes = np.asarray(structure.geometry.nodes)
    names = list(structure.geometry.row_of)
    sensors = [(names[1], "y"), (names[3], "y"), (fmu.RigidArm(names[3], (0.0, 0.0, 0.5)), "y"), (names[3], "x")]
    found = _distances(sensors, structure)
    apart = np.linalg.norm(nodes[1] - nodes[3])
    assert_allclose(found[0, 1], apart)
    assert_allclose(found[1, 2], 0.5)
    assert np.isinf(found[1, 3])
    assert np.isinf(_distances(sensors, None)[0, 1])


@pytest.mark.parametrize("sign", [(1, -1, 1), (-1, -1, 1)])
def test_a_sensor_turned_round_is_only_another_notation(sign):
    case = fmu.cases.load("cantilever-young")
    structure = case.model.parts[0].structure
    places = list(structure.geometry.row_of)[2:5]
    error = [fmu.FrequencyErrors(), fmu.ShapeErrors(sd=0.01)]

    def posterior(sign):
        sensors = tuple((place, "y" if one > 0 else "-y") for place, one in zip(places, sign, strict=True))
        shapes = np.array([[0.2, 0.5], [0.6, -0.4], [1.0, 1.0]]) * np.array(sign)[:, None]
        data = fmu.ModalData(np.asarray(case.data.frequencies_hz)[:2], sensors=sensors, shapes=shapes, sd_hz=1.0)
        of_modes = fmu.Discrepancy(kind="modes", sd=0.02, correlation=0.3, shape_sd=0.05, length=0.5)
        return fmu.UpdatingProblem(structure, data, case.parameters, error=error, discrepancy=of_modes)

    theta = np.array([p.start for p in case.parameters])
    plain, turned = (posterior(one) for one in ((1, 1, 1), sign))
    roots = [one.likelihood.errors.modes[0].root for one in (plain, turned)]
    assert_allclose(roots[1] @ roots[1].T, np.outer(sign, sign) * (roots[0] @ roots[0].T), rtol=1e-14)
    assert abs(roots[0][1, 0]) > 0.1
    assert_allclose(turned.log_likelihood(theta), plain.log_likelihood(theta), rtol=1e-10)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "modes", "tau": 0.1}, 'discrepancy.tau: must not be given with kind = "modes"'),
        ({"sd": 0.1}, 'discrepancy.sd: must not be given with kind = "embedded"'),
        ({"kind": "modes", "correlation": 1.0}, "correlation"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        fmu.Discrepancy(**settings)
