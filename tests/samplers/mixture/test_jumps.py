"""Jumps of the paper's samplers: chains cross between maxima, and the evidence comes from their candidates."""

from __future__ import annotations

import numpy as np
import pytest

import fmu
from fmu.samplers.mixture.mixture import with_jumps
from fmu.samplers.registry import make_sampler
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
