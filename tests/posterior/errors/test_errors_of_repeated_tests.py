"""Errors whose standard deviations come from the scatter of repeated tests, in the likelihood and its checks."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2, f, kstest, norm, t

import fmu
from fmu.analysis.fit.check import RESIDUALS, TEST
from fmu.analysis.fit.checks import checks_of
from fmu.analysis.fit.reweighting import by_draws, by_linearised_model
from fmu.analysis.prediction import central_sd, noise_sd, predict_frequencies
from fmu.analysis.start.prior_prediction import prior_prediction
from fmu.analysis.trace.misfit import has_scores
from fmu.posterior.data.estimated_sd import student_scores
from fmu.posterior.data.repeated import RepeatedTests, mean_shapes, shapes_sd
from fmu.posterior.data.stacked import freedom_of_shapes
from fmu.posterior.joint.configurations import stack_tests
from tests.shear_building import frequencies_hz, shear_building

RNG = np.random.default_rng(2)
VALUES = np.array([10.0, 24.0, 41.0]) * (1.0 + 1e-3 * RNG.standard_normal((8, 3)))
PARAMETERS = [fmu.Parameter(name, start, 5.0, 50.0) for name, start in zip("abc", (10.0, 24.0, 41.0), strict=True)]


def posed(data, error="frequency"):
    return fmu.UpdatingProblem(fmu.BlackBoxModel(lambda theta: theta, 3), data, PARAMETERS, error=error)


def scores_of(scatter, z, n, n_modes):
    """Return normal scores by the distributions of SciPy for errors of n tests, in their standard deviations."""
    if scatter == "joint":
        nu, before = n - 1 - np.arange(len(z)), np.cumsum(z**2) - z**2
        return norm.ppf(t.cdf(z * np.sqrt(nu / (n - n_modes - 2 + before)), nu))
    nu = n - 1 if scatter == "each" else n_modes * (n - 1)
    errors = z * t.ppf(0.975, nu) / norm.ppf(0.975)
    if scatter == "each":
        return norm.ppf(t.cdf(errors, nu))
    q, k = np.sum(errors**2), len(z)
    return errors * np.sqrt(chi2.isf(f.sf(q / k, k, nu), k) / q)


@pytest.mark.parametrize("use", [(), (True, False, True)])
@pytest.mark.parametrize("scatter", ["each", "pooled", "joint"])
def test_misfit_of_the_used_modes_is_that_of_their_scores(scatter, use):
    data = fmu.ModalData.from_tests(VALUES, scatter=scatter, use=use)
    problem, theta = posed(data), np.array([[10.01, 24.2, 40.9]])
    used = np.flatnonzero(use) if use else np.arange(3)
    C = np.diag(np.square(data.sd_hz)) if data.covariance_hz2 is None else data.covariance_hz2[np.ix_(used, used)]
    if data.covariance_hz2 is None:
        C = C[np.ix_(used, used)]
    z = np.zeros(3)
    z[used] = np.linalg.solve(np.linalg.cholesky(C), (theta[0] - data.frequencies_hz)[used])
    expected = scores_of(scatter, z[used], 8, 3) ** 2
    assert_allclose(problem.likelihood.misfit(problem.likelihood.observed(theta), theta)[0, 0], expected)
    fewer = problem.using(["1", "3"]).likelihood
    assert fewer.misfit(fewer.observed(theta), theta).shape == (1, 1, 2)


def test_standard_deviations_of_the_users_own_are_gaussian():
    tests = RepeatedTests(VALUES[:2])
    own = fmu.ModalData(tests.mean().frequencies_hz, sd_hz=[0.1, 0.2, 0.3], tests=tests)
    term = posed(own).likelihood.terms_of[0]
    assert term.tests is None
    assert_array_equal(term.normal_scores(np.array([6.0, 6.0, 6.0])), 6.0)
    covariance = fmu.ModalData(tests.mean().frequencies_hz, covariance_hz2=np.diag([0.1, 0.2, 0.3]), tests=tests)
    assert posed(covariance).likelihood.terms_of[0].tests is None
    assert posed(fmu.ModalData.from_tests(VALUES[:2])).likelihood.terms_of[0].tests is not None


RELATIVE = fmu.FrequencyErrors("relative")


@pytest.mark.parametrize(
    ("error", "scatter", "n"),
    [("frequency", "each", 2), (RELATIVE, "each", 3), (RELATIVE, "pooled", 2), ("frequency", "joint", 6)],
)
def test_intervals_of_a_new_mean_are_students(error, scatter, n):
    """The interval of 50 %, from Gaussian draws that are right at 95 %, held 86 % for two tests."""
    data = fmu.ModalData.from_tests(VALUES[:n], scatter=scatter)
    problem, mean = posed(data, error), np.tile(np.asarray(data.frequencies_hz), (20_000, 1))
    drawn = (problem.simulate_data(np.random.default_rng(1), mean) - mean)[:, 0]
    nu = {"each": n - 1, "pooled": 3 * (n - 1), "joint": n - 3}[scatter]
    if scatter == "joint":
        scale = np.sqrt(data.covariance_hz2[0, 0] * (nu - 2) / nu)
    else:
        scale = data.sd_hz[0] * norm.ppf(0.975) / t.ppf(0.975, nu)
    assert kstest(drawn / scale, t(nu).cdf).pvalue > 1e-3


@pytest.mark.parametrize("scatters", [("pooled", None), ("joint", "pooled"), ("each", "each")])
def test_a_joint_problem_treats_each_test_as_if_it_were_alone(scatters):
    """Each with its own repeats and used modes; the standard deviations of the second may be the user's own."""
    every = [
        fmu.ModalData.from_tests(VALUES[a : a + 6], scatter=scatter or "each", use=use)
        for a, scatter, use in zip((0, 2), scatters, ((), (True, False, True)), strict=True)
    ]
    if scatters[1] is None:
        every[1] = dataclasses.replace(every[1], sd_hz=0.01)
    tests = [fmu.Test(name, data) for name, data in zip("AB", every, strict=True)]
    model = fmu.BlackBoxModel(lambda theta: theta, 3)
    joint = fmu.JointProblem(model, tests, PARAMETERS)
    hz = np.array([10.01, 24.2, 40.9])
    both, none = np.tile(hz, (1, 2)), np.empty((1, 0))
    of_joint = joint.likelihood.misfit(joint.likelihood.observed(both), both)[0, 0]
    alone = [posed(data).likelihood for data in every]
    assert_allclose(of_joint, np.concatenate([x.misfit(x.observed(hz[None]), hz[None])[0, 0] for x in alone]))
    term, used = joint.likelihood.terms_of[0], [0, 1, 2, 3, 5]
    terms = [x.terms_of[0] for x in alone]
    for own, expected in zip(
        term.given_others(both, none),
        zip(*(x.given_others(hz[None], none) for x in terms), strict=True),
        strict=True,
    ):
        assert_allclose(own[:, used], np.concatenate(expected, axis=1)[:, used])
    freedom = [x.freedom(none, mode)[0] for x in terms for mode in range(3)]
    assert_array_equal([term.freedom(none, mode)[0] for mode in used], np.array(freedom)[used])


