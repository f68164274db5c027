"""Springs, ties and point masses of a frame, sections, and what parameters do to them."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fmu.fem.frame.components import DIRECTIONS, ElementGroup, JointSpring, Material, PointMass, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.frame.updates import Factor
from fmu.fem.modes.eigensolver import eigen

STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)
TUBE = Section.tube(0.1, 0.005)
FLAT = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6)
CORNER = [(0, 0, 0), (0, 0, 1), (0, 0, 2), (0, 0, 2), (1, 0, 2.2), (2, 0.3, 2.4)]
JOINT = (2, 3)


def corner(springs=(), masses=(), supports=None, nodes=CORNER):
    """Two members that meet where nodes 2 and 3 are; nothing but springs joins them."""
    groups = [
        ElementGroup("post", [(0, 1), (1, 2)], TUBE, STEEL),
        ElementGroup("arm", [(3, 4), (4, 5)], FLAT, replace(STEEL, E=7e10)),
    ]
    return Frame(np.array(nodes, float), groups, supports or {0: DIRECTIONS}, masses, springs=springs)


def eigenvalues(frame, count=10, updates=None, theta=()):
    model = frame.separable(updates)
    return eigen(model.K(theta), model.M(theta), count)[0]


def rigid():
    """The same with one node at the corner."""
    groups = [
        ElementGroup("post", [(0, 1), (1, 2)], TUBE, STEEL),
        ElementGroup("arm", [(2, 3), (3, 4)], FLAT, replace(STEEL, E=7e10)),
    ]
    nodes = np.array([node for i, node in enumerate(CORNER) if i != 3], float)
    return Frame(nodes, groups, {0: DIRECTIONS})


def test_tube_and_i_section_by_their_parts():
    tube = Section.tube(0.2, 0.01)
    assert pytest.approx(np.pi * 0.19 * 0.01) == tube.A  # mean circumference times wall
    assert pytest.approx(tube.Iy + tube.Iz) == tube.J
    assert tube.Iy == pytest.approx(np.pi / 64 * (0.2**4 - 0.18**4))
    assert pytest.approx(np.pi * 0.05**2) == Section.tube(0.1, 0.05).A
    beam = Section.i_section(height=0.3, width=0.15, web=0.0071, flange=0.0107)  # IPE 300 without its fillets
    web = Section.rectangle(0.0071, 0.3 - 2 * 0.0107)
    flange = Section.rectangle(0.15, 0.0107)
    assert pytest.approx(web.A + 2 * flange.A) == beam.A
    assert beam.Iy == pytest.approx(web.Iy + 2 * (flange.Iy + flange.A * ((0.3 - 0.0107) / 2) ** 2))
    assert beam.Iz == pytest.approx(web.Iz + 2 * flange.Iz)
    assert pytest.approx((0.2786 * 0.0071**3 + 2 * 0.15 * 0.0107**3) / 3) == beam.J
    assert beam.Iy == pytest.approx(8.356e-5, rel=0.05)  # EN 10365's, with fillets
    assert beam.Iz == pytest.approx(6.038e-6, rel=0.01)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Section.tube(0.1, 0.06), r"thickness: must not exceed half the diameter 0\.1 \(got 0\.06\)"),
        (
            lambda: Section.tube(0.1, 0.0),
            r"thickness: must be a positive finite number below 1000000 \(got 0\.0\)",
        ),
        (lambda: Section.i_section(0.1, 0.1, 0.01, 0.05), r"flange: must be thinner than half .* \(got 0\.05\)"),
        (lambda: Section.i_section(0.1, 0.1, 0.2, 0.01), r"web: must not exceed the width 0\.1 \(got 0\.2\)"),
        (
            lambda: Section.i_section(-0.1, 0.1, 0.01, 0.01),
            r"height: must be a positive finite number below 1000000 \(got -0\.1\)",
        ),
    ],
)
def test_sections_that_cannot_be(make, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        make()


@pytest.mark.parametrize(
    ("axis", "y"),
    [
        ((2, 0, 0), (0, 1, 0)),
        ((0, 2, 0), (-1, 0, 0)),
        ((0, 0, 2), (0, 1, 0)),
        ((1e-4, 1e-4, -2), (0, 1, 0)),
        ((1, 1, 0), (-(0.5**0.5), 0.5**0.5, 0)),
        ((0, 3, 4), (-1, 0, 0)),
    ],
)
def test_local_y_is_horizontal_unless_it_is_given(axis, y):
    nodes = np.array([(0, 0, 0), axis], float)
    implied, said = (
        Frame(nodes, [ElementGroup("b", [(0, 1)], FLAT, STEEL, direction)]).separable() for direction in (None, y)
    )
    assert_allclose(implied.K([]).toarray(), said.K([]).toarray(), rtol=1e-12, atol=1e-3)
    assert_allclose(implied.M([]).toarray(), said.M([]).toarray(), rtol=1e-12, atol=1e-12)


def test_nodes_tied_in_all_directions_are_one_node():
    tied = corner([JointSpring("corner", JOINT, {}, tied=DIRECTIONS)])
    assert_allclose(eigenvalues(tied), eigenvalues(rigid()), rtol=1e-9)
    model = tied.separable()
    assert model.n_dof == 24
    assert all(model.dof(3, d) == model.dof(2, d) for d in DIRECTIONS)


def test_a_tied_node_is_seen_by_sensors_and_held_by_supports():
    model = corner([JointSpring("corner", JOINT, {"ry": 1e4}, tied=("x", "y", "z", "rx", "rz"))]).separable()
    assert model.dof(3, "x") == model.dof(2, "x")
    assert model.dof(3, "ry") != model.dof(2, "ry")
    seen = model.observation([(2, "x"), (3, "x"), (3, "-x")]).toarray()
    assert_array_equal(seen[0], seen[1])
    assert_array_equal(seen[0], -seen[2])
    both = {0: DIRECTIONS, 3: ("x",)}
    held = corner([JointSpring("corner", JOINT, {}, tied=("x", "y", "z"))], supports=both).separable()
    assert (2, "x") not in held.dof_of
    assert (3, "x") not in held.dof_of


def test_ties_chain():
    """Also where two pairs are joined last, by those that do not stand for their pairs."""
    pairs = ((0, 1, "x"), (2, 3, "xy"), (3, 1, "x"))
    springs = [JointSpring(str(k), (i, j), {}, tied=tuple(tied)) for k, (i, j, tied) in enumerate(pairs)]
    nodes = np.array([(0, 0, 0)] * 4 + [(1, 0, 0), (1, 1, 0), (1, 0, 1), (1, 1, 1)], float)
    groups = [ElementGroup(str(k), [(k, k + 4)], TUBE, STEEL) for k in range(4)]
    model = Frame(nodes, groups, dict.fromkeys((4, 5, 6, 7), DIRECTIONS), springs=springs).separable()
    assert model.dof(0, "x") == model.dof(1, "x") == model.dof(2, "x") == model.dof(3, "x")
    assert model.dof(2, "y") == model.dof(3, "y")
    assert len({model.dof(node, "y") for node in range(4)}) == 3


def test_a_semi_rigid_joint_lies_between_a_hinge_and_a_rigid_one():
    def joint(stiffness):
        rotations = dict.fromkeys(("rx", "ry", "rz"), stiffness)
        return eigenvalues(corner([JointSpring("corner", JOINT, rotations, tied=("x", "y", "z"))]))

    fixed = eigenvalues(rigid())
    assert_allclose(joint(1e11), fixed, rtol=1e-5)
    assert np.all(joint(1e4) < fixed)
    hinge = eigenvalues(corner([JointSpring("corner", JOINT, {}, tied=("x", "y", "z"))]))
    assert np.all(np.abs(hinge[:3]) < 1e-6 * hinge[4])
    assert_allclose(joint(1e-3)[3:], hinge[3:], rtol=1e-5)


def test_a_spring_between_two_places_takes_no_energy_from_a_rigid_motion():
    nodes = np.array([*CORNER[:3], (0.3, -0.2, 2.5), (1.3, 0, 2.7), (2.3, 0.3, 2.9)], float)
    stiffness = dict(zip(DIRECTIONS, (1e6, 2e6, 3e6, 4e4, 5e4, 6e4), strict=True))
    model = replace(corner([JointSpring("mount", JOINT, stiffness)], nodes=nodes), supports={}).separable()
    shift, turn = np.array([0.3, -1.2, 0.7]), np.array([-0.4, 0.9, 1.1])
    rigid = np.concatenate([np.r_[shift + np.cross(turn, node), turn] for node in nodes])
    assert np.abs(model.K([]) @ rigid).max() < 1e-12 * np.abs(model.K([]).data).max()
    # a relative motion half-way between the nodes is what the springs resist
    apart = np.where(np.arange(36) >= 18, np.tile([*shift, 0, 0, 0], 6), 0.0)
    energy = sum(k * u**2 for k, u in zip(stiffness.values(), shift, strict=False))
    assert apart @ model.K([]) @ apart == pytest.approx(energy, rel=1e-9)


def test_a_mass_on_a_spring_needs_no_element():
    """A tuned mass damper's mass: ω² = k/m where its foot hardly moves."""
    nodes = np.array([(0, 0, 0), (0.2, 0, 0), (0.2, 0, 0.5)])
    group = ElementGroup("stub", [(0, 1)], TUBE, STEEL)
    supports = {0: DIRECTIONS, 2: ("y", "z", "rx", "ry", "rz")}
    frame = Frame(nodes, [group], supports, [PointMass(2, 4.0)], springs=[JointSpring("k", (1, 2), {"x": 100.0})])
    assert eigenvalues(frame, 1)[0] == pytest.approx(25.0, rel=1e-4)
    loose = replace(frame, supports={0: DIRECTIONS})
    with pytest.raises(
        ValueError, match=r"^nodes: a node without an element must be fixed.* \(got nodes \[2\]\)$"
    ):
        loose.separable()


