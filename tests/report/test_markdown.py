"""Tables in Markdown and the units that people read."""

import pandas as pd
import pytest

from fmu.report.markdown import MISSING, about, interval, number, table, whole
from fmu.report.units import shown


def test_table():
    text = table(("name", "a", "b"), [("x|y", "1", "2")], words=(0, -1))
    assert text == "| name | a | b |\n| :-- | --: | :-- |\n| x\\|y | 1 | 2 |\n"


def test_row_of_the_wrong_length():
    with pytest.raises(ValueError, match=r"^rows: must have 2 cells \(got \['1'\]\)$"):
        table(("a", "b"), [("1",)])


def test_numbers():
    assert number(1234.5678, ".1f") == "1234.6"
    assert number(7e-9, ".3g") == "7e-9"
    assert number(-4.56e-12, ".2g") == "-4.6e-12"
    assert number(3e5, ".1e") == "3.0e5"
    assert number(None, ".1f") == number(float("nan"), ".1f") == MISSING
    assert whole(1234567) == "1 234 567"
    assert whole(None) == whole(pd.NA) == whole(float("nan")) == MISSING
    assert about(11_740_000) == "≈ 12 000 000"
    assert about(86) == "≈ 86"
    assert about(None) == about(pd.NA) == about(float("nan")) == MISSING
    assert interval(1.0, 0.51, 1.56, ".1f") == "1.0 [0.5, 1.6]"


@pytest.mark.parametrize(
    ("unit", "value", "expected", "label"),
    [("N/m²", 2.1e11, 210.0, "x / GPa"), ("m⁴", 5e-9, 5000.0, "x / mm⁴"), ("m²", 6e-4, 600.0, "x / mm²"),
     ("N/m", 5.7e7, 57e3, "x / kN/m"), ("N·m/rad", 1.2e7, 12e3, "x / kN·m/rad"),
     ("kg", 3.0, 3.0, "x / kg"), ("", 2.0, 2.0, "x")],
)  # fmt: skip
def test_units(unit, value, expected, label):
    assert value / shown(unit).factor == pytest.approx(expected, rel=1e-12)
    assert shown(unit).label("x") == label
