"""What a run is said to cost, against what it costs."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

import fmu
from fmu.analysis.estimate import Estimate, estimates, estimates_in_words, gradient_cost

ORDERS = {"draws": 150, "warmup": 150, "chains": 4, "groups": None}


def frequencies(theta):
    return [4.0 * np.sqrt(theta[0] * theta[1]), 9.0 * np.sqrt(theta[1])]


@pytest.fixture(scope="module")
def problem():
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in "ab"]
    return fmu.UpdatingProblem(fmu.BlackBoxModel(frequencies, 2), fmu.ModalData([4.0, 9.0], sd_hz=0.3), parameters)


@pytest.mark.parametrize("name", ["mh", "slice", pytest.param("emcee", marks=pytest.mark.validate)])
def test_solves_within_a_factor_of_two(problem, name, monkeypatch):
    monkeypatch.setattr(problem.model.functions[0], "seconds_at", lambda theta: 1.0)
    (said,) = [part for part in estimates(problem, ORDERS | {"samplers": [name]}, 16, 1) if part.name == name]
    trace = fmu.sample(problem, name, draws=150, warmup=150)
    assert 0.5 < said.solves / (trace.attrs["n_solves"] + trace.attrs["warmup_n_solves"]) < 2.0


def test_a_function_is_timed_and_its_workers_share(problem, monkeypatch):
    monkeypatch.setattr(
        problem.model.functions[0], "seconds_at", lambda theta: 0.02 if theta.shape == (2,) else None
    )
    one = estimates(problem, ORDERS | {"samplers": ["mh", "hmc"]}, 16, 1)
    two = estimates(problem, ORDERS | {"samplers": ["mh", "hmc"]}, 16, 2)
    assert [part.name for part in one] == ["search", "mh", "hmc"]
    for alone, shared in zip(one, two, strict=True):
        assert alone.solves * 0.02 <= alone.seconds < alone.solves * 0.0202
        assert shared == alone._replace(seconds=alone.seconds / 2)
    assert one[2].solves > 20 * one[1].solves  # five a gradient, and several gradients a step


def test_a_reduced_model_is_timed_in_the_sampler(monkeypatch):
    monkeypatch.setattr("fmu.analysis.estimate.time.perf_counter", time.process_time)  # the machine may be busy
    two = fmu.cases.load("shear-2dof")
    long = ORDERS | {"samplers": ["mh"], "draws": 10_000_000}
    only, *_ = estimates(two, long, 16, 1)
    assert only.name == "mh"
    assert 1e-6 < only.seconds / only.solves < 0.01
    assert estimates(two, ORDERS | {"samplers": ["mh"], "draws": 1, "warmup": 0}, 16, 1) == []


def test_in_words():
    hmc, mh = Estimate("hmc", 36123.0, 12.3, 2_000_000), Estimate("mh", 7.0, 11_880.0)
    parts = [hmc, Estimate("certificate", 64.0, 0.2), mh]
    assert estimates_in_words(parts) == (
        "hmc: about 36 000 solves, 12 s (at most 2 000 000 solves); certificate: about 64 solves, under 1 s; "
        "mh: about 7 solves, 3.3 h"
    )


@pytest.mark.parametrize(
    ("solve_s", "each_s", "said"), [(0.0001, None, []), (0.0049, 0.0003, []), (0.0049, 0.03, ["mixture"])]
)
def test_a_run_of_seconds_is_not_announced(solve_s, each_s, said, monkeypatch):
    """Nor is it measured where solves are fast, nor said how long the most solves would take: hours."""
    monkeypatch.setattr("fmu.analysis.estimate.seconds_of_a_solve", lambda problem: solve_s)
    monkeypatch.setattr(
        "fmu.analysis.estimate._seconds_in_a_sampler", lambda *_: each_s or pytest.fail("it is measured")
    )
    young = fmu.cases.load("cantilever-young")
    orders = ORDERS | {
        "samplers": ["mixture"],
        "chains": 8,
        "draws": None,
        "warmup": None,
        "max_solves": 2_000_000,
    }
    parts = estimates(young, orders, 256, 1)
    assert [part.name for part in parts if part.name != "certificate"] == said
    assert " h" not in estimates_in_words(parts)


def test_a_gradient_is_timed_against_a_log_probability_on_a_busy_machine(monkeypatch):
    """Four of five calls are held up for a hundred times as long as they take."""
    now, calls = [0.0], []

    def takes(seconds, answer):
        def call(theta):
            calls.append(len(theta))
            now[0] += seconds if len(calls) % 5 == 0 else 100 * seconds
            return answer

        return call

    density = SimpleNamespace(log_prob=takes(0.002, 0.0), log_prob_and_grad=takes(0.005, (0.0, 0.0)))
    monkeypatch.setattr("fmu.analysis.estimate.time.perf_counter", lambda: now[0])
    assert gradient_cost(density, np.zeros((20, 2))) == pytest.approx(2.5)
    assert set(calls) == {16}
    assert len(calls) == 2 * 5
