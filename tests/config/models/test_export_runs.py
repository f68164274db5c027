"""``[model.runs]``: fmu runs a program for exports, once, and finds K(θ) = K_0 + Σ θ_j K_j from unit runs."""

import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.config import ConfigurationError, read

# Two springs in a row and two masses, the stiffness of the second spring constant; as Abaqus writes matrices.
PROGRAM = """
import sys
values = dict(line.split() for line in open(sys.argv[1]))
a, b, rho = (float(values[name]) for name in ("k1", "k2", "rho"))
with open("runs.txt", "a") as log:
    log.write(f"{a} {b} {rho}\\n")
print("assembled")
if a > 9e3:
    sys.exit("too stiff")
def write(name, entries):
    with open(name, "w") as file:
        for i, j, x in entries:
            file.write(f"{i},3, {j},3, {x!r}\\n")
write("job_STIF1.mtx", [(1, 1, a + b), (2, 1, -b), (2, 2, b + 50.0)])
write("job_MASS1.mtx", [(1, 1, 2.0 * rho), (2, 2, 1.0)])
"""
DECK = "k1 {k1}\nk2 {k2}\nrho {rho}\n"
PROBLEM = """
name = "springs"
pairing = "index"
[model]
type = "exports"
[model.runs]
template = "job.txt.in"
command = [PYTHON, "-I", "-S", "assemble.py", "{deck}"]
stiffness = "{job}_STIF1.mtx"
inputs = ["assemble.py"]
[measurement]
frequencies = [3.0, 8.0]
sd = [0.1, 0.3]
[[parameters]]
name = "k1"
start = 2e3
lower = 1e3
upper = 4e3
[[parameters]]
name = "k2"
start = 1e3
lower = 5e2
upper = 2e3
[[parameters]]
name = "rho"
start = 1.5
lower = 1.0
upper = 2.0
"""
EXPORTS = """
[[model.exports]]
values = { k1 = 2e3, k2 = 1e3, rho = 1.5 }
[[model.exports]]
values = { k1 = 3e3 }
[[model.exports]]
values = { k2 = 3e3 }
[[model.exports]]
values = { rho = 2.0 }
"""


def written(folder, problem=PROBLEM, deck=DECK, program=PROGRAM):
    (folder / "assemble.py").write_text(program)
    (folder / "job.txt.in").write_text(deck)
    path = folder / "springs.toml"
    path.write_text(problem.replace("PYTHON", repr(sys.executable)))
    return path


def model_of(path):
    file = read(path)
    return file.model.build(path.parent, file.parameters).model


def count_runs(folder):
    return len(list((folder / "exports").glob("*/runs.txt")))


def test_matrices_of_each_parameter(tmp_path):
    model = model_of(written(tmp_path))
    theta = [3.1e3, 700.0, 1.9]
    assert_allclose(model.K(theta).toarray(), [[3.8e3, -700.0], [-700.0, 750.0]], rtol=1e-12)
    assert_allclose(model.M(theta).toarray(), np.diag([3.8, 1.0]), rtol=1e-12)
    terms = {term.powers: term.matrix.toarray() for term in model.K_terms}
    assert_allclose(terms[1, 0, 0], [[1.0, 0.0], [0.0, 0.0]], rtol=1e-12)
    assert_allclose(terms[0, 1, 0], [[1.0, -1.0], [-1.0, 1.0]], rtol=1e-12)
    assert_allclose(terms[0, 0, 0], [[0.0, 0.0], [0.0, 50.0]], rtol=1e-12)
    assert count_runs(tmp_path) == 5  # all low, each alone, and one for checking


def test_runs_are_kept_until_something_changes(tmp_path):
    path = written(tmp_path)
    for _ in range(2):
        model_of(path)
    logs = list((tmp_path / "exports").glob("*/runs.txt"))
    assert [len(log.read_text().splitlines()) for log in logs] == [1] * 5
    written(tmp_path, program=PROGRAM.replace("50.0", "60.0"))
    assert model_of(path).K([3e3, 700.0, 1.0])[1, 1] == pytest.approx(760.0, rel=1e-12)
    assert count_runs(tmp_path) == 10


