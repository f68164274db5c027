"""Repeated tests that are not independent are told, and those that are stay silent."""

import numpy as np
import pytest

from fmu.analysis.convergence.diagnosis import judge
from fmu.analysis.repeatability import FALSE_ALARMS, repeatability
from fmu.analysis.start.check import check
from fmu.analysis.trace.conversion import to_trace
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.problem import UpdatingProblem
from tests.linear import LinearModel

LABELS = ("a", "b", "c", "d", "e")
LONGER = [pytest.param(n, n_modes, marks=pytest.mark.validate) for n, n_modes in ((10, 5), (30, 2), (100, 1))]


def of(values):
    return repeatability(10.0 + 0.1 * values, LABELS[: values.shape[1]])


@pytest.mark.parametrize(("n", "n_modes"), [(5, 3), *LONGER])
def test_independent_tests_are_silent(n, n_modes):
    """Fewer than 1 % false alarms over all modes together: at most 3 of 60 are expected in 3 of 1000 seeds."""
    rng = np.random.default_rng(n)
    assert sum(bool(of(rng.standard_normal((n, n_modes))).doubts()) for _ in range(60)) <= 3
    assert FALSE_ALARMS < 0.01


def test_a_mode_with_equal_values_is_silent(ar1):
    """A pooled scatter allows it, where the values of another mode differ."""
    values = np.stack([ar1(np.random.default_rng(4), (1, 60), 0.9)[0], np.ones(60)], axis=1)
    found = of(values)
    assert (found.autocorrelation[1], found.trend[1]) == (0.0, pytest.approx(0.0, abs=1e-12))
    assert [one[:7] for one in found.doubts()[:-1]] == ["Mode a:"]


def test_skewed_and_common_scatter_are_silent():
    """A temperature that moves all modes at once is no drift as long as it comes without order."""
    rng = np.random.default_rng(2)
    common = [np.tile(rng.exponential(size=(20, 1)), 4) + 0.1 * rng.standard_normal((20, 4)) for _ in range(30)]
    assert sum(bool(of(values).doubts()) for values in common) <= 2  # at 1 % each: three in 3 of 1000 seeds


@pytest.mark.parametrize(
    ("n", "n_modes", "least"),
    [
        pytest.param(10, 5, 0.4, marks=pytest.mark.validate),
        (15, 5, 0.8),
        pytest.param(30, 1, 0.6, marks=pytest.mark.validate),
        pytest.param(100, 1, 1.0, marks=pytest.mark.validate),
    ],
)
def test_tests_that_resemble_the_one_before_are_told(ar1, n, n_modes, least):
    """AR(1) of 0.7, independent from mode to mode."""
    rng = np.random.default_rng(n)
    series = ar1(rng, (40, n, n_modes), 0.7)
    assert np.mean([bool(of(values).doubts()) for values in series]) >= least


def test_what_it_means_is_said(ar1):
    found = of(ar1(np.random.default_rng(3), (1, 400, 1), 0.75)[0])
    assert found.autocorrelation[0] == pytest.approx(0.75, abs=0.1)
    assert found.effective[0] == pytest.approx(400 * 0.25 / 1.75, rel=0.4)
    first, advice = found.doubts()
    assert first.startswith("Mode a: consecutive tests are correlated (lag-1 autocorrelation 0.7")
    assert "The 400 tests are worth about" in first
    assert "s/√n, is too small by a factor of about 2." in first
    assert "Average" not in first
    assert "average the tests of each block" in advice


def test_a_trend_is_told_in_the_mode_that_has_it():
    rng = np.random.default_rng(4)
    values = rng.standard_normal((12, 3))
    values[:, 1] -= np.arange(12)
    values[4, 1] = np.nan
    found = of(values)
    assert found.drifts.tolist() == [False, True, False]
    assert found.n.tolist() == [12, 11, 12]
    first, _ = found.doubts()
    assert first.startswith("Mode b: ")
    assert "the frequency falls by 1" in first  # 11 steps of 0.1 Hz in 10 Hz
    assert found.drift[1] == pytest.approx(-0.11, abs=0.02)


def test_blocks_are_told():
    """Five sessions of six tests: within a session nearly nothing changes."""
    rng = np.random.default_rng(5)
    values = np.repeat(rng.standard_normal((5, 2)), 6, axis=0) + 0.1 * rng.standard_normal((30, 2))
    found = of(values)
    assert found.resembles.all()
    assert found.effective.max() < 10
    assert of(values[::6]).doubts() == []  # one test a session


@pytest.fixture
def drifting():
    rng = np.random.default_rng(6)
    tests = np.array([101.0, 99.5, 102.0]) + rng.standard_normal((20, 3))
    tests[:, 2] += np.arange(20) * 0.5
    return tests


def problem_of(tests, problem):
    return UpdatingProblem(
        LinearModel(), ModalData.from_tests(tests, labels=("W1", "W2", "T1")), problem.parameters
    )


def test_check_and_verdict_say_so(drifting, problem, make_result):
    rng = np.random.default_rng(7)
    for tests, is_told in ((drifting, True), (rng.permutation(drifting), False)):
        repeated = problem_of(tests, problem)
        found = check(repeated, draws=20)
        assert any("Mode T1" in doubt and "the frequency rises" in doubt for doubt in found.doubts) == is_told
        assert "Prior prediction for the mean of 20 tests, Hz" in str(found)
        trace = to_trace(make_result(rng.standard_normal((4, 100, 2))), repeated)
        assert any("the frequency rises" in warning for warning in judge(trace).warnings) == is_told