SPRINGS = (
    JointSpring("foot", (5, None), {"z": 3e5, "ry": 2e4}),
    JointSpring("corner", JOINT, {"ry": 1e4, "rz": 5e4}, tied=("x", "y", "z", "rx")),
)
MASSES = (PointMass(5, 3.0, (0.1, 0.2, 0.0), "tip"), PointMass(1, 2.0), PointMass(4, 1.0, name="box"))


def with_(frame, **changes):
    return replace(frame, **changes).separable()


def post(**changes):
    groups = corner().groups
    changed = {k: v for k, v in changes.items() if k in ("E", "rho")}
    return [replace(groups[0], material=replace(STEEL, **changed)), groups[1]]


UPDATES = {
    "mass": ([("mass", "tip")], 7.0, {"masses": (replace(MASSES[0], mass=7.0), *MASSES[1:])}),
    "times its mass": (
        Factor([("mass", "tip"), ("mass", "box")]),
        2.0,
        {"masses": (replace(MASSES[0], mass=6.0), MASSES[1], replace(MASSES[2], mass=2.0))},
    ),
    "every mass": (Factor([("mass",)]), 2.0, {"masses": tuple(replace(m, mass=2 * m.mass) for m in MASSES)}),
    "inertia": ([("inertia", "tip")], 0.5, {"masses": (replace(MASSES[0], inertia=(0.5, 0.5, 0.0)), *MASSES[1:])}),
    "inertia about one axis": (
        [("inertia", "tip", "rz")],
        0.5,
        {"masses": (replace(MASSES[0], inertia=(0.1, 0.2, 0.5)), *MASSES[1:])},
    ),
    "times its inertia": (
        Factor([("inertia", "tip")]),
        3.0,
        {"masses": (replace(MASSES[0], inertia=(0.3, 0.6, 0.0)), *MASSES[1:])},
    ),
    "stiffness": (
        [("stiffness", "corner", "ry")],
        7e3,
        {"springs": (SPRINGS[0], replace(SPRINGS[1], stiffness={"ry": 7e3, "rz": 5e4}))},
    ),
    "stiffness in all its directions": (
        [("stiffness", "corner")],
        7e3,
        {"springs": (SPRINGS[0], replace(SPRINGS[1], stiffness={"ry": 7e3, "rz": 7e3}))},
    ),
    "times its stiffness": (
        Factor([("stiffness", "foot")]),
        0.1,
        {"springs": (replace(SPRINGS[0], stiffness={"z": 3e4, "ry": 2e3}), SPRINGS[1])},
    ),
    "factor of a group": (Factor([("E", "post")]), 0.9, {"groups": post(E=0.9 * 2.1e11)}),
    "factor of all groups": (
        Factor([("E",)]),
        0.9,
        {"groups": [replace(g, material=replace(g.material, E=0.9 * g.material.E)) for g in corner().groups]},
    ),
    "value of all groups": (
        [("rho",)],
        3e3,
        {"groups": [replace(g, material=replace(g.material, rho=3e3)) for g in corner().groups]},
    ),
}


