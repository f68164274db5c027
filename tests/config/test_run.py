"""fmu run with a file."""

import numpy as np
import pytest
from click.testing import CliRunner

import fmu
from fmu import cli

SHORT = ("--draws", 6, "--warmup", 3, "--chains", 2, "--sampler", "mh", "--starts", 1, "--no-report")


@pytest.fixture
def invoke(monkeypatch, folder):
    monkeypatch.chdir(folder)
    return lambda *args: CliRunner().invoke(cli.main, list(map(str, args)), prog_name="fmu")


def test_a_file_is_run_like_a_case(invoke, matrices_text, folder):
    (folder / "two.toml").write_text(matrices_text)
    result = invoke("run", "two.toml", *SHORT)
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines()[-1] == "Written to runs/two-shape"
    trace = fmu.load_trace("runs/two-shape/mh.nc")
    problem = fmu.load("two.toml")
    draws = trace["posterior"].to_dataset().to_array().to_numpy().reshape(2, -1).T
    np.testing.assert_allclose(problem.log_prob(draws), trace["sample_stats"]["lp"].to_numpy().ravel(), rtol=1e-12)


def test_the_pairing_of_the_file_unless_told_otherwise(invoke, matrices_text, folder):
    (folder / "two.toml").write_text(f'pairing = "index"\n{matrices_text}')
    assert invoke("run", "two.toml", *SHORT).stdout.splitlines()[-1] == "Written to runs/two-index"
    other = invoke("run", "two.toml", *SHORT, "--pairing", "shape")
    assert other.stdout.splitlines()[-1] == "Written to runs/two-shape"


def test_a_line_a_mistake(invoke, frame_text, folder):
    (folder / "portal.toml").write_text(
        frame_text.replace("nu = 0.3", "nu = 3.0").replace("sd = 500.0", "sd = 0.0")
    )
    result = invoke("run", "portal.toml", *SHORT)
    assert result.exit_code == 2
    assert result.stderr.splitlines() == [
        "Error: portal.toml: 2 errors",
        "  model.materials.steel.nu: must be less than or equal to 0.5 (got 3.0)",
        "  parameters.1.prior.sd: must be greater than 0 (got 0.0)",
    ]
    assert not (folder / "runs").exists()


def test_neither_a_case_nor_a_file(invoke):
    for name, words in (("bridge", "neither a built-in problem (cantilever"), ("bridge.toml", "no such file")):
        result = invoke("run", name, *SHORT)
        assert result.exit_code == 2
        assert len(result.stderr.splitlines()) == 1
        assert words in result.stderr
