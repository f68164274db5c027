"""What the benchmarks share: the problems, and a place for each ratio with its budget."""

from __future__ import annotations

import pytest

import fmu
from tests.benchmarks.ratio import paired_ratio


@pytest.fixture(scope="session")
def load():
    problems = {}

    def get(case, pairing="shape"):
        if (case, pairing) not in problems:
            problems[case, pairing] = fmu.cases.load(case, pairing=pairing)
        return problems[case, pairing]

    return get


@pytest.fixture
def against(benchmark):
    """Time `ours` with pytest-benchmark, and note its ratio to `theirs`, taken pair by pair, with the budget."""

    def measure(what, ours, theirs, budget, at_most=True):
        benchmark.pedantic(ours, rounds=9, warmup_rounds=1)
        ratio = paired_ratio(ours, theirs) if at_most else paired_ratio(theirs, ours)
        met = ratio <= budget if at_most else ratio >= budget
        sign = "≤" if at_most else "≥"
        benchmark.extra_info.update(
            {"what": what, "measured": f"{ratio:.3g} ×", "budget": f"{sign} {budget:g} ×", "met": met}
        )
        return ratio

    return measure
