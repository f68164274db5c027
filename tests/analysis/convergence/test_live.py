"""Running diagnostics: those of the summary for short runs, within what they are known to for long ones."""

import numpy as np
import pytest
from scipy.signal import lfilter

import fmu
from fmu.analysis.convergence import effective
from fmu.analysis.convergence.effective import live_diagnostics
from fmu.analysis.trace.reading import parameter_draws, walkers_of


class Correlated:
    """A Gaussian in the plane with correlation 0.9."""

    ndim = 2
    lower = np.full(2, -np.inf)
    upper = np.full(2, np.inf)
    precision = np.linalg.inv([[1.0, 0.9], [0.9, 1.0]])

    def log_prob(self, x):
        return -0.5 * np.einsum("...i,ij,...j->...", x, self.precision, x)

    def log_prob_and_grad(self, x):
        return self.log_prob(x), -np.asarray(x) @ self.precision

    def sample_prior(self, rng, n):
        return rng.normal(size=(n, 2))


def autoregressive(phi, chains, steps, seed=0):
    """Return chains of standard deviation 1 and autocorrelation φ^lag."""
    noise = np.random.default_rng(seed).standard_normal((chains, steps))
    return lfilter([np.sqrt(1.0 - phi**2)], [1.0, -phi], noise, axis=1)


def of_walkers(phi, ensembles, steps, walkers):
    """Return ensembles (ensembles, steps · walkers), step-major, of autoregressive walkers."""
    paths = autoregressive(phi, ensembles * walkers, steps).reshape(ensembles, walkers, steps)
    return paths.swapaxes(1, 2).reshape(ensembles, -1)


@pytest.mark.parametrize(("sampler", "steps"), [("mh", 300), ("hmc", 100), ("emcee", 30)])
def test_a_short_run_has_the_numbers_of_its_summary(sampler, steps):
    trace = fmu.sample(Correlated(), sampler, draws=steps, warmup=50, chains=4)
    table, found = fmu.summary(trace), live_diagnostics(parameter_draws(trace), walkers_of(trace))
    assert found == {"rhat": table["rhat"].max(), "ess": table["ess_bulk"].min()}


@pytest.mark.parametrize(
    ("sampler", "steps"), [("mh", 5000), pytest.param(fmu.Ensemble(walkers=8), 300, marks=pytest.mark.validate)]
)
def test_a_long_run_has_nearly_those_of_its_summary(sampler, steps):
    trace = fmu.sample(Correlated(), sampler, draws=steps, warmup=100, chains=4)
    table, found = fmu.summary(trace), live_diagnostics(parameter_draws(trace), walkers_of(trace))
    assert found["rhat"] == pytest.approx(table["rhat"].max(), abs=0.005)
    assert found["ess"] == pytest.approx(table["ess_bulk"].min(), rel=0.1)


@pytest.mark.parametrize("phi", [-0.5, 0.0, 0.9, 0.99])
@pytest.mark.parametrize("steps", [5000, 20_000])
def test_batches_keep_the_effective_sample_size(phi, steps):
    x = np.exp(autoregressive(phi, 4, steps))  # skewed: ranks matter
    assert live_diagnostics(x[..., None])["ess"] == pytest.approx(effective.ess_bulk(x), rel=0.15)
    assert effective.ess_bulk(x[:, :: steps // 2000]) != pytest.approx(effective.ess_bulk(x), rel=0.5) or phi > 0.5


@pytest.mark.parametrize("phi", [0.0, 0.9, 0.99])
def test_batches_of_ensembles_too(phi):
    x = of_walkers(phi, 4, 6000, 10)
    assert live_diagnostics(x[..., None], 10)["ess"] == pytest.approx(effective.ess_bulk(x, 10), rel=0.1)


def test_of_very_long_runs_it_is_a_lower_bound():
    slow, fast = autoregressive(0.99, 2, 100_000), autoregressive(0.0, 2, 100_000)
    assert live_diagnostics(slow[..., None])["ess"] == pytest.approx(effective.ess_bulk(slow), rel=0.1)
    assert 35_000 < live_diagnostics(fast[..., None])["ess"] < 50_000


def test_the_worst_parameter_counts():
    slow, fast = autoregressive(0.95, 4, 500), autoregressive(0.0, 4, 500)
    both = live_diagnostics(np.stack([fast, slow], axis=-1))
    assert both == live_diagnostics(slow[..., None])
    assert both["ess"] < 0.2 * live_diagnostics(fast[..., None])["ess"]


def test_chains_at_different_places_show():
    x = autoregressive(0.0, 4, 8000)
    x[0] += 5.0
    found = live_diagnostics(x[..., None])
    assert found["rhat"] > 1.5
    assert found["ess"] < 20


def test_walkers_may_have_an_axis_of_their_own():
    x = of_walkers(0.5, 4, 50, 6)
    assert live_diagnostics(x.reshape(4, 50, 6, 1)) == live_diagnostics(x[..., None], 6)
    assert live_diagnostics(x[:, :, None, None]) == live_diagnostics(x[..., None])


@pytest.mark.parametrize("steps", [3, 100, 3000])
@pytest.mark.parametrize("walkers", [1, 4])
def test_what_does_not_exist_is_nan(steps, walkers):
    moving = np.random.default_rng(0).standard_normal((4, steps * walkers, 2))
    standing, broken = moving.copy(), moving.copy()
    standing[..., 1] = 7.0
    broken[2, 1, 0] = np.nan
    for draws in (standing, broken):
        assert np.all(np.isnan(list(live_diagnostics(draws, walkers).values())))
    alone = live_diagnostics(moving[:1], walkers)
    assert np.isnan(alone["rhat"])
    assert np.isnan(alone["ess"]) == (steps * walkers < 4)


def test_a_chain_that_stands_still_beside_others_is_no_exception():
    x = autoregressive(0.5, 4, 5000)
    x[1] = 0.0
    found = live_diagnostics(x[..., None])
    assert found["ess"] > 0.0
    ensembles = of_walkers(0.5, 4, 5000, 2)
    ensembles[1] = 0.0
    assert np.isnan(live_diagnostics(ensembles[..., None], 2)["ess"])
