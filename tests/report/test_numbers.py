"""Numbers as people read them."""

import math

import pytest

from fmu.report.numbers import decimals, fixed, percent, significant, span


@pytest.mark.parametrize(
    ("sd", "places"),
    [(2.2, 1), (0.95, 2), (0.099, 3), (10.0, 0), (9.99, 1), (4e5, 0), (1e-40, 12), (0.0, 3), (math.nan, 3)],
)
def test_two_digits_of_the_spread_are_shown(sd, places):
    assert decimals(sd) == places


@pytest.mark.parametrize(
    ("value", "places", "text"),
    [(172.914, 1, "172.9"), (-0.5, 2, "−0.50"), (math.nan, 1, "–"), (math.inf, 1, "–")],
)
def test_fixed(value, places, text):
    assert fixed(value, places) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0394, "0.0394"), (1.7e-08, "1.7e−8"), (2.5e20, "2.5e20"), (-3.0, "−3"), (math.nan, "–")],
)
def test_significant(value, text):
    assert significant(value) == text


def test_changes_show_their_sign():
    assert [percent(x) for x in (2.54, -9.74, 0.0, math.nan)] == ["+2.5 %", "−9.7 %", "+0.0 %", "–"]


def test_spans_may_be_open():
    assert span(1.0, 2.25, 1) == "1.0 to 2.2"
    assert span(-math.inf, 3.0, 1) == "−∞ to 3.0"
    assert span(-5.0, math.inf, 0) == "−5 to ∞"
