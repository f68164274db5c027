"""What pyNastran and pyYeti write of a frame is read: OP4 of every kind, DMIG, nodes in systems of their own."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import eigh

import fmu
from tests.formats.models.write_with_pynastran import IDS, portal

FILES = Path(__file__).parent / "nastran"
E = [2.1e11]


@pytest.fixture(scope="module")
def model():
    return portal()


def frequencies(K, M):
    return np.sqrt(eigh(K.toarray(), M.toarray(), eigvals_only=True))


def names(model):
    return tuple((IDS[node], direction) for node, direction in model.dofs)


@pytest.mark.parametrize(
    "file",
    [
        "little.op4",
        "big.op4",
        "strings.op4",
        "bigmat.op4",
        "long.op4",
        "dense.op4",
        "sparse.op4",
        "bigmat-text.op4",
    ],
)
def test_op4_has_the_frequencies_of_the_frame(model, file):
    read = fmu.read_model(FILES / file, mesh=FILES / "portal.bdf")
    assert read.dofs == names(model)
    assert read.notes == (
        "Rows have no names: they are taken for the 30 of the g-set.",
        "12 degrees of freedom are left out: without stiffness and mass.",
    )
    np.testing.assert_allclose(
        frequencies(read.stiffness, read.mass), frequencies(model.K(E), model.M(E)), rtol=1e-10
    )
    np.testing.assert_allclose(read.stiffness.toarray(), model.K(E).toarray(), rtol=1e-14)


def test_a_matrix_whose_name_occurs_twice_is_refused(tmp_path):
    once = (FILES / "little.op4").read_bytes()
    (tmp_path / "twice.op4").write_bytes(once + once)
    with pytest.raises(ValueError, match=r"must hold one matrix of the name KGG \(it holds several\)"):
        fmu.read_model(tmp_path / "twice.op4", mesh=FILES / "portal.bdf")


def test_rows_of_a_smaller_matrix_are_those_without_supports(model):
    read = fmu.read_model(FILES / "free.op4", mesh=FILES / "portal.bdf")
    assert read.dofs == names(model)
    assert read.notes == ("Rows have no names: they are taken for the 18 of the f-set.",)


@pytest.mark.parametrize(("file", "digits"), [("small.pch", 5e-4), ("large.pch", 5e-10)])
def test_dmig_has_names_and_as_many_digits_as_it_prints(model, file, digits):
    read = fmu.read_model(FILES / file)
    assert read.dofs == names(model)
    for found, wanted in ((read.stiffness, model.K(E)), (read.mass, model.M(E))):
        np.testing.assert_allclose(found.toarray(), wanted.toarray(), rtol=1.001 * digits, atol=0.0)


def test_dmig_in_free_format(tmp_path):
    (tmp_path / "two.dmig").write_text(
        "$ two masses\nDMIG, K, 0, 6, 2, 0\nDMIG, K, 5, 1,, 5, 1, 3.0+3,,\n, 9, 0, -1.5D3\n"
        "DMIG*, K, 9, 0,,*\n*, 9, 0, 1500.\nDMIG,M,0,6,1\nDMIG,M,5,1,,5,1,2.\nDMIG,M,9,0,,9,0,1.\n"
    )
    read = fmu.read_model(tmp_path / "two.dmig")
    assert read.dofs == ((5, "x"), (9, "x"))
    assert read.stiffness.toarray().tolist() == [[3000.0, -1500.0], [-1500.0, 1500.0]]
    assert read.mass.diagonal().tolist() == [2.0, 1.0]


def test_nodes_of_a_deck(model):
    for deck, digits in (("portal.bdf", 1e-7), ("turned.bdf", 1e-8)):
        mesh = fmu.read_mesh(FILES / deck)
        assert mesh.nodes.tolist() == list(IDS)
        np.testing.assert_allclose(mesh.coordinates, model.geometry.nodes, atol=digits)
        assert mesh.elements == tuple((IDS[a], IDS[b]) for a, b in model.geometry.elements.tolist())
        assert set(mesh.kinds) == {"line"}
    assert set(mesh.axes) == {205, 303, 410}


def test_matrices_in_systems_of_the_nodes_are_turned_to_global_axes(model):
    read = fmu.read_model(FILES / "turned.op4", mesh=FILES / "turned.bdf")
    assert read.dofs == names(model)
    assert not read.motions
    K = model.K(E).toarray()
    root = np.sqrt(np.diag(K))
    assert np.all(abs(read.stiffness.toarray() - K) <= 1e-7 * np.outer(root, root))


def test_a_support_along_an_axis_of_its_own_leaves_the_right_sensors(tmp_path, model):
    """Node 410 is held along the first axis of its spherical system: its motions are those across it."""
    text = (FILES / "turned.bdf").read_text()
    line = next(line for line in text.splitlines() if line.startswith("GRID*                410"))
    below = text.splitlines()[text.splitlines().index(line) + 1]
    (tmp_path / "held.bdf").write_text(text.replace(below, below[:40] + f"{'1':>16}"))
    full = fmu.read_model(FILES / "turned.op4", mesh=FILES / "turned.bdf")
    system = fmu.read_mesh(FILES / "turned.bdf").axes[410]
    turn = np.eye(18)
    turn[12:15, 12:15] = system
    keep = np.delete(np.arange(18), 12)
    for name, matrix in (("K", full.stiffness), ("M", full.mass)):
        np.savetxt(tmp_path / f"{name}.csv", (turn @ matrix.toarray() @ turn.T)[np.ix_(keep, keep)], delimiter=",")
    read = fmu.read_model(tmp_path / "K.csv", tmp_path / "M.csv", mesh=tmp_path / "held.bdf")
    assert (410, "x") not in read.dofs
    assert "410" in read.notes[-1]
    y, z = (read.dofs.index((410, d)) for d in ("y", "z"))
    motion = np.zeros(17)
    motion[[y, z]] = 0.3, -0.2
    for j, direction in enumerate("xyz"):
        seen = sum(w * motion[read.dofs.index(dof)] for dof, w in read.motions[410, direction].items())
        np.testing.assert_allclose(seen, 0.3 * system[1, j] - 0.2 * system[2, j], rtol=1e-12)


def test_names_of_rows_in_a_file(tmp_path, model):
    shutil.copy(FILES / "free.op4", tmp_path / "free.op4")
    lines = [f"{node},{direction}" for node, direction in names(model)]
    (tmp_path / "rows.csv").write_text("node,direction\n" + "\n".join(lines))
    assert fmu.read_model(tmp_path / "free.op4", dofs=tmp_path / "rows.csv").dofs == names(model)
    with pytest.raises(ValueError, match=r"^path: has 18 rows without names"):
        fmu.read_model(tmp_path / "free.op4")


def test_mystran_has_its_rows_in_the_order_of_the_deck(tmp_path):
    """Without PARAM,GRIDSEQ the rows are those of the nodes as they are defined; fmu sorts them."""
    shutil.copy(FILES / "dense.op4", tmp_path / "job.OU1")
    text = (FILES / "portal.bdf").read_text()
    first = next(line for line in text.splitlines() if line.startswith("GRID") and " 101 " in line)
    moved = text.replace(f"{first}\n", "") + f"{first}\n"
    (tmp_path / "job.bdf").write_text(moved + "PARAM,GRIDSEQ,GRID\n")
    ascending = fmu.read_model(tmp_path / "job.OU1", mesh=tmp_path / "job.bdf")
    (tmp_path / "job.bdf").write_text(moved.replace("123456", ""))
    read = fmu.read_model(tmp_path / "job.OU1", mesh=tmp_path / "job.bdf")
    there = {101: 205, 205: 303, 303: 410, 410: 1004, 1004: 101}  # the name that the rows of a node now get
    renamed = [(there[node], direction) for node, direction in ascending.dofs]
    order = [renamed.index(name) for name in read.dofs]
    np.testing.assert_array_equal(read.stiffness.toarray(), ascending.stiffness[order][:, order].toarray())
    (tmp_path / "job.bdf").write_text(moved + "PARAM,GRIDSEQ,BANDIT\n")
    with pytest.raises(ValueError, match=r"^mesh: job\.bdf: must have PARAM,GRIDSEQ,INPUT or GRID"):
        fmu.read_model(tmp_path / "job.OU1", mesh=tmp_path / "job.bdf")
