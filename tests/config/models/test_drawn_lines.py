"""Points and lines of the pictures: a structure of matrices alone is drawn in the colours of its parameters."""

import numpy as np
import pytest

import fmu
from fmu.config import ConfigurationError, load
from fmu.fem.frame.drawing import sketch

MODEL = """
[model]
type = "matrices"
dofs = [["floor", "x"], ["roof", "x"]]

[[model.stiffness]]
matrix = [[2.0e6, -1.0e6], [-1.0e6, 1.0e6]]
powers = { k = 1 }

[[model.mass]]
matrix = [[1000.0, 0.0], [0.0, 1000.0]]

"""
DRAWN = """
[model.points]
foot = [0.0, 0.0, 0.0]
floor = [0.0, 0.0, 3.0]
roof = [0.0, 0.0, 6.0]

[[model.lines]]
points = ["foot", "floor"]
parameters = ["k"]

[[model.lines]]
points = ["floor", "roof"]
"""
REST = """
[measurement]
frequencies = [3.1, 8.1]
beta = 1.0
sensors = [["roof", "x"]]

[[parameters]]
name = "k"
start = 1.0
lower = 0.5
upper = 2.0
"""


def written(folder, drawn=DRAWN):
    path = folder / "tower.toml"
    path.write_text(f'name = "tower"\npairing = "index"\n{MODEL}{drawn}{REST}', encoding="utf-8")
    return path


def test_lines_sensors_and_colours_are_drawn(tmp_path):
    problem = load(written(tmp_path))
    found = sketch(problem.model.structure, problem.data.sensors)
    np.testing.assert_array_equal(found.elements, [[0, 1], [1, 2]])
    assert found.changed.tolist() == [[True], [False]]
    assert found.kinds == ("sensor",)
    assert found.places.tolist() == [[0.0, 0.0, 6.0]]
    assert fmu.check(problem, draws=4).drawing.startswith("<svg")


def test_pictures_change_no_draw(tmp_path):
    drawn, bare = load(written(tmp_path)), load(written(tmp_path, ""))
    assert drawn.configuration() == bare.configuration()
    theta = np.linspace(0.6, 1.9, 5)[:, None]
    np.testing.assert_array_equal(drawn.log_prob(theta), bare.log_prob(theta))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"foot", "floor"]', '"foot", "cellar"]', "model.lines.0.points: must name one of foot, floor, roof"),
        ('parameters = ["k"]', 'parameters = ["c"]', "model.lines.0.parameters: must name one of k"),
        ("foot = [0.0, 0.0, 0.0]", "foot = [0.0, 0.0]", "model.points.foot"),
        (DRAWN[DRAWN.index("[[model.lines]]") :], "", "model.points: must be joined by [[model.lines]]"),
        ("[model.points]", 'mesh = "a.inp"\n[model.points]', None),
    ],
)
def test_what_is_wrong_is_said(tmp_path, old, new, said):
    if said is None:  # the key belongs above the tables
        text = written(tmp_path).read_text().replace('type = "matrices"', 'type = "matrices"\nmesh = "a.inp"')
        (tmp_path / "a.inp").write_text("*NODE\n1, 0, 0, 0\n2, 0, 0, 1\n*ELEMENT, TYPE=B31\n1, 1, 2\n")
        (tmp_path / "tower.toml").write_text(text)
        said = "model.lines: must be left out: mesh gives the pictures"
    else:
        written(tmp_path, DRAWN.replace(old, new))
    with pytest.raises(ConfigurationError) as caught:
        load(tmp_path / "tower.toml")
    assert said in str(caught.value)
