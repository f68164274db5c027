"""Failed points and their reasons: recorded once, taken once, bounded, and never in the way of the others."""

import copy
import pickle

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import fmu
from fmu.fem.modes.separable import SeparableModel
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.failures import Failure, FailureRecord
from fmu.posterior.parameters import Parameter
from fmu.posterior.problem import UpdatingProblem

TWO = [Parameter("a", 1.0, 0.5, 4.0), Parameter("b", 1.0, 0.5, 4.0)]


def points(*rows):
    return np.array(rows, dtype=float)


def asked(reasons):
    """Return a why that keeps count of what it was asked."""

    def why(theta):
        reasons.append(theta)
        return f"at {theta[0]:g}"

    return why


def test_each_failure_is_taken_once_and_stays_readable():
    record, questions = FailureRecord(), []
    record.add(points([1.0, 0.0], [2.0, 0.0], [1.0, 0.0]), asked(questions))
    assert [failed.reason for failed in record.take()] == ["at 1", "at 2"]
    assert record.take() == []
    record.add(points([3.0, 0.0]), asked(questions))
    assert [failed.reason for failed in record.take()] == ["at 3"]
    assert [failed.reason for failed in record.first] == ["at 1", "at 2", "at 3"]
    assert record.count == 4
    assert len(questions) == 3


def test_records_are_copies():
    record, given = FailureRecord(), points([1.0, 2.0])
    record.add(given, lambda theta: "why")
    given[:] = 9.0
    assert_array_equal(record.first[0].theta, [1.0, 2.0])
    assert isinstance(record.first[0], Failure)


def test_memory_and_time_are_bounded():
    record, questions = FailureRecord(most=5), []
    for start in range(0, 100, 10):
        record.add(np.arange(start, start + 10.0)[:, None], asked(questions))
    assert record.count == 100
    assert len(questions) == len(record.first) == len(record.take()) == 5
    record.add(points([200.0]), asked(questions))  # there is room again for who takes them
    assert [failed.reason for failed in record.take()] == ["at 200"]
    assert len(record.first) == 5


def test_a_copy_elsewhere_starts_empty():
    record = FailureRecord(most=7)
    record.add(points([1.0]), lambda theta: "why")
    for other in (pickle.loads(pickle.dumps(record)), copy.deepcopy(record)):
        assert (other.count, other.first, other.take(), other.most) == (0, [], [], 7)


def test_of_a_problem(oscillators):
    problem = UpdatingProblem.reduced(oscillators(2, fails_above=3.0), ModalData([1.0, 1.5]), TWO)
    assert (problem.failures, problem.n_failures, problem.take_failures()) == ([], 0, [])
    problem.log_prob([[1.0, 2.0], [3.5, 2.0], [9.0, 2.0]])
    problem.log_prob_and_grad([3.5, 2.0])
    (failed,) = problem.take_failures()
    assert_array_equal(failed.theta, [3.5, 2.0])
    assert failed.reason == "frequencies are not finite (nan, nan Hz)"
    assert problem.take_failures() == []
    assert problem.n_failures == 2
    assert [kept.reason for kept in problem.failures] == [failed.reason]


def test_points_that_work_cost_no_second_look(oscillators):
    model = oscillators(2, fails_above=3.0)
    solve, batches = model.frequencies, []
    model.frequencies = lambda theta: batches.append(len(theta)) or solve(theta)
    problem = UpdatingProblem.reduced(model, ModalData([1.0, 1.5]), TWO)
    problem.log_prob(np.full((5, 2), 1.0))
    problem.log_prob([[1.0, 2.0], [3.5, 2.0]])
    assert batches == [5, 2, 1]


