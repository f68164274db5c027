"""From nothing to a problem that was looked at: fmu init, fmu schema, fmu check."""

import json

import pytest
from click.testing import CliRunner

from fmu.cli import main
from fmu.config.problem import schema
from fmu.config.template import KINDS, files, template
from tests.report.parsed import Parsed


@pytest.fixture
def invoke(monkeypatch, tmp_path):
    """Run a command in an empty directory."""
    monkeypatch.chdir(tmp_path)
    return lambda *args: CliRunner().invoke(main, list(map(str, args)), prog_name="fmu")


@pytest.mark.parametrize("kind", KINDS)
def test_init_prints_the_file_and_says_what_it_needs(invoke, tmp_path, kind):
    result = invoke("init", kind)
    assert result.exit_code == 0
    assert result.stdout == template(kind)
    assert all(name in result.stderr for name in files(kind)[1:])
    assert bool(result.stderr) == (len(files(kind)) > 1)
    assert list(tmp_path.iterdir()) == []


def test_init_writes_all_that_belongs_together(invoke, tmp_path):
    result = invoke("init", "matrices", "new/here")
    assert result.stdout == "Written to new/here/matrices.toml\n"
    assert {path.name for path in (tmp_path / "new" / "here").iterdir()} == set(files("matrices"))
    again = invoke("init", "matrices", "new/here")
    assert again.exit_code == 2
    assert again.stderr.startswith("Error: directory: new/here already contains matrices.toml, K0.mtx")


def test_the_path_of_a_user_with_a_structure(invoke, tmp_path):
    """Print a template, look at it; break it, and hear of every mistake."""
    text = invoke("init", "frame").stdout
    (tmp_path / "beam.toml").write_text(text, encoding="utf-8")
    result = invoke("check", "beam.toml", "--draws", 20)
    assert result.exit_code == 0, result.output
    assert "moves no sensor" in result.stdout
    assert "The gradient agrees with central differences" in result.stdout
    assert result.stdout.splitlines()[-4:] == [
        "No warnings.",
        "",
        "Written to check/beam/index.html",
        "Next: fmu run beam.toml samples the posterior.",
    ]
    page = (tmp_path / "check" / "beam" / "index.html").read_text(encoding="utf-8")
    assert "k feet" in page
    assert Parsed(page).foreign_scripts == []
    (tmp_path / "beam.toml").write_text(
        text.replace('"stiffness"', '"stiff"').replace('"E"', '"e"'), encoding="utf-8"
    )
    broken = invoke("check", "beam.toml")
    assert broken.exit_code == 2
    assert broken.stdout == ""
    assert "beam.toml: 2 errors" in broken.stderr
    assert "parameters.0.property" in broken.stderr
    assert "parameters.1.property" in broken.stderr


def test_check_of_a_built_in_case_by_number(invoke, tmp_path):
    result = invoke("check", "cantilever-section", "--pairing", "index", "--draws", 20, "--out", "here")
    assert result.exit_code == 0, result.output
    assert "Modes are paired by number in the sorted spectrum: 1, 3, 5, 7, 9." in result.stdout
    assert (tmp_path / "here" / "index.html").exists()


def test_check_leaves_other_files_alone(invoke, tmp_path):
    (tmp_path / "index.html").write_text("precious")
    result = invoke("check", "cantilever-section", "--draws", 2, "--out", ".")
    assert result.exit_code == 2
    assert "did not write" in result.stderr
    assert (tmp_path / "index.html").read_text() == "precious"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("check", "bridge"), "neither a built-in problem"),
        (("check", "bridge.toml"), "no such file: bridge.toml"),
        (("check", "cantilever-young", "--draws", 1), "1 is not in the range"),
        (("init", "shell"), "'frame'"),
        (("init",), "{frame|matrices"),
    ],
)
def test_bad_input_is_one_line(invoke, tmp_path, arguments, words):
    result = invoke(*arguments)
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert words in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_schema_is_printed_or_written(invoke, tmp_path):
    assert json.loads(invoke("schema").stdout) == schema()
    assert invoke("schema", "--out", "fmu.schema.json").stdout == "Written to fmu.schema.json\n"
    assert json.loads((tmp_path / "fmu.schema.json").read_text(encoding="utf-8")) == schema()