@pytest.mark.parametrize("name", UPDATES)
def test_a_parameter_acts_where_it_should_and_nowhere_else(name):
    """The frame with the value written into it, and with the values that it had: to the last entry."""
    targets, value, changes = UPDATES[name]
    frame = corner(SPRINGS, MASSES)
    updated, expected = frame.separable({"p": targets}), with_(frame, **changes)
    for matrix, other in ((updated.K([value]), expected.K([])), (updated.M([value]), expected.M([]))):
        assert_allclose(matrix.toarray(), other.toarray(), rtol=1e-12, atol=1e-9)
    if isinstance(targets, Factor):
        assert_allclose(updated.K([1.0]).toarray(), with_(frame).K([]).toarray(), rtol=1e-12, atol=1e-3)
        assert_allclose(updated.M([1.0]).toarray(), with_(frame).M([]).toarray(), rtol=1e-12, atol=1e-9)
    first = (targets.targets if isinstance(targets, Factor) else targets)[0]
    moves_mass = first[0] in ("mass", "inertia", "rho")
    assert any(any(term.powers) for term in updated.M_terms) == moves_mass
    assert any(any(term.powers) for term in updated.K_terms) != moves_mass


MISTAKES = {
    "mass": ({"p": [("mass", "roof")]}, r"p: mass must be one of \['box', 'tip'\] \(got 'roof'\)"),
    "no name": ({"p": [("mass", "")]}, r"p: mass must be one of \['box', 'tip'\] \(got ''\)"),
    "spring": ({"p": [("stiffness", "tip")]}, r"p: spring must be one of \['corner', 'foot'\] \(got 'tip'\)"),
    "direction": (
        {"p": [("stiffness", "foot", "x")]},
        r"p: direction of 'foot' must be one of \('z', 'ry'\) \(got 'x'\)",
    ),
    "direction of an inertia": (
        {"p": [("inertia", "tip", "x")]},
        r"p: direction of 'tip' must be one of \('rx', 'ry', 'rz'\) \(got 'x'\)",
    ),
    "direction of E": ({"p": [("E", "arm", "x")]}, r"p: E has no direction \(got 'x'\)"),
    "units": (
        {"p": [("stiffness", "foot")]},
        r"p: values in N/m and N·m/rad cannot be equal: leave some out, name a direction, or use a factor",
    ),
    "units of two springs": (
        {"p": [("stiffness", "foot", "z"), ("stiffness", "corner")]},
        r"p: values in N/m and N·m/rad cannot be equal: leave some out, name a direction, or use a factor",
    ),
    "units of two properties": (
        {"p": [("E", "arm"), ("A", "arm")]},
        r"p: values in Pa and m² cannot be equal: leave some out, name a direction, or use a factor",
    ),
    "nothing to multiply": (
        {"p": Factor([("inertia", "tip", "rz")])},
        r"p: inertia along rz of mass 'tip' is 0, a factor changes nothing",
    ),
    "no inertia": ({"p": [("inertia", "box")]}, r"p: inertia of 'box' is 0: name a direction"),
    "twice": (
        {"p": Factor([("stiffness", "foot")]), "q": [("stiffness", "foot", "ry")]},
        r"q: stiffness along ry of spring 'foot' is updated already",
    ),
    "all and one": ({"p": Factor([("E",)]), "q": [("E", "arm")]}, r"q: E of group 'arm' is updated already"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_targets_that_cannot_be(name):
    updates, message = MISTAKES[name]
    with pytest.raises(ValueError, match=f"^{message}$"):
        corner(SPRINGS, MASSES).separable(updates)


BROKEN = {
    "direction": (
        ("k", (0, 1), {"w": 1.0}),
        r"spring 'k': directions of stiffness and tied must be of \(.*\) \(got 'w'\)",
    ),
    "tied direction": (
        ("k", (0, 1), {}, ("w",)),
        r"spring 'k': directions of stiffness and tied must be of \(.*\) \(got 'w'\)",
    ),
    "both": (
        ("k", (0, 1), {"x": 1.0}, ("x",)),
        r"spring 'k': must be either elastic or tied .* \(got 'x' as both\)",
    ),
    "nothing": (("k", (0, 1), {}), r"spring 'k': must have a stiffness or a tied direction \(got neither\)"),
    "ground": (("k", (0, None), {}, ("x",)), r"spring 'k': must have two ends to be tied; .*"),
    "itself": (("k", (1, 1), {"x": 1.0}), r"spring 'k': ends must differ \(got \(1, 1\)\)"),
    "negative": (("k", (0, 1), {"x": -1.0}), r"stiffness\.x: must be a positive finite number \(got -1\.0\)"),
    "NaN": (("k", (0, 1), {"rx": np.nan}), r"stiffness\.rx: must be a positive finite number \(got nan\)"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_springs_that_cannot_be(name):
    given, message = BROKEN[name]
    with pytest.raises(ValueError, match=f"^{message}$"):
        JointSpring(*given)


@pytest.mark.parametrize(
    ("springs", "masses", "message"),
    [
        ([JointSpring("k", (2, 9), {"x": 1.0})], (), r"spring 'k': node must lie in 0\.\.5 \(got 9\)"),
        (
            [JointSpring("k", (1, 2), {}, ("x",))],
            (),
            r"spring 'k': tied nodes must be at the same place \(got .* 1 m\)",
        ),
        (
            [JointSpring("k", (n, None), {"x": 1.0}) for n in (1, 2)],
            (),
            r"springs: names must be distinct \(got .*\)",
        ),
        (
            (),
            [PointMass(n, 1.0, name="m") for n in (1, 2)],
            r"masses: names must be distinct \(got \['m', 'm'\]\)",
        ),
    ],
)
def test_joints_that_do_not_fit_the_frame(springs, masses, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        corner(springs, masses).separable()
