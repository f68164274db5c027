"""Tables as text fit a terminal, and lose nothing on the way."""

import pytest

from fmu.tables import WIDTH, distinct, text_table, wrap_text


def test_columns_are_as_wide_as_their_cells():
    text = text_table(["", "sd", "unit"], [["E1", "2.2", "GPa"], ["long name", "11", ""]], words=(0, 2))
    assert text.splitlines() == ["            sd  unit", "E1         2.2  GPa", "long name   11"]


def test_words_are_folded_before_columns_go_below():
    prose = "stiffness and mass of sixteen of all thirty-two elements of the wing"
    text = text_table(["", "a", "changes"], [["x" * 40, "1.5", prose]], words=(0, 2))
    assert max(map(len, text.splitlines())) <= WIDTH
    assert "\n\n" not in text
    assert " ".join(text.split("changes")[1].split()) == f"{'x' * 40} 1.5 {prose}" or prose.split()[-1] in text


@pytest.mark.parametrize("columns", [1, 8, 9, 40])
def test_columns_without_room_follow_below(columns):
    header = ["name", *(f"column {k}" for k in range(columns))]
    rows = [[name, *(f"{name}{k}.123456" for k in range(columns))] for name in ("one", "two")]
    lines = text_table(header, rows).splitlines()
    assert max(map(len, lines)) <= WIDTH
    cells = " ".join(lines).split()
    for cell in (cell for row in rows for cell in row[1:]):
        assert cells.count(cell) == 1
    assert cells.count("one") == cells.count("name") == "\n".join(lines).count("\n\n") + 1


def test_a_sentence_is_wrapped_at_spaces_alone():
    text = wrap_text("a-b " * 40 + "x" * 120, "  - ", "    ")
    *lines, last = text.splitlines()
    assert max(map(len, lines)) <= WIDTH
    assert lines[0].startswith("  - a-b")
    assert last == "    " + "x" * 120


def test_names_that_are_taken_get_an_underscore():
    assert distinct(["a", "b", "a", "a_", "a"]) == ["a", "b", "a_", "a__", "a___"]
