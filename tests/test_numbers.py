"""Numbers as people read them."""

import ast
import math
import re
from decimal import Decimal
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

import fmu
from fmu import numbers as n

VALUES = st.floats(-1e20, 1e20, allow_nan=False).filter(lambda x: x == 0 or abs(x) > 1e-20)
SPREADS = st.floats(1e-12, 1e12)


def read(text):
    """Return the number that a text says, and half of what its last digit stands for."""
    number = Decimal(text.replace("−", "-"))
    return float(number), float(Decimal((0, (1,), number.as_tuple().exponent))) / 2


def is_within_half_a_digit(text, value):
    said, half = read(text)
    return abs(said - value) <= half * (1 + 1e-9) + 1e-15 * abs(value)


@given(VALUES, SPREADS)
@example(9.996e10, 1e9)
@example(3e-9, 1e-8)
@example(-0.04, 1.0)
def test_a_rounded_value_lies_within_half_its_last_digit(value, sd):
    text = n.round_by_sd(value, sd)
    said, _ = read(text)
    assert is_within_half_a_digit(text, value) or (said == 0 and abs(value) < 0.1 * sd)
    assert abs(said - value) <= 0.051 * sd + 1e-14 * abs(value)


@given(VALUES, st.integers(1, 8))
def test_a_value_of_unknown_uncertainty_too(value, digits):
    assert is_within_half_a_digit(n.significant(value, digits), value)


@given(VALUES, SPREADS, st.floats(1.0, 1e6), st.booleans())
def test_what_differs_by_more_than_the_uncertainty_is_seen_to_differ(value, sd, ratio, upwards):
    other = value + (ratio if upwards else -ratio) * sd
    assume(abs(other - value) > 1e-13 * max(abs(value), abs(other)))
    one, two = n.apart(value, other, sd=sd)
    assert one != two
    assert (read(one)[0] < read(two)[0]) == (value < other)


@given(st.floats(1e-6, 1e6), st.floats(1e-10, 1.0), SPREADS)
@example(0.9004, 0.0005, 0.05)
def test_a_value_outside_an_interval_never_reads_as_its_end(end, outside, sd):
    value = end * (1 + outside)
    said = n.apart(value, end, end / 2, sd=sd)
    assert read(said[0])[0] > read(said[1])[0]


@given(st.one_of(st.floats(-1.0, 2.0), st.floats(0, 1e-3), st.floats(0.999, 1.001), st.floats(-1e9, 1e9)))
def test_no_percentage_has_a_power_of_ten(part):
    for text in (n.share(part), n.change(part)):
        assert "e" not in text
        assert text.endswith(" %")
        number = text.removesuffix(" %")
        if number[0] not in "<>":
            assert is_within_half_a_digit(number.removeprefix("+"), 100 * part)
        elif number.startswith("<"):
            assert 100 * part < 0.01
        else:
            assert 100 * part > float(number[2:].replace("−", "-"))


@pytest.mark.parametrize(
    ("part", "text"),
    [
        (5.8e-153, "< 0.01 %"), (0.0, "0 %"), (1.0, "100 %"), (0.19, "19 %"), (0.013, "1.3 %"), (0.9, "90 %"),
        (0.997, "99.7 %"), (0.99996, "> 99.99 %"), (0.00023, "0.023 %"), (1.01, "101 %"), (math.nan, "–"),
    ],
)  # fmt: skip
def test_shares(part, text):
    assert n.share(part) == text


@pytest.mark.parametrize(
    ("ratio", "text"),
    [(0.0254, "+2.54 %"), (-0.0974, "-9.74 %"), (0.0, "0 %"), (1.234, "+123 %"), (3e-7, "< 0.01 %"),
     (-3e-7, "> -0.01 %"), (math.nan, "–")],
)  # fmt: skip
def test_changes_show_their_sign(ratio, text):
    assert n.change(ratio) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.912, "0.912"),
        (31.9, "31.9"),
        (12.0, "12"),
        (1234.5678, "1234.5678"),
        (2.0 / 3.0, "0.666667"),
        (1e-7, "1e-7"),
    ],
)
def test_a_measured_value_has_its_own_digits(value, text):
    assert n.given(value) == text


@given(st.floats(allow_nan=False))
def test_a_typed_value_is_the_same_value(value):
    assert float(n.typed(value)) == value


@pytest.mark.parametrize(
    ("values", "texts"),
    [((32.7, 28.84), ("32.70", "28.84")), ((1177.81, 1082.09), ("1177.8", "1082.1")),
     ((0.10031, 0.1002), ("0.1003", "0.1002")),
     ((50.0001, 50.00012), ("50.00", "50.00")), ((0.0, math.nan), ("0", "–"))],
)  # fmt: skip
def test_frequencies(values, texts):
    assert n.hertz(*values) == texts


