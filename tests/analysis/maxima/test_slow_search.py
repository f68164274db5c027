"""The search of a function that takes long: no more solves than its surrogate would take, and it says so."""

import numpy as np
import pytest

import fmu
from fmu.analysis.maxima import search
from fmu.fem.black_box import solves_of_a_surrogate
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.problem import UpdatingProblem


@pytest.fixture
def slow(monkeypatch):
    """A problem of three parameters on a function without derivatives; and its calls."""
    called = []

    def frequencies(theta):
        called.append(theta)
        return 10.0 * np.sqrt(np.array([theta[0], theta[0] + theta[1], theta[1] * theta[2], theta[2]]))

    parameters = [Parameter(name, 1.1, 0.5, 2.0) for name in "abc"]
    data = ModalData([10.0, 14.0, 10.2, 9.9])
    problem = UpdatingProblem(fmu.BlackBoxModel(frequencies, 3), data, parameters, beta=1.0)
    monkeypatch.setattr(search, "SLOW_S", 0.0)  # whatever a call takes is long
    return problem, called


def test_the_search_of_a_slow_function_takes_no_more_solves_than_a_surrogate(slow):
    problem, called = slow
    called.clear()
    found = fmu.find_map(problem)
    most = solves_of_a_surrogate(3)
    assert len(called) <= 1.1 * most  # the last start, and the curvature, go to their end
    assert found.n_solves == len(called) - 1  # the first call was timed
    (doubt,) = found.doubts
    assert doubt.startswith("a solve takes long, so that the search ended after ")
    assert "of 16 starts: let fmu.surrogate stand for the model" in doubt
    thorough = fmu.find_map(problem, starts=16)
    assert thorough.n_solves > 2 * most
    assert thorough.doubts == ()
    np.testing.assert_allclose(found[0].theta, thorough[0].theta, rtol=1e-4)


def test_its_verdict_says_locally_and_why(slow):
    problem, _ = slow
    length = {"draws": 150, "warmup": 100, "until_ess": 400}
    trace = fmu.sample(problem, init="start", seed=1, **length)
    found = fmu.diagnose(trace)
    assert found.state == "converged locally"
    assert found.remarks[0].startswith("a solve takes long, so that the search ended after ")
    searched = fmu.sample(problem, init="start", seed=1, maxima=fmu.find_map(problem, starts=16), **length)
    assert fmu.diagnose(searched).state == "converged"
