"""Jumps of the paper's samplers: chains cross between maxima, and the evidence comes from their candidates."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import fmu
from fmu.samplers.mixture.mixture import with_jumps
from fmu.samplers.registry import make_sampler
from tests.densities import Density
from tests.samplers.mixture.test_mixture import Apart, drawn


@pytest.mark.parametrize("name", ["mh", "slice", "hmc"])
def test_chains_cross_in_the_right_proportion(name):
    target = Apart()
    sampler = with_jumps(make_sampler(name)).starting_from(target.components(), np.array([0.5, 0.5]))
    assert sampler.name == name
    result = drawn(
        target, sampler, init=np.repeat(target.centres[1:], 32, axis=0), chains=32, draws=190, warmup=200
    )
    left = result.posterior.position[..., 0] < 0
    assert left.mean() == pytest.approx(0.7, abs=0.05)
    assert np.sum(left[:, 1:] != left[:, :-1], axis=1).min() > 5


@pytest.mark.parametrize("name", [pytest.param("hmc", marks=pytest.mark.validate), "mixture"])
def test_the_papers_second_experiment_by_number_converges_from_the_prior(section, section_maxima, name):
    """No sampler with local steps alone reaches its highest maximum from everywhere."""
    problem, maxima = section, section_maxima
    assert len(maxima) > 1
    trace = fmu.sample(problem, name, draws=600, warmup=300, maxima=maxima, init="prior", seed=2)
    assert fmu.diagnose(trace, problem).converged
    assert trace.attrs["sampler"] == name
    assert np.all(trace["sample_stats"]["lp"] > maxima[0].log_prob - 40)
    for method in ("importance", "bridge"):
        found = fmu.evidence(trace, method)
        assert found.log_evidence == pytest.approx(-117.165, abs=0.05)
        assert found.error < 0.03
        assert not found.warnings


def test_jumps_can_be_refused(section, section_maxima):
    trace = fmu.sample(section, "hmc", draws=4, warmup=4, maxima=section_maxima, init="start", jumps=False)
    assert "log_weight" not in trace["sample_stats"]
    with pytest.raises(
        ValueError, match=r"jumps: are for local samplers such as mh, slice, hmc \(got True with emcee\)"
    ):
        fmu.sample(section, "emcee", maxima=section_maxima, jumps=True)


def test_a_single_maximum_needs_no_jumps():
    problem = fmu.cases.load("cantilever-young")
    trace = fmu.sample(problem, "mh", draws=4, warmup=4, maxima=fmu.find_map(problem, 4))
    assert "log_weight" not in trace["sample_stats"]


class MaximaAtABound(Density):
    """A normal coordinate cut at its lower bound 0, one with two narrow modes, and two normal ones."""

    name = "maxima-at-a-bound"

    def __init__(self):
        super().__init__(4, lower=np.array([0.0, -40.0, -40.0, -40.0]), upper=np.array([np.inf, 40.0, 40.0, 40.0]))
        self.offset, self.scale, self.start = np.zeros(4), np.ones(4), np.array([1.0, 0.1, 0.0, 0.0])
        cut = stats.truncnorm(0.5, np.inf, -0.5)
        self.mean = np.array([cut.mean(), 4.0, 0.0, 0.0])
        self.sd = np.array([cut.std(), np.sqrt(16.09), 1.0, 1.0])
        self.log_evidence = np.log(stats.norm.sf(0.5) * 0.6) + 2 * np.log(2 * np.pi)

    def sample_prior(self, rng, n):
        return np.abs(self.start + 2.0 * rng.standard_normal((n, 4)))

    def value_and_slope(self, x):
        first, second = -0.5 * (x[:, 1] / 0.3) ** 2, -0.5 * ((x[:, 1] - 8.0) / 0.3) ** 2
        share = 1.0 / (1.0 + np.exp(np.clip(second - first, -700.0, 700.0)))
        value = np.logaddexp(first, second) - 0.5 * (x[:, 0] + 0.5) ** 2 - 0.5 * np.sum(x[:, 2:] ** 2, axis=1)
        slope = -np.stack([x[:, 0] + 0.5, (x[:, 1] - 8.0 * (1.0 - share)) / 0.09, x[:, 2], x[:, 3]], axis=1)
        return value, slope


@pytest.mark.parametrize("name", ["mh", "slice", "hmc"])
def test_chains_jump_where_a_half_bounded_coordinate_has_its_maximum_at_its_bound(name):
    """In a logarithmic coordinate, the expansion at the bound was centred 16 units away, at u = 10⁶."""
    density = MaximaAtABound()
    trace = fmu.sample(density, name, draws=300, warmup=300, seed=1)
    table, found = fmu.summary(trace), fmu.evidence(trace)
    assert table["ess_bulk"].min() > 200
    np.testing.assert_allclose((table["mean"] - density.mean) / table["mcse_mean"], 0.0, atol=5.0)
    np.testing.assert_allclose(table["sd"] / density.sd, 1.0, atol=0.15)
    assert found.error < 0.03
    assert found.log_evidence == pytest.approx(density.log_evidence, abs=5 * found.error)
