"""The updated model of a function of the user's own, and what may go wrong between a run and its export."""

import os
import shutil
import tomllib

import pytest

import fmu
from fmu.analysis.trace.conversion import save_trace
from fmu.report.export import _from_prior, _incomplete, export
from fmu.report.updated_file import copy_companions, updated_text
from tests.report.exported import run

MODULE = """
import numpy as np


def frequencies(theta):
    a, b = theta
    return np.array([10.0 + a, 20.0 + 2.0 * a + b, 30.0 + 0.5 * a + 3.0 * b])
"""
PYTHON = """\
#:schema ./fmu.schema.json
name = "a function"

[model]
type = "python"
function = "mine:frequencies"

[measurement]
frequencies = [11.1, 22.9, 33.4]
sd = 0.1

[[parameters]]
name = "a"
start = 0.5   # as it was
lower = 0.0
upper = 2.0

[[parameters]]
name = "b"
start = 0.5
lower = 0.0
upper = 2.0
"""


@pytest.fixture(scope="module")
def sampled(tmp_path_factory):
    """A short run on a function of the user's own."""
    folder = tmp_path_factory.mktemp("function")
    (folder / "mine.py").write_text(MODULE)
    (folder / "a.toml").write_text(PYTHON)
    run(folder / "a.toml", folder / "out")
    return folder


@pytest.fixture
def function(sampled, tmp_path):
    """A copy of that run, to be changed; it finds its problem file by a relative path."""
    return shutil.copytree(sampled, tmp_path / "copy")


def test_a_function_has_values_and_a_file(function):
    written = export(function / "out")
    assert written.files == ("mine.py", "theta.csv", "updated.toml")
    text = (written.directory / "updated.toml").read_text(encoding="utf-8")
    assert text.splitlines()[0] == "#:schema ./fmu.schema.json"
    assert "# as it was" in text
    mean = float(fmu.load_trace(function / "out" / "hmc.nc")["posterior"]["a"].mean())
    assert mean == pytest.approx(0.9975, abs=0.1)  # by least squares
    assert fmu.load(written.directory / "updated.toml").start[0] == pytest.approx(mean, rel=1e-12)


def test_what_is_missing_beside_the_updated_file_is_said(function):
    (function / "mine.py").write_text("from theirs import frequencies\n")
    (function / "theirs.py").write_text(MODULE)
    remarks = export(function / "out").remarks
    assert any(
        "updated.toml needs files that are in the directory" in remark and "theirs" in remark for remark in remarks
    )


def test_another_problem_is_refused(function):
    (function / "mine.py").write_text(MODULE.replace("10.0", "10.1"))
    with pytest.raises(ValueError, match="must be the problem that was sampled"):
        export(function / "out")
    assert not (function / "out" / "export").exists()
    (function / "mine.py").write_text(MODULE)
    other = function / "b.toml"
    other.write_text(PYTHON.replace("sd = 0.1", "sd = 0.2").replace("upper = 2.0", "upper = 3.0"))
    with pytest.raises(ValueError, match=r"sampled \(it differs in: .*likelihood.*parameters"):
        export(function / "out", model=other)


def test_a_problem_that_moved(function, tmp_path_factory):
    """The run directory alone no longer finds the module; the file's new place does."""
    there = tmp_path_factory.mktemp("there")
    shutil.copytree(function / "out", there / "out")
    with pytest.raises(ValueError, match=r"1 error") as caught:
        export(there / "out")
    assert "model.function" in str(caught.value)
    (there / "model").mkdir()
    for name in ("a.toml", "mine.py"):
        shutil.copy(function / name, there / "model" / name)
    assert export(there / "out", model=there / "model" / "a.toml").files[-1] == "updated.toml"
    (there / "out" / "run.json").unlink()
    with pytest.raises(ValueError, match=r"give the problem file \(--model\)"):
        export(there / "out")
    assert export(there / "out", model=there / "model" / "a.toml").files[-1] == "updated.toml"


def test_a_run_that_says_no_origin_as_it_was_written(function):
    (function / "out" / "run.json").write_text("{}")
    with pytest.raises(ValueError, match=r"run.json is not as fmu run wrote it"):
        export(function / "out")


def test_a_mean_between_two_modes_is_no_place_to_be(function):
    path = function / "out" / "hmc.nc"
    trace = fmu.load_trace(path)
    for name in ("a", "b"):
        trace["posterior"][name][1] += 0.5
    path.unlink()
    save_trace(trace, path)
    remarks = export(function / "out").remarks
    assert any("less probable than 99 % of the draws" in remark for remark in remarks)


