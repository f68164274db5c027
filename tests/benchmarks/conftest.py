"""Fixtures of the benchmarks: the problems, and functions that add a measurement to the page."""

from __future__ import annotations

import time

import numpy as np
import pytest

import fmu
from tests.benchmarks.ratio import paired_ratios, spread


@pytest.fixture(scope="session")
def load():
    problems = {}

    def get(case, pairing="shape"):
        if (case, pairing) not in problems:
            problems[case, pairing] = fmu.cases.load(case, pairing=pairing)
        return problems[case, pairing]

    return get


@pytest.fixture
def note(benchmark):
    """Add a row to a section of the page (`table.SECTIONS`); `met` is None if there is no budget."""

    def add(section, what, measured, budget="—", met=None):
        row = {"section": section, "what": what, "measured": measured, "budget": budget, "met": met}
        benchmark.extra_info.setdefault("rows", []).append(row)

    return add


@pytest.fixture
def against(benchmark, note):
    """Time `ours` with pytest-benchmark, and note the ratio of `ours` to `theirs` with its budget."""

    def measure(what, ours, theirs, budget=None, at_most=True, section="speed", clock=time.process_time):
        benchmark.pedantic(ours, rounds=9, warmup_rounds=1)
        ratios = paired_ratios(*((ours, theirs) if at_most else (theirs, ours)), clock=clock)
        if budget is None:
            note(section, what, spread(ratios))
            return
        median = float(np.median(ratios))
        limit = f"{'≤' if at_most else '≥'} {budget:g} ×"
        note(section, what, spread(ratios, budget), limit, median <= budget if at_most else median >= budget)

    return measure


@pytest.fixture
def within(note):
    """Note the largest error with its tolerance."""

    def check(section, what, error, tolerance):
        note(section, what, f"{error:.1e}", f"≤ {tolerance:.0e}", bool(error <= tolerance))

    return check
