"""Nodes, elements and rows of input decks."""

import numpy as np
import pytest

import fmu
from fmu.formats.models.ansys import node_axes
from fmu.formats.models.inp import kind_of
from tests.matrix_files import write_matrix

ABAQUS = """\
*HEADING
 a frame and a shell
*Node, nset=all
  10, 0., 0., 0.
  20, 1.
  30, 1., 1., 0.
  40, 0., 1., 0.
  50, 0.5, , 1.0
*Element, type=S4R,
 elset=PLATE
 1, 10, 20, 30, 40
*ELEMENT , TYPE = B32 , ELSET = B
 7, 10, 50,
 20
*ELEMENT, TYPE=UNKNOWN7
 8, 10, 20, 30, 40, 50, 10, 20
*ELEMENT, TYPE=MASS
 9, 30
*NSET, NSET=END
 10
*STEP
*NODE PRINT, NSET=END
 U
*END STEP
"""


def test_an_input_deck(tmp_path):
    (tmp_path / "a.inp").write_text(ABAQUS)
    mesh = fmu.read_mesh(tmp_path / "a.inp")
    assert mesh.nodes.tolist() == [10, 20, 30, 40, 50]
    assert mesh.coordinates[4].tolist() == [0.5, 0.0, 1.0]
    assert mesh.elements == ((10, 20, 30, 40), (10, 20, 50), (30,))
    assert mesh.kinds == ("quad", "line3", "vertex")
    assert mesh.notes == ("Elements of the unknown type 'UNKNOWN7' are left out of the mesh.",)


@pytest.mark.parametrize(
    ("name", "kind", "count"),
    [
        ("C3D8R", "hexahedron", 8), ("C3D20RI", "hexahedron20", 20), ("C3D10M", "tetra10", 10),
        ("C3D15", "wedge15", 15),
        ("SC8R", "hexahedron", 8), ("S8R5", "quad8", 8), ("S3", "triangle", 3), ("STRI65", "triangle6", 6),
        ("STRI3", "triangle", 3), ("CPS4R", "quad", 4), ("CPE6M", "triangle6", 6), ("CAX8", "quad8", 8),
        ("B31OS", "line", 2), ("B33", "line", 2), ("B32R", "line3", 3), ("B21", "line", 2), ("B22", "line3", 3),
        ("FRAME2D", "line", 2), ("FRAME3D", "line", 2),
        ("T3D2", "line", 2), ("T3D3", "line3", 3), ("PIPE31", "line", 2), ("SPRINGA", "line", 2),
        ("SPRING1", "vertex", 1), ("MASS", "vertex", 1), ("ROTARYI", "vertex", 1), ("M3D4R", "quad", 4),
        ("COHESIVE", "", 0), ("", "", 0), ("S7", "", 0),
    ],
)  # fmt: skip
def test_types_of_elements(name, kind, count):
    assert kind_of(name) == (kind, count)


def test_a_connector_to_the_ground_has_one_node(tmp_path):
    connectors = "*ELEMENT, TYPE=CONN3D2\n7, , 2\n8, 1,\n9, 1, 2\n"
    (tmp_path / "a.inp").write_text(f"*NODE\n1, 0, 0, 0\n2, 1, 0, 0\n{connectors}")
    mesh = fmu.read_mesh(tmp_path / "a.inp")
    assert mesh.elements == ((2,), (1,), (1, 2))
    assert mesh.kinds == ("vertex", "vertex", "line")
    (tmp_path / "a.inp").write_text("*NODE\n1, 0, 0, 0\n*ELEMENT, TYPE=CONN3D2\n7, ,\n")
    with pytest.raises(ValueError, match=r"a connector has one or two nodes \(got 0\)"):
        fmu.read_mesh(tmp_path / "a.inp")


def abaqus_matrix(path, matrix, dofs):
    lines = [
        f"{dofs[i][0]},{dofs[i][1]}, {dofs[j][0]},{dofs[j][1]}, {matrix[i, j]:.17g}"
        for i, j in zip(*np.nonzero(np.triu(matrix)), strict=True)
    ]
    path.write_text("\n".join(lines) + "\n")


def test_matrices_of_abaqus(tmp_path):
    K = np.array([[3.0, -1.0, 0.0], [-1.0, 2.0, 0.0], [0.0, 0.0, 1e36]])
    names = [(20, 3), (20, 5), (10, 1)]
    abaqus_matrix(tmp_path / "job_STIF1.mtx", K, names)
    abaqus_matrix(tmp_path / "job_MASS1.mtx", np.diag([2.0, 0.5, 1.0]), names)
    (tmp_path / "job.inp").write_text(ABAQUS)
    model = fmu.read_model(tmp_path / "job_STIF1.mtx", mesh=tmp_path / "job.inp")
    assert model.dofs == ((20, "z"), (20, "ry"))
    assert model.stiffness.toarray().tolist() == [[3.0, -1.0], [-1.0, 2.0]]
    assert model.notes[0] == "1 degrees of freedom are left out: held by supports."
    (tmp_path / "job.inp").write_text(ABAQUS + "*TRANSFORM, NSET=END\n 1., 1., 0., -1., 1., 0.\n")
    with pytest.raises(ValueError, match=r"^mesh: must have no \*TRANSFORM"):
        fmu.read_model(tmp_path / "job_STIF1.mtx", mesh=tmp_path / "job.inp")


