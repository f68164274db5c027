"""A model updated with several tests: its matrices are those of the structure that all of them share."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from scipy.io import mmread

import fmu
from fmu.report.export import export, in_the_file
from tests.report.exported import run

FILE = """
name = "two storeys"
pairing = "index"
reference = "{reference}"

[model]
type = "matrices"
dofs = [["floor 1", "x"], ["roof", "x"]]

[[model.stiffness]]
matrix = [[2e6, 0.0], [0.0, 0.0]]
powers = {{ k1 = 1 }}

[[model.stiffness]]
matrix = [[2e6, -2e6], [-2e6, 2e6]]
powers = {{ k2 = 1 }}

[[model.mass]]
matrix = [[1000.0, 0.0], [0.0, 1000.0]]

[[parameters]]
name = "k1"
start = 1.0
lower = 0.5
upper = 1.5
{k1}

[[parameters]]
name = "k2"
start = 1.0
lower = 0.5
upper = 1.5
"""
TESTS = """
[[tests]]
name = "{name}"
group = "{group}"
frequencies = [{f[0]}, {f[1]}]
sd = 0.05
masses = [{{ place = "roof", mass = 1.0 }}]
"""
MEASURED = (("a", "old", (4.40, 11.52)), ("b", "new", (4.20, 11.30)), ("c", "old", (4.42, 11.50)))


def test_a_parameter_with_a_value_in_each_test_beside_one_called_its_mean(tmp_path):
    text = (
        FILE.format(k1='varies = "test"', reference="old").replace('"k2"', '"k1 mean"').replace("k2", '"k1 mean"')
    )
    path = tmp_path / "building.toml"
    path.write_text(text + "".join(TESTS.format(name=n, group=g, f=f) for n, g, f in MEASURED))
    problem = fmu.load(path)
    assert problem.names == ("k1 [a]", "k1 [b]", "k1 [c]", "k1 mean")
    assert in_the_file(problem) == {"k1": "k1 [a]", "k1 mean": "k1 mean"}


@pytest.mark.parametrize(
    ("k1", "reference", "inferred"),
    [
        ('varies = "damage"', "old", "k1"),
        ('varies = "population"', "", "k1 mean"),
        pytest.param(
            'varies = "population"\npopulation = { distribution = "log-normal" }',
            "",
            "k1 median",
            marks=pytest.mark.validate,
        ),
        ('varies = "group"', "", "k1 [old]"),
        ('varies = "test"', "", "k1 [a]"),
    ],
)
def test_matrices_and_starts_are_those_of_the_structure(tmp_path, k1, reference, inferred):
    text = FILE.format(k1=k1, reference=reference)
    text = text if reference else text.replace('reference = ""\n', "")
    path = tmp_path / "building.toml"
    path.write_text(text + "".join(TESTS.format(name=n, group=g, f=f) for n, g, f in MEASURED))
    problem, _ = run(path, tmp_path / "run", "index", draws=8, warmup=8)
    written = export(tmp_path / "run")
    table = pd.read_csv(written.directory / "theta.csv", index_col="name")["value"]
    assert tuple(table.index) == problem.names
    first, second = table[inferred], table["k2"]
    stiffness = 2e6 * np.array([[first + second, -second], [-second, second]])
    assert_allclose(mmread(written.directory / "K.mtx", spmatrix=False).toarray(), stiffness, rtol=1e-14)
    assert_allclose(mmread(written.directory / "M.mtx", spmatrix=False).toarray(), np.diag([1000.0, 1000.0]))
    updated = fmu.load(written.directory / "updated.toml")
    assert updated.names == problem.names
    start = dict(zip(updated.names, updated.start, strict=True))
    assert (start[inferred], start["k2"]) == (first, second)