def test_no_maxima_no_map(function):
    path = function / "out" / "hmc.nc"
    trace = fmu.load_trace(path)
    del trace["maxima"]
    path.unlink()
    save_trace(trace, path)
    with pytest.raises(ValueError, match=r"at: the run has no maxima"):
        export(function / "out", at="map")


def test_other_files_are_left_alone(function):
    (function / "precious").mkdir()
    (function / "precious" / "theta.csv").write_text("precious")
    with pytest.raises(ValueError, match="does not replace"):
        export(function / "out", out=function / "precious")
    assert (function / "precious" / "theta.csv").read_text() == "precious"


def test_a_value_that_the_data_did_not_inform_says_so_beside_it():
    """After the comment that was there, if there was one."""
    text, _ = updated_text(PYTHON, {"a": 0.7, "b": 0.8}, None, "about", ["a"])
    assert "start = 0.7   # as it was; from the prior: the data did not inform it\n" in text
    assert "start = 0.8\n" in text
    text, _ = updated_text(PYTHON, {"a": 0.7, "b": 0.8}, None, "about", ["b"])
    assert "start = 0.7   # as it was\n" in text
    assert "start = 0.8  # from the prior: the data did not inform it\n" in text


def test_an_inline_table_has_no_comment_inside():
    """A comment in it would end only with the line, after its closing brace; the file's head says it instead."""
    head, *_ = PYTHON.partition("[[parameters]]")
    tables = "".join(f'  {{ name = "{name}", start = 0.5, lower = 0.0, upper = 2.0 }},\n' for name in "ab")
    original = head.replace("[model]", f"parameters = [\n{tables}]\n\n[model]")
    text, _ = updated_text(original, {"a": 0.7, "b": 0.8}, None, "about", ["b"])
    found = tomllib.loads(text)
    assert [one["start"] for one in found["parameters"]] == [0.7, 0.8]
    assert [one["upper"] for one in found["parameters"]] == [2.0, 2.0]
    assert text.splitlines()[1:3] == ["# about", "# b: from the prior: the data did not inform it"]


def test_a_problem_file_with_a_byte_order_mark_is_exported(function):
    kept = function / "out" / "problem.toml"
    kept.write_bytes(b"\xef\xbb\xbf" + kept.read_bytes())
    written = export(function / "out")
    assert fmu.load(written.directory / "updated.toml").names == ("a", "b")


def test_a_file_that_is_no_toml_is_not_said_to_need_files(tmp_path):
    (tmp_path / "updated.toml").write_text("a = {", encoding="utf-8")
    (said,) = _incomplete(tmp_path / "updated.toml")
    assert said.startswith("updated.toml cannot be read (is not valid TOML")
    assert "needs files" not in said


def test_what_the_data_did_not_inform_is_a_remark():
    assert _from_prior(["b"]) == ["The data did not inform b: its value comes from its prior alone."]
    assert _from_prior(["a", "b"]) == [
        "The data did not inform a and b: their values come from their priors alone."
    ]
    assert _from_prior([]) == []


def test_a_program_beside_the_file_can_still_be_run(tmp_path):
    (tmp_path / "solve.sh").write_text("#!/bin/sh\n")
    (tmp_path / "mesh.inp").write_text("")
    (tmp_path / "solve.sh").chmod(0o755)
    (tmp_path / "copy").mkdir()
    assert copy_companions(["./solve.sh", "mesh.inp"], tmp_path, tmp_path / "copy") == {}
    assert os.access(tmp_path / "copy" / "solve.sh", os.X_OK)
    assert not (tmp_path / "copy" / "mesh.inp").stat().st_mode & 0o111


def test_files_in_folders_that_a_deck_includes_are_copied(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "x.bdf").write_text("$ a part\n")
    (tmp_path / "plate.bdf").write_text("INCLUDE 'parts/x.bdf'\n")
    assert copy_companions(["plate.bdf"], tmp_path, tmp_path / "copy") == {}
    assert (tmp_path / "copy" / "parts" / "x.bdf").read_text() == "$ a part\n"


@pytest.mark.parametrize("file", ["pkg/storeys.py", "pkg/storeys/__init__.py"])
def test_a_module_in_a_package_is_copied(tmp_path, file):
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).write_text("# a model\n")
    assert copy_companions(["pkg.storeys:solve"], tmp_path, tmp_path / "copy") == {}
    assert (tmp_path / "copy" / file).read_text() == "# a model\n"
