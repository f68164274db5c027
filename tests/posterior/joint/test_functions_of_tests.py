"""Users' functions and matrices in several tests: what is the same in two tests is solved once."""

import os

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu.analysis.estimate import seconds_of_a_solve
from fmu.analysis.maxima.search import default_starts
from fmu.cli.sampled import _spread
from fmu.engines.base import InProcess
from fmu.posterior.joint.modal_test import TestsError
from fmu.progress.phases import solves
from tests.shear_building import frequencies_hz, shear_building

HERE = os.getpid()


class Function:
    """Two frequencies of the parameters; its calls are counted."""

    def __init__(self):
        self.called = []

    def __call__(self, theta):
        self.called.append(tuple(theta))
        return np.array([1.0, 2.0]) * np.sqrt(theta[0] * np.ones(2))


def several(n, second=2.0):
    data = [fmu.ModalData([1.0, second + 0.01 * i], sd_hz=0.02, labels=("one", "two")) for i in range(n)]
    return [fmu.Test(f"test {i}", one, group="old" if i < n // 2 else "new") for i, one in enumerate(data)]


def joint(function, n=10, p=1, **options):
    parameters = [fmu.Parameter(name, 1.0, 0.5, 2.0) for name in "ab"[:p]]
    return fmu.JointProblem(fmu.BlackBoxModel(function, p), several(n), parameters, **options)


def building(n=10, **options):
    parameters = [fmu.Parameter(name, 100.0, 50.0, 200.0) for name in ("k1", "k2")]
    return fmu.JointProblem(shear_building(["k1", "k2"]), several(n, 2.6), parameters, pairing="index", **options)


def test_what_tests_share_is_called_once():
    function = Function()
    problem = joint(function)
    function.called.clear()
    problem.log_prob([1.1])
    assert function.called == [(1.1,)]
    problem.log_prob_and_grad([1.2])
    assert len(function.called) == 1 + 3  # central differences of one parameter


def test_calls_are_the_distinct_parameters_of_all_tests():
    function = Function()
    problem = joint(function, p=2, varies={"b": "group"})
    function.called.clear()
    theta = np.array([[1.1, 1.2, 1.3], [1.1, 1.2, 1.2], [1.1, 1.3, 1.2], [1.1, 1.2, 1.3]])
    problem.log_prob(theta)
    assert sorted(function.called) == [(1.1, 1.2), (1.1, 1.3)]


@pytest.mark.parametrize(
    ("options", "distinct"),
    [
        ({}, 1),
        ({"varies": {"k1": "group"}}, 2),
        ({"varies": {"k1": "test"}}, 10),
        ({"varies": {"k1": fmu.Damage()}}, 2),
    ],
)
def test_matrices_are_solved_once_for_tests_with_the_same_parameters(options, distinct):
    problem = building(**options)
    before = solves()
    problem.log_prob(problem.start)
    assert solves() - before == distinct
    problem.log_prob_and_grad(problem.start)
    assert solves() - before == 2 * distinct


def test_tests_of_other_covariates_are_solved_apart():
    tests = [
        fmu.Test(f"test {i}", fmu.ModalData([1.0, 2.6], sd_hz=0.02, labels=("one", "two")), covariates={"T": t})
        for i, t in enumerate([10.0, 20.0, 10.0])
    ]
    parameters = [fmu.Parameter(name, 100.0, 50.0, 200.0) for name in ("k1", "k2")]
    model = building().model.configurations[0].model.structure
    problem = fmu.JointProblem(model, tests, parameters, slopes={"k1": {"T": fmu.Normal(0.01)}}, pairing="index")
    theta = np.array([100.0, 0.01, 110.0])
    before = solves()
    first, second, third = problem.frequencies(theta).reshape(3, 2)
    assert solves() - before == 2
    assert_array_equal(first, third)
    assert np.all(second > first)


def where(theta):
    return [float(os.getpid()), 1e9]


def test_workers_share_the_calls():
    with fmu.engine(workers=2) as engine:
        problem = joint(where, n=2, p=2, varies={"b": "test"})
        with _spread(problem, engine, None) as chains:
            assert isinstance(chains, InProcess)  # the chains advance here, and the calls are made there
            calls = problem.frequencies([[1.0, 1.1, 1.2], [1.0, 1.3, 1.4]])[:, [0, 2]]
        assert HERE not in calls
        with _spread(building(), engine, None) as chains:
            assert chains is engine


def test_the_time_of_a_solve_is_that_of_the_calls(monkeypatch):
    monkeypatch.setattr(fmu.BlackBoxModel, "seconds_at", lambda model, theta: 0.5 if theta.shape == (2,) else None)
    assert seconds_of_a_solve(joint(Function(), p=2, varies={"b": "test"})) == 10 * 0.5
    assert seconds_of_a_solve(joint(Function(), p=2, varies={"b": "group"})) == 2 * 0.5


def test_a_slow_function_of_several_tests_is_searched_like_any_other(monkeypatch):
    monkeypatch.setattr(fmu.BlackBoxModel, "seconds_at", lambda model, theta: 1.0)
    function = Function()
    problem = joint(function, p=2, varies={"b": "test"})
    alone = fmu.UpdatingProblem(fmu.BlackBoxModel(Function(), 2), several(2)[0].data, problem.parameters[:2])
    assert default_starts(problem) == default_starts(alone)
    (doubt,) = fmu.find_map(problem).doubts
    assert doubt.startswith("a solve takes long, so that the search ended after ")


def test_there_is_one_kind_of_problem():
    """A problem of several tests is made by a function, which has no `reduced` that could fail."""
    found = building()
    assert type(found) is fmu.UpdatingProblem
    assert len(found.tests) > 1
    assert not hasattr(fmu.JointProblem, "reduced")


def test_a_coarser_model_of_all_tests():
    n = 60
    ends = [np.diag(2.0 * half) for half in (np.arange(n) < n // 2, np.arange(n) >= n // 2)]
    neighbours = -np.eye(n, k=1) - np.eye(n, k=-1)
    model = fmu.SeparableModel.from_terms(
        ["k1", "k2"], [(ends[0], "k1"), (ends[1], "k2"), 0.5 * neighbours], [np.eye(n)]
    )
    modes = np.sqrt(np.linalg.eigvalsh(sum(ends) + 0.5 * neighbours)[:3]) / (2.0 * np.pi)
    tests = [
        fmu.Test(name, fmu.ModalData(modes * (1.0 + 0.01 * i), labels=("one", "two", "three")))
        for i, name in enumerate(("before", "after"))
    ]
    parameters = [fmu.Parameter(name, 1.0, 0.7, 1.5) for name in ("k1", "k2")]
    problem = fmu.JointProblem(model, tests, parameters, varies={"k1": "test"}, beta=1e6, pairing="index")
    theta = np.array([1.2, 0.9, 1.3])
    coarse = problem.coarser(0.5)
    assert coarse.ndim == 3
    assert coarse.layout is problem.layout
    assert sum(coarse.model.sizes) < sum(problem.model.sizes)
    assert coarse.log_prob(theta) != problem.log_prob(theta)
    np.testing.assert_allclose(coarse.frequencies(theta), problem.frequencies(theta), rtol=0.01)
    assert problem.coarser(1.0).model is problem.model


def test_modes_of_a_function_with_one_number_are_told_with_their_tests():
    data = [fmu.ModalData([1.0, 2.0], sd_hz=0.02, labels=labels) for labels in (("one", "two"), ("one", "three"))]
    tests = [fmu.Test(f"test {t}", one) for t, one in enumerate(data)]
    rule = (
        r"^tests\.1\.numbers: mode 'three' must not have the number of mode 'two' in tests\.0 \(got 2 for both\)"
    )
    with pytest.raises(ValueError, match=rule):
        fmu.JointProblem(fmu.BlackBoxModel(Function(), 1), tests, [fmu.Parameter("a", 1.0, 0.5, 2.0)])


@pytest.mark.parametrize("seen", [((0, 1, 2), (0, 2)), ((0, 2), (0, 1, 2))])
def test_measured_shapes_pair_the_modes_of_a_test_that_missed_an_inner_one(seen):
    """Its modes need labels only; without shapes they need numbers, and the message asks for these."""
    building = shear_building(["k1", "k2", "k3"], 1e6, 1000.0, dofs=[(i, "x") for i in range(3)])
    f, shapes = frequencies_hz(building, np.ones(3))
    k = [fmu.Parameter(f"k{i}", 1.0, 0.5, 2.0) for i in (1, 2, 3)]

    def tests(with_shapes):
        shown = {"sensors": tuple((i, "x") for i in range(3))} if with_shapes else {}
        every = []
        for t, own in enumerate(map(list, seen)):
            at = shown | ({"shapes": shapes[:, own]} if with_shapes else {})
            data = fmu.ModalData(f[own], sd_hz=0.02, labels=tuple(f"m{m + 1}" for m in own), **at)
            every.append(fmu.Test(f"t{t}", data))
        return every

    problem = fmu.JointProblem(building, tests(True), k)
    assert_allclose(problem.frequencies(np.ones(3)), problem.data.frequencies_hz, rtol=1e-6)

    def function(theta):
        return frequencies_hz(building, theta)

    def of_frequencies(theta):
        return function(theta)[0]

    problem = fmu.JointProblem(fmu.BlackBoxModel(function, 3), tests(True), k)
    assert_allclose(problem.frequencies(np.ones(3)), problem.data.frequencies_hz, rtol=1e-9)
    ask = r"^tests\.1\.numbers: mode 'm3' .*: if a test missed a mode, give its numbers$"
    for model, with_shapes, pairing in (
        (building, False, "shape"),
        (building, True, "index"),
        (fmu.BlackBoxModel(of_frequencies, 3), True, "shape"),
    ):
        with pytest.raises(TestsError, match=ask):
            fmu.JointProblem(model, tests(with_shapes), k, pairing=pairing)
