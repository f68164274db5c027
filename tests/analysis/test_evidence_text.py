"""What is said of the evidence, and when it is called reliable."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import fmu
from fmu.analysis.convergence.diagnosis import diagnose_all
from fmu.analysis.evidence import found_evidences
from tests import two_storeys


@pytest.fixture(scope="module")
def building():
    problem = fmu.cases.load("shear-2dof")
    maxima = fmu.find_map(problem, starts=16)
    lengths = {"hmc": {"draws": 20, "warmup": 20}, "tempering": {"draws": 60, "warmup": 60}}
    traces = {name: fmu.sample(problem, name, chains=4, maxima=maxima, **n) for name, n in lengths.items()}
    return traces, maxima


def with_lowest_effective(maxima, effective):
    return replace(maxima, maxima=tuple(replace(m, effective_draws=effective) for m in maxima))


def test_both_ways_come_to_the_quadrature_within_their_errors(building):
    traces, maxima = building
    exact = two_storeys.quadrature().log_evidence
    found = found_evidences(traces, diagnose_all(traces), maxima)
    assert [one.method.split(" over")[0].split(" at ")[0] for one in found] == [
        "parallel tempering",
        "importance sampling",
    ]
    for one in found:
        assert abs(one.log_evidence - exact) < 5 * one.error
    assert found[1].doubts == ()
    assert str(found[1]).endswith("(importance sampling at 2 maxima, reliable)")
    assert found[1].error == maxima.log_evidence_error
    assert 0.2 < found[1].error * np.sqrt(sum(m.effective_draws for m in maxima)) < 0.8


def test_a_run_that_has_not_converged_gives_none_to_rely_on(building):
    traces, maxima = building
    verdicts = diagnose_all(traces)
    stopped = verdicts | {"tempering": replace(verdicts["tempering"], converged=False)}
    assert "the run has not converged" in found_evidences(traces, stopped, maxima)[0].doubts
    sound = verdicts | {"tempering": replace(verdicts["tempering"], converged=True)}
    assert "the run has not converged" not in found_evidences(traces, sound, maxima)[0].doubts


def test_few_weights_or_none_are_no_evidence(building):
    traces, maxima = building
    run = {"hmc": traces["hmc"]}

    def told(effective):
        (found,) = found_evidences(run, diagnose_all(run), with_lowest_effective(maxima, effective))
        return str(found)

    assert told(20.0).endswith("reliable)")
    assert "not reliable: at one of them it has 19 effective draws; 20 are needed" in told(19.0)
    assert "± – (Laplace approximation at 2 maxima, not reliable" in told(0.0)


def test_a_draw_above_the_maxima_and_another_evidence_cast_doubt(building):
    traces, maxima = building
    verdicts = {name: replace(found, converged=True) for name, found in diagnose_all(traces).items()}
    lower = replace(maxima, maxima=tuple(replace(m, log_prob=m.log_prob - 30.0) for m in maxima))
    assert "a draw lies above all maxima, so one was missed" in found_evidences(traces, verdicts, lower)[1].doubts
    lighter = replace(maxima, maxima=tuple(replace(m, log_mass=m.log_mass - 3.0) for m in maxima))
    tempered = found_evidences(traces, verdicts, lighter)[0]
    assert tempered.doubts[-1].startswith("it disagrees with -5.7")


def test_a_pseudo_likelihood_has_none(building):
    traces, maxima = building
    trace = traces["hmc"].copy()
    trace["log_likelihood"] = xr.DataTree(trace["log_likelihood"].to_dataset().rename(modes="residual"))
    assert found_evidences({"hmc": trace}, diagnose_all({"hmc": trace}), maxima) == []


def test_nothing_is_known_without_maxima_or_tempering(building):
    traces, _ = building
    run = {"hmc": traces["hmc"]}
    assert found_evidences(run, diagnose_all(run), None) == []