def test_runs_at_given_values(tmp_path):
    model = model_of(written(tmp_path, PROBLEM.replace("[measurement]", f"{EXPORTS}[measurement]")))
    assert_allclose(model.K([3.1e3, 700.0, 1.9]).toarray(), [[3.8e3, -700.0], [-700.0, 750.0]], rtol=1e-11)
    assert count_runs(tmp_path) == 4


def test_values_are_those_that_the_deck_has(tmp_path):
    """A field of eight columns has five digits of this number: K_1 is of 2001.2, the number in the deck."""
    text = PROBLEM.replace("start = 2e3", "start = 2001.23456789")
    model = model_of(written(tmp_path, text, DECK.replace("{k1}", "{k1:8}")))
    assert_allclose(model.K([3.1e3, 700.0, 1.9])[0, 0], 3.8e3, rtol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('inputs = ["assemble.py"]', "", "model.runs: at k1 = 2.0, k2 = 1.0, rho = 0.0015: "),
        ("start = 2e3", "start = 0.0", "parameters.0.start: must not be zero"),
        ("PYTHON", '"no-such-program"', "model.runs.command.0: must be a program that is installed"),
        ("job.txt.in", "none.in", "model.runs.template: must be a text file (no such file: "),
        ("_STIF1.mtx", "_STIF2.mtx", "it has written no job_STIF2.mtx; it printed at the end: assembled"),
        ("{deck}", "{dek}", "model.runs.command.4: "),
        ('name = "rho"', 'name = "m"', "model.runs.template: line 3: {rho} must name one of k1, k2, m"),
        ("[model.runs]", "[[model.exports]]\n[model.runs]", "parameters.0.name: must have a value in the first"),
        ('inputs = ["assemble.py"]', 'inputs = ["assemble.py"]\ntimeout = 0', "model.runs.timeout: "),
        ("start = 2e3", "start = 1e4", "too stiff; its files are in "),
    ],
)
def test_mistakes(old, new, said, tmp_path):
    assert old in PROBLEM
    with pytest.raises(ConfigurationError) as error:
        fmu.load(written(tmp_path, PROBLEM.replace(old, new).replace("upper = 4e3", "upper = 4e4")))
    assert said in str(error.value)


OTHERS = [("a * a + b", (2, 0, 0)), ("a * rho + b", (1, 0, 1)), ("a + 1e-3 * a**3 + b", (3, 0, 0))]


@pytest.mark.parametrize(("stiffness", "powers"), OTHERS)
def test_other_powers_are_found_where_they_are_alone(stiffness, powers, tmp_path):
    model = model_of(written(tmp_path, program=PROGRAM.replace("(1, 1, a + b)", f"(1, 1, {stiffness})")))
    assert powers in {term.powers for term in model.K_terms}
    expected = eval(stiffness, {"a": 3.1e3, "b": 700.0, "rho": 1.9})
    assert_allclose(model.K([3.1e3, 700.0, 1.9])[0, 0], expected, rtol=1e-9)


@pytest.mark.parametrize("stiffness", ["a**0.5 + b", "a + 1e-3 * a**3 + 300.0 + b"])
def test_what_unit_runs_do_not_determine_is_refused(stiffness, tmp_path):
    path = written(tmp_path, program=PROGRAM.replace("(1, 1, a + b)", f"(1, 1, {stiffness})"))
    with pytest.raises(ConfigurationError, match=r"model\.exports: what k1"):
        fmu.load(path)


def test_exports_without_files_need_a_program(tmp_path):
    start, end = PROBLEM.index("[model.runs]"), PROBLEM.index("[measurement]")
    for exports, said in (
        (EXPORTS, "model.exports.0.stiffness: must be given without"),
        ("", "must be at least 2"),
    ):
        path = written(tmp_path, PROBLEM[:start] + exports + PROBLEM[end:])
        with pytest.raises(ConfigurationError, match=said):
            fmu.load(path)


def test_a_stored_run_that_lacks_a_file_is_run_again(tmp_path):
    path = written(tmp_path)
    model_of(path)
    for matrix in tmp_path.rglob("job_STIF1.mtx"):
        matrix.unlink()
    model_of(path)
    assert len(list(tmp_path.rglob("job_STIF1.mtx"))) == 5
