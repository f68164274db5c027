"""Populations: the truncated normal distribution by SciPy, and that the centring changes coordinates alone."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose

import fmu
from fmu.analysis.convergence.diagnosis import POPULATION
from fmu.posterior.joint.joint_problem import simulate_next_test
from fmu.posterior.joint.varies.truncated_normal import (
    truncated_normal_log_pdf,
    truncated_normal_scores,
    truncated_normal_values,
)
from tests.gradients import assert_gradient

CASES = [(0.0, 1.0, -np.inf, np.inf), (1.0, 0.3, 0.5, 1.5), (0.5, 2.0, 0.5, np.inf), (1.49, 0.05, 0.5, 1.5)]


@pytest.mark.parametrize(("mean", "sd", "lower", "upper"), CASES)
def test_truncated_normal_is_that_of_scipy(mean, sd, lower, upper):
    z = np.linspace(-6.0, 6.0, 49)
    exact = scipy.stats.truncnorm((lower - mean) / sd, (upper - mean) / sd, mean, sd)
    m, s = np.full_like(z, mean), np.full_like(z, sd)
    x, slopes = truncated_normal_values(z, m, s, lower, upper)
    by_tail = np.where(z < 0, exact.ppf(scipy.stats.norm.cdf(z)), exact.isf(scipy.stats.norm.sf(z)))
    assert_allclose(x, by_tail, rtol=1e-7)  # the inverse of SciPy is good to 1e-8
    assert_allclose(truncated_normal_scores(x, m, s, lower, upper), z, rtol=1e-7, atol=1e-7)
    value, of_density = truncated_normal_log_pdf(x, m, s, lower, upper)
    assert_allclose(value, exact.logpdf(x), rtol=1e-10, atol=1e-12)

    inner = slice(4, -4)
    slopes, of_density = (np.stack(np.broadcast_arrays(*one), axis=1)[inner] for one in (slopes, of_density))
    at = np.stack([z, m, s], axis=1)[inner]
    assert_gradient(
        slopes, lambda at: truncated_normal_values(*at.T, lower, upper)[0], at, 1e-6, rtol=1e-6, atol=1e-8
    )
    at = np.stack([x, m, s], axis=1)[inner]
    assert_gradient(
        of_density, lambda at: truncated_normal_log_pdf(*at.T, lower, upper)[0], at, 1e-6, rtol=1e-6, atol=1e-6
    )


def springs(distribution="normal", n=8, scatter=0.1, noise=0.01, centring=None):
    """Return a problem of one spring with a mass, tested `n` times: f² = k/(4π²)."""
    rng = np.random.default_rng(5)
    model = fmu.SeparableModel.from_terms(["k"], [(np.eye(1), "k")], [np.eye(1)])
    k = 1.0 + scatter * rng.standard_normal(n)
    f = np.sqrt(k) / (2 * np.pi) * (1 + noise * rng.standard_normal(n))
    tests = [fmu.Test(f"t{i}", fmu.ModalData([one], sd_hz=noise * one)) for i, one in enumerate(f)]
    parameter = fmu.Parameter("k", 1.0, 0.7, 1.4)
    problem = fmu.JointProblem(
        model, tests, [parameter], varies={"k": fmu.Population(distribution)}, pairing="index"
    )
    if centring is not None:
        one = replace(problem.layout.values_of[0], centring=np.full(n, centring))
        return problem.with_layout(replace(problem.layout, values_of=(one,)))
    return problem


@pytest.mark.parametrize("distribution", ["normal", "log-normal"])
@pytest.mark.parametrize("centring", [0.4, 1.0])
def test_centring_is_a_change_of_coordinates(distribution, centring):
    """The density of the values is the same, so that densities of scores differ by the Jacobian alone."""
    free, centred = springs(distribution, centring=0.0), springs(distribution, centring=centring)
    theta = free.sample_prior(np.random.default_rng(2), 20)
    one = centred.layout.drawn[0]
    values = free.values(theta)[:, :, 0]
    moved = theta.copy()
    for i, point in enumerate(theta):
        moved[i, one.columns] = one.scores_at(values[i][None], point[None])[0]
    assert_allclose(centred.values(moved)[:, :, 0], values, rtol=1e-9)

    def log_jacobian(problem, points):  # log |∂ values / ∂ scores|
        return np.sum(np.log(problem.layout.values_of[0](points)[1][0].values), axis=1)

    densities = [p.log_prob(x) - log_jacobian(p, x) for p, x in ((free, theta), (centred, moved))]
    assert_allclose(densities[1], densities[0], rtol=1e-8)


@pytest.mark.parametrize("centring", [0.0, 0.7])
def test_draws_of_the_prior_are_draws_of_the_population(centring):
    problem = springs(centring=centring)
    theta = problem.sample_prior(np.random.default_rng(1), 4000)
    mean, sd = theta[:, 0], theta[:, 1]
    a, b = (0.7 - mean) / sd, (1.4 - mean) / sd
    unit = scipy.stats.truncnorm.cdf(problem.values(theta)[:, 3, 0], a, b, mean, sd)
    assert scipy.stats.kstest(unit, "uniform").pvalue > 1e-3
    assert scipy.stats.kstest(mean, scipy.stats.uniform(0.7, 0.7).cdf).pvalue > 1e-3
    assert scipy.stats.kstest(sd, scipy.stats.halfnorm(0, 0.2).cdf).pvalue > 1e-3


@pytest.fixture(scope="module")
def by_quadrature():
    """Return mean and sd of the population's mean and sd, and of the first value, integrated on a grid."""
    problem = springs()
    data = np.asarray(problem.data.frequencies_hz)
    k = np.linspace(0.7, 1.4, 351)
    mean, sd = np.linspace(0.7, 1.4, 141), np.linspace(2.5e-3, 0.4, 160)  # beyond 0.4 there is less than 1e-3
    m, s = (x[..., None] for x in np.meshgrid(mean, sd, indexing="ij"))
    likelihood = scipy.stats.norm.pdf(
        data[:, None], np.sqrt(k) / (2 * np.pi), np.asarray(problem.data.sd_hz)[:, None]
    )
    density = np.exp(-0.5 * ((k - m) / s) ** 2)
    density /= density.sum(axis=-1, keepdims=True)
    each = density @ likelihood.T
    weight = np.prod(each, axis=-1) * scipy.stats.halfnorm.pdf(s[..., 0], 0, 0.2)
    weight /= weight.sum()
    first = np.sum(weight * ((density * k) @ likelihood[0]) / each[..., 0])
    return (
        [np.sum(weight * (m[..., 0] < x)) for x in MEANS],
        [np.sum(weight * (s[..., 0] < x)) for x in SPREADS],
        first,
    )


