"""Broken files: every mistake at once, each with its place, the rule and the value received."""

import os
import re

import numpy as np
import pytest
import scipy.sparse as sp
from click.testing import CliRunner
from scipy.io import mmwrite

from fmu import cli
from fmu.config import ConfigurationError, load

FRAME = [
    ("E = 2.1e11", 'E = "soft"', "model.materials.steel.E: must be a valid number (got 'soft')"),
    ("E = 2.1e11", "E = -1.0", "model.materials.steel.E: must be greater than 0 (got -1.0)"),
    ("E = 2.1e11", "E = 1e308", "model.materials.steel.E: must be 0, or from 1e-60 to 1e+60 in size (got 1e+308)"),
    ("start = 7850.0", "start = -1e-300", "parameters.1.start: must be 0, or from 1e-60 to 1e+60"),
    ("elements = 4", f"elements = 1{'0' * 400}", "model.members.2.elements: must be 0, or from 1e-60 to 1e+60"),
    ("elements = 4", f"elements = 1{'0' * 5000}", "is not valid TOML"),
    ("E = 2.1e11", "E = nan", "model.materials.steel.E: must be a finite number (got nan)"),
    ("nu = 0.3", "nu = 0.7", "model.materials.steel.nu: must be less than or equal to 0.5 (got 0.7)"),
    ("rho = 7850.0\n", "", "model.materials.steel.rho: is missing"),
    ("nu = 0.3", "nu = 0.3\ncolour = 1", "model.materials.steel.colour: is not a known key"),
    (
        "thickness = 0.005",
        "thickness = 0.06",
        "model.sections.leg.tube.thickness: must not exceed half the diameter 0.1",
    ),
    (
        "J = 7e-6\n",
        "",
        "sections.beam: must have either rectangle, or tube, or i, or A, Iy, Iz and J (got ['A', 'Iy', 'Iz'])",
    ),
    (
        "J = 7e-6",
        "J = 7e-6\ntube = { diameter = 1.0, thickness = 0.1 }",
        "model.sections.beam: must have either rectangle",
    ),
    ("corner = [0.0, 0.0, 2.0]", "corner = [0.0, 2.0]", "model.points.corner: must have at least 3 items (got ["),
    (
        "[model.points]",
        "[model.points]\nidle = [1.0, 1.0, 1.0]",
        "model.points.idle: is not connected to a member or spring",
    ),
    (
        'left = "clamped"',
        'nowhere = "clamped"',
        "model.supports: must be one of left, corner, other, right (got 'nowhere')",
    ),
    ('right = ["x", "y", "z"]', 'right = ["up"]', "model.supports.right"),
    ('point = "corner"', 'point = "roof"', "model.masses: must be one of left, corner, other, right (got 'roof')"),
    ("mass = 20.0", "mass = -20.0", "model.masses.0.mass: must be greater than or equal to 0 (got -20.0)"),
    (
        'to = "right"',
        'to = "wrong"',
        "model.members.1.to: must be one of left, corner, other, right (got 'wrong')",
    ),
    ('to = "right"', 'to = "other"', "model.members.1.to: must not be the same point as from (got 'other')"),
    ('section = "beam"', 'section = "I"', "model.members.2.section: must be one of leg, beam (got 'I')"),
    ("elements = 4", "elements = 0", "model.members.2.elements: must be greater than or equal to 1 (got 0)"),
    ("elements = 4", "elements = 9998", "model.members: must have at most 10000 elements in total"),
    ("elements = 4", "elements = 10001", "model.members.2.elements: must be less than or equal to 10000"),
    ("elements = 4", "elements = 4.5", "model.members.2.elements: must be a valid integer"),
    (
        "y_direction = [0.0, 1.0, 0.0]",
        "y_direction = [1.0, 0.0, 0.0]",
        "model.members.2.y_direction: must not be zero or parallel to the member, from corner to other "
        "(got [1.0, 0.0, 0.0])",
    ),
    (
        "frequencies = [9.5, 12.1]",
        "frequencies = [9.5, 0.0]",
        "measurement.frequencies.1: must be greater than 0 (got 0.0)",
    ),
    ("frequencies = [9.5, 12.1]", "frequencies = [9.5]", "measurement: sd must be 1, one per mode (got 2)"),
    ("sd = [0.1, 0.2]", "", "measurement: must have either sd or beta"),
    ("sd = [0.1, 0.2]", "sd = 0.1\nbeta = 1.0", "measurement: must have either sd or beta"),
    (
        '["other", "y"]]',
        '["roof", "y"]]',
        "measurement.sensors.1: must be at a place that exists in the model",
    ),
    (
        '["other", "y"]]',
        '["left", "y"]]',
        "measurement.sensors.1: must be a point and a direction that are free to move",
    ),
    (
        "sd = [0.1, 0.2]",
        "sd = 0.1\nnumbers = [1, 99]",
        "numbers: must lie in 1..57, the modes of the model (got (1, 99))",
    ),
    (
        'name = "rho beam"',
        'name = "E legs"',
        "parameters.1.name: must not be the name of another parameter (got 'E legs')",
    ),
    ('name = "rho beam"', 'name = "rho/beam"', "parameters.1.name: must have no slash, line break"),
    ("upper = 2.5e11", "upper = 1.4e11", "parameters.0.upper: must exceed lower 1.5e+11 (got 1.4e+11)"),
    ("start = 7850.0", "start = 9850.0", "parameters.1.start: must be finite and within [5000, 9000] (got 9850)"),
    ("lower = 5000.0", "lower = 0.0", "parameters.1.lower: must be positive, as the property is (got 0.0)"),
    ("lower = 5000.0\n", "", "parameters.1.lower: must be positive, as the property is (got None)"),
    ("upper = 2.5e11\n", "", "parameters.0.prior: a uniform prior needs finite bounds"),
    ("sd = 500.0", "sd = 0.0", "parameters.1.prior.sd: must be greater than 0 (got 0.0)"),
    (
        'distribution = "normal", mean',
        'distribution = "beta", mean',
        "parameters.1.prior.mean: must lie between low 0 and high 1 (got 7850)",
    ),
    ('groups = ["beam"]', 'groups = ["roof"]', "parameters.1.groups: must be among beam, legs (got 'roof')"),
    ('groups = ["beam"]\n', "", "parameters.1.groups: must name a group"),
    ('property = "rho"\n', "", "parameters.1.property: is missing: one of E, rho, A, Iy, Iz, J"),
    (
        'property = "rho"\ngroups = ["beam"]',
        'property = "E"\ngroups = ["legs"]',
        "parameters.1.groups: E of legs is already updated by E legs",
    ),
    ('pairing = "index"', 'pairing = "ear"', "pairing: must be 'shape', 'index' or 'soft' (got 'ear')"),
    (
        'type = "frame"',
        'type = "shell"',
        "model.type: must be one of frame, matrices, exports, command, opensees, python (got 'shell')",
    ),
    ('name = "portal"\n', "", "name: is missing"),
    ("[measurement]", "[measurement", "is not valid TOML"),
]

