"""A model that is wrong in the same way in all tests of a structure."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

import fmu
from fmu.posterior.errors.slopes import residuals_of_term
from fmu.posterior.joint.joint_problem import simulate_next_test
from fmu.sampling import default_sampler
from tests.gradients import assert_gradient
from tests.shear_building import frequencies_hz, shear_building

pytestmark = pytest.mark.usefixtures("all_half_centred")

NAMES = ("k1", "k2", "k3")
SENSORS = ((0, "x"), (1, "x"), (2, "x"))
SHAPES = np.array([[0.35, -0.8, 0.7], [0.7, -0.5, -0.9], [1.0, 1.0, 0.5]])
SIGMA = fmu.Parameter("sigma", 0.02, 1e-3, 0.2)
ERRORS = {
    "frequencies": [fmu.FrequencyErrors("relative", sd=SIGMA)],
    "both": [fmu.FrequencyErrors("relative", sd=0.01), fmu.ShapeErrors(sd=SIGMA)],
}
VARIES = {
    "shared": {},
    "own": {"k1": "test"},
    "damage": {"k2": fmu.Damage(), "k3": fmu.Damage()},
    "population": {"k1": fmu.Population()},
}


def posed(varies="own", errors="frequencies", discrepancy=None):
    """Return three tests with different modes; the second has a mass more, and k3 is known in the third."""
    parameters = [fmu.Parameter(name, start, 0.3, 3.0) for name, start in zip(NAMES, [1.0, 1.2, 0.9], strict=True)]
    tests = []
    for t, modes in enumerate([(0, 1, 2), (2, 0), (0, 1)]):
        data = fmu.ModalData(
            np.array([0.07, 0.21, 0.29])[list(modes)] * (1 + 0.02 * t),
            numbers=[m + 1 for m in modes],
            labels=[f"mode {m}" for m in modes],
            sensors=SENSORS,
            shapes=SHAPES[:, modes] * [1.0, 1.1][t % 2],
        )
        known = {"k3": 0.8} if t == 2 and varies in ("own", "shared") else {}
        tests.append(
            fmu.Test(f"test {t}", data, group=f"state {t % 2}", masses={1: 0.3} if t == 1 else {}, known=known)
        )
    return fmu.JointProblem(
        shear_building(NAMES, mass=[1.0, 1.5, 1.2], dofs=SENSORS),
        tests,
        parameters,
        varies=VARIES[varies],
        pairing="index",
        error=ERRORS[errors] if isinstance(errors, str) else errors,
        reduction=False,
        discrepancy=fmu.Discrepancy(by="group") if discrepancy is None else discrepancy,
    )


def points(problem, n=3):
    return problem.start * np.random.default_rng(4).uniform(0.9, 1.1, (n, problem.ndim)) + 0.01


@pytest.mark.parametrize("errors", ERRORS)
@pytest.mark.parametrize("varies", VARIES)
def test_gradient_against_differences(varies, errors):
    problem = posed(varies, errors)
    theta = points(problem)
    gradient = problem.log_prob_and_grad(theta)[1]
    step = 1e-3 * np.maximum(np.abs(theta), 0.1)
    assert_gradient(gradient, problem.log_prob, theta, step, order=4, rtol=1e-6, of_largest=1e-6)


@pytest.mark.parametrize("errors", [*ERRORS.values(), [fmu.FrequencyErrors("absolute", sd=0.002)]])
def test_gradient_of_the_likelihood_without_the_discrepancy(errors):
    """It keeps the discrepancy's parameters, also where the errors have none, and its slopes along them are 0."""
    problem = posed("population", errors)
    (easier,) = problem.likelihood.easier()
    problem = problem.with_likelihood(easier)
    theta = points(problem)
    slopes = easier.terms_and_gradient(problem.layout.of_model(theta))[1]
    of_tau = [i - len(easier.noise) for i, one in enumerate(easier.noise) if one.name.startswith("tau")]
    assert of_tau
    assert np.all(slopes[..., of_tau] == 0.0)
    step = 1e-3 * np.maximum(np.abs(theta), 0.1)
    assert_gradient(problem.log_prob_and_grad(theta)[1], problem.log_prob, theta, step, order=4, of_largest=1e-6)