BULK = """\
SOL 103
CEND
SPC = 9
BEGIN BULK
GRDSET                 1                               2       6
GRID          10              1.      2.      3.
GRID,20,0,1.,0.,0.,0,345
GRID*                 30               0              0.              1.*A
*A                    0.               0
CORD1R         1      91      92      93
GRID          91       0      1.      0.      0.       0
GRID          92       0      1.      0.      1.       0
GRID          93       0      1.      1.      0.       0
CORD2C         2       0      0.      0.      0.      0.      0.      1.+
+             1.      0.      0.
SPOINT  15      THRU    17
CHEXA,1,1,10,20,30,91,92,93
,10,20,30,91,92,93,10,20
,30,91,92,93,10,20
CTETRA,2,1,10,20,30,91
CPENTA,3,1,10,20,30,91,92,93
CTRIA3,4,1,10,20,30
CBUSH,5,1,10
CONROD,6,20,30,1,0.1
SPC1,9,12,91,THRU,93
ENDDATA
GRID          99              1.      2.      3.
"""


def test_bulk_data(tmp_path):
    (tmp_path / "a.bdf").write_text(BULK)
    mesh = fmu.read_mesh(tmp_path / "a.bdf")
    assert mesh.nodes.tolist() == [10, 20, 30, 91, 92, 93]
    np.testing.assert_allclose(mesh.coordinates[0], [1.0 - 2.0, 1.0, 3.0], atol=1e-15)  # x' = y, y' = -x
    assert mesh.kinds == ("hexahedron20", "tetra", "wedge", "triangle", "line")
    assert list(mesh.axes) == [10]
    np.testing.assert_allclose(mesh.axes[10][0], np.array([-1.0, 1.0, 0.0]) / np.sqrt(2.0), atol=1e-15)
    assert len(mesh.sets["g"]) == 6 * 6 + 3
    assert mesh.sets["g"][6:9] == ((15, "x"), (16, "x"), (17, "x"))
    free = mesh.sets["f"]
    assert len(free) == 6 * 6 + 3 - 6 - 3 - 5  # SPC1, GRID 20, and GRDSET at the other five
    assert (20, "z") not in free
    assert (91, "x") not in free
    assert (10, "rz") not in free


def test_rows_of_the_a_set(tmp_path):
    (tmp_path / "a.bdf").write_text(BULK.replace("SPC1,9", "ASET,10,123,20,2\nASET1,0,16,17\nSPC1,9"))
    rows = fmu.read_mesh(tmp_path / "a.bdf").sets["a"]
    assert rows == ((10, "x"), (10, "y"), (10, "z"), (16, "x"), (17, "x"), (20, "y"))


def test_nodes_of_a_hexahedron_with_midside_nodes(tmp_path):
    """Nastran has the edges that stand between bottom and top before those of the top; meshio after them."""
    nodes = "".join(f"GRID,{n},,{n}.,0.,0.\n" for n in range(1, 21))
    (tmp_path / "a.bdf").write_text(nodes + "CHEXA,1,1,1,2,3,4,5,6\n,7,8,9,10,11,12,13,14\n,15,16,17,18,19,20\n")
    assert fmu.read_mesh(tmp_path / "a.bdf").elements == ((*range(1, 13), 17, 18, 19, 20, 13, 14, 15, 16),)


def test_axes_of_nodes_that_ansys_turns():
    """THXY turns about z, THYZ about the new x, THZX about the new y."""
    np.testing.assert_allclose(
        node_axes(np.array([90.0, 0.0, 0.0])), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-15
    )
    np.testing.assert_allclose(
        node_axes(np.array([0.0, 90.0, 0.0])), [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-15
    )
    np.testing.assert_allclose(
        node_axes(np.array([0.0, 0.0, 90.0])), [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-15
    )
    np.testing.assert_allclose(
        node_axes(np.array([90.0, 90.0, 0.0])), [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-15
    )


def test_matrices_of_any_program_with_names_and_a_mesh(tmp_path):
    K = np.array([[3.0, -1.0], [-1.0, 2.0]])
    write_matrix(tmp_path / "K.mtx", np.tril(K))
    write_matrix(tmp_path / "M.mtx", np.eye(2))
    (tmp_path / "rows.csv").write_text("node;direction\n20;z\n50;5\n")
    (tmp_path / "job.inp").write_text(ABAQUS)
    model = fmu.read_model(
        tmp_path / "K.mtx", tmp_path / "M.mtx", mesh=tmp_path / "job.inp", dofs=tmp_path / "rows.csv"
    )
    assert model.dofs == ((20, "z"), (50, "ry"))
    assert model.stiffness.toarray().tolist() == K.tolist()
    assert model.elements[0] == (10, 20, 30, 40)
