"""Input decks as templates: every digit that a program reads, and nothing but the placeholders changed."""

import re

import numpy as np
import pytest

from fmu.formats.decks import columns, fill_deck, filled_name, number, placeholders, read_deck, write_deck

VALUES = [
    2.1e11,
    2.0734567890123456e11,
    -2.0734567890123456e-11,
    -1.23456789e-10,
    1e21,
    1 / 3,
    0.0,
    -7850.123456,
    1e-300,
    4.56789e-3,
    123456789.0,
]


def of_nastran(field):
    """Return the number in a field as Nastran reads it: a sign inside is that of the exponent."""
    return float(re.sub(r"(?<=[\d.])([+-]\d+)$", r"e\1", field.strip()))


@pytest.mark.parametrize("value", VALUES)
def test_a_free_number_keeps_its_digits_within_what_calculix_reads(value):
    text = number(value)
    assert len(text) <= 20
    assert "." in text
    assert float(text) == pytest.approx(value, rel=1e-12, abs=0)


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize(("width", "digits"), [(8, 2), (16, 9)])
def test_a_field_is_filled_exactly_and_read_back(value, width, digits):
    field = columns(value, width)
    assert len(field) == width
    assert "." in field
    assert of_nastran(field) == pytest.approx(value, rel=10.0**-digits, abs=0)


def test_a_field_has_the_closest_number_that_fits():
    """Of random numbers no other text of eight columns is closer: one more or less in the last place is not."""
    for value in 10.0 ** np.random.default_rng(3).uniform(-12, 12, 200):
        field = columns(value, 8).strip()
        error = abs(of_nastran(field) - value)
        last = max(
            i for i, c in enumerate(field.split("+")[0].split("-")[0] if field[0] != "-" else field) if c.isdigit()
        )
        for step in (-1, 1):
            digit = int(field[last]) + step
            if 0 <= digit <= 9:
                assert abs(of_nastran(field[:last] + str(digit) + field[last + 1 :]) - value) >= error * (1 - 1e-9)


def test_a_deck_is_filled_and_otherwise_unchanged():
    text = "MAT1    1       {E1:8}                .3\r\nif {$x > 0} {puts {a b}}\n{'a': {E1}} {{E1}} {E1 sd}\n"
    assert placeholders(text) >= {"E1", "E1 sd"}
    found = fill_deck(text, {"E1": 2.1e11, "E1 sd": 3e9, "t": 1.0})
    assert found == (
        "MAT1    1       2.1+11                  .3\r\nif {$x > 0} {puts {a b}}\n"
        f"{{'a': {number(2.1e11)}}} {{E1}} {number(3e9)}\n"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nothing here", r"must have a placeholder, as \{E1\}"),
        ("{E1}\n\n{E2} {Ee:8}", r"line 3: \{E2\} must name one of E1, t; line 3: \{Ee:8\} must name"),
        ("{E1:5}", r"line 1: \{E1:5\} must have 8 or 16 columns"),
        ("{{E1}}", "must have a placeholder"),
    ],
)
def test_a_deck_that_cannot_be_filled(text, message):
    with pytest.raises(ValueError, match=message):
        fill_deck(text, {"E1": -3e-120, "t": 1.0})


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8"])
def test_the_encoding_of_a_deck_is_kept(encoding, tmp_path):
    (tmp_path / "a.inp.in").write_bytes("** Träger {E1}\r\n".encode(encoding))
    write_deck(tmp_path / "a.inp", fill_deck(read_deck(tmp_path / "a.inp.in"), {"E1": 1.5}))
    assert (tmp_path / "a.inp").read_bytes() == "** Träger 1.5\r\n".encode(encoding)


@pytest.mark.parametrize(
    ("name", "made"),
    [("plate.inp.in", "plate.inp"), ("decks/a.bdf.in", "decks/a.bdf"), ("../a.py.in", "a.py"), ("/x/a.in", "a")],
)
def test_a_template_gives_a_file_of_another_name(name, made):
    assert filled_name(name) == made


@pytest.mark.parametrize("name", ["plate.inp", ".in", "in", "a.in.txt"])
def test_a_template_that_would_replace_itself(name):
    with pytest.raises(ValueError, match=r"must end with \.in"):
        filled_name(name)


def test_what_is_no_deck(tmp_path):
    with pytest.raises(ValueError, match=r"must be a text file \(no such file"):
        read_deck(tmp_path / "none.inp")
    (tmp_path / "binary.op2").write_bytes(b"\0\1\2")
    with pytest.raises(ValueError, match="NUL"):
        read_deck(tmp_path / "binary.op2")
