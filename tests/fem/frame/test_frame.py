"""Frames: rigid-body modes, invariance under rotation, what updates mean, and wrong input."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, PointMass, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.full_block import full_blocks
from fmu.fem.modes.modal import frequency_hz, solve_spectrum

SECTION = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6)
STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)


def l_frame(R=None, supports=None, masses=(), n=6):
    """Return an L of two legs with different sections, turned by R."""
    R = np.eye(3) if R is None else R
    leg = np.linspace(0.0, 1.0, n + 1)
    nodes = np.concatenate(
        [np.outer(leg, [1.2, 0, 0]), np.outer(leg[1:], [0.1, 0.7, 0.3]) + np.array([1.2, 0, 0])]
    )
    elements = np.stack([np.arange(2 * n), np.arange(1, 2 * n + 1)], axis=1)
    second = Section(A=2e-3, Iy=8e-6, Iz=3e-6, J=5e-6)
    groups = [
        ElementGroup("first", elements[:n], SECTION, STEEL, tuple(R @ [0.0, 0.8, 0.6])),
        ElementGroup("second", elements[n:], second, STEEL, tuple(R @ [1.0, 0.0, 0.0])),
    ]
    return Frame(nodes @ R.T, groups, supports or {}, masses)


def rigid_motions(nodes):
    """Return the six infinitesimal rigid motions of the free nodes, shape (6 n_nodes, 6)."""
    motions = np.zeros((len(nodes), 6, 6))
    motions[:, :3, :3] = motions[:, 3:, 3:] = np.eye(3)
    for k in range(3):
        motions[:, :3, 3 + k] = np.cross(np.eye(3)[k], nodes)
    return motions.reshape(-1, 6)


quaternions = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(quaternions, st.floats(-1.0, 1.0))
def test_free_beam_has_six_rigid_body_modes_at_any_orientation(quaternion, offset):
    R = Rotation.from_quat(quaternion).as_matrix()
    nodes = (np.linspace(0, 2, 9)[:, None] * [1.0, 0, 0] + offset) @ R.T
    elements = np.stack([np.arange(8), np.arange(1, 9)], axis=1)
    model = Frame(nodes, [ElementGroup("b", elements, SECTION, STEEL, tuple(R @ [0, 1.0, 0.5]))]).separable()
    K, M = model.K([]), model.M([])
    lam, phi = eigen(K, M, model.n_dof)
    assert np.all(np.abs(lam[:6]) < 1e-10 * lam[-1])
    assert np.all(lam[6:] > 1e-8 * lam[-1])
    frequencies = frequency_hz(lam)
    assert np.all(np.isfinite(frequencies))
    rigid = rigid_motions(nodes)
    assert np.abs(K @ rigid).max() < 1e-12 * np.abs(K.data).max() * np.abs(rigid).max()
    # the zero modes span the rigid motions
    amplitudes = phi[:, :6].T @ (M @ rigid)
    assert_allclose(phi[:, :6] @ amplitudes, rigid, atol=1e-6 * np.abs(rigid).max())


def test_rigid_body_inertia_of_a_frame():
    masses = [PointMass(3, 0.5, (0.01, 0.02, 0.03)), PointMass(3, 0.25), PointMass(12, 2.0)]
    frame = l_frame(Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix(), masses=masses)
    nodes = np.asarray(frame.nodes)
    rigid = rigid_motions(nodes)
    inertia = rigid.T @ (frame.separable().M([]) @ rigid)
    legs = [(nodes[0], nodes[6], 3e-3), (nodes[6], nodes[12], 2e-3)]
    mass = sum(7850.0 * A * np.linalg.norm(b - a) for a, b, A in legs) + 2.75
    assert_allclose(inertia[:3, :3], mass * np.eye(3), rtol=1e-12, atol=1e-12 * mass)
    moment = sum(7850.0 * A * np.linalg.norm(b - a) * (a + b) / 2 for a, b, A in legs)
    moment = moment + 0.75 * nodes[3] + 2.0 * nodes[12]
    # A rotation about the origin moves mass at r by e_k × r.
    first_moment = np.stack([np.cross(e, moment) for e in np.eye(3)], axis=1)
    assert_allclose(inertia[:3, 3:], first_moment, rtol=1e-11, atol=1e-12 * mass)


@settings(max_examples=10, deadline=None, derandomize=True)
@given(quaternions)
def test_frequencies_are_invariant_under_rotation(quaternion):
    R = Rotation.from_quat(quaternion).as_matrix()
    options = {"supports": {0: DIRECTIONS}, "masses": [PointMass(12, 1.5, (0.02, 0.02, 0.02))]}
    reference, turned = l_frame(None, **options).separable(), l_frame(R, **options).separable()
    lam = eigen(reference.K([]), reference.M([]), 20)[0]
    assert_allclose(eigen(turned.K([]), turned.M([]), 20)[0], lam, rtol=1e-8)


def test_assembled_matrices_are_symmetric_and_definite():
    model = l_frame(Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix(), {0: DIRECTIONS}).separable()
    for matrix in (model.K([]).toarray(), model.M([]).toarray()):
        assert np.abs(matrix - matrix.T).max() <= 1e-14 * np.abs(matrix).max()
        assert np.linalg.eigvalsh(matrix)[0] > 0.0


def test_second_moments_belong_to_the_local_axes():
    """∫z²dA resists bending along local z, which `y_direction` fixes."""
    nodes = np.array([[0.0, 0, 0], [0, 0, 2.0]])  # x along global Z
    group = ElementGroup("b", [(0, 1)], SECTION, STEEL, y_direction=(0.0, 1.0, 0.0))  # local z = −global X
    model = Frame(nodes, [group], {0: DIRECTIONS}).separable()
    flexibility = np.linalg.inv(model.K([]).toarray())
    x, y, z = (model.dof(1, d) for d in ("x", "y", "z"))
    assert flexibility[x, x] == pytest.approx(2.0**3 / (3 * 2.1e11 * 4e-6), rel=1e-10)
    assert flexibility[y, y] == pytest.approx(2.0**3 / (3 * 2.1e11 * 9e-6), rel=1e-10)
    assert flexibility[z, z] == pytest.approx(2.0 / (2.1e11 * 3e-3), rel=1e-10)


UPDATES = {
    "E": {"K": ("EA", "EIy", "EIz", "GJ"), "M": ()},
    "rho": {"K": (), "M": ("rhoA", "rhoIy", "rhoIz")},
    "A": {"K": ("EA",), "M": ("rhoA",)},
    "Iy": {"K": ("EIy",), "M": ("rhoIy",)},
    "Iz": {"K": ("EIz",), "M": ("rhoIz",)},
    "J": {"K": ("GJ",), "M": ()},
}


@pytest.mark.parametrize("name", list(UPDATES))
def test_an_updated_property_acts_where_it_should_and_nowhere_else(name):
    """Doubling a parameter gives the frame whose section or material has the doubled value."""
    from dataclasses import replace

    frame = l_frame(supports={0: DIRECTIONS}, masses=[PointMass(5, 0.3)])
    group = frame.groups[0]
    updated = frame.separable({"p": [(name, "first")]})
    value = group.value(name)
    if name in ("E", "rho"):
        doubled = replace(group, material=replace(STEEL, **{name: 2 * value}))
    else:
        doubled = replace(group, section=replace(SECTION, **{name: 2 * value}))
    for theta, groups in ((value, frame.groups), (2 * value, [doubled, frame.groups[1]])):
        fixed = Frame(frame.nodes, groups, frame.supports, frame.masses).separable()
        assert_allclose(updated.K([theta]).toarray(), fixed.K([]).toarray(), rtol=1e-12, atol=1e-3)
        assert_allclose(updated.M([theta]).toarray(), fixed.M([]).toarray(), rtol=1e-12, atol=1e-12)
    has = {part: any(any(t.powers) for t in getattr(updated, f"{part}_terms")) for part in ("K", "M")}
    assert has == {part: bool(rigidities) for part, rigidities in UPDATES[name].items()}


def test_parameters_shared_by_groups_and_multiplied():
    frame = l_frame(supports={0: DIRECTIONS})
    model = frame.separable({"E": [("E", "first"), ("E", "second")], "I": [("Iy", "first")]})
    assert model.n_parameters == 2
    assert {t.powers for t in model.K_terms} == {(1.0, 0.0), (1.0, 1.0)}
    assert {t.powers for t in model.M_terms} == {(0.0, 0.0), (0.0, 1.0)}
    assert_allclose(model.K([2.1e11, 4e-6]).toarray(), frame.separable().K([]).toarray(), rtol=1e-12, atol=1e-3)


def test_supports_and_names_of_degrees_of_freedom():
    model = l_frame(supports={0: ("x", "rz"), 12: DIRECTIONS}, n=6).separable()
    assert model.n_dof == 13 * 6 - 8
    assert model.dofs[:5] == ((0, "y"), (0, "z"), (0, "rx"), (0, "ry"), (1, "x"))
    assert model.dof(1, "x") == 4
    assert set(model.translations) == {i for i, (_, d) in enumerate(model.dofs) if d in "xyz"}


def test_blocks_of_a_cantilever_and_of_a_general_frame():
    nodes = np.linspace(0, 1, 6)[:, None] * [0.0, 0.0, 1.0]
    elements = np.stack([np.arange(5), np.arange(1, 6)], axis=1)
    frame = Frame(nodes, [ElementGroup("b", elements, SECTION, STEEL)], {0: DIRECTIONS})
    blocks = frame.separable().blocks
    assert sorted(len(b) for b in blocks) == [5, 5, 10, 10]
    assert sorted(np.concatenate(blocks)) == list(range(30))
    model = l_frame(Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix(), {0: DIRECTIONS}).separable()
    assert [len(b) for b in model.blocks] == [model.n_dof]


def test_rounding_in_a_turned_element_does_not_couple_its_planes():
    """Along the diagonal of two axes the third one still bends on its own."""
    nodes = np.linspace(0, 1, 6)[:, None] * np.array([np.cos(0.4), np.sin(0.4), 0.0])
    elements = np.stack([np.arange(5), np.arange(1, 6)], axis=1)
    frame = Frame(nodes, [ElementGroup("b", elements, SECTION, STEEL, (0.0, 0.0, 1.0))], {0: DIRECTIONS})
    model = frame.separable()
    # x, y, rz move in the plane; z, rx, ry out of it
    assert sorted(len(b) for b in model.blocks) == [15, 15]
    split = solve_spectrum(full_blocks(frame.separable({"E": [("E", "b")]})), np.array([[2.1e11]]), 12)
    assert_allclose(split.eigenvalues[0], eigen(model.K([]), model.M([]), 12)[0], rtol=1e-8)


def test_rectangle():
    """Roark's coefficient of a square is 0.1406 b⁴; the cut series is good to a few per mille."""
    flat, upright = Section.rectangle(0.03, 0.01), Section.rectangle(0.01, 0.03)
    assert flat.Iy == pytest.approx(0.03 * 0.01**3 / 12)
    assert flat.Iz == pytest.approx(0.01 * 0.03**3 / 12)
    assert (upright.Iy, upright.Iz, upright.J) == (flat.Iz, flat.Iy, flat.J)
    assert pytest.approx(0.1406, rel=5e-3) == Section.rectangle(1.0, 1.0).J
    assert pytest.approx(1e-12 / 3, rel=1e-4) == Section.rectangle(1.0, 1e-4).J


def test_the_model_knows_where_it_is():
    frame = l_frame()
    geometry = frame.separable().geometry
    assert_allclose(geometry.nodes, frame.nodes)
    assert_allclose(geometry.elements, np.stack([np.arange(12), np.arange(1, 13)], axis=1))
