"""The conditional densities of a hierarchical posterior against its joint density, and their gradients."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import multivariate_t

import fmu
from fmu.posterior.joint.conditional.both import conditionals
from fmu.posterior.joint.conditional.expansion import expand
from fmu.posterior.joint.layout import sum_by_test
from fmu.posterior.joint.typical import typical_point
from fmu.posterior.scaled import ScaledDensity
from tests.gradients import assert_gradient
from tests.shear_building import frequencies_hz, shear_building

N, P = 7, 3
NAMES = tuple(f"k{j + 1}" for j in range(P))


def campaign(distribution="normal", correlation=None, slopes=(), shared=(), noise=0.01):
    """Return the problem of seven tests of three storeys whose stiffnesses scatter by 5 % and bounds are near."""
    rng = np.random.default_rng(2)
    model = shear_building(list(NAMES), 2e8, 1e5)
    temperature = rng.uniform(-5.0, 25.0, N)
    k = np.exp(0.05 * rng.standard_normal((N, P)) - 0.002 * temperature[:, None])
    f = np.stack([frequencies_hz(model, one)[0] for one in k]) * (1.0 + 0.01 * rng.standard_normal((N, P)))
    covariates = [{"temperature": t} for t in temperature]
    tests = [fmu.Test(f"t{t}", fmu.ModalData(f[t]), covariates=covariates[t]) for t in range(N)]
    tests[2] = fmu.Test("t2", fmu.ModalData(f[2]), covariates=covariates[2], known={"k3": 1.0})
    return fmu.JointProblem(
        model,
        tests,
        [fmu.Parameter(name, start=1.0, lower=0.75, upper=1.5) for name in NAMES],
        varies={name: fmu.Population(distribution) for name in NAMES if name not in shared},
        slopes={name: {"temperature": fmu.Normal(0.01)} for name in slopes},
        correlation=correlation,
        error=fmu.FrequencyErrors("relative", sd=noise),
    )


CAMPAIGNS = {
    "normal": {},
    "log-normal": {"distribution": "log-normal"},
    "correlated": {"correlation": 2.0},
    "with trends": {"slopes": ("k1", "k2")},
    "log-normal, correlated, with trends": {"distribution": "log-normal", "correlation": 1.0, "slopes": ("k3",)},
    "shared": {"shared": ("k2",)},
}


@pytest.fixture(scope="module", params=CAMPAIGNS)
def campaign_points(request):
    """Return a problem, its conditional densities, the problem without centring, and three points there."""
    problem = campaign(**CAMPAIGNS[request.param])
    plain = problem.with_layout(problem.layout.remove_centring())
    rng, found = np.random.default_rng(3), conditionals(problem)
    own = np.repeat(ScaledDensity(problem).to_theta(typical_point(problem))[None], 3, axis=0)
    own[:, found.main.columns] *= 1.0 + 0.02 * rng.standard_normal((3, len(found.main.columns)))
    if problem.layout.correlation is not None:
        own[:, list(problem.layout.correlation.columns)] += np.array([[0.1], [0.2], [-0.1]])
    return problem, found, plain, own


def test_scores_without_centring_give_the_same_values(campaign_points):
    problem, _, plain, own = campaign_points
    theta = problem.layout.standardise_scores(own)
    assert_allclose(plain.values(theta), problem.values(own), rtol=1e-12)
    assert_allclose(problem.layout.restore_scores(theta), own, rtol=1e-8, atol=1e-9)


def test_main_given_values_is_the_joint_density_at_these_values(campaign_points):
    """By the change of variables p(main, values) = p(main, scores) / |∂values/∂scores|."""
    problem, found, plain, own = campaign_points
    main, scores = found.main, found.scores.scores
    before = problem.layout.standardise_scores(own)
    values, w = main.values(before), main.coordinates(before, main.values(before))
    assert_allclose(main.theta_at(w, before, values), before, rtol=1e-12)

    moved = w + 0.2 * np.random.default_rng(4).standard_normal(w.shape) / len(w[0])
    after = main.with_values(main.theta_at(moved, before, values), values)
    assert_allclose(main.values(after)[:, scores.scored], values[:, scores.scored], rtol=1e-9)

    def of_joint(theta, w):
        jacobian = [np.log(one.slope(theta))[:, one.drawn.scored].sum(axis=1) for one in scores.every]
        total = plain.log_prior(theta) - np.sum(jacobian, axis=0)
        for one, (centre, width) in zip(scores.every, main._pairs, strict=True):  # |∂(centre, width)/∂w|
            total += 2.0 * w[:, width]
            if one.drawn.population.of_logarithm:
                total += np.log(theta[:, main.columns[centre]])
        return total

    change = (main.log_prob_and_grad(x, before, values)[0] for x in (moved, w))
    assert_allclose(np.subtract(*change), of_joint(after, moved) - of_joint(before, w), rtol=1e-6, atol=1e-6)


def test_gradients_of_main_parameters(campaign_points):
    problem, found, _, own = campaign_points
    theta = problem.layout.standardise_scores(own)[:1]
    values = found.main.values(theta)
    w = found.main.coordinates(theta, values)
    of_main = lambda w: found.main.log_prob_and_grad(w, *(np.repeat(x, len(w), axis=0) for x in (theta, values)))  # noqa: E731
    assert_gradient(of_main(w)[1], lambda w: of_main(w)[0], w, 1e-5, rtol=1e-4, atol=1e-3)
    w = found.shift.coordinates(theta)
    of_shift = lambda w: found.shift.log_prob_and_grad(w, np.repeat(theta, len(w), axis=0))  # noqa: E731
    assert_gradient(of_shift(w)[1], lambda w: of_shift(w)[0], w, 1e-5, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("distribution", ["normal", "log-normal"])
def test_correlations_given_scores_move_the_scores_by_the_root_of_their_matrix(distribution):
    """A test without k3 has scores of the other two, and the root of the matrix of these."""
    problem = campaign(distribution, correlation=2.0)
    copula, shift, scores = (
        problem.layout.correlation,
        conditionals(problem).shift,
        conditionals(problem).scores.scores,
    )
    own = ScaledDensity(problem).to_theta(typical_point(problem))[None]
    theta = problem.layout.standardise_scores(own)
    assert set(copula.columns) <= set(shift.columns.tolist())
    w = shift.coordinates(theta) + 0.05 * np.random.default_rng(6).standard_normal((1, len(shift.columns)))
    after = shift.theta_at(w, theta)
    assert_allclose(shift.coordinates(after), w, rtol=1e-12)
    z, moved = (scores.take(at)[0] for at in (theta, after))
    L, M = (copula.factor(at)[0] for at in (theta, after))
    for t, scored in enumerate(scores.scored):
        before, then = (np.linalg.cholesky((root @ root.T)[np.ix_(scored, scored)]) for root in (L, M))
        expected = then @ np.linalg.solve(before, z[t, scored])
        assert_allclose(moved[t, scored], expected, rtol=1e-10, atol=1e-12)
        assert np.linalg.norm(moved[t, scored] - z[t, scored]) > 1e-4


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
