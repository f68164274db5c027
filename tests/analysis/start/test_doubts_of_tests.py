"""Doubts about several tests: modes that no other test has, and tests that were entered twice."""

import numpy as np
import pytest

import fmu
from fmu.analysis.start.doubts_of_tests import doubts_of_tests
from tests.shear_building import frequencies_hz, shear_building


def several(rows, **options):
    data = fmu.ModalData(np.ones(len(rows[0])), sd_hz=0.01)
    return [fmu.Test(f"t{i}", data.with_frequencies(np.array(row)), **options) for i, row in enumerate(rows)]


def test_one_test_has_the_lower_modes_and_another_the_upper_ones():
    """They share the stiffnesses, which neither determines alone; that no label is shared may be a mistake."""
    model = shear_building(["k1", "k2"], 4e6, 1000.0)
    f = frequencies_hz(model, np.array([0.9, 1.1]))[0]
    tests = [
        fmu.Test(name, fmu.ModalData([f[m]], sd_hz=0.01, numbers=[m + 1], labels=[name]))
        for name, m in (("lower", 0), ("upper", 1))
    ]
    parameters = [fmu.Parameter(name, 1.0, 0.5, 2.0) for name in ("k1", "k2")]
    problem = fmu.JointProblem(model, tests, parameters, pairing="index")
    assert problem.log_likelihood(np.array([0.9, 1.1])) > problem.log_likelihood(problem.start) + 10.0
    warned = fmu.check(problem, draws=2).doubts
    for name in ("lower", "upper"):
        assert sum(said.startswith(f"No other test has a mode of {name} ({name}): ") for said in warned) == 1


def test_equal_tests_are_told():
    rows = [[4.474, 10.966], [4.465, 11.044], [4.451, 10.976], [4.474, 10.966]]
    (said,) = doubts_of_tests(several(rows))
    assert said.startswith("The tests t0, t3 have exactly the same frequencies: ")
    equal, other = several(rows, group="before"), several(rows, group="after")[3]
    assert doubts_of_tests([*equal[:3], other]) == []


@pytest.mark.parametrize("digits", [2, 3])
def test_rounded_frequencies_agree_by_chance(digits):
    """Of 40 tests, two have the same frequency to three digits, and many to two."""
    f = np.round(4.4 * (1.0 + 0.01 * np.random.default_rng(1).standard_normal((40, 1))), digits)
    assert len(np.unique(f)) < 40
    assert doubts_of_tests(several(f)) == []
