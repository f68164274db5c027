"""One log-probability for all: a plain emcee user and fmu's samplers get the same posterior."""

import emcee
import numpy as np
import pytest

import fmu
from fmu.analysis.convergence import effective
from fmu.analysis.trace.reading import parameter_draws

WALKERS, STEPS, DISCARD = 32, 600, 250


@pytest.fixture(scope="module")
def problem():
    return fmu.cases.load("cantilever-section")


@pytest.fixture(scope="module")
def plain_draws(problem):
    """What a user of emcee who knows nothing of fmu's samplers does with the callable: (1, draws, ndim)."""
    sampler = emcee.EnsembleSampler(WALKERS, problem.ndim, problem.log_prob, vectorize=True)
    sampler.random_state = np.random.RandomState(7).get_state()
    start = problem.sample_prior(np.random.default_rng(7), WALKERS)
    sampler.run_mcmc(start, STEPS)
    return sampler.get_chain(discard=DISCARD, flat=True)[np.newaxis]


def z_scores(draws, walkers, other, other_walkers):
    """Difference of the posterior means in units of their combined Monte-Carlo standard error, (ndim,)."""
    errors = [
        [effective.mcse_mean(x[..., j], w) for j in range(x.shape[-1])]
        for x, w in ((draws, walkers), (other, other_walkers))
    ]
    return (draws.mean(axis=(0, 1)) - other.mean(axis=(0, 1))) / np.hypot(*errors)


@pytest.mark.validate
def test_plain_emcee_agrees_with_ours(problem, plain_draws):
    trace = fmu.sample(problem, "emcee", draws=500, warmup=300, chains=2, seed=3)
    assert np.all(np.abs(z_scores(plain_draws, WALKERS, parameter_draws(trace), WALKERS)) < 5)


@pytest.mark.parametrize(
    ("name", "draws"),
    [("mixture", 250), pytest.param("hmc", 600, marks=pytest.mark.validate)],
)
def test_plain_emcee_agrees_with_samplers_of_single_chains(problem, plain_draws, name, draws):
    trace = fmu.sample(problem, name, draws=draws, warmup=200, chains=4, seed=4)
    assert fmu.summary(trace)["rhat"].max() < 1.01
    assert np.all(np.abs(z_scores(plain_draws, WALKERS, parameter_draws(trace), 1)) < 5)
    # and the test can fail: a posterior standard deviation would be seen
    moved = plain_draws + 1.0 * plain_draws.std(axis=(0, 1))
    assert np.max(np.abs(z_scores(moved, WALKERS, parameter_draws(trace), 1))) > 5
