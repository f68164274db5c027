"""Student's errors of frequencies: the density by SciPy, and a test that the others contradict."""

import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose

import fmu
from tests.gradients import assert_gradient
from tests.shear_building import frequencies_hz, shear_building

PARAMETERS = [fmu.Parameter(name, 1.0, 0.7, 1.5) for name in ("k1", "k2")]
NU = fmu.Parameter("nu", 5.0, 1.0, 60.0, prior=fmu.ScipyPrior(scipy.stats.gamma(2.0, scale=10.0)))
SCALE = fmu.Parameter("s", 0.01, 0.0, 0.5, prior=fmu.HalfNormal(0.02))


@pytest.fixture(scope="module")
def building():
    return shear_building(["k1", "k2"], 2e6, 1000.0)


def measured(building, theta=(1.0, 1.0)):
    return frequencies_hz(building, theta)[0]


@pytest.mark.parametrize("kind", ["absolute", "relative", "eigenvalue"])
def test_density_is_that_of_student(building, kind):
    f = measured(building)
    errors = fmu.StudentErrors(kind, sd=0.02, freedom=3.0)
    problem = fmu.UpdatingProblem.reduced(building, fmu.ModalData(f), PARAMETERS, pairing="index", error=errors)
    theta = np.array([1.1, 0.95])
    g = problem.frequencies(theta)
    expected = {
        "absolute": scipy.stats.t.logpdf(f, 3.0, g, 0.02),
        "relative": scipy.stats.t.logpdf(f, 3.0, g, 0.02 * f),
        "eigenvalue": scipy.stats.t.logpdf((g / f) ** 2 - 1, 3.0, 0, 0.02),
    }[kind]
    assert_allclose(problem.log_likelihood_terms(theta), expected, rtol=1e-10)


def test_gradient_with_inferred_scale_and_freedom(building):
    errors = fmu.StudentErrors("relative", sd=SCALE, freedom=NU)
    data = fmu.ModalData(measured(building, (1.1, 0.9)))
    problem = fmu.UpdatingProblem(building, data, PARAMETERS, pairing="index", error=errors)
    assert problem.names == ("k1", "k2", "s", "nu")
    for theta in ([1.0, 1.0, 0.02, 2.0], [1.2, 0.8, 0.05, 30.0]):
        theta = np.array(theta)
        assert_gradient(problem.log_prob_and_grad(theta)[1], problem.log_prob, theta, 1e-6 * theta, rtol=1e-6)


def test_simulated_errors_have_the_density(building):
    errors = fmu.StudentErrors("relative", sd=0.01, freedom=2.5)
    f = measured(building)
    problem = fmu.UpdatingProblem.reduced(building, fmu.ModalData(f), PARAMETERS, pairing="index", error=errors)
    noisy = problem.simulate_data(np.random.default_rng(1), np.tile(f, (4000, 1)))
    scores = (noisy[:, 0] - f[0]) / (0.01 * f[0])
    assert scipy.stats.kstest(scores, scipy.stats.t(2.5).cdf).pvalue > 1e-3
    normal = problem.likelihood.terms_of[0].normal_scores(scores)
    assert scipy.stats.kstest(normal, "norm").pvalue > 1e-3


def test_a_further_test_has_inferred_errors_of_student_and_no_known_ones(building):
    """The errors of the tests themselves come from their scatter."""
    f, rng = measured(building), np.random.default_rng(2)
    data = fmu.ModalData.from_tests(f * [[0.99, 1.0], [1.0, 1.01], [1.01, 0.99]])
    known, inferred = (
        fmu.UpdatingProblem(building, data, PARAMETERS, pairing="index", error=errors)
        for errors in (fmu.StudentErrors(freedom=2.5), fmu.StudentErrors(freedom=2.5, model_sd=SCALE))
    )
    computed = np.tile(f, (4000, 1))
    scatter = data.tests.simulate(np.random.default_rng(3), len(computed))
    assert_allclose(known.simulate_test(np.random.default_rng(3), computed) - computed, scatter, atol=1e-12)
    theta = np.tile([1.0, 1.0, 0.02], (len(computed), 1))
    noisy = inferred.likelihood.simulate_discrepancy(rng, computed, theta[:, 2:])
    scores = (noisy - computed) / (0.02 * np.asarray(data.frequencies_hz))
    assert scipy.stats.kstest(scores.ravel(), scipy.stats.t(2.5).cdf).pvalue > 1e-3


@pytest.mark.parametrize(
    ("settings", "rule"),
    [
        ({"freedom": 0.5}, "freedom: must be a finite number of at least 1"),
        ({"covariance": True}, "the data have a covariance"),
    ],
)
def test_what_is_refused(building, settings, rule):
    covariance = np.diag([0.01, 0.02]) if settings.pop("covariance", False) else None
    data = fmu.ModalData(measured(building), covariance_hz2=covariance)

    def pose():
        errors = fmu.StudentErrors("absolute", sd=None if covariance is not None else 0.1, **settings)
        fmu.UpdatingProblem(building, data, PARAMETERS, pairing="index", error=errors)

    with pytest.raises(ValueError, match=rule):
        pose()


def twenty_tests(building, wrong):
    """Return 20 tests of one building, the seventh with its second mode `wrong` (relative)."""
    rng, f = np.random.default_rng(8), measured(building, (1.1, 0.9))
    tests = []
    for t in range(20):
        g = f * (1 + 0.01 * rng.standard_normal(2))
        if t == 6:
            g[1] *= 1 + wrong
        tests.append(fmu.Test(f"t{t + 1}", fmu.ModalData(g, sd_hz=0.01 * f)))
    return tests


@pytest.mark.parametrize(
    "errors",
    [pytest.param(fmu.FrequencyErrors("absolute"), marks=pytest.mark.validate), fmu.StudentErrors("absolute")],
)
def test_a_contradictory_test_is_named(building, errors):
    def run(wrong):
        problem = fmu.JointProblem(
            building, twenty_tests(building, wrong), PARAMETERS, pairing="index", error=errors
        )
        return fmu.sample(problem, draws=80, warmup=60, seed=3, maxima=fmu.find_map(problem, starts=2))

    right, wrong = run(0.0), run(0.25)
    assert "test t" not in str(fmu.diagnose(right))
    said = str(fmu.diagnose(wrong))
    assert "test t7: what it measured is not" in said
    assert said.count("what it measured is not") == 1
    before, after = fmu.summary(right), fmu.summary(wrong)
    moved = np.abs(after["mean"] - before["mean"]) / before["sd"]
    assert moved.max() < 0.3 if isinstance(errors, fmu.StudentErrors) else moved.max() > 1.0
