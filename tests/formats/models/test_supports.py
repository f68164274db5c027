"""Supports of a deck: applied to matrices that include them, and told where rows of supported nodes stay."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import eigh

import fmu
from fmu.types import DIRECTIONS

DECK = """\
CEND
SPC = 1
BEGIN BULK
GRID,1,,0.,0.,0.
GRID,2,,1.,0.,0.
GRID,3,,2.,0.,0.
GRID,4,,3.,0.,0.
GRID,5,,4.,0.,0.
SPC1,1,123456,1
{}
ENDDATA
"""
LINK = "RBE2,9,3,123456,4"


def chains():
    """Return K, M of springs 1-2-3 and 4-5 in all components, and T of a rigid link from 3 to 4, 1 m along x."""
    K, M = np.zeros((30, 30)), np.eye(30)
    for a, b in ((0, 1), (1, 2), (3, 4)):
        for c in range(6):
            ends = [6 * a + c, 6 * b + c]
            K[np.ix_(ends, ends)] += 1e6 * (1 + c) * np.array([[1, -1], [-1, 1]])
    K[24:, 24:] += 1e5 * np.eye(6)
    T = np.zeros((30, 24))
    T[np.r_[:18, 24:30], np.arange(24)] = 1.0
    T[18:24, 12:18] = np.eye(6)
    T[19, 17], T[20, 16] = 1.0, -1.0  # u_y = rz × 1 m, u_z = -ry × 1 m
    return K, M, T


def read(folder, K, M, entry=LINK, dofs=None):
    (folder / "deck.bdf").write_text(DECK.format(entry))
    np.savez(folder / "km.npz", K=K, M=M)
    if dofs is not None:
        (folder / "rows.csv").write_text("\n".join(f"{node},{d}" for node, d in dofs))
        dofs = folder / "rows.csv"
    return fmu.read_model(folder / "km.npz", mesh=folder / "deck.bdf", dofs=dofs)


def omegas(K, M):
    return np.sqrt(eigh(K, M, eigvals_only=True))


def test_matrices_of_the_n_set_lose_the_rows_of_supports(tmp_path):
    """Nastran eliminates dependents first, and supports from what remains: the f-set has the exact frequencies."""
    K, M, T = chains()
    n_set = [T.T @ A @ T for A in (K, M)]
    exact = omegas(*(A[6:, 6:] for A in n_set))
    for matrices in (n_set, (K, M)):  # the n-set, and the g-set
        model = read(tmp_path, *matrices)
        assert (1, "x") not in model.dofs
        assert_allclose(omegas(model.stiffness.toarray(), model.mass.toarray()), exact, rtol=1e-10)
        assert "6 degrees of freedom are left out: supports of the mesh hold them." in model.notes
        assert model.motions[4, "y"] == {(3, "y"): 1.0, (3, "rz"): 1.0}


@pytest.mark.parametrize("is_named", [False, True])
def test_all_rows_lose_those_of_supports_with_and_without_names(tmp_path, is_named):
    K, M, _ = chains()
    names = [(node, d) for node in range(1, 6) for d in DIRECTIONS]
    model = read(tmp_path, K, M, "", names if is_named else None)
    assert list(model.dofs) == names[6:]


def test_supports_whose_rows_stay_are_told(tmp_path):
    """Some rows with names: fmu cannot know whether the program has applied the supports."""
    K, M, _ = chains()
    names = [(node, d) for node in range(1, 6) for d in DIRECTIONS]
    model = read(tmp_path, K[3:, 3:], M[3:, 3:], "", names[3:])
    assert list(model.dofs) == names[3:]
    assert "3 degrees of freedom that the mesh holds have rows, and stay free: 1 rx, 1 ry, 1 rz." in model.notes