def test_residuals_of_a_joint_problem_are_normal_scores():
    """At the true frequencies, the literal Gaussian had 3 % of p-values below 0.001."""
    rng, p, truth = np.random.default_rng(3), [], np.array([10.0, 24.0, 41.0])
    for _ in range(200):
        values = truth * (1.0 + 1e-3 * rng.standard_normal((2, 2, 3)))
        data = stack_tests(
            [fmu.Test(name, fmu.ModalData.from_tests(x)) for name, x in zip("AB", values, strict=True)]
        )
        term = fmu.FrequencyErrors().bind(data, lambda parameter: 0)
        squares = term.normal_scores((np.tile(truth, 2) - data.frequencies_hz) / data.sd_hz) ** 2
        p += [chi2.sf(np.sum(squares[:3]), 3), chi2.sf(np.sum(squares[3:]), 3)]
    for level in (0.001, 0.01, 0.1):
        assert np.mean(np.array(p) < level) == pytest.approx(level, abs=5 * np.sqrt(level * (1 - level) / 400))


def test_errors_of_new_means_in_a_joint_problem_are_students():
    tests = [fmu.Test(name, fmu.ModalData.from_tests(VALUES[:n])) for name, n in zip("AB", (2, 3), strict=True)]
    tests.append(fmu.Test("C", fmu.ModalData(VALUES[0], sd_hz=0.01)))
    joint = fmu.JointProblem(fmu.BlackBoxModel(lambda theta: theta, 3), tests, PARAMETERS)
    mean = np.tile(np.asarray(joint.data.frequencies_hz), (20_000, 1))
    z = (joint.simulate_data(np.random.default_rng(1), mean) - mean) / joint.data.sd_hz
    for t_, nu in ((0, 3), (3, 6)):
        assert kstest(z[:, t_] * t.ppf(0.975, nu) / norm.ppf(0.975), t(nu).cdf).pvalue > 1e-3
    assert kstest(z[:, 6], "norm").pvalue > 1e-3


