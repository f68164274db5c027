"""The matrices and the mesh that come with ansys-mapdl-reader; both libraries crash on broken files."""

import shutil

import numpy as np
import pytest
from scipy.sparse.linalg import eigsh

import fmu

reader = pytest.importorskip(
    "ansys.mapdl.reader", reason="ansys-mapdl-reader is not installed: make test-programs"
)
pytest.importorskip("mapdl_archive", reason="mapdl-archive is not installed: make test-programs")


@pytest.fixture(scope="module")
def examples():
    from pathlib import Path

    return Path(reader.__file__).parent / "examples"


def test_frequencies_of_the_example_are_those_that_ansys_found(examples):
    model = fmu.read_model(examples / "file.full", mesh=examples / "file.rst")
    frequencies = np.sqrt(eigsh(model.stiffness, 4, model.mass, sigma=0.0)[0]) / (2.0 * np.pi)
    np.testing.assert_allclose(frequencies, [1283.200, 1283.200, 5781.975, 6919.399], atol=5e-4)
    assert model.notes == ("63 degrees of freedom are left out: without stiffness and mass.",)
    assert len(model.dofs) == 900
    assert set(model.kinds) == {"hexahedron20"}
    assert len(model.nodes) == 321
    assert {node for node, _ in model.dofs} <= set(model.nodes.tolist())


def test_elements_of_archives(examples):
    for name, kinds, nodes in (
        ("HexBeam.cdb", {"hexahedron20"}, 321),
        ("TetBeam.cdb", {"tetra"}, None),
        ("sector.cdb", {"hexahedron", "wedge"}, 655),
    ):
        mesh = fmu.read_mesh(examples / name)
        assert set(mesh.kinds) == kinds
        assert nodes is None or len(mesh.nodes) == nodes


def test_constraint_equations_of_an_archive(examples, tmp_path):
    text = (examples / "HexBeam.cdb").read_text()
    lines = "CE,R5.0,DEFI,       2,       1,  0.00000000\n"
    lines += "CE,R5.0,NODE,       1,UX  ,  1.00000000    ,       2,UX  , -1.00000000\n"
    (tmp_path / "a.cdb").write_text(
        text.replace("\nFINISH", f"\n{lines}FINISH", 1) if "\nFINISH" in text else text + lines
    )
    mesh = fmu.read_mesh(tmp_path / "a.cdb")
    assert [(one.dependent, one.weights) for one in mesh.equations] == [((1, "x"), {(2, "x"): 1.0})]
    assert len(mesh.nodes) == 321


@pytest.mark.parametrize("share", [0.0, 0.2, 0.6, 0.9])
def test_cut_files_are_refused_where_the_library_crashes(examples, tmp_path, share):
    content = (examples / "file.full").read_bytes()
    (tmp_path / "cut.full").write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=r"^path: "):
        fmu.read_model(tmp_path / "cut.full")


def test_a_problem_file_names_the_matrices(examples, tmp_path):
    for name in ("file.full", "file.rst"):
        shutil.copy(examples / name, tmp_path)
    (tmp_path / "beam.toml").write_text("""
name = "beam"
error = "frequency"
[model]
type = "matrices"
mesh = "file.rst"
stiffness = [{ file = "file.full", variable = "stiffness", powers = { k = 1 } }]
mass = [{ file = "file.full", variable = "mass" }]
[measurement]
frequencies = [5780.0]
sd = 1.0
numbers = [3]
sensors = [[30, "z"], [30, "-x"]]
[[parameters]]
name = "k"
start = 1.0
lower = 0.5
upper = 2.0
prior = { distribution = "uniform" }
""")
    problem = fmu.load(tmp_path / "beam.toml", pairing="index")
    np.testing.assert_allclose(problem.frequencies([1.0]), [5781.975], rtol=1e-6)
    assert len(problem.model.structure.geometry.elements) > 100
