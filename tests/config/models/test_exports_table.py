"""``[model] type = "exports"``: from files of another program to a problem, and every mistake with its place."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.config import ConfigurationError

K1 = np.array([[2.0, -1.0], [-1.0, 1.0]])
K2 = np.array([[1.0, 0.0], [0.0, 0.0]])
M = np.diag([3.0, 2.0])
E, T = 7e10, 0.003
POINTS = {
    "first": (E, T),
    "stiffer": (8e10, T),
    "thicker": (E, 0.004),
    "thinner": (E, 0.0025),
    "both": (6e10, 0.0035),
}
PROBLEM = """
name = "plate"
pairing = "index"
[model]
type = "exports"
[[model.exports]]
stiffness = "first_STIF1.mtx"
values = { E = 7e10, t = 0.003 }
[[model.exports]]
stiffness = "stiffer_STIF1.mtx"
values = { E = 8e10 }
[[model.exports]]
stiffness = "thicker_STIF1.mtx"
values = { t = 0.004 }
[[model.exports]]
stiffness = "thinner_STIF1.mtx"
values = { t = 0.0025 }
[[model.exports]]
stiffness = "both_STIF1.mtx"
mass = "both_MASS1.mtx"
values = { E = 6e10, t = 0.0035 }
check = true
[measurement]
frequencies = [20.0, 60.0]
sd = [0.1, 0.3]
[[parameters]]
name = "t"
unit = "m"
start = 0.003
lower = 0.002
upper = 0.005
[[parameters]]
name = "E"
unit = "N/m²"
start = 7e10
lower = 5e10
upper = 9e10
"""


def stiffness(E, t):
    return E * (1e-5 * t * K2 + t**3 * K1)


def mass(t):
    return t / T * M


def written(folder, matrix, name, nodes=(11, 12)):
    """Write a matrix as Abaqus does: node, degree of freedom, node, degree of freedom, entry."""
    lines = [f"{nodes[i]},3, {nodes[j]},3, {matrix[i, j]!r}" for i in range(2) for j in range(i + 1)]
    (folder / name).write_text("\n".join(lines).replace("np.float64(", "").replace(")", "") + "\n")


@pytest.fixture
def folder(tmp_path):
    for name, (e, t) in POINTS.items():
        written(tmp_path, stiffness(e, t), f"{name}_STIF1.mtx")
        written(tmp_path, mass(t), f"{name}_MASS1.mtx")
    (tmp_path / "plate.toml").write_text(PROBLEM)
    return tmp_path


def mistakes(folder):
    with pytest.raises(ConfigurationError) as error:
        fmu.load(folder / "plate.toml")
    return [str(mistake) for mistake in error.value.mistakes]


def test_parameters_may_be_in_another_order(folder):
    """Theta is in the order of the parameters, whatever that of the values."""
    problem = fmu.load(folder / "plate.toml")
    structure = problem.model.structure
    assert_allclose(structure.K([0.0045, 5.5e10]).toarray(), stiffness(5.5e10, 0.0045), rtol=1e-12)
    assert_allclose(structure.M([0.0045, 5.5e10]).toarray(), mass(0.0045), rtol=1e-12)
    values = np.linalg.eigvals(np.linalg.solve(mass(0.0045), stiffness(5.5e10, 0.0045)))
    assert_allclose(problem.frequencies([0.0045, 5.5e10]), np.sqrt(np.sort(values)) / (2 * np.pi), rtol=1e-6)


def test_check_says_what_was_recovered(folder):
    said = " ".join(fmu.check(fmu.load(folder / "plate.toml"), draws=10).model)
    assert "The stiffness is a sum of 2 terms: t E and t³ E." in said
    assert "kept for checking is reproduced to" in said


MISTAKES = [
    ("values = { E = 8e10 }", "values = { nu = 0.3 }", "model.exports.1.values: must be of t, E (got 'nu')"),
    ("{ E = 7e10, t = 0.003 }", "{ E = 7e10 }", "parameters.0.name: must have a value in the first"),
    ('"thicker_STIF1.mtx"', '"nowhere_STIF1.mtx"', "model.exports.2.stiffness: must be a file"),
    ('mass = "both_MASS1.mtx"', 'mass = "both.mtx"', "model.exports.4.mass: must be a file"),
    ("values = { E = 8e10 }", "values = { E = 8e10, t = 0.004 }", "model.exports: must have one, not kept for"),
    (
        "values = { E = 7e10, t = 0.003 }",
        "values = { E = 7e10, t = 0.0 }",
        "model.exports.0.values.t: must be finite",
    ),
    ("check = true", "check = 1", "model.exports.4.check: must be a valid boolean (got 1)"),
    ("both_STIF1", "thicker_STIF1", "model.exports: what t and E changes of the stiffness must be"),
    ('type = "exports"', 'type = "exports"\nmesh = "plate.inp"', "model.mesh: must be a file"),
]


@pytest.mark.parametrize(("right", "wrong", "told"), MISTAKES)
def test_mistakes_have_their_place(folder, right, wrong, told):
    (folder / "plate.toml").write_text(PROBLEM.replace(right, wrong))
    found = mistakes(folder)
    assert any(told in one for one in found), found


def test_an_export_of_another_mesh(folder):
    written(folder, stiffness(E, 0.004), "thicker_STIF1.mtx", nodes=(11, 13))
    written(folder, mass(0.004), "thicker_MASS1.mtx", nodes=(11, 13))
    assert "model.exports.2: must have the degrees of freedom of the first export" in mistakes(folder)[0]


def test_a_structure_that_nothing_holds(folder):
    for name, (e, t) in POINTS.items():
        written(folder, e * t**3 * np.array([[1.0, -1.0], [-1.0, 1.0]]), f"{name}_STIF1.mtx")
    assert "can move without strain" in mistakes(folder)[0]
    free = PROBLEM.replace('type = "exports"', 'type = "exports"\nfree = true')
    (folder / "plate.toml").write_text(
        free.replace("[20.0, 60.0]", "[60.0]\nnumbers = [2]").replace("[0.1, 0.3]", "[0.3]")
    )
    assert fmu.load(folder / "plate.toml").ndim == 2
