import pytest

from tests.validation.kernels import outcome, page

SAID = [
    "........ [100%]\n",
    "SKIPPED [1] tests/a.py:3: needs ccx\n",
    "FAILED tests/a.py::test_b[x - y] - AssertionError: 1e-9\n",
    "ERROR tests/c.py\n",
    "2 failed, 7 passed, 1 skipped in 3.21s\n",
]


def test_a_failure_of_one_kernel_is_named():
    good = outcome("Haswell", ["8 passed, 1 skipped in 2.0s\n"], 1.25)
    assert (good.passed, good.skipped, good.failed) == (8, 1, ())
    assert "No test failed with any kernel." in page([good])
    bad = outcome("Prescott", SAID, 2.0)
    assert (bad.passed, bad.skipped, len(bad.failed)) == (7, 1, 2)
    said = page([good, bad])
    assert "No test failed" not in said
    assert "- Prescott: `tests/c.py`" in said
    assert "| Haswell | 8 | 1 | 0 | 1.2 |" in said


def test_a_run_that_ended_early_is_no_success():
    with pytest.raises(RuntimeError, match="must say how many tests passed with Prescott"):
        outcome("Prescott", ["Fatal Python error: Illegal instruction\n"], 0.1)
