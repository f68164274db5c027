"""The whole path in the shell: start a file, sample it, export the updated model, look at it again."""

import pytest
from click.testing import CliRunner

import fmu
from fmu.cli import main

SHORT = ("--draws", 150, "--warmup", 150, "--chains", 2, "--no-report")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of the template of matrices."""
    folder = tmp_path_factory.mktemp("user")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        runner = CliRunner()
        assert runner.invoke(main, ["init", "matrices", "model"]).exit_code == 0
        result = runner.invoke(main, ["run", "model/matrices.toml", *map(str, SHORT), "--out", "out"])
        assert result.exit_code == 0, result.output
    return folder


@pytest.fixture
def invoke(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return lambda *args: CliRunner().invoke(main, list(map(str, args)), prog_name="fmu")


def test_a_run_keeps_what_its_export_needs(invoke, folder):
    kept = (folder / "out" / "problem.toml").read_bytes()
    assert kept == (folder / "model" / "matrices.toml").read_bytes()
    result = invoke("export", "out")
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("Written to out/export: K.mtx, ")
    assert result.stdout.splitlines()[-1].startswith("Next: fmu check out/export/updated.toml ")
    assert fmu.load(folder / "out" / "export" / "updated.toml").start[0] == pytest.approx(0.89, abs=0.03)


def test_the_updated_file_can_be_checked(invoke):
    invoke("export", "out", "--at", "map", "--out", "there")
    result = invoke("check", "there/updated.toml", "--draws", 10)
    assert result.exit_code == 0, result.output
    assert "No warnings." in result.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("export", "absent"), "does not exist"),
        (("export", "model"), "contains no traces"),
        (("export", "out", "--sampler", "mh"), "must be one of mixture (got 'mh')"),
        (("export", "out", "--at", "median"), "'median'"),
    ],
)
def test_bad_input_is_one_line(invoke, arguments, words):
    result = invoke(*arguments)
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert words in result.stderr


def test_a_built_in_case_is_exported_from_the_file_it_keeps(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    length = ("--draws", "6", "--warmup", "3", "--chains", "2", "--starts", "2")
    run = ("run", "shear-2dof", *length, "--no-report", "--out", "out")
    assert CliRunner().invoke(main, run).exit_code == 0
    result = CliRunner().invoke(main, ["export", "out"])
    assert result.exit_code == 0, result.output
    assert "Warning: The run is not converged" in result.stderr
    assert (tmp_path / "out" / "export" / "K.mtx").exists()