def covariance(problem, at, correlation=0.0):
    """Return all residuals at the parameters of the tests and their covariance, mode by mode, at one point."""
    likelihood = problem.likelihood
    seen, noise = likelihood.observed(at[None]), at[None, 9:]
    parts = [residuals_of_term(term, seen, noise, within=True) for term in likelihood.terms_of]
    r, J = (np.concatenate(x, axis=2)[0] for x in zip(*parts, strict=True))
    m, k, _ = J.shape
    labels = [label.split(": ")[1] for label in problem.data.labels]
    tau = dict(zip([p.name for p in likelihood.noise], noise[0], strict=True))
    tau = np.array([tau[f"tau {name}"] for name in NAMES])
    values = at[:9].reshape(3, 3)[problem.model.test_of_modes]
    A = J * (values * tau)[:, None]
    S = np.eye(m * k)
    for i in range(m):
        for j in range(m):
            alike = 1.0 if labels[i] == labels[j] else correlation
            S[i * k : (i + 1) * k, j * k : (j + 1) * k] += alike * A[i] @ A[j].T
    return r.ravel(), S


@pytest.mark.parametrize("errors", ERRORS)
@pytest.mark.parametrize("varies", ["own", "damage"])
def test_a_mode_sees_the_same_parameters_in_all_tests(varies, errors):
    problem, plain = posed(varies, errors), posed(varies, errors, ())
    theta = points(problem)
    alone = plain.likelihood.terms(problem.layout.of_model(theta)[:, :10]).sum(axis=1)
    for i, at in enumerate(problem.layout.of_model(theta)):
        r, S = covariance(problem, at)
        expected = alone[i] - np.sum(stats.norm.logpdf(r)) + stats.multivariate_normal.logpdf(r, cov=S)
        assert_allclose(problem.log_likelihood(theta[i]), expected, rtol=1e-9)


def test_each_datum_given_the_others_and_the_predicted_frequency():
    problem = posed("damage")
    theta = points(problem)
    at = problem.layout.of_model(theta)
    likelihood = problem.likelihood
    assert likelihood.couples_modes
    given = likelihood.terms_given_others(at)
    f = problem.frequencies(theta)
    sd = at[:, 9:10] * np.asarray(problem.data.frequencies_hz)
    for k in range(7):
        for i in range(3):
            r, S = covariance(problem, at[i])
            others = np.delete(np.arange(7), k)
            gain = np.linalg.solve(S[np.ix_(others, others)], S[others, k])
            mean, variance = gain @ r[others], S[k, k] - gain @ S[others, k]
            term = stats.norm.logpdf(r[k], mean, np.sqrt(variance)) - np.log(sd[i, k])
            assert_allclose(given[i, k], term, rtol=1e-8)
            shift, of_model = (x[i] for x in likelihood.error_given_others(likelihood.observed(at), at, k))
            assert_allclose(shift, -sd[i, k] * mean, rtol=1e-7, atol=1e-12)
            assert_allclose(of_model + sd[i, k] ** 2, sd[i, k] ** 2 * variance, rtol=1e-8)
    assert np.all(np.abs(f) > 0)


def test_a_model_error_does_not_average_out_over_tests():
    """With many tests the information is that of one whose measurement has no error."""
    found = []
    for n in (1, 30):
        f = frequencies_hz(shear_building(["k", "k", "k"]), [1.0])[0]
        data = [fmu.ModalData(f, labels=["1", "2", "3"]) for _ in range(2 * n)]
        tests = [fmu.Test(f"test {i}", one) for i, one in enumerate(data)]
        parameters = [fmu.Parameter("k", 1.0, 0.3, 3.0)]
        problem = fmu.JointProblem(
            shear_building(["k", "k", "k"]),
            tests,
            parameters,
            pairing="index",
            error=fmu.FrequencyErrors("relative", sd=0.02),
            reduction=False,
            discrepancy=fmu.Discrepancy(tau=0.1),
        )
        found.append(1 / np.sqrt(problem.quadratic(np.array([[1.0]]))[2][0, 0, 0]))
    # relative slopes are ½: the sd of k by three modes is √(τ² + (2σ)²/n_tests)/√3
    assert_allclose(found, [np.sqrt((0.1**2 + 0.04**2 / n) / 3) for n in (2, 60)], rtol=1e-6)


def test_rows_of_a_batch_are_those_of_single_points():
    problem = posed("own", "both")
    theta = points(problem, 5)
    assert [problem.log_prob(one) for one in theta] == problem.log_prob(theta).tolist()


def test_gibbs_sampling_is_the_default_for_populations():
    assert default_sampler(posed("population")) == "gibbs"


