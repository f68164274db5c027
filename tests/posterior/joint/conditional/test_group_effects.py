"""Steps of populations that scatter between groups, given the values in the tests: they leave prior and values."""

import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose

import fmu
from fmu.analysis.convergence.rank_statistics import rank_ess
from fmu.posterior.joint.conditional.group_effects import group_effect_steps

NAMES = ("k1", "k2")
SPRINGS = fmu.SeparableModel.from_terms(
    list(NAMES), [(np.diag([1.0, 0.0]), "k1"), (np.diag([0.0, 1.0]), "k2")], [np.eye(2)]
)
WITHIN, BETWEEN = fmu.LogNormal(0.05, 0.4), fmu.LogNormal(0.15, 0.4)


def campaign(distribution="normal", bounds=(0.2, 6.0), loss=False, options=None, **settings):
    """Return the problem of two springs in eight tests of three groups; the second one is known in one test."""
    rng, tests = np.random.default_rng(2), []
    for t, group in enumerate("aabbcccc"):
        f = np.sqrt([1.0, 4.0] + 0.05 * rng.standard_normal(2)) / (2 * np.pi)
        known = {"k2": 4.0} if t == 6 else {}
        tests.append(fmu.Test(f"t{t}", fmu.ModalData(f, sd_hz=0.1 * f), group, {"day": 1.0 * t}, known=known))
    one = fmu.Population(distribution, WITHIN, BETWEEN, **settings)
    varies = {"k1": fmu.UndatedDamage(scatter=one) if loss else one, "k2": one}
    prior = fmu.LogNormal(1.0, 0.3), fmu.LogNormal(4.0, 0.3)
    parameters = [fmu.Parameter(NAMES[j], (1.0, 4.0)[j], *bounds, prior[j]) for j in range(2)]
    slopes = {"k1": {"day": fmu.Normal(0.01)}} if loss else {}
    options = {"pairing": "index", **(options or {})}
    return fmu.JointProblem(SPRINGS, tests, parameters, varies=varies, slopes=slopes, **options)


CAMPAIGNS = {
    "normal": {},
    "near bounds": {"bounds": (0.9, 4.4), "options": {"correlation": 2.0}},
    "log-normal": {"distribution": "log-normal"},
    "sd by group": {"sd_by_group": True, "loss": True},
    "outlying": {"options": {"outliers": fmu.Outliers()}},
    "in time": {"bounds": (0.9, 4.4), "correlation_time": 3.0, "by": "day"},
}


@pytest.mark.parametrize("settings", CAMPAIGNS.values(), ids=CAMPAIGNS)
def test_the_prior_is_left_as_it_is(settings):
    """Draws from the prior are draws from it after the steps, with the values that they had."""
    problem = campaign(**settings)
    plain = problem.with_layout(problem.layout.remove_centring())
    steps, rng, n = group_effect_steps(plain.layout, plain.parameters), np.random.default_rng(4), 3000
    assert len(steps) == 2
    before = after = plain.sample_prior(rng, n)
    for one in 5 * steps:
        after = one.move(rng, after)
    scored = np.stack([one.scored for one in plain.layout.drawn], axis=1)
    assert_allclose(plain.values(after)[:, scored], plain.values(before)[:, scored], rtol=1e-9)
    moving = [k for k, role in enumerate(plain.roles) if role.kind in ("mean", "effect")]
    moving += [k for k, name in enumerate(plain.names) if name.endswith("between groups")]
    share = (after[:, moving] != before[:, moving]).mean(axis=0)
    assert np.all(share > 0.5)
    fresh = plain.sample_prior(rng, n)
    for k in range(plain.ndim):
        assert scipy.stats.ks_2samp(after[:, k], fresh[:, k]).pvalue > 1e-4, plain.names[k]
        for power in (1, 2):
            change = after[:, k] ** power - before[:, k] ** power
            assert abs(np.mean(change)) <= 4.5 * np.std(change) / np.sqrt(n), plain.names[k]


VALUES = np.array([[1.0, 1.03, 0.98], [1.1, 1.13, 1.08], [0.9, 0.93, 0.91]])
ERROR, OF_SCATTER = 0.01, 0.1


