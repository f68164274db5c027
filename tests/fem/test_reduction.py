"""Guyan and Craig–Bampton: exact where they claim to be, Ritz bounds elsewhere, wrong input."""

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_allclose, assert_array_equal

from fmu.fem.condensation import craig_bampton, guyan, reusable, substructures
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, PointMass, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.eigensolver import eigen

SECTION = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6)
STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)
FOUR = {"E1": [("E", "0")], "E2": [("E", "1")], "rho2": [("rho", "1")], "Iy1": [("Iy", "0")]}
THETA = np.array([2.1e11, 2.1e11, 7850.0, 4e-6])


def beam(supports=None, masses=()):
    """Return a straight beam of two groups of six elements."""
    nodes = np.linspace(0, 1.2, 13)[:, None] * [1.0, 0.0, 0.0]
    elements = np.stack([np.arange(12), np.arange(1, 13)], axis=1)
    groups = [ElementGroup(str(g), part, SECTION, STEEL) for g, part in enumerate(np.split(elements, 2))]
    return Frame(nodes, groups, {0: DIRECTIONS} if supports is None else supports, masses).separable(FOUR)


def at(model, nodes, directions=DIRECTIONS):
    return np.array([model.dof(node, d) for node in nodes for d in directions])


@pytest.fixture(scope="module")
def clamped():
    model = beam()
    return model, model.K(THETA), model.M(THETA)


def test_guyan_is_exact_in_statics(clamped):
    model, K, M = clamped
    masters = at(model, (9, 4), ("z", "y", "ry"))
    reduced = guyan(K, M, masters)
    flexibility = np.linalg.inv(K.toarray())[np.ix_(masters, masters)]
    assert_allclose(np.linalg.inv(reduced.K), flexibility, rtol=1e-9, atol=1e-12 * np.abs(flexibility).max())
    # a load at the masters: the slaves follow exactly
    load = np.zeros(model.n_dof)
    load[masters] = np.random.default_rng(0).standard_normal(6)
    exact = np.linalg.solve(K.toarray(), load)
    follow = reduced.basis @ np.linalg.solve(reduced.K, load[masters])
    assert_allclose(follow, exact, rtol=1e-8, atol=1e-10 * np.abs(exact).max())
    assert_array_equal(reduced.retained, masters)
    assert_allclose(reduced.basis[masters], np.eye(6), atol=1e-15)


def test_guyan_keeps_rigid_body_mass():
    model = beam(supports={}, masses=[PointMass(12, 0.7)])
    K, M = model.K(THETA), model.M(THETA)
    masters = at(model, (0, 6, 12), ("x", "y", "z", "rx"))
    reduced = guyan(K, M, masters)
    for direction in ("x", "y", "z"):
        rigid = np.array([float(model.dofs[i][1] == direction) for i in masters])
        assert_allclose(reduced.K @ rigid, 0.0, atol=1e-9 * np.abs(reduced.K).max())
        assert rigid @ reduced.M @ rigid == pytest.approx(7850 * 3e-3 * 1.2 + 0.7, rel=1e-9)


def test_guyan_bounds_frequencies_from_above_and_gets_better_with_masters(clamped):
    model, K, M = clamped
    exact = eigen(K, M, 4)[0]
    errors = []
    for nodes in ((12,), (6, 12), (3, 6, 9, 12), range(1, 13)):
        lam, shapes = guyan(K, M, at(model, nodes)).eigen(4)
        assert shapes.shape == (model.n_dof, 4)
        errors.append(lam / exact - 1.0)
    errors = np.array(errors)
    assert np.all(errors > -1e-8)
    assert np.all(np.diff(errors, axis=0) < 1e-8)
    assert_allclose(errors[-1], 0.0, atol=1e-8)  # every degree of freedom a master
    assert errors[1, 3] > 10 * errors[1, 0]  # worse for higher modes
    assert errors[2, 0] < 1e-4


