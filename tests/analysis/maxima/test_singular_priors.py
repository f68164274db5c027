"""Densities that are infinite at a bound: no chain starts there, and no message counts on the point there."""

import numpy as np
import pytest
from scipy import special, stats

import fmu
from fmu.analysis.convergence.diagnosis import with_maxima
from fmu.analysis.convergence.remedies import for_chains_apart, for_missed_maximum
from fmu.analysis.maxima.kinds import MAXIMUM, SINGULARITY
from fmu.analysis.maxima.missed import missed_maxima
from tests.shear_building import shear_building

MEASURED, SD = 0.0985, 0.004


@pytest.fixture(scope="module")
def problem():
    """Two storeys, one frequency, and a prior of the upper stiffness that is infinite at both ends."""
    parameters = [
        fmu.Parameter("k1", 1.0, 0.5, 1.5),
        fmu.Parameter("k2", 1.0, prior=fmu.ScaledBeta(0.6, 0.6, 0.5, 1.5)),
    ]
    data = fmu.ModalData([MEASURED], sd_hz=[SD])
    return fmu.UpdatingProblem(shear_building(["k1", "k2"]), data, parameters)


@pytest.fixture(scope="module")
def maxima(problem):
    return fmu.find_map(problem)


def exact_mean_and_sd():
    """By midpoints in the quantiles of both priors."""
    q = (np.arange(600) + 0.5) / 600
    k1, k2 = np.meshgrid(0.5 + q, 0.5 + stats.beta(0.6, 0.6).ppf(q), indexing="ij")
    b = k1 + 2.0 * k2
    f = np.sqrt(0.5 * (b - np.sqrt(b**2 - 4.0 * k1 * k2))) / (2.0 * np.pi)
    w = stats.norm.pdf(MEASURED, f, SD)
    w /= w.sum()
    mean = np.array([np.sum(w * k) for k in (k1, k2)])
    return mean, np.array([np.sqrt(np.sum(w * (k - m) ** 2)) for k, m in zip((k1, k2), mean, strict=True)])


def test_a_point_beside_a_bound_is_no_maximum_and_no_edge_of_the_model(maxima):
    assert maxima[0].kind == SINGULARITY
    assert maxima.are_singular
    said = str(maxima)
    assert "Singularity 1 is no maximum: it is at a bound where the prior's density is infinite." in said
    assert "no solution" not in said
    assert "100 %" not in said


@pytest.mark.parametrize("name", ["emcee", "slice"])
def test_chains_start_at_prior_draws(problem, maxima, name):
    trace = fmu.sample(problem, name, draws=100, warmup=100, maxima=maxima, seed=3)
    assert trace.attrs["init"] == "prior"
    table = fmu.summary(trace)
    mean, sd = exact_mean_and_sd()
    np.testing.assert_allclose((table["mean"] - mean) / sd, 0.0, atol=5.0 / np.sqrt(table["ess_bulk"].min()))
    assert missed_maxima(trace, maxima) == []


def test_walkers_of_emcee_start_at_prior_draws(problem):
    walkers = problem.walkers(40, seed=1)
    assert walkers.shape == (40, 2)
    assert np.ptp(walkers[:, 1]) > 0.8


def test_no_remedy_leads_back_to_the_bound(problem, maxima, make_trace):
    trace = make_trace(np.random.default_rng(1).standard_normal((4, 50, 2)))
    trace["observed_data"] = trace["constant_data"]
    trace.attrs |= {"init": "prior", "sampler": "emcee"}
    assert "init" in for_chains_apart(trace)
    trace = with_maxima(trace, maxima)
    assert for_chains_apart(trace) == "; take the default sampler, the mixture"
    assert "tempering" in for_missed_maximum(trace)


class Gamma:
    """Without a prior: a gamma distribution with the shape 0.8, infinite at 0."""

    ndim, name, shape = 1, "gamma", 0.8
    lower, upper, start = np.zeros(1), np.full(1, np.inf), np.ones(1)

    def log_prob(self, x):
        with np.errstate(divide="ignore", invalid="ignore"):
            value = (self.shape - 1.0) * np.log(x[..., 0]) - x[..., 0] - special.gammaln(self.shape)
        return np.where(x[..., 0] > 0.0, value, -np.inf)


class Steep(Gamma):
    """Finite at the bound, from which it falls a thousandfold within 0.0007."""

    def log_prob(self, x):
        return np.where(x[..., 0] >= 0.0, -1e4 * x[..., 0], -np.inf)


def test_a_plain_density_that_is_infinite_at_its_bound_converges():
    found = fmu.find_map(Gamma())
    assert found[0].kind == SINGULARITY
    assert "it is at a bound where the density is infinite." in str(found)
    trace = fmu.sample(Gamma(), draws=300, warmup=300, maxima=found, seed=1)
    table = fmu.summary(trace)
    assert abs(table["mean"].iloc[0] - 0.8) < 5 * table["mcse_mean"].iloc[0]
    assert missed_maxima(trace, found) == []


def test_a_density_that_is_steep_at_its_bound_has_a_maximum_there():
    assert fmu.find_map(Steep())[0].kind == MAXIMUM
