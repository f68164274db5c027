"""The updated values in input decks of other programs: those programs read what `fmu export` wrote."""

import re
import shutil
import subprocess

import numpy as np
import pytest

import fmu
from fmu.analysis.trace.conversion import save_trace
from fmu.config import ConfigurationError, load
from fmu.config.kept import KeptProblem
from fmu.formats.decks import columns, number
from fmu.report.export import export
from tests.config.models.test_command_table import find_maxima, folder_of
from tests.report.exported import run
from tests.report.test_export_function import MODULE, PYTHON

NASTRAN = """$ a: {a}, sd {a sd}
MAT1    1       {a:8}                .3     7850.
PSHELL* 1               1               {b:16}1
"""
OPENSEES = """thickness = {b}
materials = {'steel': {a}, "sd": {a sd}}
"""
EXPORT = '\n[export]\ntemplates = ["plate.bdf.in", "decks/portal.py.in"]\n'


@pytest.fixture(scope="module")
def sampled(tmp_path_factory):
    folder = tmp_path_factory.mktemp("decks")
    (folder / "mine.py").write_text(MODULE)
    (folder / "plate.bdf.in").write_text(NASTRAN)
    (folder / "decks").mkdir()
    (folder / "decks" / "portal.py.in").write_text(OPENSEES)
    (folder / "a.toml").write_text(PYTHON + EXPORT)
    run(folder / "a.toml", folder / "out")
    return folder


@pytest.mark.parametrize("at", ["mean", "map"])
def test_decks_have_the_exported_values(sampled, at, tmp_path):
    written = export(sampled / "out", at=at, out=tmp_path / "updated")
    assert {"plate.bdf", "plate.bdf.in", "decks/portal.py", "decks/portal.py.in"} <= set(written.files)
    assert not any("placeholder" in remark for remark in written.remarks)
    draws = fmu.load_trace(sampled / "out" / "hmc.nc")["posterior"]
    sd = float(draws["a"].std(ddof=1))
    values = fmu.load(written.directory / "updated.toml").start
    lines = (written.directory / "plate.bdf").read_text().splitlines()
    told, _, its_sd = lines[0].rpartition(" ")
    assert told == f"$ a: {number(values[0])}, sd"
    assert float(its_sd) == pytest.approx(sd, rel=1e-13)
    assert lines[1][16:24] == columns(values[0], 8)
    assert lines[1][24:] == NASTRAN.splitlines()[1][21:]  # the other fields are in their columns
    assert lines[2][40:56] == columns(values[1], 16)
    given = {}
    exec((written.directory / "decks" / "portal.py").read_text(), given)
    assert (given["thickness"], given["materials"]["steel"]) == pytest.approx(values[::-1], rel=1e-13)


def test_a_parameter_without_a_placeholder_is_a_remark(sampled, tmp_path):
    folder = shutil.copytree(sampled, tmp_path / "copy")
    for path in (folder / "plate.bdf.in", folder / "decks" / "portal.py.in"):
        path.write_text(path.read_text().replace("{b}", "1.0").replace("{b:16}", "1.0"))
    assert "b is a placeholder of no template." in export(folder / "out").remarks


def test_a_file_of_the_model_with_the_name_of_a_deck_is_kept(sampled, tmp_path):
    folder = shutil.copytree(sampled, tmp_path / "copy")
    (folder / "mine.py.in").write_text("a = {a}; b = {b}\n")
    (folder / "a.toml").write_text(PYTHON + EXPORT.replace("plate.bdf.in", "mine.py.in"))
    written = export(folder / "out", model=folder / "a.toml")
    assert (written.directory / "mine.py").read_text() == MODULE
    draws = fmu.load_trace(sampled / "out" / "hmc.nc")["posterior"]
    values = re.fullmatch(r"a = (\S+); b = (\S+)\n", (written.directory / "updated-mine.py").read_text()).groups()
    assert [float(one) for one in values] == pytest.approx([float(draws[name].mean()) for name in "ab"], rel=1e-12)


