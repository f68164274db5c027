"""Gibbs sampling of populations over several tests: the right posterior, at two solves a draw."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose
from scipy.special import logsumexp

import fmu
from fmu.analysis.convergence.rank_statistics import chain_ess
from fmu.posterior.joint.conditional.both import scatter_about_typical
from fmu.posterior.joint.conditional.scores import REGULAR
from fmu.posterior.joint.varies.base import sum_by_test
from tests.posterior.joint.conditional.test_conditional_densities import campaign
from tests.shear_building import frequencies_hz, shear_building, two_frequencies_hz


def draws_of(trace, name):
    return np.asarray(trace["posterior"][name])


@pytest.fixture(scope="module")
def drawn():
    """Return a problem with correlated populations and a short run of it."""
    problem = campaign(correlation=2.0)
    return problem, fmu.sample(problem, "gibbs", draws=8, warmup=5)


def without_data(distribution, correlation):
    """Return the problem of two tests with errors so large that the posterior is the prior."""
    model = shear_building(["k1", "k2"], 2e8, 1e5)
    f = frequencies_hz(model, [1.0, 1.0])[0]
    tests = [fmu.Test(f"t{t}", fmu.ModalData(f)) for t in range(2)]
    parameters = [fmu.Parameter(name, start=1.0, lower=0.9, upper=1.3) for name in ("k1", "k2")]
    return fmu.JointProblem(
        model,
        tests,
        parameters,
        varies={name: fmu.Population(distribution, sd=fmu.HalfNormal(0.1)) for name in ("k1", "k2")},
        correlation=correlation,
        error=fmu.FrequencyErrors("relative", sd=100.0),
    )


def test_without_information_the_draws_are_those_of_the_prior():
    problem = without_data("log-normal", 1.0)
    trace = fmu.sample(
        problem, fmu.GibbsSampler(step_size=0.4), draws=30, warmup=0, chains=40, init="prior", seed=3
    )
    prior = problem.sample_prior(np.random.default_rng(1), 20_000)
    for k, name in enumerate(problem.names):
        drawn = draws_of(trace, name)
        n = int(chain_ess(drawn))
        assert n > 200, name
        thinned = drawn.ravel()[:: max(1, drawn.size // n)]
        assert scipy.stats.ks_2samp(thinned, prior[:, k]).pvalue > 1e-4, name


def test_the_posterior_is_that_of_hmc():
    rng, model = np.random.default_rng(7), shear_building(["k1", "k2"], 2e8, 1e5)
    k = np.stack([1.0 + 0.05 * rng.standard_normal(4), np.full(4, 1.1)], axis=1)
    f = np.stack([frequencies_hz(model, one)[0] for one in k]) * (1.0 + 0.02 * rng.standard_normal((4, 2)))
    problem = fmu.JointProblem(
        model,
        [fmu.Test(f"t{t}", fmu.ModalData(one)) for t, one in enumerate(f)],
        [fmu.Parameter(name, start=1.0, lower=0.5, upper=1.6) for name in ("k1", "k2")],
        varies={"k1": fmu.Population(sd=fmu.HalfNormal(0.1))},
        error=fmu.FrequencyErrors(
            "relative", sd=fmu.Parameter("noise", 0.02, 0.005, 0.2, prior=fmu.HalfNormal(0.03))
        ),
    )
    gibbs = fmu.sample(problem, "gibbs", draws=50, warmup=30, chains=40)
    hmc = fmu.sample(problem, "hmc", draws=20, warmup=50, chains=32)
    assert chain_ess(draws_of(gibbs, "noise")) > 200
    for name in problem.names:
        centre = np.median(draws_of(hmc, name))
        drawn = [draws_of(trace, name) for trace in (gibbs, hmc)]
        spread = [np.log(np.abs(x - centre) + 1e-9) for x in drawn]
        for word, (one, other) in (("mean", drawn), ("log spread", spread)):
            error = np.hypot(*(np.std(x) / np.sqrt(chain_ess(x)) for x in (one, other)))
            assert abs(np.mean(one) - np.mean(other)) < 4.5 * error, (name, word)


def imprecise():
    """Return the problem of ten tests that say little about their own values beside the correlated populations."""
    rng, model = np.random.default_rng(5), shear_building(["k1", "k2"], 2e8, 1e5)
    k = np.exp(0.04 * rng.multivariate_normal(np.zeros(2), [[1.0, 0.7], [0.7, 1.0]], 10))
    f = np.stack([frequencies_hz(model, one)[0] for one in k]) * (1.0 + 0.03 * rng.standard_normal((10, 2)))
    return fmu.JointProblem(
        model,
        [fmu.Test(f"t{t}", fmu.ModalData(one)) for t, one in enumerate(f)],
        [fmu.Parameter(name, start=1.0, lower=0.5, upper=1.6) for name in ("k1", "k2")],
        varies=dict.fromkeys(("k1", "k2"), fmu.Population(sd=fmu.HalfNormal(0.05))),
        correlation=1.0,
        error=fmu.FrequencyErrors("relative", sd=0.03),
    )


def moments_by_quadrature(problem, n=60_000):
    """Return means and standard deviations of the main parameters of `imprecise`, and the errors of the means.

    The scores of each test are integrated out by Gauss and Hermite's rule, at importance draws of the others.
    """
    f = np.stack([test.data.frequencies_hz for test in problem.tests])
    rng, (x, w) = np.random.default_rng(0), np.polynomial.hermite_e.hermegauss(9)
    mean, sd = rng.uniform(0.82, 1.14, (n, 2)), np.abs(0.05 * rng.standard_normal((n, 2)))
    rho, u = rng.uniform(-1.0, 1.0, n), np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    weight, total = np.log(np.outer(w, w).ravel() / (2.0 * np.pi)), np.empty(n)
    for here in np.array_split(np.arange(n), 15):
        r = rho[here, None]
        z = np.stack([u[:, 0] + 0.0 * r, r * u[:, 0] + np.sqrt(1.0 - r**2) * u[:, 1]], axis=-1)
        k = np.clip(mean[here, None] + sd[here, None] * z, 0.5, 1.6)
        error = two_frequencies_hz(2e8 * k, (1e5, 1e5))[:, None] / f[None, :, None] - 1.0
        total[here] = logsumexp(weight - 0.5 * np.sum((error / 0.03) ** 2, axis=-1), axis=-1).sum(axis=1)
    w = np.exp(total - logsumexp(total))
    values = np.column_stack([mean[:, 0], sd[:, 0], mean[:, 1], sd[:, 1], rho])
    centre = w @ values
    return centre, np.sqrt(w @ (values - centre) ** 2), np.sqrt(w**2 @ (values - centre) ** 2)


@pytest.mark.validate
def test_correlations_mix_where_tests_say_little_and_the_posterior_is_right():
    problem = imprecise()
    trace = fmu.sample(problem, fmu.GibbsSampler(step_size=0.4), draws=700, warmup=60, seed=5)
    centre, sd, error = moments_by_quadrature(problem)
    for k, name in enumerate(("k1 mean", "k1 sd", "k2 mean", "k2 sd", "k1 k2 correlation")):
        drawn = draws_of(trace, name)
        ess = chain_ess(drawn)
        assert ess > 400, name
        assert abs(np.mean(drawn) - centre[k]) < 4.5 * np.hypot(error[k], sd[k] / np.sqrt(ess)), name
        assert abs(np.std(drawn) / sd[k] - 1.0) < 0.15, name


def of_shear_building(n, storeys, correlation=None):
    """Return the problem of n tests in which the stiffness of every storey scatters by 4 %, errors of 0.5 %."""
    rng, names = np.random.default_rng(0), [f"k{j + 1}" for j in range(storeys)]
    model = shear_building(names, 2e8, 1e5)
    k = np.exp(0.04 * rng.standard_normal((n, storeys)))
    f = np.stack([frequencies_hz(model, one)[0] for one in k]) * (1.0 + 0.005 * rng.standard_normal((n, storeys)))
    return fmu.JointProblem(
        model,
        [fmu.Test(f"t{t}", fmu.ModalData(one)) for t, one in enumerate(f)],
        [fmu.Parameter(name, start=1.0, lower=0.3, upper=3.0, prior=fmu.Normal(0.1, mean=1.0)) for name in names],
        varies=dict.fromkeys(names, fmu.Population("log-normal", sd=fmu.HalfNormal(0.05))),
        correlation=correlation,
        pairing="index",
        error=fmu.FrequencyErrors("relative", sd=0.005),
    )


@pytest.mark.parametrize("correlation", [pytest.param(None, marks=pytest.mark.validate), 2.0])
def test_populations_of_a_few_tests_have_an_effective_draw_in_fifteen_solves(correlation):
    """Sampled given the values in turn with the scores, they take 30 to 75."""
    problem, chains, draws = of_shear_building(8, 3, correlation), 24, 40
    trace = fmu.sample(problem, fmu.GibbsSampler(step_size=0.4), draws=draws, warmup=20, chains=chains)
    assert trace.attrs["sampler"] == "gibbs"
    solves = trace.attrs["n_solves"]
    assert solves <= 2 * chains * draws
    for name, role in zip(problem.names, problem.roles, strict=True):
        if role.kind != "score":
            assert chain_ess(draws_of(trace, name)) > solves / 15.0, name


@pytest.mark.validate
def test_a_default_run_converges():
    problem = of_shear_building(20, 4)
    trace = fmu.sample(problem, draws=400, warmup=100, until_ess=400, max_solves=12_000)
    assert fmu.diagnose(trace, problem).converged, fmu.diagnose(trace, problem)
    assert float(np.mean(trace["sample_stats"]["acceptance_rate"])) > 0.7


def test_scores_on_a_bent_ridge_have_their_density():
    """One precise mode leaves a curve of two stiffnesses open; the exact density is summed on a grid."""
    model = shear_building(["k1", "k2"], 2e8, 1e5)
    k = np.exp(0.25 * np.random.default_rng(6).standard_normal((4, 2)))
    measured = [fmu.ModalData(frequencies_hz(model, one)[0][:1], numbers=(1,)) for one in k]
    problem = fmu.JointProblem(
        model,
        [fmu.Test(f"t{t}", one) for t, one in enumerate(measured)],
        [fmu.Parameter(name, start=1.0, lower=0.1, upper=6.0) for name in ("k1", "k2")],
        varies={name: fmu.Population("log-normal", sd=fmu.HalfNormal(0.3)) for name in ("k1", "k2")},
        error=fmu.FrequencyErrors("relative", sd=0.01),
        pairing="index",
    )
    kernel, rng = fmu.GibbsSampler(step_size=0.4).bind(problem), np.random.default_rng(7)
    of = kernel.conditionals.scores
    assert of.bend is not None
    assert np.max(np.abs(of.bend.curvature)) > 0.3
    theta = np.repeat(kernel.conditionals.typical, 300, axis=0)
    kept, terms = [], problem.likelihood.terms(of.layout.of_model(theta))
    for step in range(60):
        theta, terms, moved = kernel._move_scores(rng, theta, terms, of.linearise(theta))
        if step >= 20:
            kept.append(of.scores.take(theta))
    assert np.mean(moved) > 0.5
    z = np.stack(np.meshgrid(*[np.linspace(-6.0, 6.0, 161)] * 2, indexing="ij"), axis=2).reshape(-1, 1, 2)
    grid = of.scores.put(np.repeat(theta[:1], len(z), axis=0), np.repeat(z, 4, axis=1))
    log_density = sum_by_test(problem.likelihood.terms(of.layout.of_model(grid)), np.arange(4), 4) + of.log_prior(
        grid
    )
    weight = np.exp(log_density - logsumexp(log_density, axis=0))
    drawn = np.stack(kept)
    for power in (1, 2, 3):
        expected = np.einsum("gt,gp->tp", weight, z[:, 0] ** power)
        by_chain = (drawn**power).mean(axis=0)
        error = by_chain.std(axis=0) / np.sqrt(len(theta))
        assert np.max(np.abs(by_chain.mean(axis=0) - expected) / error) < 5.0, power


def test_scores_with_two_solutions_have_their_density():
    """Both (k1, k2) and (2 k2, k1/2) have the two measured frequencies; the exact shares are summed on a grid."""
    model = shear_building(["k1", "k2"], 2e8, 1e5)
    f = [frequencies_hz(model, one)[0] for one in ([2.3, 1.0], [2.2, 1.0], [2.1, 1.0], [2.4, 1.1])]
    problem = fmu.JointProblem(
        model,
        [fmu.Test(f"t{t}", fmu.ModalData(one)) for t, one in enumerate(f)],
        [fmu.Parameter("k1", 2.0, 0.3, 8.0), fmu.Parameter("k2", 1.0, 0.2, 4.0)],
        varies={name: fmu.Population("log-normal", sd=fmu.HalfNormal(0.2)) for name in ("k1", "k2")},
        error=fmu.FrequencyErrors("relative", sd=0.005),
        pairing="index",
    )
    kernel, rng = fmu.GibbsSampler(step_size=0.4).bind(problem), np.random.default_rng(7)
    assert kernel.ridges is not None
    of = kernel.conditionals.scores
    theta = np.repeat(kernel.conditionals.typical, 300, axis=0)
    theta[:, :4] = 2.2, 0.1, 1.1, 0.1  # medians and standard deviations, between the two solutions
    z = np.stack(np.meshgrid(*[np.linspace(-4.5, 4.5, 241)] * 2, indexing="ij"), axis=2).reshape(-1, 1, 2)
    k = np.array([2.2, 1.1]) * np.exp(0.1 * z)
    error = two_frequencies_hz(2e8 * k[:, 0], (1e5, 1e5))[:, None] / np.array(f) - 1.0
    weight = np.exp(-0.5 * np.sum((error / 0.005) ** 2, axis=2) - 0.5 * np.sum(z**2, axis=2))

    def side_and_distance(values):
        ratio = np.log(0.5 * values[..., 0] / values[..., 1])
        return np.stack([ratio < 0.0, np.abs(ratio)], axis=-1)

    expected = np.einsum("gt,gq->tq", weight / weight.sum(axis=0), side_and_distance(k[:, 0]))
    kept, fit, linear = [], kernel.fit_at(theta), of.linearise(theta)
    for step in range(60):
        theta, fit, _ = kernel._move_along_ridges(rng, theta, fit, linear, REGULAR, kernel.ridges)
        if step >= 20:
            kept.append(side_and_distance(of.layout.values(theta[:, : problem.n_structural])))
    found = np.mean(kept, axis=0)
    assert np.all(np.abs(found.mean(axis=0) - expected) < 4.5 * found.std(axis=0) / np.sqrt(len(theta)))
    assert np.all(found[..., 0].std(axis=0) < 0.3)  # 0.5 if every chain keeps to one solution


@pytest.mark.parametrize(
    "noise",
    [
        pytest.param(0.01, marks=pytest.mark.validate),
        fmu.Parameter("noise", 0.01, 0.002, 0.1, prior=fmu.HalfNormal(0.02)),
    ],
    ids=["known", "inferred"],
)
def test_the_kept_residuals_and_slopes_are_those_of_the_new_point(noise):
    problem = campaign("log-normal", noise=noise, bounds=(0.2, 5.0))
    kernel = fmu.GibbsSampler(step_size=0.4).bind(problem)
    kernel, rng = replace(kernel, ridges=problem.likelihood), np.random.default_rng(5)
    state = kernel.init(kernel.scaled.to_scaled(scatter_about_typical(problem, rng, 3, 1.0)))[0]
    for _ in range(3):
        before = state.extra
        state, info = kernel.step(rng, state)
        assert np.all(info.n_solves == 3 + isinstance(noise, fmu.Parameter))
    assert np.all(before["residuals"] != state.extra["residuals"])
    expected = kernel.fit_at(problem.layout.standardise_scores(kernel.scaled.to_theta(state.position)))
    for name, values in expected.items():
        assert_allclose(state.extra[name], values, rtol=1e-6, atol=1e-6 * np.max(np.abs(values)), err_msg=name)


def test_a_test_with_a_known_parameter_has_scores_of_the_right_width():
    """Without information from the data, the scores keep the standard normal distribution they start from."""
    problem = campaign(noise=100.0, bounds=(0.2, 5.0))
    kernel, rng = fmu.GibbsSampler(step_size=0.4).bind(problem), np.random.default_rng(3)
    of, kept = kernel.conditionals.scores, []
    assert not of.scores.scored.all()
    theta = np.repeat(kernel.conditionals.typical, 800, axis=0)
    theta = of.scores.put(theta, rng.standard_normal((len(theta), *of.scores.scored.shape)))
    terms, linear = problem.likelihood.terms(of.layout.of_model(theta)), of.linearise(theta)
    for step in range(12):
        theta, terms, _ = kernel._move_scores(rng, theta, terms, linear)
        if step >= 4:
            kept.append(of.scores.take(theta) ** 2)
    by_chain = np.mean(kept, axis=0)
    error = by_chain.std(axis=0)[of.scores.scored] / np.sqrt(len(theta))
    assert np.max(np.abs(by_chain.mean(axis=0)[of.scores.scored] - 1.0) / error) < 4.5


def test_log_probability_of_the_draws_is_stored(drawn):
    problem, trace = drawn
    theta = np.stack([draws_of(trace, name) for name in problem.names], axis=-1).reshape(-1, problem.ndim)
    # a step recomputes scores from values, which costs rounding times the slope of the log-likelihood
    np.testing.assert_allclose(draws_of_lp(trace), problem.log_prob(theta), rtol=1e-7, atol=1e-6)


def draws_of_lp(trace):
    return np.asarray(trace["sample_stats"]["lp"]).ravel()


def test_it_needs_a_population():
    problem = fmu.cases.load("shear-2dof")
    with pytest.raises(ValueError, match=r"problem: must have a population over several tests .* \(got none\)"):
        fmu.sample(problem, "gibbs", draws=10, warmup=10)


def test_a_resumed_run_has_the_same_draws(drawn, tmp_path):
    problem, whole = drawn
    fmu.sample(problem, "gibbs", draws=3, warmup=5, checkpoint=tmp_path / "run")
    rest = fmu.sample(problem, "gibbs", draws=8, warmup=5, checkpoint=tmp_path / "run")
    for name in problem.names:
        np.testing.assert_array_equal(draws_of(whole, name), draws_of(rest, name))