def test_computed_frequencies_have_the_decimals_of_the_measured_one():
    assert n.hertz(1.0, 1.0049, measured=0.9872) == ("1.0000", "1.0049")
    assert n.hertz(32.7, 28.84, measured=31.9) == ("32.70", "28.84")
    assert n.hertz(9.25e6, 9.26e6, measured=1.25e7) == ("9250000", "9260000")


@pytest.mark.parametrize(("value", "decimals"), [(31.90, 1), (12.0, 0), (0.012, 3), (1.5e11, 0), (1.25e-7, 0)])
def test_decimals_of_a_value_as_it_was_given(value, decimals):
    assert n.given_decimals(value) == decimals


@pytest.mark.parametrize(
    ("value", "sd", "text"),
    [
        (41.2637, 0.153, "41.26 ± 0.15"),
        (1.7291e11, 2.2e9, "1.729e11 ± 0.022e11"),
        (41.2, math.nan, "41.2 ± –"),
        (12.0, 300.0, "12 ± 300"),
    ],
)
def test_values_with_their_uncertainty(value, sd, text):
    assert n.with_sd(value, sd) == text


def test_intervals_may_be_open():
    assert n.interval(1.0, 2.25, 1) == "1.0 to 2.2"
    assert n.interval(-5.0, math.inf, 0) == "-5 to ∞"


@pytest.mark.parametrize(
    ("sd", "places"),
    [(2.2, 1), (0.95, 2), (0.099, 3), (10.0, 0), (9.99, 0), (4e5, 0), (1e-40, 12), (0.0, 3), (math.nan, 3)],
)
def test_two_digits_of_the_spread_are_shown(sd, places):
    assert n.decimals(sd) == places


@pytest.mark.parametrize(
    ("value", "places", "text"),
    [(172.914, 1, "172.9"), (-0.5, 2, "-0.50"), (math.nan, 1, "–"), (math.inf, 1, "–"), (-0.001, 2, "0.00")],
)
def test_fixed(value, places, text):
    assert n.fixed(value, places) == text


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(0.0394, 3, "0.0394"), (1.7e-08, 3, "1.7e-8"), (2.5e20, 3, "2.5e20"), (-3.0, 3, "-3"), (math.nan, 3, "–"),
     (12345.0, 5, "12345"), (12345.0, 2, "12345"), (-math.inf, 3, "-∞")],
)  # fmt: skip
def test_significant(value, digits, text):
    assert n.significant(value, digits) == text


@pytest.mark.parametrize(("value", "text"), [(12345678, "12 345 678"), (math.nan, "–"), (None, "–")])
def test_whole_numbers(value, text):
    assert n.whole(value) == text


def test_estimates():
    assert n.about(12_345_678) == "≈ 12 000 000"
    assert n.about(None) == "–"
    assert n.about(pd.NA) == "–"
    assert n.about(86) == "≈ 86"


def test_published_tables():
    assert n.with_interval(1.0, 0.51, 1.56, 1) == "1.0 [0.5, 1.6]"
    assert n.fixed(None, 1) == n.significant(None) == "–"


SYNTAX = {
    "fem/frame/drawing.py": "SVG",
    "report/svg.py": "SVG",
    "report/packed.py": "data for the script of a page",
    "report/figure_data.py": "data for the script of a page",
    "analysis/convergence/diagnostics.py": "names of columns, eti90_lb",
    "analysis/prediction.py": "names of columns",
    "paper/page.py": "names of columns",
    "config/parameters.py": "a power of ten that no float can hold",
    "formats/decks.py": "fields of other programs",
    "fem/exports/entries.py": "how many digits a file has",
    "formats/modes/uff.py": "fields of a universal file",
    "report/plan/files.py": "numbers of a TOML file",
}
"""Where numbers are not for people."""


@pytest.mark.parametrize("path", sorted(Path(fmu.__file__).parent.rglob("*.py")), ids=lambda path: path.stem)
def test_no_other_module_chooses_digits(path):
    name = path.relative_to(Path(fmu.__file__).parent).as_posix()
    if name == "numbers.py" or name in SYNTAX:
        return
    for part in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(part, ast.FormattedValue) and part.format_spec is not None:
            style = "".join(piece.value for piece in part.format_spec.values if isinstance(piece, ast.Constant))
            assert not re.search(r"[,eEfFgG%]$", style), f"line {part.lineno}: {style}"
