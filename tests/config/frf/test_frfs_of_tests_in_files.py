"""Frequency response functions of ``[[tests]]`` in a file: as from Python, or a mistake with its place."""

import re

import numpy as np
import pytest
from click.testing import CliRunner

import fmu
from fmu import cli
from tests.config.frf.test_frf_tables import (
    FRFS,
    MATRICES,
    MODAL,
    mistakes_of,
    problem_of,
    ratio_tables,
    storey_tables,
    write_table,
)
from tests.measured_frfs import RATIOS, TRUTH, building, modes, parameters, ratios, simulate

TESTS = """
[[tests]]
name = "may"
data = "may.csv"
group = "sound"

[[tests]]
name = "june"
data = "june.csv"
modes = [1, 2, 3]
group = "damaged"
masses = [{ place = 1, mass = 50.0 }]
"""
SHARED = FRFS.replace('data = "frfs.csv"\n', "")
DAMAGE = 'upper = 1.6\nvaries = "damage"'
NEW = simulate(seed=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("tests")
    write_table(found / "may.csv", simulate())
    write_table(found / "june.csv", NEW)
    return found


@pytest.fixture(scope="module")
def text():
    tables = storey_tables().replace("upper = 1.6", DAMAGE, 1) + ratio_tables()
    return MATRICES.format(extra=SHARED + MODAL) + TESTS + tables.replace("0.1\n", '0.1\nvaries = "test"\n', 1)


def test_each_test_has_its_file(text, folder):
    found = problem_of(text, folder)
    damping = fmu.ModalDamping(ratios())
    data = {"may": simulate(), "june": NEW}
    error = [fmu.FRFErrors(one, damping, test=name) for name, one in data.items()]
    tests = [fmu.Test("may", modes(), "sound"), fmu.Test("june", modes(), "damaged", masses={1: 50.0})]
    varies = {"k1": fmu.Damage(), "zeta1": "test"}
    expected = fmu.JointProblem(building(), tests, parameters(), varies=varies, error=error)
    assert found.names == expected.names
    theta = np.r_[TRUTH[0], 0.05, TRUTH[1:], RATIOS[0], RATIOS]
    assert np.isclose(found.log_likelihood(theta), expected.log_likelihood(theta), rtol=1e-12)
    assert found.data.labels == ("may: 1", "may: 2", "may: 3", "june: 1", "june: 2", "june: 3")
    assert not any(found.data.use)


def test_a_test_may_have_a_window_of_its_own(text, folder):
    own = text.replace('data = "may.csv"', 'data = "may.csv"\nwindow = ["hann", 12.0]')
    shared = own.replace('of = "frf"', 'of = "frf"\nwindow = ["boxcar", 9.0]')
    for file, other in ((own, None), (shared, ("boxcar", 9.0))):
        terms = problem_of(file, folder).likelihood.responses
        assert [term.data.window for term in terms] == [("hann", 12.0), other]


def test_a_test_of_modes_stands_beside_one_of_frfs(text, folder):
    f = np.asarray(modes().frequencies_hz)
    of_modes = f'name = "may"\nfrequencies = {f.tolist()}'
    shared = text.replace('varies = "test"\n', "") + FREQUENCY
    found = problem_of(shared.replace('name = "may"\ndata = "may.csv"', of_modes), folder)
    assert found.data.use == (True,) * 3 + (False,) * 3
    theta = np.r_[TRUTH[0], 0.05, TRUTH[1:], RATIOS]
    assert found.names == ("k1", "k1 loss [damaged]", "k2", "k3", "zeta1", "zeta2", "zeta3")
    assert found.log_likelihood_terms(theta).shape == (4,)


FREQUENCY = '\n[[error]]\nof = "frequencies"\nsd = 0.05\n'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('data = "june.csv"', 'data = "july.csv"', r"tests\.1\.data: must be a .*july\.csv"),
        ('data = "june.csv"\nmodes = [1, 2, 3]', "frequencies = [3.0]", r"tests\.1\.data: is missing, for"),
        ("modes = [1, 2, 3]", "modes = [1, 2, 3, 4]", r"tests\.1\.modes: must be 3, one per resonance"),
        ('name = "may"\n', 'name = "may"\nsd = 0.1\n', r"tests\.0\.sd: must not be given with data"),
        ('name = "may"\n', 'name = "may"\nfrequencies = [3.0]\n', r"tests\.0: must have one of"),
        ('data = "may.csv"', "frequencies = [3.0]\nmodes = [1]", r"tests\.0\.modes: must be given with data"),
        (
            'data = "may.csv"',
            'data = "may.csv"\nwindow = ["round", 1.0]',
            r"tests\.0\.window: must be a window of",
        ),
        (
            'data = "may.csv"',
            'frequencies = [3.0]\nwindow = ["hann", 1.0]',
            r"tests\.0\.window: must be given with d",
        ),
        ('of = "frf"', 'of = "frf"\nwindow = ["round", 1.0]', r"error\.0\.window: must be a window of"),
        ('of = "frf"', 'of = "frf"\ndata = "may.csv"', r"error\.0\.data: must not be given with \[\[tests\]\]"),
        ('of = "frf"', 'of = "frf"\nband = [90.0, 99.0]', r"error\.0\.use: must leave a line"),
        ('of = "frf"', 'of = "frf"\ndrives = [[9, "x"], [9, "x"]]', r"tests\.0\.data: must be a place .* 9 x"),
        (TESTS, MODES := "\n[measurement]\nfrequencies = [3.0]\nsd = 0.1\n", r"error\.0\.data: is missing"),
        (SHARED + MODAL, "", r"tests\.0\.data: is used by frequency response functions only"),
        (
            'varies = "test"',
            "updated = false",
            r"parameters\.3\.updated: must not be given for a parameter of the d",
        ),
    ],
)
def test_a_mistake_has_its_place_in_the_file(old, new, message, text, folder):
    assert old in text
    assert re.search(message, mistakes_of(text.replace(old, new, 1), folder))


@pytest.mark.usefixtures("no_pictures")
def test_a_run_of_a_file_writes_a_page(text, folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("may.csv", "june.csv"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / "storeys.toml").write_text(text)
    options = ["--draws", "10", "--warmup", "10", "--chains", "2", "--starts", "2", "--report"]
    result = CliRunner().invoke(cli.main, ["run", "storeys.toml", *options, "--out", "run"], prog_name="fmu")
    assert result.exit_code == 0, result.output
    page = (tmp_path / "run" / "report" / "index.html").read_text(encoding="utf-8")
    assert "june: 0 x / 2 x" in page
    assert "may: Frequency response functions: 2 accelerances" in page