def test_craig_bampton_without_modes_is_guyan(clamped):
    model, K, M = clamped
    boundary = at(model, (6,))
    static, without = guyan(K, M, boundary), craig_bampton(K, M, boundary, 0)
    assert_array_equal(without.K, static.K)
    assert_array_equal(without.M, static.M)


def test_craig_bampton_converges_to_the_exact_modes(clamped):
    model, K, M = clamped
    exact, exact_shapes = eigen(K, M, 5)
    boundary = at(model, (6,))
    errors = []
    for n_modes in (2, 6, 12, 1000):
        reduced = craig_bampton(K, M, boundary, n_modes)
        lam, shapes = reduced.eigen(5)
        errors.append(lam / exact - 1.0)
    assert np.all(np.array(errors) > -1e-8)
    assert np.all(np.diff(errors, axis=0) < 1e-8)
    assert np.abs(errors[1]).max() < 1e-2
    assert_allclose(errors[-1], 0.0, atol=1e-7)
    assert reduced.K.shape[0] <= model.n_dof
    cosine = np.abs(np.sum(shapes * (M @ exact_shapes), axis=0))
    assert_allclose(cosine, 1.0, atol=1e-7)


def test_craig_bampton_matrices_have_the_textbook_form(clamped):
    """K_r is block diagonal: constraint modes apart from fixed-interface modes, whose block holds their λ."""
    model, K, M = clamped
    boundary = at(model, (6,))
    reduced = craig_bampton(K, M, boundary, 3)
    scale = np.abs(reduced.K).max()
    assert_allclose(reduced.K[:6, 6:], 0.0, atol=1e-9 * scale)
    held = np.setdiff1d(np.arange(model.n_dof), boundary)
    lam = eigen(K[held][:, held], M[held][:, held], 200 if model.n_dof > 206 else len(held))[0]
    assert_allclose(reduced.K[6:, 6:], np.diag(np.diag(reduced.K[6:, 6:])), atol=1e-9 * scale)
    for value in np.diag(reduced.K[6:, 6:]):
        assert np.min(np.abs(lam / value - 1.0)) < 1e-7
    assert_allclose(reduced.M[6:, 6:], np.eye(reduced.M.shape[0] - 6), atol=1e-9)


def test_substructures_are_what_the_boundary_separates(clamped):
    model, K, M = clamped
    parts = substructures(K, M, at(model, (6,)))
    nodes = [{model.dofs[i][0] for i in part} for part in parts]
    # four planes of motion on each side of the boundary
    assert sorted(map(min, nodes)) == [1] * 4 + [7] * 4
    assert all(n == set(range(1, 6)) or n == set(range(7, 13)) for n in nodes)
    assert sum(map(len, parts)) == model.n_dof - 6


def test_reusable_modes_are_those_that_no_parameter_changes(clamped):
    model, *_ = clamped
    boundary = at(model, (6,))
    parts = substructures(model.K(THETA), model.M(THETA), boundary)
    verdict = {}
    for part, ok in zip(parts, reusable(model, THETA, boundary), strict=True):
        side = "far" if model.dofs[part[0]][0] > 6 else "near"
        plane = "".join(sorted({model.dofs[i][1] for i in part}))
        verdict[side, plane] = ok
    # beyond the boundary the density is updated; on this side Iy changes bending in x–z and the torsional inertia
    assert verdict == {
        ("near", "x"): True,
        ("near", "rx"): False,
        ("near", "rzy"): True,
        ("near", "ryz"): False,
        ("far", "x"): False,
        ("far", "rx"): False,
        ("far", "rzy"): False,
        ("far", "ryz"): False,
    }


