"""Scatter of the parameters that all modes have in common, wholly or in part."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

import fmu
from fmu.posterior.errors.slopes import residuals_of_term
from tests.gradients import assert_gradient
from tests.posterior.discrepancy import test_discrepancy_in_several_tests as several
from tests.posterior.discrepancy import test_embedded as embedded

KINDS = {
    "in part": fmu.Discrepancy(by="group", correlation=0.6),
    "one wholly": (
        fmu.Discrepancy(groups=("k2",), correlation=1.0),
        fmu.Discrepancy(tau=0.05, groups=("lower",), name="other"),
    ),
    "inferred": fmu.Discrepancy(correlation="inferred"),
    "both parts": (fmu.Discrepancy(), fmu.Discrepancy(correlation=1.0, name="in common")),
    "beside errors of modes": (fmu.Discrepancy(tau=0.06, correlation="inferred"), fmu.Discrepancy(kind="modes")),
}


def problem_of(kind, errors="relative, weighted"):
    plain = embedded.problem_of("none", errors)
    return fmu.UpdatingProblem(
        plain.model.structure,
        plain.data,
        plain.parameters[:4],
        pairing="index",
        error=embedded.ERRORS[errors],
        discrepancy=KINDS[kind],
    )


@pytest.mark.parametrize("errors", ["absolute", "eigenvalue", "inferred", "shapes, inferred"])
@pytest.mark.parametrize("kind", KINDS)
def test_gradient_against_differences(kind, errors):
    problem = problem_of(kind, errors)
    theta = embedded.points(problem)
    gradient = problem.log_prob_and_grad(theta)[1]
    assert_gradient(gradient, problem.log_prob, theta, 1e-3 * theta, order=4, rtol=1e-6, of_largest=1e-7)


def covariance(problem, kind, theta):
    """Return the computed frequencies and the covariance of the measured ones at one point, Hz and Hz²."""
    at = dict(zip(problem.names, theta, strict=True))
    f, J = (x[0] for x in problem.model.frequencies_and_gradient(theta[None, :4]))
    sd = np.array([0.02, 0.03, 0.01]) / np.sqrt([1.0, 0.5, 2.0]) * embedded.MEASURED
    tau, rho = {
        "in part": lambda: ([at[f"tau {name}"] for name in ("k1", "k2", "lower", "lower")], 0.6),
        "one wholly": lambda: ([0.0, at["tau"], 0.05, 0.05], [0.0, 1.0, 0.0, 0.0]),
        "inferred": lambda: (at["tau"], at["tau correlation"]),
    }[kind]()
    A, rho = J * theta[:4] * tau, np.broadcast_to(rho, 4)
    return f, np.diag(sd**2 + np.sum(A**2 * (1.0 - rho), axis=1)) + (A * rho) @ A.T


@pytest.mark.parametrize("kind", ["in part", "one wholly", "inferred"])
def test_frequencies_are_gaussian_with_the_covariance(kind):
    """All frequencies, some, and one given the others; simulated frequencies have it too."""
    problem, measured = problem_of(kind), embedded.MEASURED
    theta = embedded.points(problem)
    for one in theta:
        f, S = covariance(problem, kind, one)
        assert_allclose(problem.log_likelihood(one), stats.multivariate_normal.logpdf(measured, f, S), rtol=1e-10)
        two, part = problem.using(["1", "3"]), np.ix_([0, 2], [0, 2])
        expected = stats.multivariate_normal.logpdf(measured[[0, 2]], f[[0, 2]], S[part])
        assert_allclose(two.log_likelihood(one), expected, rtol=1e-10)
        gain = np.linalg.solve(S[part], S[[0, 2], 1])
        seen = two.likelihood.observed(one[None])
        shift, variance = (x[0] for x in two.likelihood.error_given_others(seen, one[None], 1))
        assert_allclose(shift, gain @ (measured - f)[[0, 2]], rtol=1e-9)
        noise = (0.03 / np.sqrt(0.5) * measured[1]) ** 2
        assert_allclose(variance + noise, S[1, 1] - gain @ S[[0, 2], 1], rtol=1e-9)
    n = 4000
    drawn = problem.simulate_data(np.random.default_rng(1), np.tile(f, (n, 1)), np.tile(theta[-1], (n, 1)))
    sd = np.sqrt(np.diag(S))
    assert_allclose(np.cov(drawn.T) / np.outer(sd, sd), S / np.outer(sd, sd), atol=6 * np.sqrt(2 / n))


@pytest.mark.parametrize("kind", ["in part", "one wholly", "inferred"])
def test_predictions_know_the_common_part_as_far_as_the_data_do(kind):
    """The errors of all modes given the data of two, against the dense covariance."""
    problem, n, used = problem_of(kind).using(["1", "3"]), 4000, [0, 2]
    one = embedded.points(problem, 1)[0]
    f, S = covariance(problem, kind, one)
    errors = S - np.diag((np.array([0.02, 0.03, 0.01]) / np.sqrt([1.0, 0.5, 2.0]) * embedded.MEASURED) ** 2)
    gain = np.linalg.solve(S[np.ix_(used, used)], errors[used]).T
    mean, C = f + gain @ (embedded.MEASURED - f)[used], errors - gain @ errors[used]
    many = np.tile(f, (n, 1)), np.tile(one, (n, 1))
    drawn = problem.likelihood.with_discrepancy(np.random.default_rng(1), *many, given_data=True)
    sd = np.sqrt(np.diag(C))
    assert_allclose((drawn.mean(axis=0) - mean) / sd, 0.0, atol=5 / np.sqrt(n))
    assert_allclose(np.cov(drawn.T) / np.outer(sd, sd), C / np.outer(sd, sd), atol=6 * np.sqrt(2 / n))


def test_frequencies_and_shapes_share_the_parameters():
    problem, plain = problem_of("inferred", "shapes too"), embedded.problem_of("none", "shapes too")
    for one in embedded.points(problem):
        S, seen = embedded.dense(problem, one)[0], problem.likelihood.observed(one[None])
        parts = [residuals_of_term(t, seen, one[None, 4:])[0][0] for t in problem.likelihood.terms_of]
        r = np.concatenate(parts, axis=1).ravel()
        values = np.linalg.eigvalsh(S)
        log_det = np.sum(np.log(values[values > 1e-9]))
        expected = plain.log_likelihood(one[:4]) + 0.5 * (r @ r - r @ np.linalg.pinv(S, rcond=1e-9) @ r - log_det)
        assert_allclose(problem.log_likelihood(one), expected, rtol=1e-9)


def test_at_a_correlation_of_one_the_density_is_the_mean_over_one_value_for_all_modes():
    """Monte Carlo over a stiffness that is wrong by the same factor in all modes."""
    plain = embedded.problem_of("none")
    theta, rng, n = plain.start, np.random.default_rng(2), 4000
    data = fmu.ModalData(plain.frequencies(theta) * [1.02, 0.99, 1.01])

    def posed(discrepancy):
        return fmu.UpdatingProblem(
            plain.model.structure, data, plain.parameters, pairing="index",
            error=fmu.FrequencyErrors("relative", sd=0.01), discrepancy=discrepancy,
        )  # fmt: skip

    alone, scatter = posed(()), posed(fmu.Discrepancy(tau=0.02, groups=("k2",), correlation=1.0))
    drawn = alone.log_likelihood(theta * (1.0 + np.outer(0.02 * rng.standard_normal(n), [0, 1, 0, 0])))
    weight = np.exp(drawn - drawn.max())
    error = weight.std() / weight.mean() / np.sqrt(n)
    found = scatter.log_likelihood(theta)
    assert abs(found - np.log(weight.mean()) - drawn.max()) < 4 * error
    assert abs(found - alone.log_likelihood(theta)) > 0.1


@pytest.mark.parametrize("errors", several.ERRORS)
def test_several_tests_have_it_in_common(errors):
    problem = several.posed("damage", errors, fmu.Discrepancy(by="group", correlation=0.5))
    plain = several.posed("damage", errors, ())
    theta = several.points(problem)
    at = problem.layout.of_model(theta)
    alone = plain.likelihood.terms(at[:, :10]).sum(axis=1)
    for i, one in enumerate(at):
        r, S = several.covariance(problem, one, correlation=0.5)
        expected = alone[i] - np.sum(stats.norm.logpdf(r)) + stats.multivariate_normal.logpdf(r, cov=S)
        assert_allclose(problem.log_likelihood(theta[i]), expected, rtol=1e-9)
    gradient = problem.log_prob_and_grad(theta)[1]
    step = 1e-3 * np.maximum(np.abs(theta), 0.1)
    assert_gradient(gradient, problem.log_prob, theta, step, order=4, rtol=1e-6, of_largest=1e-6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"correlation": 1.1}, r"correlation.*1\.1"),
        ({"correlation": "common"}, "correlation.*'common'"),
        ({"kind": "modes", "correlation": 1.0}, 'correlation: must be less than 1 with kind = "modes"'),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        fmu.Discrepancy(**settings)