MATRICES = [
    ('file = "k1.mtx"', 'file = "k9.mtx"', "model.stiffness.0.file: must be a file"),
    ('file = "k1.mtx"', 'file = "k1.xlsx"', "model.stiffness.0.file: must end in .mtx, "),
    ('file = "k1.mtx"', 'file = "garbage.mtx"', "model.stiffness.0.file: must hold a matrix (garbage.mtx: "),
    ('file = "k2.npz"', 'file = "garbage.npz"', "model.stiffness.1.file: must hold a matrix (garbage.npz: "),
    (
        'file = "m.mtx"',
        'file = "wide.mtx"',
        "model.mass.0.file: must hold a real square matrix (got float64 of shape (2, 3))",
    ),
    ('file = "m.mtx"', 'file = "complex.mtx"', "model.mass.0.file: must hold a real square matrix"),
    (
        'file = "k1.mtx"',
        'file = "skew.mtx"',
        "model.stiffness.0.file: must be symmetric (row 1, column 2 differs by 2)",
    ),
    (
        'file = "m.mtx"',
        'file = "large.mtx"',
        "model.mass.0.file: must have 2 rows, as model.stiffness.0 has (got 3)",
    ),
    ("powers = { k2 = 1 }", "powers = { k3 = 1 }", "model.stiffness.1.powers: must name one of k1, k2 (got 'k3')"),
    ("powers = { k2 = 1 }", "", "parameters.1.name: must be in the powers of a term (got 'k2')"),
    (
        '["first", "x"], ["second", "x"]]\n\n[[model',
        '["first", "x"]]\n\n[[model',
        "model.dofs: must name 2 degrees of freedom, one per row (got 1)",
    ),
    (
        'sensors = [["first", "x"], ["second", "x"]]',
        'sensors = [["third", "x"], ["second", "x"]]',
        "measurement.sensors.0",
    ),
    ("shapes = [[0.6, 1.0], [1.0, -0.6]]", "shapes = [[0.6], [1.0]]", "shapes: must have shape (2, 2)"),
    (
        "shapes = [[0.6, 1.0], [1.0, -0.6]]",
        "shapes = [[0.0, 0.0], [1.0, -0.6]]",
        "must not be zero at every sensor",
    ),
    (
        "frequencies = [3.1, 9.8]",
        "frequencies = [3.1, 9.8, 20.0]",
        "measurement: shapes must be 3, one per mode (got 2)",
    ),
    (
        'name = "k2"',
        'prior = { distribution = "normal", mean = 9e7, sd = 1e6 }\nname = "k2"',
        "parameters.1.prior: must have probability between the bounds (got 1e-",
    ),
]


