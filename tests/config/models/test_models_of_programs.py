"""Models of other programs in problem files: matrices by name of file, sensors by node, pictures of the mesh."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import fmu
from fmu.config import ConfigurationError, load
from tests.formats.models.write_with_pynastran import portal

FILES = Path(__file__).parents[2] / "formats" / "models" / "nastran"
E = [2.1e11]
TEXT = """
name = "portal"
error = "frequency"
[model]
type = "matrices"
mesh = "{mesh}"
[[model.stiffness]]
file = "{file}"
variable = "KGG"
factor = {factor}
powers = {{ E = 1 }}
[[model.mass]]
file = "{file}"
variable = "MGG"
[measurement]
frequencies = [10.0, 20.0]
sd = 0.1
sensors = [[303, "y"], [303, "-z"], [410, "x"]]
shapes = [[1.0, 0.1, 0.0], [0.0, 1.0, 1.0]]
[[parameters]]
name = "E"
start = 2.1e11
lower = 1e11
upper = 3e11
prior = {{ distribution = "normal", mean = 2.1e11, sd = 1e10 }}
"""


def problem(folder, file="turned.op4", mesh="turned.bdf", change=("", "")):
    for name in (file, mesh):
        if (FILES / name).exists():
            shutil.copy(FILES / name, folder / name)
    (folder / "portal.toml").write_text(TEXT.format(file=file, mesh=mesh, factor=1 / E[0]).replace(*change))
    return load(folder / "portal.toml")


@pytest.mark.parametrize(("file", "mesh"), [("turned.op4", "turned.bdf"), ("big.op4", "portal.bdf")])
def test_sensors_by_node_read_what_they_read_in_the_frame(tmp_path, file, mesh):
    frame = portal()
    model = problem(tmp_path, file, mesh).model.structure
    seen = model.observation([(303, "y"), (303, "-z"), (410, "x")])
    wanted = frame.observation([(2, "y"), (2, "-z"), (3, "x")])
    compliance = [np.linalg.inv(one.K(E).toarray()) for one in (model, frame)]
    found, expected = (H.toarray() @ C @ H.toarray().T for H, C in zip((seen, wanted), compliance, strict=True))
    np.testing.assert_allclose(found, expected, rtol=1e-5)  # the axes of the deck have 10 digits


def test_the_mesh_is_drawn(tmp_path):
    found = problem(tmp_path)
    check = fmu.check(found, draws=2)
    assert "12 degrees of freedom are left out: without stiffness and mass." in check.model
    assert check.drawing.count("<line") >= 4
    assert "4 of 4 elements" in check.parameters["changes"].iloc[0]
    assert check.shapes["displacement"].shape[2:] == (5, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('"turned.bdf"', '"nothing.bdf"'), r"model\.mesh: must be a file"),
        (('"turned.bdf"', '"turned.stl"'), r"model\.mesh: must end in"),
        (('"KGG"', '"KXX"'), r"model\.stiffness\.0\.variable: must be one of KGG, MGG"),
        (('mesh = "turned.bdf"\n', ""), r"neither stiffness nor mass"),
        (('[303, "y"]', '[304, "y"]'), r"304"),
    ],
)
def test_mistakes_are_told_with_their_place(tmp_path, change, message):
    with pytest.raises(ConfigurationError) as caught:
        problem(tmp_path, change=change)
    assert re.search(message, str(caught.value)), str(caught.value)
