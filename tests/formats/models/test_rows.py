"""A further matrix of a program is brought to a model's degrees of freedom as the stiffness is."""

from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_allclose

import fmu
from fmu.formats.matrices.read import read_labelled
from fmu.formats.models.assembly import place_matrix
from tests.formats.models.test_supports import LINK, chains, read

TURNED = "CORD2R,7,,0.,0.,0.,0.,.6,.8\n,1.,1.,0.\nGRID,6,,5.,0.,0.,7\nRBE2,8,5,1235,6\n"


def full(n, seed=0):
    half = np.random.default_rng(seed).standard_normal((n, n))
    return half @ half.T


def in_g_set(folder, entry):
    K, M = full(36), full(36, 1)
    return read(folder, K, M, TURNED + entry), K


def test_constraints_supports_and_axes(tmp_path):
    """Of the stiffness itself the result is the model's stiffness, with and without constraints and supports."""
    for entry in (LINK, "SPC1,1,12,3", f"{LINK}\nASET1,123456,2"):
        model, K = in_g_set(tmp_path, entry)
        mesh = fmu.read_mesh(tmp_path / "deck.bdf")
        assert 6 in mesh.axes
        found = model.rows.place(K, mesh.sets["g"])
        assert_allclose(found.toarray(), model.stiffness.toarray(), atol=1e-12 * K.max())
        other = np.random.default_rng(2).permutation(36)
        names = [mesh.sets["g"][i] for i in other]
        assert_allclose(model.rows.place(sp.coo_array(K[np.ix_(other, other)]), names).toarray(), found.toarray())


def test_matrices_without_constraints_and_with_axes_of_nodes():
    files = Path(__file__).parent / "nastran"
    mesh = fmu.read_mesh(files / "turned.bdf")
    model = fmu.read_model(files / "turned.op4", mesh=mesh)
    K = read_labelled(files / "turned.op4", "KGG")
    placed = place_matrix(K, "C", model.rows, mesh)
    assert_allclose(placed.toarray(), model.stiffness.toarray(), rtol=1e-12, atol=1e-9)


def test_rows_of_the_n_set(tmp_path):
    K, M, T = chains()
    model = read(tmp_path, T.T @ K @ T, T.T @ M @ T)
    mesh = fmu.read_mesh(tmp_path / "deck.bdf")
    C = full(24)
    assert_allclose(model.rows.place(C, mesh.sets["n"]).toarray(), C[6:, 6:], rtol=1e-14)


def test_damping_without_stiffness_and_mass_is_refused(tmp_path):
    K, M, _ = chains()
    K[29], K[:, 29], M[29, 29] = 0.0, 0.0, 0.0
    model = read(tmp_path, K, M, "")
    names = fmu.read_mesh(tmp_path / "deck.bdf").sets["g"]
    assert (5, "rz") not in model.dofs
    assert_allclose(model.rows.place(K, names).toarray(), model.stiffness.toarray())
    with pytest.raises(ValueError, match=r"must be of rows with stiffness or mass \(got 5 rz\)"):
        model.rows.place(np.eye(30), names)
