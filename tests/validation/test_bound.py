"""The study of the bound fails if an error exceeds its bound, or if the bound is far above the error."""

from dataclasses import replace

import numpy as np
import pytest

from fmu.fem.reduced import residuals
from tests.fem.reduced.test_frequency_bound import halves
from tests.validation import bound
from tests.validation.bound import Found, examined, page

GOOD = Found("frame", 432, 2, 35, 1000, 13_000, 0, 2e-6, 3e-6, np.array([1.0, 1.2, 1.3]))


@pytest.fixture(scope="module")
def chain():
    return bound._of_chain(halves)._replace(points=64)


def test_a_bound_is_found_sound(chain):
    found = examined(chain)
    assert found.is_sound
    assert (found.n_dof, found.points, found.compared) == (60, 64, 320)
    assert 0.0 < found.error <= found.bound
    assert np.min(found.ratios) >= 1.0


@pytest.mark.parametrize("factor", [0.5, 20.0])
def test_half_a_bound_and_twenty_are_not(chain, monkeypatch, factor):
    whole = residuals.frequency_error
    monkeypatch.setattr(residuals, "frequency_error", lambda *given: factor * whole(*given))
    found = examined(chain)
    assert not found.is_sound
    assert (found.exceeded > 0) == (factor < 1.0)


def test_the_page_says_whether_errors_exceed_their_bounds():
    text = page([GOOD])
    assert "No error exceeds its bound" in text
    assert "| frame | 432 | 2 | 35 | 1 000 | 13 000 | 0 | 2e-6 | 3e-6 | 1.2 | 1 |" in text
    bad = replace(GOOD, exceeded=3)
    assert not bad.is_sound
    assert "**Errors that exceed their bounds: 3. " in page([GOOD, bad])


def test_the_exit_code_is_that_of_the_worst_case(tmp_path, monkeypatch):
    found = iter([GOOD, replace(GOOD, exceeded=1)])
    monkeypatch.setattr(bound, "chains", lambda: ((str(k), lambda: [None]) for k in range(2)))
    monkeypatch.setattr(bound, "examined", lambda case: next(found))
    assert bound.main([str(tmp_path), "--quick"]) == 1
    assert "exceed their bounds: 1. " in (tmp_path / "bound.md").read_text(encoding="utf-8")