def broken(text, old, new):
    assert text.count(old) >= 1, old
    return text.replace(old, new, 1)


def complaint(folder, text, name="portal.toml"):
    (folder / name).write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        load(folder / name)
    return str(caught.value)


@pytest.mark.parametrize(("old", "new", "expected"), FRAME)
def test_a_broken_frame(frame_text, tmp_path, old, new, expected):
    found = complaint(tmp_path, broken(frame_text, old, new))
    assert expected in found
    assert re.match(r"portal\.toml: \d errors?:\n  ", found)


@pytest.mark.parametrize(("old", "new", "expected"), MATRICES)
def test_broken_matrices(matrices_text, folder, old, new, expected):
    for suffix in ("mtx", "npz"):
        (folder / f"garbage.{suffix}").write_text("this is no matrix")
    mmwrite(folder / "wide.mtx", sp.coo_array(np.ones((2, 3))))
    mmwrite(folder / "complex.mtx", sp.coo_array(np.array([[1j, 0.0], [0.0, 1.0]])))
    mmwrite(folder / "skew.mtx", sp.coo_array(np.array([[1.0, 2.0], [0.0, 1.0]])))
    mmwrite(folder / "large.mtx", sp.coo_array(np.eye(3)))
    assert expected in complaint(folder, broken(matrices_text, old, new))


def test_every_mistake_at_once(frame_text, tmp_path):
    text = (
        frame_text.replace("nu = 0.3", "nu = 3.0")
        .replace("mass = 20.0", "mass = true")
        .replace("sd = 500.0", "sd = -1")
    )
    lines = complaint(tmp_path, text).splitlines()
    assert lines[0] == "portal.toml: 3 errors:"
    assert [line.split(":")[0].strip() for line in lines[1:]] == [
        "model.materials.steel.nu",
        "model.masses.0.mass",
        "parameters.1.prior.sd",
    ]


def test_mistakes_between_tables_come_together_too(frame_text, tmp_path):
    text = frame_text.replace('to = "right"', 'to = "wrong"').replace("start = 7850.0", "start = 1.0")
    found = complaint(tmp_path, text)
    assert "model.members.1.to" in found
    assert "parameters.1.start" in found


def test_too_many_parameters(frame_text, tmp_path):
    many = "".join(f'[[parameters]]\nname = "p{i}"\nstart = 1.0\n' for i in range(300))
    assert "parameters: must have at most 200 items (got " in complaint(tmp_path, frame_text + many)


def test_twenty_thousand_mistakes_are_few_lines(frame_text, tmp_path):
    """All of them are kept, and the first ones are told."""
    many = "".join(f"unknown{i} = {i}\n" for i in range(20_000))
    (tmp_path / "portal.toml").write_text(many + frame_text)
    with pytest.raises(ConfigurationError) as caught:
        load(tmp_path / "portal.toml")
    assert len(caught.value.mistakes) == 20_000
    lines = str(caught.value).splitlines()
    assert len(lines) == 22
    assert lines[0] == "portal.toml: 20000 errors:"
    assert lines[-1] == "  … and 19 980 more"
    result = CliRunner().invoke(cli.main, ["check", str(tmp_path / "portal.toml")], prog_name="fmu")
    assert result.exit_code == 2
    assert result.output.splitlines()[1:] == lines[1:]


def test_a_list_of_what_is_known_is_cut_short(frame_text, tmp_path):
    """Each mistake has one: their length must not grow with their number."""
    many = "".join(f"q{i} = [0.0, 0.0, {i}.0]\n" for i in range(5000))
    text = broken(frame_text, "[model.points]\n", f"[model.points]\n{many}").replace(
        'from = "left"', 'from = "lift"'
    )
    found = complaint(tmp_path, text)
    assert "model.members.0.from: must be one of q0, q1, q2, " in found
    assert "q11, … (5004 in all) (got 'lift')" in found
    assert max(map(len, found.splitlines())) < 300