MEANS, SPREADS = (0.9475, 0.9725, 0.9975), (0.061, 0.081, 0.121)


@pytest.mark.parametrize("centring", [None, pytest.param(0.3, marks=pytest.mark.validate)])
def test_posterior_of_mean_and_spread_by_quadrature(by_quadrature, centring):
    problem = springs(centring=centring)
    trace = fmu.sample(problem, draws=30, warmup=25, chains=16, seed=2)
    assert fmu.diagnose(trace).doubts_of_search == (POPULATION,)  # and no advice to search
    ess = fmu.summary(trace)["ess_bulk"].min()
    draws = np.stack([trace["posterior"][name].values.ravel() for name in problem.names], axis=1)
    for column, thresholds, exact in ((0, MEANS, by_quadrature[0]), (1, SPREADS, by_quadrature[1])):
        for threshold, p in zip(thresholds, exact, strict=True):
            assert_allclose(np.mean(draws[:, column] < threshold), p, atol=4.5 * np.sqrt(p * (1 - p) / ess))
    values = problem.values(draws)[:, 0, 0]
    assert_allclose(values.mean(), by_quadrature[2], atol=4.5 * values.std() / np.sqrt(ess))


def test_the_next_test_is_a_draw_from_the_population():
    problem, rng = springs(), np.random.default_rng(9)
    theta = np.tile(problem.start, (20_000, 1))
    theta[:, problem.names.index("k mean")] = 0.9
    theta[:, problem.names.index("k sd")] = 0.2
    computed, measured = simulate_next_test(problem, rng, theta)
    drawn = scipy.stats.truncnorm((0.7 - 0.9) / 0.2, (1.4 - 0.9) / 0.2, 0.9, 0.2)
    assert scipy.stats.kstest((2 * np.pi * computed[:, 0]) ** 2, drawn.cdf).pvalue > 1e-4
    assert_allclose(np.std(measured - computed), problem.tests[0].data.sd_hz[0], rtol=0.03)


KINDS = (("normal", 0.7, 1.4), ("log-normal", 0.8, 1.2), ("normal", 0.9, 3.0), ("log-normal", 0.5, 2.5))


def several(centring):
    """Return the populations of a layout, of two kinds and different bounds, and five points theta."""
    names = [f"k{i}" for i in range(len(KINDS))]
    K = [(np.diag(np.eye(len(KINDS))[i]), name) for i, name in enumerate(names)]
    model = fmu.SeparableModel.from_terms(names, K, [np.eye(len(KINDS))])
    tests = [fmu.Test(f"t{i}", fmu.ModalData([0.16, 0.17, 0.18, 0.19], sd_hz=0.01)) for i in range(6)]
    parameters = [fmu.Parameter(name, 1.0, low, high) for name, (_, low, high) in zip(names, KINDS, strict=True)]
    varies = {name: fmu.Population(kind) for name, (kind, *_) in zip(names, KINDS, strict=True)}
    layout = fmu.JointProblem(model, tests, parameters, varies=varies, pairing="index").layout
    values_of = tuple(replace(one, centring=np.full(len(tests), centring)) for one in layout.values_of)
    rng = np.random.default_rng(8)
    theta = np.array([p.prior.draw(rng, 5, p.lower, p.upper) for p in layout.parameters]).T
    return replace(layout, values_of=values_of).drawn, theta


@pytest.mark.parametrize("centring", [0.0, 0.6])
def test_populations_computed_together_are_those_computed_one_by_one(centring):
    """Near bounds too: nothing depends on which parameters share a call."""
    drawn, theta = several(centring)
    alone = [replace(one) for one in drawn]
    assert [len(one.batch.drawn) for one in (drawn[0], alone[0])] == [len(KINDS), 1]
    assert all(np.min((theta[:, [one.centre]] - one.family.lower) / theta[:, one.widths]) < 12 for one in drawn)
    values = [one(theta) for one in drawn]
    for (value, slopes), one in zip(values, alone, strict=True):
        own, of_own = one(theta)
        assert_allclose(value, own, rtol=1e-13)
        for by, by_own in zip(slopes, of_own, strict=True):
            assert_allclose(by.values, by_own.values, rtol=1e-13)
    inside = [value for value, _ in values]
    together = drawn[0].batch
    for k, one in enumerate(alone):
        assert_allclose(together.scores(inside, theta)[k], one.scores_at(inside[k], theta), rtol=1e-13)
        density = one.family.log_pdf(inside[k], theta[:, [one.centre]], theta[:, one.widths])[0]
        assert_allclose(together.log_pdf(inside, theta)[k], density, rtol=1e-13)
