"""Damping matrices from files pass through the same order, constraints and axes as the stiffness."""

import re

import numpy as np
import pytest
import scipy.io

from fmu.config import ConfigurationError, load

K = 1e6 * np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
M = np.diag([1.0, 2.0, 3.0])
C = np.array([[5.0, -2.0, 0.0], [-2.0, 2.0, 0.0], [0.0, 0.0, 200.0]])
LINES = np.linspace(20.0, 400.0, 60)
HEAD = """\
name = "d"
reduction = false
[[error]]
of = "frf"
data = "frfs.csv"
kind = "receptance"
[[damping]]
kind = "matrix"
matrix = "C.mat"
[[parameters]]
name = "k"
start = 1.0
lower = 0.5
upper = 2.0
[model]
"""
MATRICES = (
    'type = "matrices"\nstiffness = [{ file = "K.mat", powers = { k = 1.0 } }]\nmass = [{ file = "M.mat" }]\n'
)
EXPORTS = 'type = "exports"\n' + "".join(
    f'[[model.exports]]\nstiffness = "K{k}.mat"\nmass = "M.mat"\nvalues = {{ k = {k} }}\n' for k in (1.0, 2.0)
)


def names(nodes):
    return {"dofs": np.array([[node, 1] for node in nodes])}


def problem(folder, nodes, model=MATRICES, damping=None, **changed):
    """Write the matrices of nodes 1 to 3 with the rows of `nodes`, and FRFs at the truth, and load the problem."""
    order = np.ix_(*[[node - 1 for node in nodes]] * 2)
    rows = names(nodes) | changed
    for name, matrix in (("K", K), ("K1.0", K), ("K2.0", 2.0 * K), ("M", M)):
        scipy.io.savemat(folder / f"{name}.mat", {name[0]: matrix[order]} | rows)
    scipy.io.savemat(folder / "C.mat", {"C": C[order]} | names(nodes) if damping is None else damping)
    omega = 2.0 * np.pi * LINES
    H = np.array([np.linalg.inv(K + 1j * w * C - w**2 * M)[2, 0] for w in omega])
    sd = np.full(len(H), 0.01 * np.abs(H).max())
    table = np.column_stack([LINES, H.real, H.imag, sd])
    first = 1 if "dofs" not in changed or "dofs" in model else 0  # rows without names are counted from 0
    columns = ",".join(f"{first + 2} x / {first} x {part}" for part in ("re", "im", "sd"))
    np.savetxt(
        folder / "frfs.csv", table, fmt="%.17g", delimiter=",", header=f"frequency_hz,{columns}", comments=""
    )
    (folder / "problem.toml").write_text(HEAD + model)
    return load(folder / "problem.toml")


@pytest.mark.parametrize("model", [MATRICES, EXPORTS])
@pytest.mark.parametrize("nodes", [(1, 2, 3), (3, 1, 2)])
def test_named_rows_are_put_in_the_order_of_the_model(tmp_path, nodes, model):
    (term,) = problem(tmp_path, nodes, model).likelihood.responses
    measured = np.asarray(term.data.values)
    np.testing.assert_allclose(term.frfs(np.array([[1.0]]))[0], measured, atol=1e-9 * np.abs(measured).max())


@pytest.mark.parametrize(
    ("damping", "changed", "message"),
    [
        (
            {"C": C} | names((1, 2, 4)),
            {},
            r"damping\.0\.matrix: must be of rows with stiffness or mass \(got 4 x\)",
        ),
        ({"C": C}, {}, r"damping\.0\.matrix: has 3 rows without names"),
        ({"C": C} | names((1, 2, 3)), {"dofs": "none"}, r"damping\.0\.matrix: must not name its rows"),
        (
            {"C": C[:2, :2]},
            {"dofs": "none"},
            r"damping\.0\.matrix: must have 3 rows, as the other matrices \(got 2\)",
        ),
    ],
)
def test_rows_that_differ_are_refused(tmp_path, damping, changed, message):
    model = (
        MATRICES if not changed else MATRICES + 'dofs = [[1, "x"], [2, "x"], [3, "x"]]\n' * ("2 deg" in message)
    )
    with pytest.raises(ConfigurationError) as caught:
        problem(tmp_path, (1, 2, 3), model, damping, **changed)
    assert re.search(message, " ".join(str(caught.value).split()))


def test_rows_of_the_file_itself_name_those_of_the_damping(tmp_path):
    """Rows in another order than that of the names in the problem file."""
    model = MATRICES + 'dofs = [[1, "x"], [2, "x"], [3, "x"]]\n'
    order = np.ix_([2, 0, 1], [2, 0, 1])
    for damping in ({"C": C}, {"C": C[order]} | names((3, 1, 2))):
        (term,) = problem(tmp_path, (1, 2, 3), model, damping, dofs="none").likelihood.responses
        measured = np.asarray(term.data.values)
        np.testing.assert_allclose(term.frfs(np.array([[1.0]]))[0], measured, atol=1e-9 * np.abs(measured).max())