@pytest.mark.parametrize(
    ("templates", "text", "rule"),
    [
        ('["none.inp.in"]', None, "templates.0: must be a text file (no such file"),
        ('["a.inp"]', "{a}", "templates.0: must end with .in, as plate.inp.in"),
        ('["K.mtx.in"]', "{a}", "templates.0: must give a file of another name (got K.mtx)"),
        ('["a.inp.in", "./a.inp.in"]', "{a}", "templates.1: must give a file of another name (got a.inp)"),
        ('["a.inp.in"]', "\n{c}", "templates.0: line 2: {c} must name one of a, b"),
        ('["a.inp.in"]', "E = 2.1e11", "templates.0: must have a placeholder, as {a}"),
        ('["a.inp.in"]', "{a:2}", "templates.0: line 1: {a:2} must have 8 or 16 columns"),
        ("[]", None, "templates: "),
        ('"a.inp.in"', "{a}", "templates: "),
    ],
)
def test_broken_templates_are_told_before_a_run(templates, text, rule, tmp_path):
    (tmp_path / "mine.py").write_text(MODULE)
    (tmp_path / "a.toml").write_text(f"{PYTHON}\n[export]\ntemplates = {templates}\n")
    for name in re.findall(r'"([^"]+)"', templates) if text is not None else []:
        (tmp_path / name).write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        fmu.load(tmp_path / "a.toml")
    assert f"export.{rule}" in str(caught.value)


def test_the_deck_of_a_command_is_the_answer(tmp_path):
    path, out = folder_of(tmp_path / "springs"), tmp_path / "out"
    problem = load(path, "index")
    maxima = find_maxima(problem)
    trace = fmu.sample(problem, "mh", draws=2, warmup=2, chains=2, init="start", maxima=maxima)
    out.mkdir()
    KeptProblem(path, path.parent, "index").save(out)
    save_trace(trace, out / "mh.nc")
    written = export(out)
    values = load(written.directory / "updated.toml").start
    lines = (written.directory / "springs.txt").read_text().splitlines()
    assert lines == [f"k1 {values[0]:.17g}", f"k2 {values[1]:.17g}"]
    assert "springs.txt.in" in written.files


BEAM = """*NODE, NSET=ALL
1, 0, 0, 0
2, .5, 0, 0
3, 1, 0, 0
4, 1.5, 0, 0
5, 2, 0, 0
*ELEMENT, TYPE=B32, ELSET=BEAM
1, 1, 2, 3
2, 3, 4, 5
*MATERIAL, NAME=STEEL
*ELASTIC
{a}, .3
*DENSITY
7850.
*BEAM SECTION, ELSET=BEAM, MATERIAL=STEEL, SECTION=RECT
.02, .02
0, 1, 0
*BOUNDARY
1, 1, 6
*STEP
*FREQUENCY
2
*END STEP
"""


@pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX (ccx) is not installed")
def test_calculix_reads_all_digits_of_a_number(tmp_path):
    """A number of 22 characters, as Python prints it, CalculiX reads without its exponent."""
    from fmu.formats.decks import fill_deck

    found = []
    for value in (2.0734567890123456e11, 4 * 2.0734567890123456e11):
        (tmp_path / "beam.inp").write_text(fill_deck(BEAM, {"a": value}))
        subprocess.run(["ccx", "beam"], cwd=tmp_path, check=True, capture_output=True, timeout=60)
        rows = re.findall(r"^\s+1\s+(\S+)\s+(\S+)\s+(\S+)", (tmp_path / "beam.dat").read_text(), re.MULTILINE)
        found.append(float(rows[0][2]))
    inertia, area = 0.02**4 / 12, 0.02**2
    beam = 1.8751041**2 / (2 * np.pi * 4) * np.sqrt(2.0734567890123456e11 * inertia / (7850 * area))
    assert found[0] == pytest.approx(beam, rel=0.15)  # two elements of second order
    assert found[1] / found[0] == pytest.approx(2.0, rel=1e-6)