def posterior_by_a_grid():
    """Return μ and s on a grid, (n,) each, and their posterior probabilities, for `VALUES` of three groups."""
    grids = np.linspace(0.5, 1.7, 41), np.geomspace(0.004, 0.15, 12), np.linspace(0.01, 0.5, 40)
    mean, within, between = (grid.ravel() for grid in np.meshgrid(*grids, indexing="ij"))
    log_p = np.log(within) - 0.5 * (within / OF_SCATTER) ** 2 - 0.5 * (between / OF_SCATTER) ** 2
    u = np.linspace(-4.0, 4.0, 33)
    for group in VALUES:
        factor = np.abs(1.0 + between[:, None] * u)
        variance = (within[:, None] * factor) ** 2
        density = scipy.stats.norm.pdf(u) * np.ones_like(factor)
        for value in group:
            of_both = variance + (ERROR * value) ** 2
            density *= np.exp(-0.5 * (value - mean[:, None] * factor) ** 2 / of_both) / np.sqrt(of_both)
        log_p += np.log(density.sum(axis=1) + 1e-300)
    p = np.exp(log_p - log_p.max())
    return mean, between, p / p.sum()


def spring(error, distribution="normal", prior=None, **options):
    """Return the problem of a spring in nine tests of three groups, whose values are `VALUES`."""
    tests = [
        fmu.Test(f"t{g}{i}", fmu.ModalData([np.sqrt(value) / (2 * np.pi)]), f"g{g}")
        for g, group in enumerate(VALUES)
        for i, value in enumerate(group)
    ]
    scatter = fmu.HalfNormal(OF_SCATTER)
    return fmu.JointProblem(
        fmu.SeparableModel.from_terms(["k"], [(np.eye(1), "k")], [np.eye(1)]),
        tests,
        [fmu.Parameter("k", 1.0, 0.2, 3.0, prior or fmu.Uniform())],
        varies={"k": fmu.Population(distribution, scatter, scatter)},
        pairing="index",
        error=fmu.FrequencyErrors("eigenvalue", sd=error),
        **options,
    )


def test_a_few_precise_tests_of_three_groups_are_sampled():
    """Mean and scatter between groups beside a grid. Without the steps, 3200 draws had an ESS of 20."""
    trace = fmu.sample(spring(ERROR), draws=80, warmup=60, seed=2, progress=False)["posterior"]
    mean, between, p = posterior_by_a_grid()
    for name, x in (("k mean", mean), ("k sd between groups", between)):
        draws = trace[name].to_numpy()
        ess, expected = float(rank_ess(draws)), p @ x
        assert ess > 80, name
        assert abs(draws.mean() - expected) < 5.0 * np.sqrt(p @ (x - expected) ** 2 / ess), name


@pytest.mark.parametrize("distribution", ["normal", "log-normal"])
def test_draws_of_the_posterior_remain_draws_of_the_posterior(distribution):
    """Draws from the prior, resampled by their likelihood, keep their distribution in a few Gibbs steps."""
    problem, rng, n = spring(0.1, distribution, fmu.LogNormal(1.0, 0.1)), np.random.default_rng(3), 2000
    prior = problem.sample_prior(rng, 100_000)
    w = np.exp(problem.log_likelihood(prior))
    w /= w.sum()
    assert 1.0 / np.sum(w**2) > 2 * n
    theta = prior[np.searchsorted(np.cumsum(w), (np.arange(n) + rng.random()) / n).clip(max=len(prior) - 1)]
    kernel = fmu.GibbsSampler(step_size=0.2).bind(problem)
    state, _ = kernel.init(kernel.scaled.to_scaled(theta))
    for _ in range(8):
        state, _ = kernel.step(rng, state)
    after = kernel.scaled.to_theta(state.position)
    assert_allclose(state.log_prob, problem.log_prob(after), rtol=1e-9)
    for k, name in enumerate(problem.names):
        centre = w @ prior[:, k]
        for f in (lambda x: x, lambda x, c=centre: (x - c) ** 2):
            expected = w @ f(prior[:, k])
            error = np.sqrt(w**2 @ (f(prior[:, k]) - expected) ** 2)
            error = np.hypot(error, np.std(f(after[:, k])) / np.sqrt(n))
            assert abs(np.mean(f(after[:, k])) - expected) < 4.5 * error, name


def test_steps_beside_errors_of_the_model_keep_to_the_posterior():
    """The log-probability that a step returns is that of its point, and the errors are those of the terms."""
    problem = spring(0.1, discrepancy=fmu.Discrepancy())
    kernel, rng = fmu.GibbsSampler(step_size=0.4).bind(problem), np.random.default_rng(2)
    state = kernel.init(kernel.scaled.to_scaled(problem.sample_prior(rng, 6)))[0]
    for _ in range(3):
        state, _ = kernel.step(rng, state)
    theta = kernel.scaled.to_theta(state.position)
    assert_allclose(state.log_prob, problem.log_prob(theta), rtol=1e-9)
    both = np.concatenate([problem.layout.of_model(theta), state.extra["errors"]], axis=1)
    assert_allclose(state.extra["terms"], kernel.problem.likelihood.terms(both), rtol=1e-8)
