"""The meter of the peers counts what the model is asked for, whoever asks, and ends a run at its budget."""

import numpy as np
import pytest

import fmu
from tests.benchmarks.peers import ensembles
from tests.benchmarks.peers.ensembles import wrapping
from tests.benchmarks.peers.posteriors import Target
from tests.benchmarks.peers.run import BudgetError, Meter


@pytest.fixture
def target():
    return Target("shear-2dof", "index", fmu.cases.load("shear-2dof", pairing="index"))


def test_log_probabilities_and_gradients_count_once_each_and_only_inside(target):
    theta, outside = target.starts(1, 7), -target.starts(1, 2)
    meter = Meter(target)
    with meter.counting():
        target.problem.log_prob(theta)
        target.problem.log_prob(outside)
        assert meter.read().evaluations == 7
        target.problem.log_prob_and_grad(theta)
        assert meter.read().evaluations == pytest.approx(7 * target.gradient_cost)
        fmu.find_map(target.problem)
        assert meter.read().evaluations > 100
    target.problem.log_prob(theta)
    assert meter.read().evaluations == 0


def test_a_run_ends_at_its_largest_number_of_calls(target):
    meter = Meter(target, most_calls=10)
    limited = meter.limit(target.problem.log_prob)
    theta = target.starts(1, 7)
    with meter.counting():
        limited(theta)
        limited(theta)
        with pytest.raises(BudgetError):
            limited(theta)
    assert meter.read().evaluations == 14


def test_both_sides_of_the_wrapping_of_emcee_do_the_same_work(target, monkeypatch):
    """Evaluations stand for seconds: the ratio is then that of what the two sides ask of the model."""
    asked = 0
    log_prob = target.problem.log_prob

    def counted(theta):
        nonlocal asked
        value = log_prob(theta)
        asked += np.isfinite(value).sum()  # outside the bounds only emcee asks
        return value

    monkeypatch.setattr(target.problem, "log_prob", counted)
    monkeypatch.setattr(ensembles.time, "process_time", lambda: float(asked))
    assert wrapping(target, 0.1) == pytest.approx(1.0, abs=0.1)


@pytest.mark.validate
def test_the_wrapping_of_emcee_is_of_order_one(target):
    assert 0.5 < wrapping(target, 0.3) < 3.0
