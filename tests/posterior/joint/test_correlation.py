"""Correlated populations: the copula is a density, the prior is LKJ, the posterior finds a correlation."""

import numpy as np
import pytest
import scipy.linalg
import scipy.stats
from numpy.testing import assert_allclose

import fmu
from fmu.posterior.joint.correlation import Correlation, correlations
from fmu.posterior.joint.modal_test import TestsError
from tests.gradients import assert_gradient
from tests.shear_building import frequencies_hz, shear_building

NAMES = ("k1", "k2", "k3")


def values_of(rng, n, r=0.0):
    """Return stiffnesses of three storeys in n tests; those of the first two are correlated."""
    R = np.array([[1.0, r, 0.0], [r, 1.0, 0.0], [0.0, 0.0, 1.0]])
    return 1.0 + 0.08 * rng.multivariate_normal(np.zeros(3), R, n)


def posed(values, known=None, noise=0.002, distribution="normal", seed=2, **options):
    """Return the problem of tests of three masses in a row, whose frequencies have small errors."""
    rng, tests = np.random.default_rng(seed), []
    model = shear_building(NAMES, mass=[1.0, 0.7, 1.6])
    for t, theta in enumerate(values):
        f = frequencies_hz(model, theta)[0] * (1 + noise * rng.standard_normal(3))
        tests.append(fmu.Test(f"t{t}", fmu.ModalData(f, sd_hz=noise * f), known=(known or {}).get(t, {})))
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in NAMES]
    varies = dict.fromkeys(NAMES, fmu.Population(distribution))
    return fmu.JointProblem(model, tests, parameters, varies=varies, pairing="index", **options)


def test_the_density_is_that_of_scipy():
    rng = np.random.default_rng(1)
    theta = np.concatenate([rng.uniform(-0.9, 0.9, (4, 3))])
    scored = np.array([[True, True, True], [True, False, True], [False, True, False]])
    correlation = Correlation((0, 1, 2), scored)
    L = correlation.factor(theta)
    R, z = L @ np.swapaxes(L, 1, 2), rng.standard_normal((4, 3, 3))
    assert_allclose(np.diagonal(R, axis1=1, axis2=2), 1.0, rtol=1e-14)
    assert_allclose(R[:, 0, 1], theta[:, 0], rtol=1e-14)
    exact = np.zeros(4)
    for n in range(4):
        for t, here in enumerate(scored):
            block, of = R[n][np.ix_(here, here)], z[n, t, here]
            joint = scipy.stats.multivariate_normal(np.zeros(len(of)), block).logpdf(of)
            exact[n] += joint - scipy.stats.norm.logpdf(of).sum()
    assert_allclose(correlation.log_density(theta, z)[0].sum(axis=1), exact, rtol=1e-10)


def test_the_prior_is_lkj():
    """Every correlation is then beta on (-1, 1) with both shapes η − 1 + p/2, whatever its place (section 2.4)."""
    eta, rng = 1.5, np.random.default_rng(3)
    parameters = correlations(["a", "b", "c", "d"], eta)
    assert [p.name for p in parameters[:3]] == ["a b correlation", "a c correlation", "b c correlation given a"]
    theta = np.stack([p.prior.draw(rng, 20_000, p.lower, p.upper) for p in parameters], axis=1)
    L = Correlation(tuple(range(6)), np.ones((1, 4), dtype=bool)).factor(theta)
    R = L @ np.swapaxes(L, 1, 2)
    shape = eta - 1.0 + 2.0
    for i, j in zip(*np.triu_indices(4, 1), strict=True):
        assert scipy.stats.kstest(R[:, i, j], scipy.stats.beta(shape, shape, -1.0, 2.0).cdf).pvalue > 1e-4


@pytest.mark.parametrize(("noise", "distribution"), [(0.002, "normal"), (0.2, "normal"), (0.002, "log-normal")])
@pytest.mark.usefixtures("half_centred")
def test_gradient(noise, distribution):
    """With scores that refer to the values (small errors) and to the population (large ones)."""
    values = values_of(np.random.default_rng(4), 6, 0.5)
    problem = posed(values, {2: {"k2": 1.0}}, noise, distribution, correlation=1.5)
    points = 0.8 * problem.start + 0.2 * problem.sample_prior(np.random.default_rng(5), 3)
    gradient = problem.log_prob_and_grad(points)[1]
    assert_gradient(gradient, problem.log_prob, points, 1e-6 * problem.scale, rtol=1e-4, of_largest=1e-5)
    assert_allclose(problem.log_prob(points), [problem.log_prob(point) for point in points], rtol=0, atol=0)


def test_draws_of_the_prior_have_its_correlations():
    problem = posed(values_of(np.random.default_rng(6), 5), correlation=1.0)
    theta = problem.sample_prior(np.random.default_rng(7), 4000)
    z = np.stack([one.population_scores(theta)[0] for one in problem.layout.drawn], axis=2)
    R = problem.layout.correlations(theta)
    assert_allclose(np.mean(z[:, :, 0] * z[:, :, 1] * R[:, None, 0, 1]), np.mean(R[:, 0, 1] ** 2), atol=0.03)
    assert_allclose(np.mean(z[:, :, 1] * z[:, :, 2] * R[:, None, 1, 2]), np.mean(R[:, 1, 2] ** 2), atol=0.03)
    assert_allclose(np.std(z, axis=(0, 1)), 1.0, atol=0.03)


@pytest.mark.validate
def test_a_correlation_is_found():
    values = values_of(np.random.default_rng(8), 30, 0.9)
    trace = fmu.sample(posed(values, correlation=1.0), draws=100, warmup=150, seed=1)
    r = trace["populations"]["correlation"].to_numpy().reshape(-1, 3, 3)
    sample = np.corrcoef(values, rowvar=False)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert abs(r[:, i, j].mean() - sample[i, j]) < 3 * r[:, i, j].std()
    assert np.quantile(r[:, 0, 1], 0.05) > 0.5
    assert np.quantile(np.abs(r[:, 0, 2]), 0.05) < 0.2


def test_what_cannot_be_correlated():
    values = values_of(np.random.default_rng(9), 3)
    with pytest.raises(TestsError, match=r"correlation: must be positive \(got 0.0\)"):
        posed(values, correlation=0.0)
    model = fmu.SeparableModel.from_terms(["k1"], [(np.eye(1), "k1")], [np.eye(1)])
    tests = [fmu.Test(name, fmu.ModalData([0.16], sd_hz=0.01)) for name in "ab"]
    with pytest.raises(TestsError, match=r"correlation: needs two parameters or more with a population \(got 0\)"):
        fmu.JointProblem(model, tests, [fmu.Parameter("k1", 1.0, 0.5, 1.5)], pairing="index", correlation=1.0)