def test_a_function_of_ones_own_is_not_called_again():
    calls = []

    def function(theta):
        calls.append(theta)
        if theta[0] > 3.0:
            raise RuntimeError("the mesh is folded")
        return np.sqrt(theta)

    problem = UpdatingProblem(fmu.BlackBoxModel(function, 2), ModalData([1.0, 1.5]), TWO)
    before = len(calls)
    problem.log_prob([[3.5, 2.0], [1.0, 1.2], [3.6, 2.0]])  # at the start it has been called
    assert [failed.reason for failed in problem.take_failures()] == ["RuntimeError: the mesh is folded"] * 2
    assert len(calls) == before + 3
    model = problem.model
    model.frequencies(points([3.7, 1.0]))  # nobody asked for a log-probability
    assert problem.take_failures() == []


def massless(b_lower, reduction=False):
    """Return a problem whose mass at node 1 is b: without any where b is 0."""
    eye = np.eye(2)
    model = SeparableModel.from_terms(
        ["a", "b"],
        [(np.array([[2.0, -1.0], [-1.0, 2.0]]), "a")],
        [np.diag([1.0, 0.0]), (eye - np.diag([1.0, 0.0]), "b")],
    )
    parameters = [Parameter("a", 1.0, 0.5, 4.0), Parameter("b", 1.0, b_lower, 4.0)]
    return UpdatingProblem.reduced(model, ModalData([0.1, 0.3]), parameters, pairing="index", reduction=reduction)


def test_of_a_structure():
    problem = massless(0.0)
    value = problem.log_prob([[1.0, 0.0], [1.0, 1.0], [1.0, 0.5]])
    assert_array_equal(np.isfinite(value), [False, True, True])
    (failed,) = problem.take_failures()
    assert failed.reason == "M gives 1 modes of finite frequency, 2 are needed"


def test_what_fails_while_a_reduced_model_is_trained_is_not_recorded(tmp_path, monkeypatch):
    monkeypatch.setenv("FMU_CACHE_DIR", str(tmp_path))  # trained anew
    problem = massless(-0.05, reduction=True)
    assert (problem.failures, problem.n_failures) == ([], 0)
    assert problem.log_prob([1.0, -0.04]) == -np.inf
    assert problem.failures[0].reason == "M is not positive semidefinite: its diagonal is -0.04 at node 1 x"


TINY = [1e-150, 1e-150]


@pytest.mark.parametrize(
    ("errors", "measured", "theta", "reason"),
    [
        ("frequency", TINY, [1e300, 1.0], "frequency error of mode 1 overflows"),
        (
            fmu.FrequencyErrors("eigenvalue", sd=0.1),
            TINY,
            [1e150, 1.0],
            "eigenvalue frequency error of mode 1 overflows",
        ),
        (
            [
                fmu.FrequencyErrors("relative", sd=0.1),
                fmu.FrequencyErrors("absolute", sd=Parameter("s", 1.0, 0, 4)),
            ],
            [1.0, 1e10],
            [1.0, 2.0, 1e-150],
            "absolute frequency error of mode 2 overflows",
        ),
    ],
)
def test_an_overflow_names_the_error_model(oscillators, errors, measured, theta, reason):
    parameters = [Parameter("a", 1.0, 0.5, 1e305), Parameter("b", 1.0, 0.5, 4.0)]
    beta = [1e300, 1.0] if errors == "frequency" else None
    problem = UpdatingProblem.reduced(oscillators(2), ModalData(measured), parameters, error=errors, beta=beta)
    assert problem.log_prob(theta) == -np.inf
    (failed,) = problem.take_failures()
    assert failed.reason == f"the log-likelihood is not finite: {reason}"


def test_a_model_that_fails_now_and_then(oscillators):
    model = oscillators(2)
    solve = model.frequencies
    problem = UpdatingProblem.reduced(model, ModalData([1.0, 1.0]), TWO)
    model.frequencies = lambda theta: setattr(model, "frequencies", solve) or np.full((1, 2), np.nan)
    assert problem.log_prob([1.0, 1.0]) == -np.inf
    (failed,) = problem.take_failures()
    assert failed.reason == "the log-likelihood was not finite, and is when it is computed again"