def test_a_further_test_has_the_error_that_the_data_show():
    """Two precise tests of one mode too high for the model: a further test is predicted high as well."""
    data = fmu.ModalData([0.08], sd_hz=1e-4, labels=["1"])
    parameters = [fmu.Parameter("k", 1.0, 0.5, 2.0, prior=fmu.Normal(0.02, mean=1.0))]
    problem = fmu.JointProblem(
        shear_building(["k", "k", "k"]),
        [fmu.Test("a", data), fmu.Test("b", data)],
        parameters,
        pairing="index",
        reduction=False,
        discrepancy=fmu.Discrepancy(tau=0.2),
    )
    theta, rng = np.full((400, 1), 1.0), np.random.default_rng(1)
    _, measured = simulate_next_test(problem, rng, theta)
    assert abs(problem.frequencies(theta)[0, 0] - 0.08) > 0.005
    assert_allclose(measured.mean(), 0.08, atol=1e-3)
    assert measured.std() < 1e-3


LOSS = np.array([0.0, 0.12, 0.0])


def damaged(discrepancy, stiffness=NAMES):
    """Return tests before and after damage of a building whose masses are not those of the model."""
    building = shear_building(NAMES, 2e6, [1000.0, 1450.0, 800.0])
    rng, tests = np.random.default_rng(1), []
    for state, loss in (("reference", 0.0 * LOSS), ("later", LOSS)):
        for k in range(2):
            f = frequencies_hz(building, 1.0 - loss)[0] * (1.0 + 0.002 * rng.standard_normal(3))
            tests.append(fmu.Test(f"{state} {k}", fmu.ModalData(f, sd_hz=0.002 * f), group=state))
    parameters = [fmu.Parameter(name, 1.0, 0.4, 1.8, prior=fmu.Normal(0.15, mean=1.0)) for name in set(stiffness)]
    return fmu.JointProblem(
        shear_building(stiffness, 2e6, [1000.0, 1100.0, 1000.0]),
        tests,
        sorted(parameters, key=lambda p: p.name),
        varies=dict.fromkeys(stiffness, fmu.Damage()),
        pairing="index",
        reduction=False,
        discrepancy=discrepancy,
    )


def losses_at_the_maximum(problem):
    """Return the losses at the maximum of the posterior, and their standard deviations by its curvature."""
    maximum = fmu.find_map(problem, starts=1)[0]
    theta = maximum.theta[None]
    step = 1e-4 * problem.scale * np.eye(problem.ndim)
    slopes = [
        problem.log_prob_and_grad(theta[0] + h)[1] - problem.log_prob_and_grad(theta[0] - h)[1] for h in step
    ]
    curvature = -np.array(slopes) / (2e-4 * problem.scale[:, None])
    sd = np.sqrt(np.diag(np.linalg.inv(0.5 * (curvature + curvature.T))))
    at = [k for k, name in enumerate(problem.names) if "loss" in name]
    return theta[0, at], sd[at]


def test_a_wrong_model_raises_no_false_alarm_where_the_scatter_is_known():
    """Without it, an undamaged storey seems to have lost stiffness; with it the loss is still found."""
    plain, sd = losses_at_the_maximum(damaged(()))
    assert plain[2] > 3 * sd[2]
    found, wider = losses_at_the_maximum(damaged(fmu.Discrepancy(tau=0.2)))
    assert np.all(wider > 1.5 * sd)
    assert np.all(np.abs(found - LOSS) < 2 * wider)
    assert found[1] > 2 * wider[1]


def test_a_common_loss_is_as_sure_as_without_scatter():
    """One stiffness scales all frequencies alike, and its error is the same before and after the damage."""
    one = ("k", "k", "k")
    _, sd = losses_at_the_maximum(damaged((), one))
    _, other = losses_at_the_maximum(damaged(fmu.Discrepancy(tau=0.2), one))
    assert_allclose(other, sd, rtol=0.1)


def test_a_failed_solve_leaves_the_errors_at_other_points_as_they_are():
    """The determinants of its factors, which are NaN, gave warnings when modes were left out."""
    problem = posed("population", "both", fmu.Discrepancy())
    theta, of = problem.layout.of_model(points(problem)), problem.likelihood
    seen = of.observed(theta)
    expected = of.error_given_others(seen, theta, 1)
    frequencies, slopes = seen.frequencies.copy(), seen.frequency_slopes.copy()
    frequencies[0] = slopes[0] = np.nan
    found = of.error_given_others(replace(seen, frequencies=frequencies, frequency_slopes=slopes), theta, 1)
    for one, other in zip(found, expected, strict=True):
        assert np.isnan(one[0])
        assert_allclose(one[1:], other[1:], rtol=1e-12)
