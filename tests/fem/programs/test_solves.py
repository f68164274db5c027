"""Solves of a callable: each theta is asked for once, whoever asks, and a failure is an answer too."""

import pickle

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import fmu
from fmu.fem.programs.solves import Solves
from fmu.fem.programs.store import SolveStore

SOFT = 0.9


class Counted:
    """Two frequencies of the parameters; fails where the first is low, or as often as it is told to."""

    def __init__(self, failing=0):
        self.called, self.failing, self.factor = [], failing, 1.0

    def __call__(self, theta):
        self.called.append(tuple(theta))
        if theta[0] < SOFT or len(self.called) <= self.failing:
            raise RuntimeError("mesh is inverted")
        return self.factor * np.array([1.0, 2.0]) * np.sqrt(theta[0])


def parameters():
    return [fmu.Parameter("a", 1.0, 0.5, 2.0)]


def test_equal_points_are_one_call_and_one_solve():
    function = Counted()
    solves = Solves(function, 1)
    one, other, same = solves.of(np.array([[1.0], [1.5], [1.0]]))
    assert same is one
    assert function.called == [(1.0,), (1.5,)]
    assert_array_equal(other.frequencies, np.array([1.0, 2.0]) * np.sqrt(1.5))
    assert solves.of(np.array([[1.5]])) == [other]
    assert len(function.called) == 2


def test_a_point_that_failed_is_not_called_again():
    function = Counted()
    problem = fmu.UpdatingProblem(
        fmu.BlackBoxModel(function, 1), fmu.ModalData([1.0, 2.0], sd_hz=0.1), parameters()
    )
    function.called.clear()
    for _ in range(2):
        assert problem.log_prob([0.8]) == -np.inf
        assert [failed.reason for failed in problem.take_failures()] == ["RuntimeError: mesh is inverted"]
    assert function.called == [(0.8,)]
    assert len(problem.model.reasons) == 1


def test_a_mode_that_is_missing_is_said_again_without_a_call():
    function = Counted()
    model = fmu.BlackBoxModel(lambda theta: function(theta)[: 1 if theta[0] > 1.5 else 2], 1)
    problem = fmu.UpdatingProblem(model, fmu.ModalData([1.0, 2.0], sd_hz=0.1), parameters())
    function.called.clear()
    for _ in range(2):
        assert problem.log_prob([1.8]) == -np.inf
        (failed,) = problem.take_failures()
        assert failed.reason == "must give the measured modes, numbers [1, 2] (gave 1 modes)"
    assert function.called == [(1.8,)]
    assert len(model.reasons) == 1


def test_problems_and_configurations_of_one_function_share_its_calls():
    function = Counted()
    shapes = np.eye(2)
    model = fmu.BlackBoxModel(lambda theta: (function(theta), shapes), 1)
    tests = [
        fmu.Test(
            name,
            fmu.ModalData([1.0, 2.0], sd_hz=0.1, labels=("one", "two"), sensors=sensors, shapes=shapes),
        )
        for name, sensors in (("spring", ((1, "x"), (2, "x"))), ("autumn", ((1, "x"), (3, "x"))))
    ]
    joint = fmu.JointProblem(model, tests, parameters())
    assert len(joint.model.configurations) == 2
    alone = fmu.UpdatingProblem(model, tests[0].data, parameters())
    function.called.clear()
    assert np.isfinite(joint.log_prob([1.2]))
    assert np.isfinite(alone.log_prob([1.2]))
    assert function.called == [(1.2,)]


def test_what_is_remembered_is_forgotten_where_the_start_has_changed():
    """Without a store nothing else tells that a value which the function reads has changed."""
    function = Counted()
    model, data = fmu.BlackBoxModel(function, 1), fmu.ModalData([1.0, 2.0], sd_hz=0.1)
    first = fmu.UpdatingProblem(model, data, parameters()).frequencies([1.44])
    assert_array_equal(fmu.UpdatingProblem(model, data, parameters()).frequencies([1.44]), first)
    assert function.called == [(1.0,), (1.44,), (1.0,)]
    function.factor = 2.0
    assert_array_equal(fmu.UpdatingProblem(model, data, parameters()).frequencies([1.44]), 2.0 * first)


def test_memory_is_bounded_and_the_oldest_is_forgotten():
    function = Counted()
    solves = Solves(function, 1, most_bytes=20_000)
    theta = np.linspace(1.0, 2.0, 100)[:, None]
    assert len(solves.of(theta)) == 100
    assert solves.recall(theta[0]) is None
    assert solves.recall(theta[-1]) is not None
    known = sum(solves.recall(point) is not None for point in theta)
    assert 10 < known < 40
    solves.of(theta[:1])
    assert function.called[100:] == [(1.0,)]


def test_a_copy_remembers_nothing():
    solves = Solves(np.sqrt, 1)
    solves.of(np.array([[1.0]]))
    assert pickle.loads(pickle.dumps(solves)).recall(np.array([1.0])) is None
    assert solves.recall(np.array([1.0])) is not None


@pytest.mark.parametrize(("retries", "calls"), [(0, 1), (1, 2), (2, 3), (5, 3)])
def test_a_call_that_fails_is_repeated(retries, calls):
    function = Counted(failing=2)
    (solve,) = Solves(function, 1, retries=retries).of(np.array([[1.0]]))
    assert len(function.called) == calls
    assert bool(solve.reason) == (retries < 2)


def test_a_store_keeps_what_is_slow_and_what_lasts(tmp_path):
    store, function = SolveStore(tmp_path / "store"), Counted()
    solves = Solves(function, 1, store=store, least_s=0.0)
    solves.of(np.array([[1.0], [0.8]]))
    assert sorted((solve.theta[0], bool(solve.reason)) for solve in store) == [(0.8, True), (1.0, False)]
    Solves(function, 1, store=store, least_s=0.0).of(np.array([[1.0], [0.8]]))
    assert len(function.called) == 2
    again = Solves(function, 1, store=store, least_s=0.0, is_outdated=lambda solve: bool(solve.reason))
    again.of(np.array([[1.0], [0.8]]))
    assert function.called[2:] == [(0.8,)]
    other = Solves(function, 1, store=SolveStore(tmp_path / "other"), least_s=0.0, lasting=ValueError)
    other.of(np.array([[1.0], [0.8]]))
    assert [solve.theta[0] for solve in SolveStore(tmp_path / "other")] == [1.0]
