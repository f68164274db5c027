"""Element matrices: rigid-body motion, mass, statics and an independent oracle."""

import numpy as np
import pytest
import skfem
from numpy.testing import assert_allclose
from skfem.helpers import d, dd

from fmu.fem.frame import beam

LENGTHS = np.array([0.4, 1.7])
BENDING_XY = [1, 5, 7, 11]
BENDING_XZ = [2, 4, 8, 10]


def rigid_motions(L):
    """Return the six infinitesimal rigid motions of a two-node beam about its centre, shape (12, 6)."""
    motions = np.zeros((12, 6))
    for node, x in ((0, -L / 2), (6, L / 2)):
        motions[node : node + 3, :3] = np.eye(3)
        motions[node + 3 : node + 6, 3:] = np.eye(3)
        motions[node + 2, 4] = -x  # a rotation about y lowers w ahead of the centre
        motions[node + 1, 5] = x
    return motions


@pytest.mark.parametrize("terms", [beam.stiffness_terms, beam.mass_terms])
def test_unit_matrices_are_symmetric_and_positive_semidefinite(terms):
    for matrices in terms(LENGTHS).values():
        assert matrices.shape == (2, 12, 12)
        assert_allclose(matrices, np.swapaxes(matrices, 1, 2), rtol=0, atol=0)
        lam = np.linalg.eigvalsh(matrices)
        assert np.all(lam >= -1e-13 * lam[:, -1:])


@pytest.mark.parametrize(("name", "rank"), [("EA", 1), ("EIy", 2), ("EIz", 2), ("GJ", 1)])
def test_stiffness_annihilates_rigid_motions_and_nothing_else(name, rank):
    for L, K in zip(LENGTHS, beam.stiffness_terms(LENGTHS)[name], strict=True):
        assert_allclose(K @ rigid_motions(L), 0.0, atol=1e-13 * np.abs(K).max())
        assert np.linalg.matrix_rank(K) == rank


def test_total_stiffness_has_six_deformations():
    K = sum(beam.stiffness_terms([1.0]).values())[0]
    assert np.linalg.matrix_rank(K) == 6


def test_mass_and_rotary_inertia_of_a_rigid_element():
    rho, A, Iy, Iz = 7850.0, 3e-3, 4e-6, 9e-6
    for i, L in enumerate(LENGTHS):
        unit = beam.mass_terms(LENGTHS)
        M = rho * (A * unit["rhoA"] + Iy * unit["rhoIy"] + Iz * unit["rhoIz"])[i]
        about_y, about_z = rho * A * L**3 / 12 + rho * Iy * L, rho * A * L**3 / 12 + rho * Iz * L
        expected = np.diag([rho * A * L] * 3 + [rho * (Iy + Iz) * L, about_y, about_z])
        assert_allclose(rigid_motions(L).T @ M @ rigid_motions(L), expected, rtol=1e-13, atol=1e-13 * rho * A * L)


def test_cantilever_statics():
    """Tip loads on one clamped element give the textbook deflections, in sign too."""
    L, EA, EIy, EIz, GJ = 1.3, 7.0, 2.0, 3.0, 5.0
    unit = beam.stiffness_terms([L])
    K = (EA * unit["EA"] + EIy * unit["EIy"] + EIz * unit["EIz"] + GJ * unit["GJ"])[0]
    flexibility = np.linalg.inv(K[6:, 6:])
    expected = np.diag([L / EA, L**3 / (3 * EIz), L**3 / (3 * EIy), L / GJ, L / EIy, L / EIz])
    expected[1, 5] = expected[5, 1] = L**2 / (2 * EIz)  # an upward force turns the tip by +θz …
    expected[2, 4] = expected[4, 2] = -(L**2) / (2 * EIy)  # … but by −θy
    assert_allclose(flexibility, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("plane", "sign", "EI", "rhoI"), [("xy", 1, "EIz", "rhoIz"), ("xz", -1, "EIy", "rhoIy")])
