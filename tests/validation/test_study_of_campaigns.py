"""The study of campaigns: it counts what it was given, and is red where too little is told or too much."""

import numpy as np
import pytest

from tests.validation.campaigns import DEPARTURES, Laws, departures_told, is_told, page


@pytest.mark.parametrize(
    ("wrong", "passed"), [({}, True), ({"told": 30}, False), ({"alarms": 20}, False), ({"inside": 40}, False)]
)
def test_a_departure_that_is_missed_is_counted(wrong, passed):
    n = 100
    inside, told, alarms = wrong.get("inside", 10), wrong.get("told", 2), wrong.get("alarms", 1)
    laws = [Laws(i >= inside, True, True, True, True) for i in range(n)]
    text, is_good = page(laws, [0.5] * 95 + [9.0] * 5, [[i >= told, *[True] * 3, i < alarms] for i in range(n)])
    assert is_good == passed
    assert f"| population: {DEPARTURES[0]} told | {n - told} of {n} |" in text
    assert "| date of damage within 5 tests | 95 of 100 |" in text


def test_a_drift_is_told_and_one_population_is_not():
    assert [is_told(np.random.default_rng(0), departure) for departure in DEPARTURES[::4]] == [True, False]


@pytest.mark.validate
def test_departures_are_told_and_one_population_is_not():
    assert departures_told(0) == [*[True] * 4, False]