@pytest.mark.parametrize("deep", [7, 1000, 100_000])
@pytest.mark.parametrize("form", ["{} = 1\n", "[{}]\n", "[[{}]]\n", "x = {{ y = 1, {} = 1 }}\n", "{}\n"])
def test_a_dotted_key_is_looked_at_before_the_parser_is(frame_text, tmp_path, form, deep):
    """The parser takes gigabytes for 50 000 parts, and what comes after it overflows the stack at 1000."""
    if form == "{}\n" and deep < 48:
        return
    text = form.format(".".join(["a"] * deep)) + frame_text
    assert "line 1: a key must have at most 6 parts with dots between them" in complaint(tmp_path, text)


@pytest.mark.parametrize("text", ["see a.b.c.d.e.f.g, h.i.j.k.l.m.n.o", "[a.b.c.d.e.f.g.h.i", "1.2.3.4.5.6.7.8"])
def test_dots_in_a_text_are_no_key(frame_text, tmp_path, text):
    (tmp_path / "portal.toml").write_text(f'# {text}, {text}\ndescription = "{text}"\n{frame_text}')
    load(tmp_path / "portal.toml")


@pytest.mark.parametrize("nested", ["[" * 13 + "]" * 13, "[" * 400 + "]" * 400, "[" * 9000 + "]" * 9000])
def test_lists_that_are_nested_too_deeply(frame_text, tmp_path, nested):
    found = complaint(tmp_path, f"x = {nested}\n{frame_text}")
    assert "must not be nested more than 12 tables and lists deep" in found


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ("0x" + "f" * 5000, "(got a whole number of 6021 digits)"),
        ("1979-05-27", "must be a valid number (got 1979-05-27)"),
        ('"' + "x" * 100_000 + '"', "(got '" + "x" * 60 + "' …)"),
        ("true", "must be a valid number (got true)"),
        ('"\\u001b[31m"', "(got '\\x1b[31m')"),
    ],
)
def test_values_are_shown_short_and_as_the_file_has_them(frame_text, tmp_path, value, told):
    assert told in complaint(tmp_path, broken(frame_text, "E = 2.1e11", f"E = {value}"))


def test_what_moves_the_cursor_is_escaped(frame_text, tmp_path):
    found = complaint(tmp_path, f'"\\u001b[2J\\u202e" = 1\n{frame_text}')
    assert "\\x1b[2J\\u202e: is not a known key" in found


def test_a_text_of_a_spreadsheet_is_read(frame_text, tmp_path):
    """With a byte order mark and carriage returns, as Windows writes them."""
    (tmp_path / "portal.toml").write_bytes(b"\xef\xbb\xbf" + frame_text.replace("\n", "\r\n").encode())
    load(tmp_path / "portal.toml")
    (tmp_path / "portal.toml").write_bytes(frame_text.encode("utf-16"))
    with pytest.raises(ConfigurationError, match="must be text in UTF-8"):
        load(tmp_path / "portal.toml")


def test_what_is_no_regular_file(tmp_path):
    os.mkfifo(tmp_path / "pipe.toml")
    (tmp_path / "loop.toml").symlink_to("loop.toml")
    (tmp_path / "zero.toml").symlink_to("/dev/zero")
    for name, why in (
        ("pipe", "is a pipe"),
        ("zero", "is a pipe, a socket or a device"),
        ("loop", "symbolic links"),
    ):
        with pytest.raises(FileNotFoundError, match=rf"path: must be a TOML file \(.*{name}\.toml.* .*{why}"):
            load(tmp_path / f"{name}.toml")
    with pytest.raises(FileNotFoundError, match="file name too long"):
        load(tmp_path / ("x" * 5000 + ".toml"))


def test_no_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="must be a TOML file"):
        load(tmp_path / "nothing.toml")


def test_a_directory(tmp_path):
    (tmp_path / "portal.toml").mkdir()
    with pytest.raises(FileNotFoundError, match=r"must be a TOML file \(.*portal\.toml is a directory\)"):
        load(tmp_path / "portal.toml")


def test_a_file_that_is_no_text(tmp_path):
    (tmp_path / "portal.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigurationError, match="is not valid TOML"):
        load(tmp_path / "portal.toml")


def test_a_file_that_is_too_large(tmp_path, monkeypatch, frame_text):
    monkeypatch.setattr("fmu.config.LARGEST_FILE", 100)
    assert "must have at most 100 bytes" in complaint(tmp_path, frame_text)


@pytest.mark.parametrize("power", ["0.5", "-1"])
def test_a_power_that_does_not_exist_between_the_bounds(matrices_text, folder, power):
    text = broken(matrices_text, "k2 = 1", f"k2 = {power}")
    first, second, third = text.rpartition("lower = 1e7")
    found = complaint(folder, f"{first}lower = -1.0{third}", "two.toml")
    assert second
    rule = f"must be positive, as model.stiffness.1.powers has it to the power {power} (got -1.0)"
    assert f"parameters.1.lower: {rule}" in found
