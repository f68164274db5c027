"""Gibbs sampling of populations over several tests: the right posterior, at one or two solves a draw."""

import numpy as np
import pytest
import scipy.stats

import fmu
from fmu.analysis.convergence.rank_statistics import chain_ess
from tests.posterior.joint.conditional.test_conditional_densities import campaign
from tests.shear_building import frequencies_hz, shear_building


def draws_of(trace, name):
    return np.asarray(trace["posterior"][name])


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
    trace = fmu.sample(problem, fmu.GibbsSampler(step_size=0.4), draws=800, warmup=0, seed=3)
    prior = problem.sample_prior(np.random.default_rng(1), 20_000)
    for k, name in enumerate(problem.names):
        drawn = draws_of(trace, name)
        n = int(chain_ess(drawn))
        assert n > 500, name
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
    gibbs = fmu.sample(problem, "gibbs", draws=1000, warmup=100)
    hmc = fmu.sample(problem, "hmc", draws=300, warmup=300)
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


@pytest.mark.validate
def test_correlations_mix_where_tests_say_little():
    problem = imprecise()
    trace = fmu.sample(problem, draws=400, warmup=100)
    assert chain_ess(draws_of(trace, "k1 k2 correlation")) > 180  # 280; 90 if only the values are held


@pytest.mark.validate
def test_the_posterior_with_a_correlation_is_that_of_hmc():
    problem = imprecise()
    gibbs = fmu.sample(problem, "gibbs", draws=1500, warmup=100)
    hmc = fmu.sample(problem, "hmc", draws=400, warmup=300)
    for name in ("k1 mean", "k1 sd", "k2 mean", "k2 sd", "k1 k2 correlation"):
        drawn = [draws_of(trace, name) for trace in (gibbs, hmc)]
        for word, of in (("mean", drawn), ("square", [(x - np.mean(drawn[1])) ** 2 for x in drawn])):
            error = np.hypot(*(np.std(x) / np.sqrt(chain_ess(x)) for x in of))
            assert abs(np.mean(of[0]) - np.mean(of[1])) < 4.5 * error, (name, word)


def test_it_converges_at_one_solve_of_all_tests_a_draw():
    rng = np.random.default_rng(4)
    names = ["k1", "k2", "k3", "k4"]
    model = shear_building(names, 2e8, 1e5)
    k = np.exp(0.03 * rng.standard_normal((20, 4)))
    f = np.stack([frequencies_hz(model, one)[0] for one in k]) * (1.0 + 0.003 * rng.standard_normal((20, 4)))
    problem = fmu.JointProblem(
        model,
        [fmu.Test(f"t{t}", fmu.ModalData(one)) for t, one in enumerate(f)],
        [fmu.Parameter(name, start=1.0, lower=0.3, upper=3.0) for name in names],
        varies={name: fmu.Population() for name in names},
        error=fmu.FrequencyErrors("relative", sd=0.003),
    )
    trace = fmu.sample(problem, draws=800, warmup=200)
    assert trace.attrs["sampler"] == "gibbs"
    assert trace.attrs["n_solves"] + trace.attrs["warmup_n_solves"] <= 4 * (800 + 200) + 4
    assert fmu.diagnose(trace, problem).converged, fmu.diagnose(trace, problem)
    assert float(np.mean(trace["sample_stats"]["acceptance_rate"])) > 0.9


def test_it_needs_a_population():
    problem = fmu.cases.load("shear-2dof")
    with pytest.raises(ValueError, match=r"problem: must have a population over several tests .* \(got none\)"):
        fmu.sample(problem, "gibbs", draws=10, warmup=10)


def test_a_resumed_run_has_the_same_draws(tmp_path):
    problem = campaign()
    whole = fmu.sample(problem, "gibbs", draws=12, warmup=10)
    fmu.sample(problem, "gibbs", draws=5, warmup=10, checkpoint=tmp_path / "run")
    rest = fmu.sample(problem, "gibbs", draws=12, warmup=10, checkpoint=tmp_path / "run")
    for name in problem.names:
        np.testing.assert_array_equal(draws_of(whole, name), draws_of(rest, name))
