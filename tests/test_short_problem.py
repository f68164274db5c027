"""Two parameters, exported matrices, measured shapes: how little it takes from the files to a posterior."""

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.io import mmwrite

import fmu

SCRIPT = """\
import fmu
from scipy.io import mmread

K0, K1, K2, M = (mmread(f"{name}.mtx", spmatrix=False) for name in ("K0", "K1", "K2", "M"))
model = fmu.SeparableModel.from_terms(
    ["lower columns", "upper columns"],
    stiffness=[K0, (K1, "lower columns"), (K2, "upper columns")],
    mass=[M],
)
data = fmu.ModalData(
    frequencies_hz=[1.615, 4.549, 7.188],
    sensors=[(0, "x"), (2, "x"), (4, "x")],
    shapes=[[0.29, -0.83, 0.98], [0.79, -0.42, -1.00], [1.01, 0.99, 0.93]],
)
parameters = [fmu.Parameter(name, start=1.0, lower=0.5, upper=1.5) for name in model.names]
problem = fmu.UpdatingProblem(model, data, parameters, beta=1 / (2 * 0.02**2))
trace = fmu.sample(problem, "hmc", draws=200, warmup=200, chains=4, seed=1)
print(fmu.summary(trace))
"""

TOML = """\
name = "five storeys"

[model]
type = "matrices"

[[model.stiffness]]
file = "K0.mtx"

[[model.stiffness]]
file = "K1.mtx"
powers = { "lower columns" = 1 }

[[model.stiffness]]
file = "K2.mtx"
powers = { "upper columns" = 1 }

[[model.mass]]
file = "M.mtx"

[measurement]
frequencies = [1.615, 4.549, 7.188]
sd = 0.02
sensors = [[0, "x"], [2, "x"], [4, "x"]]
shapes = [[0.29, 0.79, 1.01], [-0.83, -0.42, 0.99], [0.98, -1.00, 0.93]]

[[parameters]]
name = "lower columns"
start = 1.0
lower = 0.5
upper = 1.5

[[parameters]]
name = "upper columns"
start = 1.0
lower = 0.5
upper = 1.5
"""


def springs(*stiffness):
    """The stiffness of five floors above each other."""
    K = np.diag(np.array(stiffness) + np.array([*stiffness[1:], 0.0]))
    return K - np.diag(stiffness[1:], 1) - np.diag(stiffness[1:], -1)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Matrices of five storeys, as a program would have exported them."""
    matrices = {
        "K0": springs(4e6, 4e6, 4e6, 4e6, 4e6),
        "K1": springs(24e6, 24e6, 0.0, 0.0, 0.0),
        "K2": springs(0.0, 0.0, 18e6, 18e6, 18e6),
        "M": np.diag([21e3, 21e3, 21e3, 21e3, 16e3]),
    }
    for name, matrix in matrices.items():
        mmwrite(tmp_path / f"{name}.mtx", sp.coo_array(matrix), symmetry="symmetric")
    (tmp_path / "storeys.toml").write_text(TOML)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def lines(text):
    return [line for line in text.splitlines() if line.strip()]


def test_under_twenty_lines_of_python(folder, capsys):
    assert len(SCRIPT.splitlines()) < 20
    names = {}
    exec(compile(SCRIPT, "storeys.py", "exec"), names)
    assert "lower columns" in capsys.readouterr().out
    table = fmu.summary(names["trace"])
    assert list(table.index) == ["lower columns", "upper columns"]
    assert table["rhat"].max() < 1.05
    # what fits the data best, found by other means, is where the posterior is
    best = fmu.find_map(names["problem"], starts=8)[0].theta
    assert np.all(np.abs(table["mean"] - best) < 0.5 * table["sd"])


def test_forty_lines_of_toml_are_the_same_problem(folder):
    assert len(lines(TOML)) <= 40
    names = {}
    exec(compile(SCRIPT.split("trace =")[0], "storeys.py", "exec"), names)
    from_file = fmu.load(folder / "storeys.toml")
    theta = from_file.sample_prior(np.random.default_rng(1), 20)
    np.testing.assert_allclose(from_file.log_prob(theta), names["problem"].log_prob(theta), rtol=1e-12)
    short = {"draws": 20, "warmup": 20, "chains": 2, "seed": 1, "init": "start"}
    of_file, of_script = (fmu.sample(problem, "mh", **short) for problem in (from_file, names["problem"]))
    for name in from_file.names:
        drawn = (trace["posterior"][name].to_numpy() for trace in (of_file, of_script))
        np.testing.assert_allclose(*drawn, rtol=1e-6)
