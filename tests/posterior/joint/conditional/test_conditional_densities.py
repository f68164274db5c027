"""The conditional densities of a hierarchical posterior against its joint density, and their gradients."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import logsumexp
from scipy.stats import multivariate_t

import fmu
from fmu.posterior.joint.conditional.both import conditionals
from fmu.posterior.joint.conditional.expansion import expand
from fmu.posterior.joint.typical import typical_point
from fmu.posterior.joint.varies.base import sum_by_test
from fmu.posterior.scaled import ScaledDensity
from tests.gradients import assert_gradient
from tests.shear_building import frequencies_hz, shear_building

pytestmark = pytest.mark.usefixtures("all_half_centred")

N, P = 7, 3
NAMES = tuple(f"k{j + 1}" for j in range(P))


def campaign(
    distribution="normal",
    correlation=None,
    slopes=(),
    shared=(),
    noise=0.01,
    bounds=(0.75, 1.5),
    sd_by_group=False,
    outliers=None,
    sd=None,
):
    """Return the problem of seven tests of three storeys whose stiffnesses scatter by 5 % and bounds are near."""
    rng = np.random.default_rng(2)
    model = shear_building(list(NAMES), 2e8, 1e5)
    temperature = rng.uniform(-5.0, 25.0, N)
    k = np.exp(0.05 * rng.standard_normal((N, P)) - 0.002 * temperature[:, None])
    f = np.stack([frequencies_hz(model, one)[0] for one in k]) * (1.0 + 0.01 * rng.standard_normal((N, P)))
    covariates = [{"temperature": t} for t in temperature]
    tests = [fmu.Test(f"t{t}", fmu.ModalData(f[t]), "aababba"[t], covariates=covariates[t]) for t in range(N)]
    tests[2] = replace(tests[2], known={"k3": 1.0})
    return fmu.JointProblem(
        model,
        tests,
        [fmu.Parameter(name, 1.0, *bounds) for name in NAMES],
        varies={
            name: fmu.Population(distribution, sd, sd_by_group=sd_by_group) for name in NAMES if name not in shared
        },
        slopes={name: {"temperature": fmu.Normal(0.01)} for name in slopes},
        correlation=correlation,
        outliers=outliers,
        error=fmu.FrequencyErrors("relative", sd=noise),
    )


CAMPAIGNS = {
    "normal": {},
    "log-normal": {"distribution": "log-normal"},
    "correlated": {"correlation": 2.0},
    "with trends": {"slopes": ("k1", "k2")},
    "log-normal, correlated, with trends": {"distribution": "log-normal", "correlation": 1.0, "slopes": ("k3",)},
    "shared": {"shared": ("k2",)},
    "sd by group": {"sd_by_group": True, "correlation": 1.0},
}
ALONE = ("normal", "log-normal", "correlated", "with trends")
"""What is tried every day in campaigns beside something else, and by itself in `make validate`."""
KINDS = [pytest.param(kind, marks=[pytest.mark.validate] * (kind in ALONE)) for kind in CAMPAIGNS]


@pytest.fixture(scope="module", params=KINDS)
def campaign_points(request, all_half_centred):
    """Return a problem, its conditional densities, the problem without centring, and three points there."""
    return points_of(campaign(**CAMPAIGNS[request.param]))


def points_of(problem):
    """Return a problem, its conditional densities, the problem without centring, and three points there."""
    plain = problem.with_layout(problem.layout.remove_centring())
    rng, found = np.random.default_rng(3), conditionals(problem)
    own = np.repeat(ScaledDensity(problem).to_theta(typical_point(problem))[None], 3, axis=0)
    columns = found.marginal.columns
    own[:, columns] *= 1.0 + 0.02 * rng.standard_normal((3, len(columns)))
    if problem.layout.correlation is not None:
        own[:, list(problem.layout.correlation.columns)] += np.array([[0.1], [0.2], [-0.1]])
    return problem, found, plain, own


def test_scores_without_centring_give_the_same_values(campaign_points):
    problem, _, plain, own = campaign_points
    theta = problem.layout.standardise_scores(own)
    assert_allclose(plain.values(theta), problem.values(own), rtol=1e-12)
    assert_allclose(problem.layout.restore_scores(theta), own, rtol=1e-8, atol=1e-9)


def test_coordinates_of_main_parameters_and_their_inverse(campaign_points):
    problem, found, _, own = campaign_points
    theta = problem.layout.standardise_scores(own)
    assert_allclose(found.marginal.theta_at(found.marginal.coordinates(theta), theta), theta, rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_main_parameters_without_scores(kind):
    """The gradient is exact where the bounds are distant."""
    problem, found, _, own = points_of(campaign(**CAMPAIGNS[kind], bounds=(0.05, 20.0)))
    theta = problem.layout.standardise_scores(own)[:1]
    w = found.marginal.coordinates(theta)
    of = lambda w: found.marginal.log_prob_and_grad(w, np.repeat(theta, len(w), axis=0))  # noqa: E731
    assert_gradient(of(w)[1], lambda w: of(w)[0], w, 1e-5, rtol=1e-4, atol=1e-3)


def test_evidence_is_the_integral_over_the_scores(campaign_points):
    """Beside importance sampling of the exact integral: by how much it changes with the main parameters."""
    problem, found, plain, own = campaign_points
    theta, of, n = problem.layout.standardise_scores(own), found.scores, 2000
    widths = np.unique([one.drawn.widths for one in of.scores.every])
    theta[:, widths] *= np.array([[1.0], [1.5], [0.7]])
    linear = of.linearise(theta)
    normal, rng = of.normal_of(linear), np.random.default_rng(9)
    evidence, exact = of.log_evidence(linear), np.empty((len(theta), N))
    u = rng.standard_normal((n, *normal.mean.shape[1:]))
    for k in range(len(theta)):
        one = of.approximate(np.repeat(theta[k : k + 1], n, axis=0))
        at = of.scores.put(np.repeat(theta[k : k + 1], n, axis=0), one.restore(u))
        assert_allclose(one.standardise(of.scores.take(at)), np.where(of.scores.scored, u, 0.0), atol=1e-7)
        terms = sum_by_test(plain.terms_of_tests(at), plain.likelihood.test_of_terms, N)
        log_weight = (
            terms + of.log_prior(at) + 0.5 * np.sum(u**2 * of.scores.scored, axis=2) - linear.log_det_factor[k]
        )
        exact[k] = logsumexp(log_weight, axis=0) - np.log(n)
    error = np.abs((evidence[1:] - evidence[0]) - (exact[1:] - exact[0]))
    assert np.median(error) < 0.1
    assert np.max(error) < 0.5


def test_scores_given_main_are_close_to_their_normal_approximation(campaign_points):
    problem, found, plain, own = campaign_points
    theta, of = problem.layout.standardise_scores(own), found.scores
    z = np.random.default_rng(5).standard_normal((*theta.shape[:1], N, len(of.scores.every)))
    assert_allclose(
        (of.log_prior(of.scores.put(theta, z)) - of.log_prior(theta)).sum(axis=1),
        plain.log_prior(of.scores.put(theta, z)) - plain.log_prior(theta),
        rtol=1e-9,
    )

    def exact(theta):
        terms = sum_by_test(plain.terms_of_tests(theta), plain.likelihood.test_of_terms, N)
        return terms + of.log_prior(theta)

    normal = of.approximate(theta)
    straight = [normal.mean + normal.scatter(size * z) for size in (0.0, 1.0)]
    middle, drawn = (of.scores.put(theta, normal.bend(one)) for one in straight)
    gain = exact(drawn) - exact(middle)
    of_normal = normal.log_density(straight[1]) - normal.log_density(straight[0])
    assert np.max(np.abs(gain - of_normal)) < 1.0
    assert np.median(np.abs(gain - of_normal)) < 0.1


def test_student_density_counts_the_scores_that_a_test_has(campaign_points):
    """The third test lacks the score of k3."""
    problem, found, _, own = campaign_points
    normal = found.scores.approximate(problem.layout.standardise_scores(own))
    rng, nu = np.random.default_rng(8), 5.0
    z = np.where(normal.scored, normal.mean + normal.scatter(3.0 * rng.standard_normal(normal.mean.shape)), 0.0)
    gain = normal.log_density(z, nu) - normal.log_density(normal.mean, nu)
    for t in (0, 2):
        here = normal.scored[t]
        precision = (normal.factor[0, t] @ normal.factor[0, t].T)[np.ix_(here, here)]
        student = multivariate_t(normal.mean[0, t, here], np.linalg.inv(precision), nu)
        expected = student.logpdf(z[0, t, here]) - student.logpdf(normal.mean[0, t, here])
        assert_allclose(gain[0, t], expected, rtol=1e-9)


def test_expansion_is_weighed_exactly_where_one_deviation_belongs_to_all_errors():
    problem = campaign(noise=fmu.Parameter("noise", 0.01, 0.002, 0.1, prior=fmu.HalfNormal(0.02)))
    plain = problem.with_layout(problem.layout.remove_centring())
    theta = conditionals(problem).typical
    before = expand(plain.layout, plain.likelihood, theta[0])
    theta[:, -1] *= 1.7
    after = expand(plain.layout, plain.likelihood, theta[0])
    weight = before.weigh(theta[:, -1:])
    assert_allclose(weight, 1.7**-2)
    assert_allclose(weight[0, :, :, None] * before.information, after.information, rtol=1e-9, atol=1e-9)
    assert_allclose(weight[0] * before.slope, after.slope, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("settings", [{}, {"correlation": 2.0}], ids=["independent", "correlated"])
def test_an_approximation_about_the_present_scores_has_the_gradient_there(settings):
    problem = campaign("log-normal", bounds=(0.2, 5.0), **settings)
    plain, given = problem.with_layout(problem.layout.remove_centring()), conditionals(problem).scores
    theta = np.repeat(conditionals(problem).typical, 2, axis=0)
    z = given.scores.take(theta) + np.random.default_rng(4).standard_normal((2, N, P))
    theta = given.scores.put(theta, z)
    residuals = plain.likelihood.residuals_and_slopes(given.layout.of_model(theta))
    normal = given.approximate_here(theta, *residuals, plain.likelihood.test_of_residuals)
    precision = normal.factor @ np.swapaxes(normal.factor, 2, 3)
    gradient = np.einsum("ntij,ntj->nti", precision, normal.mean - given.scores.take(theta))
    of_joint = given.scores.take(plain.log_prob_and_grad(theta)[1])
    assert_allclose(gradient, of_joint, rtol=1e-7, atol=1e-7 * np.max(np.abs(of_joint)))
    assert_allclose(normal.log_det_factor, 0.5 * np.linalg.slogdet(precision)[1], rtol=1e-9, atol=1e-9)


def test_the_uncertainty_of_a_standard_deviation_is_that_of_its_residuals():
    """Of 21 residuals, relative to the standard deviation."""
    found = conditionals(campaign(noise=fmu.Parameter("noise", 0.01, 0.002, 0.1, prior=fmu.HalfNormal(0.02))))
    assert_allclose(found.noise, 1.0 / np.sqrt(1.0 + 2.0 * N * P), rtol=1e-9)
