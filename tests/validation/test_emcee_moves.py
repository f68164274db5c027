"""The study of emcee's moves counts all evaluations, and fails if two moves disagree."""

from dataclasses import replace

import numpy as np
import pytest

import fmu
from tests.validation import emcee_moves
from tests.validation.emcee_moves import Found, disagreements, page, tried

GOOD = Found(
    "beam, by shape",
    "stretch",
    0.5,
    64.0,
    1000.0,
    25_728,
    64_000,
    "converged",
    np.array([1.0, 2.0]),
    np.full(2, 0.1),
)
FASTER = replace(GOOD, move="mixture", time=1.6, ess=40_000.0, warmup=5248)


def test_a_run_is_counted_in_full(monkeypatch):
    make, _, tune = emcee_moves.MOVES["stretch"]
    monkeypatch.setitem(emcee_moves.MOVES, "stretch", (make, 20, tune))
    found = tried(fmu.cases.load("shear-2dof"), "two storeys", "stretch", lengths=(8, 16))
    assert found.warmup == 4 * 32 * (20 + 1)
    assert found.evaluations == 4 * 32 * 16, "it is too short and goes on to the last length"
    assert found.time == pytest.approx(found.evaluations / found.ess)
    assert found.verdict.startswith("not converged")


def test_the_page_compares_with_the_stretch_move():
    text = page([GOOD, FASTER, replace(GOOD, move="slow", verdict="not converged: too short")])
    assert "| beam, by shape | stretch | 50 % | 64 | 16 | 1 | 51 300 | yes |" in text
    assert "| beam, by shape | mixture | 50 % | 1.6 | 625 | 40 | 5 900 | yes |" in text
    assert "| beam, by shape | slow | 50 % | ≈ 64 | ≈ 16 | ≈ 1 | ≈ 51 300 | no |" in text
    assert "All moves that have converged agree" in text


def test_moves_that_disagree_are_named(tmp_path, monkeypatch):
    other = replace(FASTER, mean=GOOD.mean + 0.8)
    assert disagreements([GOOD, FASTER]) == []
    assert disagreements([GOOD, other]) == ["beam, by shape: stretch and mixture"]
    assert disagreements([GOOD, replace(other, verdict="not converged: too short")]) == []
    assert disagreements([GOOD, replace(other, experiment="beam, by index")]) == []
    found = iter([GOOD, other])
    monkeypatch.setattr(emcee_moves, "MOVES", {"stretch": None, "mixture": None})
    monkeypatch.setattr(emcee_moves, "tried", lambda *given: next(found))
    monkeypatch.setattr(fmu.cases, "load", lambda case, pairing: (case, pairing))
    assert emcee_moves.main([str(tmp_path), "--quick"]) == 1
    assert "They disagree: beam, by shape: stretch and mixture" in (tmp_path / "emcee-moves.md").read_text()