def test_bending_against_scikit_fem(plane, sign, EI, rhoI):
    """Hermite elements of unequal lengths with piecewise constant properties, matrix by matrix."""
    nodes = np.array([0.0, 0.13, 0.5, 0.61, 1.0, 1.05])
    properties = np.array([1.0, 3.0, 0.2, 2.5, 0.7])
    basis = skfem.Basis(skfem.MeshLine(nodes), skfem.ElementLineHermite(), intorder=8)
    weight = np.repeat(properties[:, None], basis.X.shape[1], axis=1)
    oracle = {
        EI: skfem.BilinearForm(lambda u, v, w: w.c * dd(u)[0, 0] * dd(v)[0, 0]).assemble(basis, c=weight),
        "rhoA": skfem.BilinearForm(lambda u, v, w: w.c * u * v).assemble(basis, c=weight),
        rhoI: skfem.BilinearForm(lambda u, v, w: w.c * d(u)[0] * d(v)[0]).assemble(basis, c=weight),
    }
    local = np.array(BENDING_XY if plane == "xy" else BENDING_XZ)
    flip = np.diag([1, sign, 1, sign])
    unit = {**beam.stiffness_terms(np.diff(nodes)), **beam.mass_terms(np.diff(nodes))}
    for name, expected in oracle.items():
        ours = np.zeros((12, 12))
        for e in range(5):
            small = flip @ unit[name][e][np.ix_(local, local)] @ flip
            ours[2 * e : 2 * e + 4, 2 * e : 2 * e + 4] += properties[e] * small
        order = basis.nodal_dofs.T.ravel()
        assert_allclose(
            ours, expected.toarray()[np.ix_(order, order)], rtol=1e-10, atol=1e-12 * np.abs(ours).max()
        )


def test_local_axes_are_right_handed_and_normal():
    rng = np.random.default_rng(0)
    axis = rng.standard_normal((20, 3)) * 10.0 ** rng.uniform(-3, 3, size=(20, 1))
    y_direction = rng.standard_normal((20, 3))
    axes = beam.local_axes(axis, y_direction)
    assert_allclose(axes @ np.swapaxes(axes, 1, 2), np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-14)
    assert_allclose(np.linalg.det(axes), 1.0, rtol=1e-13)
    assert_allclose(np.sum(axes[:, 0] * axis, axis=1), np.linalg.norm(axis, axis=1), rtol=1e-13)
    assert np.all(np.sum(axes[:, 1] * y_direction, axis=1) > 0.0)
    assert_allclose(np.sum(axes[:, 2] * y_direction, axis=1), 0.0, atol=1e-13)


def test_local_axes_do_not_depend_on_the_size_of_the_direction():
    axis = [[1.0, 1.0, 0.0]]
    assert_allclose(
        beam.local_axes(axis, (0.0, 1e-9, 1e-9)), beam.local_axes(axis, (0.0, 1e9, 1e9)), rtol=1e-14, atol=1e-15
    )


def test_rotation_to_global_axes_turns_forces_with_the_element():
    """A load along a turned element's local axis moves its tip as the local element says."""
    axis, y_direction, L = np.array([[1.0, 2.0, -2.0]]), (0.0, 1.0, 0.0), 3.0
    unit = beam.stiffness_terms([L])
    K_local = sum(c * unit[n] for c, n in zip((7.0, 2.0, 3.0, 5.0), ("EA", "EIy", "EIz", "GJ"), strict=True))
    axes = beam.local_axes(axis, y_direction)
    K = beam.to_global(K_local, axes)[0]
    T = np.kron(np.eye(2), axes[0])
    load = np.random.default_rng(0).standard_normal(6)
    moved = np.linalg.solve(K[6:, 6:], T.T @ load)
    assert_allclose(T @ moved, np.linalg.solve(K_local[0, 6:, 6:], load), rtol=1e-11)


@pytest.mark.parametrize("y_direction", [(0.0, 1.0, 0.0), (0.0, 0.0, 0.0), (np.nan, 0.0, 1.0), (1e-7, -3.0, 0.0)])
def test_direction_that_gives_no_y_axis(y_direction):
    rule = r"^y_direction: must not be zero or parallel to an element \(wrong for element [01]\)$"
    with pytest.raises(ValueError, match=rule):
        beam.local_axes([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]], y_direction)


@pytest.mark.parametrize("terms", [beam.stiffness_terms, beam.mass_terms])
@pytest.mark.parametrize("length", [0.0, -1.0, np.nan])
def test_length_that_is_not_positive(terms, length):
    with pytest.raises(ValueError, match=rf"^length: must be positive \(got {length} m\)$"):
        terms([1.0, length])


def test_axis_without_length():
    with pytest.raises(ValueError, match=r"^length: must be positive \(got 0\.0 m\)$"):
        beam.local_axes([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], (0.0, 1.0, 0.0))
