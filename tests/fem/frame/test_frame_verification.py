"""Frames against statics in closed form and against exact dynamic stiffness; orientation, springs, rigid arms."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from fmu.fem.frame.components import DIRECTIONS, ElementGroup, JointSpring, Material, PointMass, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.modal import frequency_hz
from fmu.fem.modes.separable import RigidArm
from tests.fem.frame.exact_frame import Member, frequencies

STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)
LEG = Section(A=3e-3, Iy=9e-6, Iz=4e-6, J=7e-6)
ARM = Section.i_section(height=0.16, width=0.082, web=0.005, flange=0.0074)


def chain(points, groups, n):
    """Nodes and groups of straight members between points; a group is (from, to, section, y_direction)."""
    nodes, found = [np.asarray(point, float) for point in points], []
    for k, (i, j, section, y_direction) in enumerate(groups):
        inner = range(len(nodes), len(nodes) + n - 1)
        nodes += [nodes[i] + (nodes[j] - nodes[i]) * m / n for m in range(1, n)]
        row = [i, *inner, j]
        elements = np.stack([row[:-1], row[1:]], axis=1)
        found.append(ElementGroup(str(k), elements, section, STEEL, y_direction))
    return np.array(nodes), found


def exact_members(points, groups):
    """The same members for the exact solution."""
    G, found = STEEL.E / (2 * (1 + STEEL.nu)), []
    for i, j, s, y_direction in groups:
        a, b = (np.asarray(points[k], float) for k in (i, j))
        x = (b - a) / np.linalg.norm(b - a)
        y = np.asarray(y_direction) - x * (x @ np.asarray(y_direction))
        rigidities = (STEEL.E * s.A, G * s.J, STEEL.E * s.Iy, STEEL.E * s.Iz)
        masses = (STEEL.rho * s.A, STEEL.rho * s.Iy, STEEL.rho * s.Iz)
        found.append(Member(a, b, *rigidities, *masses, y / np.linalg.norm(y)))
    return found


def lowest(frame, count):
    model = frame.separable()
    return frequency_hz(eigen(model.K([]), model.M([]), count)[0])


@pytest.mark.parametrize("stiffness_ratio", [0.01, 0.5, 1.0, 20.0])
def test_sway_stiffness_of_a_portal(stiffness_ratio):
    """Slope–deflection: k = 24 E Ic/h³ · (6 κ + 1)/(6 κ + 4), κ = (Ib/l)/(Ic/h), if nothing stretches."""
    h, span, I_column = 3.0, 5.0, 4e-6
    column = Section(A=1e3, Iy=1e-5, Iz=I_column, J=1e-5)
    beam = Section(A=1e3, Iy=1e-5, Iz=stiffness_ratio * I_column * span / h, J=1e-5)
    points = [(0, 0, 0), (0, 0, h), (span, 0, h), (span, 0, 0)]
    members = [(0, 1, column, (1, 0, 0)), (1, 2, beam, (0, 0, 1)), (2, 3, column, (1, 0, 0))]
    nodes, groups = chain(points, members, 3)
    model = Frame(nodes, groups, {0: DIRECTIONS, 3: DIRECTIONS}).separable()
    load = np.zeros(model.n_dof)
    load[[model.dof(1, "x"), model.dof(2, "x")]] = 0.5
    sway = np.linalg.solve(model.K([]).toarray(), load)[model.dof(1, "x")]
    expected = 24 * STEEL.E * I_column / h**3 * (6 * stiffness_ratio + 1) / (6 * stiffness_ratio + 4)
    assert 1 / sway == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("slenderness", [1e-2, 1e-3])
def test_tripod_of_slender_members_is_a_truss(slenderness):
    """K = Σ EA/L d dᵀ but for bending, which is (r/L)² as stiff."""
    feet = np.array([[1.0, 0.1, 0.0], [-0.6, 0.9, 0.1], [-0.3, -1.1, -0.2]])
    apex = np.array([0.1, 0.05, 1.3])
    A = 1e-4
    I = A * slenderness**2  # noqa: E741
    rod = Section(A=A, Iy=I, Iz=I, J=I)
    groups = [ElementGroup(str(k), [(k, 3)], rod, STEEL) for k in range(3)]
    model = Frame([*feet, apex], groups, dict.fromkeys(range(3), ("x", "y", "z"))).separable()
    top = [model.dof(3, d) for d in "xyz"]
    flexibility = np.linalg.inv(model.K([]).toarray())[np.ix_(top, top)]
    legs = apex - feet
    lengths = np.linalg.norm(legs, axis=1)
    truss = sum(STEEL.E * A / L**3 * np.outer(d, d) for d, L in zip(legs, lengths, strict=True))
    error = np.abs(np.linalg.inv(flexibility) - truss).max() / np.abs(truss).max()
    assert 0.1 * slenderness**2 < error < 20 * slenderness**2


PORTAL = (
    [(0, 0, 0), (0, 0, 3), (4, 0, 3), (4, 0, 0)],
    [(0, 1, LEG, (0, 1, 0)), (1, 2, ARM, (0, 1, 0)), (3, 2, LEG, (0, 1, 0))],
    (0, 3),
)
L_SHAPE = (
    [(0, 0, 0), (0.2, 0.1, 1.5), (1.4, -0.5, 1.9)],
    [(0, 1, LEG, (0.3, 1, 0.2)), (1, 2, ARM, (0.1, 0.2, 1))],
    (0,),
)


@cache
def exact(name):
    points, members, feet = {"portal": PORTAL, "L": L_SHAPE}[name]
    return frequencies(exact_members(points, members), 7, [points[k] for k in feet])


@pytest.mark.parametrize("name", [pytest.param("portal", marks=pytest.mark.validate), "L"])
def test_frames_against_exact_dynamic_stiffness(name):
    """Rayleigh–Ritz comes from above; cubics converge with h⁴, the linear bar and shaft with h²."""
    points, members, feet = {"portal": PORTAL, "L": L_SHAPE}[name]

    def error(n):
        nodes, groups = chain(points, members, n)
        return lowest(Frame(nodes, groups, dict.fromkeys(feet, DIRECTIONS)), 7) / exact(name) - 1.0

    coarse, fine = error(10), error(20)
    assert np.all(fine > 0.0)
    order = np.log2(coarse / fine)
    assert np.all((order > 1.9) & (order < 4.1))
    assert np.all(np.abs(4 * fine - coarse) / 3 < 1e-4)  # without the part that falls with h²


def test_an_elastic_clamp_in_all_directions_against_exact_dynamic_stiffness():
    """The L on ground springs instead of its clamp."""
    points, members, _ = L_SHAPE
    stiffness = dict(zip(DIRECTIONS, (2e6, 3e6, 4e7, 5e4, 6e4, 7e3), strict=True))
    springs = [(points[0], np.diag(list(stiffness.values())))]
    expected = frequencies(exact_members(points, members), 6, springs=springs)

    def computed(n):
        nodes, groups = chain(points, members, n)
        return lowest(Frame(nodes, groups, springs=[JointSpring("clamp", (0, None), stiffness)]), 6)

    assert_allclose((4 * computed(20) - computed(10)) / 3, expected, rtol=2e-5)
    assert np.all(np.abs(expected / exact("L")[:6] - 1.0) > 0.01)


@cache
def of_turned(quaternion):
    """Return the frequencies of a frame that is turned as a whole."""
    R = Rotation.from_quat(quaternion).as_matrix()
    points = [(0, 0, 0), (0, 0, 3), (4, 0, 3), (4, 1, 0), (0, 0, 3)]
    members = [(0, 1, LEG, (0, 1, 0)), (4, 2, ARM, (0, 1, 0)), (3, 2, LEG, (0, 1, 0))]
    members = [(i, j, section, tuple(R @ np.array(y, float))) for i, j, section, y in members]
    nodes, groups = chain(np.array(points, float) @ R.T, members, 2)
    stiffness = dict.fromkeys("xyz", 1e7) | dict.fromkeys(("rx", "ry", "rz"), 1e6)
    joints = [
        JointSpring("foot", (3, None), stiffness),
        JointSpring("corner", (1, 4), dict.fromkeys(("rx", "ry", "rz"), 1e4), tied=("x", "y", "z")),
    ]
    return lowest(Frame(nodes, groups, {0: DIRECTIONS}, [PointMass(2, 5.0, (0.2, 0.2, 0.2))], springs=joints), 12)


quaternions = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)


@settings(max_examples=5, deadline=None, derandomize=True)
@given(quaternions)
def test_frequencies_do_not_depend_on_the_orientation_of_the_whole(quaternion):
    """With springs as stiff in all directions, a hinge, a mass and a support."""
    assert_allclose(of_turned(tuple(quaternion)), of_turned((0.0, 0.0, 0.0, 1.0)), rtol=1e-9)


LENGTH, EI, MASS = 1.5, 3e4, 8.0


def elastic_cantilever(n):
    """A beam along x whose root turns about y against a spring, without rotary inertia; theta is its stiffness."""
    I = 1e-14 * 1e-3 * LENGTH**2  # noqa: E741
    group = ElementGroup(
        "beam",
        np.stack([np.arange(n), np.arange(1, n + 1)], axis=1),
        Section(1e-3, I, I, I),
        Material(EI / I, 0.25, MASS / 1e-3),
    )
    nodes = np.linspace(0, LENGTH, n + 1)[:, None] * [1.0, 0, 0]
    support = {0: ("x", "y", "z", "rx", "rz")}
    frame = Frame(nodes, [group], support, springs=[JointSpring("root", (0, None), {"ry": 1.0})])
    return frame.separable({"k": [("stiffness", "root")]})


def bending_frequencies(model, theta, count):
    here = np.array([i for i, (_, d) in enumerate(model.dofs) if d in ("z", "ry")])
    K, M = model.K([theta])[here][:, here], model.M([theta])[here][:, here]
    return frequency_hz(eigen(K, M, count)[0])


@pytest.mark.parametrize("ratio", [1e-3, 0.1, 1.0, 10.0, 1e3])
def test_cantilever_on_a_rotational_spring(ratio):
    """κ (1 + cos x cosh x) + x (cos x sinh x − sin x cosh x) = 0 with κ = k L/EI and x⁴ = ω² ρA L⁴/EI."""

    def characteristic(x):
        return ratio * (1 / np.cosh(x) + np.cos(x)) + x * (np.cos(x) * np.tanh(x) - np.sin(x))

    brackets = [(1e-3, 1.8752), (3.92, 4.6942), (7.06, 7.8548)]  # pinned–free to clamped–free
    x = np.array([brentq(characteristic, a, b, xtol=1e-13) for a, b in brackets])
    expected = (x / LENGTH) ** 2 * np.sqrt(EI / MASS) / (2 * np.pi)
    computed = bending_frequencies(elastic_cantilever(20), ratio * EI / LENGTH, 3)
    assert_allclose(computed, expected, rtol=2e-5)


def test_limits_of_the_rotational_spring():
    """Soft, the beam swings on it as a rigid rod, ω² = 3 k/(ρA L³); stiff, it is clamped."""
    soft = 1e-5 * EI / LENGTH
    swing = np.sqrt(3 * soft / (MASS * LENGTH**3)) / (2 * np.pi)
    assert bending_frequencies(elastic_cantilever(2), soft, 1)[0] == pytest.approx(swing, rel=1e-5)
    clamped = 1.8751040687119611**2 / LENGTH**2 * np.sqrt(EI / MASS) / (2 * np.pi)
    assert bending_frequencies(elastic_cantilever(10), 1e7 * EI / LENGTH, 1)[0] == pytest.approx(clamped, rel=2e-6)


@settings(max_examples=8, deadline=None, derandomize=True)
@given(st.lists(st.floats(-1, 1), min_size=9, max_size=9))
def test_a_sensor_on_a_rigid_arm_moves_with_the_body(numbers):
    """u(place) = t + ω × r for the motion of the whole as a rigid body, in every direction, of either sign."""
    shift, turn, offset = np.array(numbers).reshape(3, 3)
    nodes, groups = chain(*PORTAL[:2], 2)
    model = Frame(nodes, groups, arms={"skin": RigidArm(2, tuple(offset))}).separable()
    body = [np.r_[shift + np.cross(turn, node), turn] for node in nodes]
    motion = np.array([body[node][DIRECTIONS.index(d)] for node, d in model.dofs])
    seen = model.observation([("skin", d) for d in DIRECTIONS] + [("skin", "-z")]) @ motion
    expected = shift + np.cross(turn, nodes[2] + offset)
    assert_allclose(seen, [*expected, *turn, -expected[2]], atol=1e-12)
