"""A sample of the hostile files of the validation: refused in plain words, soon, or checked; nothing else."""

import re
import sys

import pytest

from fmu.config import ConfigurationError, load
from tests.validation import hostile_matrices, hostile_measured
from tests.validation.hostile_bases import PROBLEM, bases, put
from tests.validation.hostile_beside import crafted
from tests.validation.hostile_files import problem_file
from tests.validation.hostile_functions import FUNCTIONS
from tests.validation.hostile_run import checked, unclear, wrong

EVERY = 181
ANY_MEMORY = float("inf")
MATRICES = (
    "absurd size.mtx", "size of 5000 digits.mtx", "long banner.mtx", "many comments.mtx", "cut short.mtx.gz",
    "absurd shape.npy", "twenty thousand arrays.npz", "unknown element.mat", "packed bomb.mat", "of text.h5",
    "in another file.h5", "with a chunk of gigabytes.h5", "whose parts are links.h5", "absurd counts.hb",
    "one row.csv", "blank lines.csv", "stars.abaqus.mtx",
)  # fmt: skip


def every_other(names):
    """Leave every second name to `make validate`."""
    return [pytest.param(name, marks=pytest.mark.validate) if k % 2 else name for k, name in enumerate(names)]


@pytest.fixture(autouse=True)
def modules():
    """Take out of the interpreter what a hostile function put there."""
    before = dict(sys.modules)
    yield
    for name in sys.modules.keys() - before.keys():
        if type(sys.modules[name]) is not type(sys):
            del sys.modules[name]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return tmp_path_factory.mktemp("made")


def fault(hostile, folder):
    hostile.write(folder)
    return checked(hostile.name, folder / PROBLEM, ANY_MEMORY).fault


def test_the_bases_are_right(made, tmp_path):
    for name, base in bases(made).items():
        (tmp_path / name).mkdir()
        load(put(tmp_path / name, base, base.text.encode()))


@pytest.mark.parametrize("number", range(0, 2000, EVERY))
def test_problem_files(made, tmp_path, number):
    assert fault(problem_file(number, made), tmp_path) == ""


@pytest.mark.parametrize("name", every_other(FUNCTIONS))
def test_functions(made, tmp_path, name):
    """Whatever a user's function raises or answers, the file is refused in words, or the point has failed."""
    base = bases(made)["python"]
    path = put(tmp_path, base._replace(beside={"storeys.py": FUNCTIONS[name]}), base.text.encode())
    said = complaint(path)
    if said:
        assert re.search(r"model\.function|measurement|shapes|frequencies", said)
    else:
        problem = load(path)
        problem.log_prob(problem.start * 1.01)


@pytest.mark.parametrize("name", every_other([*hostile_measured.tables(), *hostile_measured.operational()]))
def test_measured_modes(made, tmp_path, name):
    hostile = next(one for one in crafted(made) if one.name in (f"table: {name}", f"operational: {name}"))
    hostile.write(tmp_path)
    complaint(tmp_path / PROBLEM)


def test_universal_files(made, tmp_path):
    pytest.importorskip("pyuff")
    for hostile in crafted(made):
        if hostile.name.startswith("universal file"):
            hostile.write(tmp_path)
            complaint(tmp_path / PROBLEM)


@pytest.mark.parametrize("name", MATRICES)
def test_matrices(made, tmp_path, name):
    hostile = next(one for one in crafted(made) if one.name == f"matrix: {name}")
    hostile.write(tmp_path)
    assert "model.stiffness.1.file: " in complaint(tmp_path / PROBLEM)


def complaint(path):
    """Return what is wrong with a file, in plain words; empty if it is a problem after all."""
    said = ""
    try:
        load(path)
    except ConfigurationError as error:
        said = str(error)
    assert not said or unclear(f"Error: {said}") == ""
    return said


def test_every_matrix_that_is_changed_at_random_was_right(tmp_path):
    from fmu.formats.matrices.read import read_matrix

    for kind in hostile_matrices.KINDS:
        path = tmp_path / f"K{kind[kind.index('.') :] if not kind.startswith('abaqus') else '.mtx'}"
        path.write_bytes(hostile_matrices.right(kind, tmp_path / "right.bin"))
        assert abs(read_matrix(path) - hostile_matrices.K).max() == 0.0


@pytest.mark.parametrize(
    ("code", "text", "taken_s", "peak_mib", "expected"),
    [
        (2, "Error: x.toml: 1 error:\n  name: is missing\n", 0.1, 200.0, ""),
        (0, "fine", 100.0, 200.0, ""),
        (1, "Traceback (most recent call last):\nKeyError: 3", 0.1, 200.0, "traceback: KeyError: 3"),
        (1, "Error: x", 0.1, 200.0, "exit code 1"),
        (-11, "", 0.1, 200.0, "died of signal 11"),
        (2, "Error: x", 5.1, 200.0, "late: 5.1 s"),
        (2, "Error: x", 0.1, 1025.0, "memory: 1025 MiB"),
        (2, "Error: \n", 0.1, 200.0, "message: there is none"),
        (2, "Error: " + "x" * 20_000, 0.1, 200.0, "message: 20007 characters"),
        (2, "Error: 'NoneType' object", 0.1, 200.0, "message: Error: 'NoneType' object"),
        (2, "Error: a\x1b[31m", 0.1, 200.0, "message: has the character '\\x1b'"),
    ],
)
def test_what_is_a_fault(code, text, taken_s, peak_mib, expected):
    assert wrong(code, text, taken_s, peak_mib) == expected