def test_shapes_of_a_joint_problem_have_the_freedom_of_their_tests():
    sensors, shape = tuple((i, "x") for i in range(4)), np.array([0.5, 0.5, -0.5, 0.5])
    shapes = shape[:, None] + 0.01 * np.random.default_rng(1).standard_normal((3, 4, 3))
    data = [fmu.ModalData.from_tests(VALUES[:n], shapes[:n], sensors=sensors) for n in (2, 3)]
    data.append(dataclasses.replace(data[0], tests=None))
    stacked = stack_tests([fmu.Test(name, x) for name, x in zip("ABC", data, strict=True)])
    term = bound(stacked)
    assert_array_equal(term.nu, np.repeat([3.0, 6.0, np.inf], 3))
    r = RNG.standard_normal((5, 4, 9))
    expected = [bound(x).normal_scores(r[..., 3 * i : 3 * i + 3]) for i, x in enumerate(data)]
    assert_allclose(term.normal_scores(r), np.concatenate(expected, axis=2), rtol=1e-12)
    assert freedom_of_shapes(stack_tests([fmu.Test("A", data[2])])) is None


def test_standard_deviations_of_predictions_are_of_a_central_interval():
    """Student's distribution with one degree of freedom has no variance."""
    data = fmu.ModalData.from_tests(VALUES[:2], scatter="each")
    problem = posed(data, RELATIVE)
    trace = fmu.sample(problem, draws=200, warmup=60, seed=1, maxima=fmu.find_map(problem, starts=2))
    sd = np.array([noise_sd(trace, mode) for mode in "123"])
    assert_allclose(sd, data.sd_hz, rtol=0.5)
    predicted = predict_frequencies(trace)
    assert_allclose(predicted["noisy_sd"], central_sd(trace["posterior_predictive"]["frequency"].to_numpy()))
    assert np.all(predicted["noisy_sd"] < 4.0 * np.asarray(data.sd_hz))
    assert_allclose(prior_prediction(problem, 2000, 1).noise_sd, data.sd_hz, rtol=0.4)


def test_scatter_of_parameters_is_not_estimated_from_normal_scores():
    model = shear_building(["k"] * 3)
    measured = frequencies_hz(shear_building(["k1", "k2", "k3"]), np.array([1.0, 1.1, 0.93]))[0]
    parameters = [fmu.Parameter("k", 1.0, 0.2, 3.0, fmu.Normal(0.5, mean=1.0))]
    data = fmu.ModalData.from_tests(measured * (1.0 + 0.02 * np.random.default_rng(1).standard_normal((3, 3))))
    problem = fmu.UpdatingProblem.reduced(model, data, parameters, pairing="index")
    trace = fmu.sample(problem, draws=400, warmup=100, maxima=fmu.find_map(problem, starts=4))
    assert by_draws(trace) is None
    assert by_linearised_model(trace) is None
    # nor is the factor on residuals at which a check fails: they have heavier tails than their scores
    assert [x.shows for x in checks_of(trace) if x.kind == RESIDUALS] == ["residuals with p below 0.0025"]


def test_a_run_of_several_tests_says_that_its_squares_are_of_scores():
    tests = [fmu.Test(name, fmu.ModalData.from_tests(VALUES[:2])) for name in "AB"]
    gaussian = [fmu.Test(name, fmu.ModalData(VALUES[0], sd_hz=0.01)) for name in "AB"]
    for every, expected in ((tests, True), (gaussian, False)):
        problem = fmu.JointProblem(fmu.BlackBoxModel(lambda theta: theta, 3), every, PARAMETERS)
        maxima = fmu.find_map(problem, starts=2)
        trace = fmu.sample(problem, draws=20, warmup=20, seed=1, maxima=maxima)
        assert has_scores(trace) == expected
        shows = {"with p below" in check.shows for check in checks_of(trace) if check.kind in (RESIDUALS, TEST)}
        assert shows == {expected}


def bound(data, **settings):
    return fmu.ShapeErrors(**settings).bind(data, lambda parameter: 0)


def test_squared_scores_of_a_mean_shape_sum_to_chi_square():
    """Plain residuals of two tests took 18 % below 1 %: the components of a shape share one estimated scatter."""
    rng, phi, p = np.random.default_rng(5), np.array([0.5, 0.5, -0.5, 0.5]), []
    sensors = tuple((i, "x") for i in range(4))
    for _ in range(60):
        shapes = phi[:, None] + 0.01 * rng.standard_normal((2, 4, 10))
        data = fmu.ModalData.from_tests(10.0 + rng.uniform(size=(2, 10)), shapes, sensors=sensors)
        error = mean_shapes(shapes).T @ phi
        r = (mean_shapes(shapes) - error * phi[:, None]) / data.shapes_sd
        p.append(chi2.sf(np.sum(bound(data).normal_scores(r[None]) ** 2, axis=1)[0], 3))
    for level in (0.01, 0.05):
        assert np.mean(np.array(p) < level) == pytest.approx(level, abs=5 * np.sqrt(level * (1 - level) / 600))


