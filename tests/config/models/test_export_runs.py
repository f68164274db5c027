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


# Springs at node 1, and a mass of 10 at node 2, which an RBE2 of length h moves; no row is reduced.
LEVER = """
import re, sys
text = open(sys.argv[1]).read()
k, h = (float(re.search(name + "=(.+)", text)[1]) for name in "KH")
def dmig(name, entries):
    head = f"DMIG    {name:8s}       0       6       1       0\\n"
    rows = ["DMIG*   %-16s%16d%16d\\n*       %16d%16d%16.9E\\n" % (name, g, c, g, c, x) for g, c, x in entries]
    return head + "".join(rows)
with open("job.pch", "w") as file:
    file.write(dmig("KAAX", [(1, c, k) for c in range(1, 7)]))
    file.write(dmig("MAAX", [(1, c, 5.0) for c in range(1, 7)] + [(2, c, 10.0 MASS) for c in (1, 2, 3)]))
"""
BULK = """BEGIN BULK
PARAM,P,K={k:.9e}
PARAM,P,H={h:.9e}
GRID,1,,0.,0.,0.
GRID,2,,0.,0.,AT
CBAR,1,1,1,2,1.,0.,0.
RBE2,9,1,123456,2
ENDDATA
"""


def lever(folder, at, mass):
    (folder / "assemble.py").write_text(LEVER.replace("MASS", mass))
    (folder / "job.bdf.in").write_text(BULK.replace("AT", at))
    text = (
        PROBLEM[: PROBLEM.index("[[parameters]]")]
        .replace("job.txt.in", "job.bdf.in")
        .replace("_STIF1.mtx", ".pch")
    )
    for name, start in (("k", 1e4), ("h", 2.0)):
        text += f'[[parameters]]\nname = "{name}"\nstart = {start}\nlower = {start / 2}\nupper = {2 * start}\n'
    (folder / "lever.toml").write_text(text.replace("PYTHON", repr(sys.executable)))
    return folder / "lever.toml"


def test_each_run_has_the_constraints_of_its_own_deck(tmp_path):
    """A lever arm h was 1/1000 of its start value in all runs, and the inertia 10 h² of the mass forgotten."""
    with pytest.raises(ConfigurationError, match=r"have the geometry of the first export.*at every theta"):
        fmu.load(lever(tmp_path, "{h:.9e}", ""))


def test_a_mass_on_a_lever_and_the_nodes_of_plots(tmp_path):
    """A lever of constant length with a mass that grows by h; a node without constraints is plotted at 0.75 h."""
    path = lever(tmp_path, "3.", "* h")
    text = (tmp_path / "job.bdf.in").read_text()
    (tmp_path / "job.bdf.in").write_text(text.replace("RBE2", "GRID,3,,{h:.9e},0.,0.\nRBE2"))
    model = model_of(path)
    M = model.M([1e4, 1.5])
    turning = list(model.dofs).index((1, "rx"))
    assert_allclose(M[turning, turning], 5.0 + 10.0 * 1.5 * 3.0**2, rtol=1e-9)
    assert_allclose(model.geometry.nodes[2], [1.5, 0.0, 0.0], rtol=1e-9)


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
