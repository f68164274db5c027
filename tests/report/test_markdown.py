"""Tables in Markdown and the units that people read."""

import pytest

from fmu.numbers import customary_unit, with_unit
from fmu.tables import markdown_table


def test_table():
    text = markdown_table(("name", "a", "b"), [("x|y", "1", "2")], words=(0, -1))
    assert text == "| name | a | b |\n| :-- | --: | :-- |\n| x\\|y | 1 | 2 |\n"


def test_row_of_the_wrong_length():
    with pytest.raises(ValueError, match=r"^rows: must have 2 cells \(got \['1'\]\)$"):
        markdown_table(("a", "b"), [("1",)])


def test_bars_in_names_end_no_cell():
    assert markdown_table(("a|b",), [("<b>",)]) == "| a\\|b |\n| :-- |\n| <b> |\n"


@pytest.mark.parametrize(
    ("unit", "value", "expected", "label"),
    [("N/m²", 2.1e11, 210.0, "x / GPa"), ("m⁴", 5e-9, 5000.0, "x / mm⁴"), ("m²", 6e-4, 600.0, "x / mm²"),
     ("N/m", 5.7e7, 57e3, "x / kN/m"), ("N·m/rad", 1.2e7, 12e3, "x / kN·m/rad"),
     ("kg", 3.0, 3.0, "x / kg"), ("", 2.0, 2.0, "x")],
)  # fmt: skip
def test_units(unit, value, expected, label):
    assert value / customary_unit(unit).factor == pytest.approx(expected, rel=1e-12)
    assert customary_unit(unit).label("x") == label


@pytest.mark.parametrize(
    ("value", "unit", "sd", "words"),
    [(1.7e11, "N/m²", None, "170 GPa"), (1.729e11, "N/m²", 2.2e9, "172.9 GPa"), (1.3, "", None, "1.3"),
     (3.9e-9, "m⁴", None, "3900 mm⁴"), (3.9e-9, "m⁴", 0.0, "3900 mm⁴")],
)  # fmt: skip
def test_values_in_sentences_have_the_units_of_the_tables(value, unit, sd, words):
    assert (with_unit(value, unit) if sd is None else with_unit(value, unit, sd)) == words