def test_modes_under_two_coefficients_are_not_reusable():
    """The interior between the clamp and the tip holds both moduli."""
    nodes = np.linspace(0, 1.2, 13)[:, None] * [1.0, 0.0, 0.0]
    elements = np.stack([np.arange(12), np.arange(1, 13)], axis=1)
    groups = [ElementGroup(str(g), part, SECTION, STEEL) for g, part in enumerate(np.split(elements, 2))]
    frame = Frame(nodes, groups, {0: DIRECTIONS})
    tip, middle = (
        [frame.separable().dof(node, d) for node in (12,) for d in DIRECTIONS],
        at(frame.separable(), (6,)),
    )
    two, one = {"a": [("E", "0")], "b": [("E", "1")]}, {"a": [("E", "0"), ("E", "1")]}
    assert reusable(frame.separable(two), [2.1e11, 2.1e11], tip) == (False,) * 4
    assert reusable(frame.separable(two), [2.1e11, 2.1e11], middle) == (True,) * 8
    assert reusable(frame.separable(one), [2.1e11], tip) == (True,) * 4


def test_reusable_modes_diagonalise_at_another_theta(clamped):
    model, *_ = clamped
    boundary, other = at(model, (6,)), THETA * [1.7, 0.6, 1.3, 0.8]
    for part, ok in zip(
        substructures(model.K(THETA), model.M(THETA), boundary), reusable(model, THETA, boundary), strict=True
    ):
        modes = eigen(model.K(THETA)[part][:, part], model.M(THETA)[part][:, part], 3)[1]
        projected = modes.T @ (model.M(other)[part][:, part] @ modes)
        diagonal = modes.T @ (model.K(other)[part][:, part] @ modes)
        off = np.abs(diagonal - np.diag(np.diag(diagonal))).max() / np.abs(diagonal).max()
        if ok:
            assert_allclose(projected, np.eye(3), atol=1e-9)
            assert off < 1e-9


@pytest.mark.parametrize("reduce", [guyan, lambda K, M, dofs: craig_bampton(K, M, dofs, 2)])
@pytest.mark.parametrize(
    ("dofs", "message"),
    [
        ([], r"(masters|boundary): must be a list of degrees of freedom \(got \[\]\)"),
        ([[0, 1]], r"(masters|boundary): must be a list of degrees of freedom \(got array.*\)"),
        ([0, 72], r"(masters|boundary): must lie in 0\.\.71 \(got 0\.\.72\)"),
        ([-1], r"(masters|boundary): must lie in 0\.\.71 \(got -1\.\.-1\)"),
        ([3, 3], r"(masters|boundary): must be distinct \(got \[3, 3\]\)"),
    ],
)
def test_wrong_masters(clamped, reduce, dofs, message):
    _, K, M = clamped
    with pytest.raises(ValueError, match=f"^{message}$"):
        reduce(K, M, np.array(dofs, dtype=int) if dofs != [] else [])


@pytest.mark.parametrize("name", ["K", "M"])
@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_matrices_that_are_not_finite(clamped, name, wrong):
    _, K, M = clamped
    dense = {"K": K.toarray(), "M": M.toarray()}
    dense[name][1, 1] = wrong
    for reduce in (guyan, lambda K, M, dofs: craig_bampton(K, M, dofs, 2)):
        with pytest.raises(ValueError, match=rf"^{name}: must be finite \(got NaN or infinite entries\)$"):
            reduce(dense["K"], dense["M"], [0])


def test_wrong_number_of_modes(clamped):
    _, K, M = clamped
    with pytest.raises(ValueError, match=r"^n_modes: must be a whole number of at least 0 \(got -1\)$"):
        craig_bampton(K, M, [0], -1)


@pytest.mark.parametrize("supports", [{}, {0: ("x", "y", "z")}], ids=["free", "hinged"])
def test_structure_that_still_moves_with_its_masters_held(supports):
    model = beam(supports=supports)
    with pytest.raises(
        ValueError, match=r"^masters: the structure can still move when they are held \(singular K_ss\)$"
    ):
        guyan(model.K(THETA), model.M(THETA), at(model, (12,), ("z",)))


def test_dense_matrices_do_as_well(clamped):
    model, K, M = clamped
    masters = at(model, (6, 12))
    sparse, dense = guyan(K, M, masters), guyan(K.toarray(), M.toarray(), masters)
    assert_allclose(dense.K, sparse.K, rtol=1e-12)
    assert_array_equal(dense.basis.shape, sparse.basis.shape)
    assert sp.issparse(K)