def test_shapes_with_other_standard_deviations_are_gaussian():
    shapes = np.array([0.5, 0.5, -0.5, 0.5])[:, None] + 0.01 * RNG.standard_normal((3, 4, 2))
    shapes[2, :, 1] = np.nan
    sensors, values = tuple((i, "x") for i in range(4)), VALUES[:3, :2]
    data = fmu.ModalData.from_tests(values, shapes, sensors=sensors)
    assert_array_equal(bound(data).nu, [6.0, 3.0])
    z = RNG.standard_normal((5, 4, 2))
    of_scores, g = np.sum(bound(data).normal_scores(z) ** 2, axis=1), t.ppf(0.975, [6, 3]) / norm.ppf(0.975)
    assert_allclose(chi2.sf(of_scores, 3), f.sf(g**2 * np.sum(z**2, axis=1) / 3, 3, [6, 3]), rtol=1e-9)
    assert bound(data, sd=0.01).nu is None
    assert bound(data, weights=[1.0, 2.0]).nu is None
    own = dataclasses.replace(data, shapes_sd=2.0 * shapes_sd(shapes))
    assert bound(own).nu is None
    r = RNG.standard_normal((5, 4, 2))
    assert bound(own).normal_scores(r) is r
    left = data.with_frequencies(np.array([np.nan, 24.0]))
    assert_array_equal(bound(left).nu, [3.0])


@pytest.mark.parametrize("use", [(), (True, False, True), (True, True, False)])
def test_a_mode_given_the_others_by_regression(use):
    """With a joint scatter, its score is that of the t-value of the constant in its regression on the others."""
    truth, none = np.array([10.0, 24.0, 41.0]), np.empty((1, 0))
    data = fmu.ModalData.from_tests(VALUES, scatter="joint", use=use)
    errors, others = VALUES - truth, [k for k in (1, 2) if not use or use[k]]
    columns = np.column_stack([np.ones(8), errors[:, others]])
    constant = np.linalg.lstsq(columns, errors[:, 0])[0]
    left, nu = errors[:, 0] - columns @ constant, 7 - len(others)
    variance = left @ left / nu * np.linalg.inv(columns.T @ columns)[0, 0]
    expected = norm.ppf(t.cdf(constant[0] / np.sqrt(variance), nu))
    term = fmu.FrequencyErrors("absolute").bind(data, lambda parameter: 0).among(data.used)
    mean, sd = (x[0, 0] for x in term.given_others(truth[None], none))
    found = student_scores((data.frequencies_hz[0] - mean) / sd, term.freedom(none, 0)[0])
    assert_allclose(found, expected, rtol=1e-8)


@pytest.mark.parametrize(
    ("scatter", "n", "use"),
    [
        ("pooled", 2, ()),
        pytest.param("pooled", 3, (True, False, True), marks=pytest.mark.validate),
        pytest.param("joint", 7, (), marks=pytest.mark.validate),
        ("joint", 6, (True, True, False)),
    ],
)
def test_a_mode_given_the_others_is_students(scatter, n, use):
    """At the true frequencies, the tail probability of a measured mode given the others is uniform."""
    rng, p, truth = np.random.default_rng(6), [], np.array([10.0, 24.0, 41.0])
    mixed = np.eye(3) if scatter == "pooled" else np.array([[1.0, 0.0, 0.0], [0.9, 0.4, 0.0], [-0.5, 0.5, 0.7]])
    for _ in range(400):
        data = fmu.ModalData.from_tests(
            truth * (1.0 + 1e-3 * rng.standard_normal((n, 3)) @ mixed.T), scatter=scatter, use=use
        )
        term = fmu.FrequencyErrors("absolute").bind(data, lambda parameter: 0).among(data.used)
        none = np.empty((1, 0))
        mean, sd = (x[0, 0] for x in term.given_others(truth[None], none))
        p.append(norm.cdf(student_scores((data.frequencies_hz[0] - mean) / sd, term.freedom(none, 0)[0])))
    assert kstest(p, "uniform").pvalue > 1e-3
    far = np.mean(2.0 * np.minimum(p, np.subtract(1.0, p)) < 0.01)
    assert far == pytest.approx(0.01, abs=5 * np.sqrt(0.0099 / 400))
