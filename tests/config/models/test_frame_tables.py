"""Frames from files: sections, springs, ties, places off the points, and what parameters stand for."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fmu.config import ConfigurationError, load
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, JointSpring, Material, PointMass, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.frame.updates import Factor
from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.modal import frequency_hz
from fmu.fem.modes.separable import RigidArm

HALL = """\
name = "hall"
pairing = "index"
reduction = false

[model]
type = "frame"

[model.materials.steel]
E = 2.1e11
nu = 0.3
rho = 7850.0

[model.materials.timber]
E = 1.1e10
nu = 0.3
rho = 450.0

[model.sections.post]
i = { height = 0.2, width = 0.2, web = 0.0065, flange = 0.01 }

[model.sections.purlin]
tube = { diameter = 0.1, thickness = 0.004 }

[model.points]
foot = [0.0, 0.0, 0.0]
top = [0.0, 0.0, 3.0]
eaves = [0.0, 0.0, 3.0]
ridge = [0.0, 4.0, 3.5]
end = [2.0, 4.0, 3.5]
damper = [0.0, 4.0, 3.0]

[model.supports]
damper = ["x", "y", "rx", "ry", "rz"]

[model.springs.base]
point = "foot"
stiffness = { x = 1e8, y = 1e8, z = 1e9, rx = 2e6, ry = 3e6, rz = 1e6 }

[model.springs.knee]
points = ["top", "eaves"]
stiffness = { rx = 4e5, ry = 5e5 }
tied = ["x", "y", "z", "rz"]

[model.springs.hanger]
points = ["damper", "ridge"]
stiffness = { z = 2e4 }

[model.springs.wall]
point = "end"
stiffness = { y = 1e5 }

[model.offsets.skin]
point = "ridge"
offset = [0.0, 0.1, -0.05]

[[model.masses]]
point = "damper"
mass = 30.0

[[model.masses]]
name = "crane"
point = "end"
mass = 100.0
inertia = [1.0, 2.0, 3.0]

[[model.members]]
from = "foot"
to = "top"
group = "posts"
section = "post"
material = "steel"
elements = 2

[[model.members]]
from = "eaves"
to = "ridge"
group = "roof"
section = "purlin"
material = "steel"
elements = 2

[[model.members]]
from = "ridge"
to = "end"
group = "roof"
section = "purlin"
material = "timber"
y_direction = [0.0, 1.0, 1.0]

[measurement]
frequencies = [1.0, 2.0, 3.0]
sd = 0.1
sensors = [["skin", "z"], ["skin", "-ry"], ["top", "x"], ["eaves", "ry"]]

"""

PARAMETER = """\
[[parameters]]
name = "p"
{}
start = {start}
lower = {lower}
upper = {upper}
"""


def text(keys='property = "E"\ngroups = ["posts"]', start=2e11):
    lines = keys.replace("; ", "\n")
    return HALL + PARAMETER.format(lines, start=float(start), lower=start / 2.0, upper=start * 2.0)


def hall():
    """The frame of the file, in Python."""
    steel, timber = Material(2.1e11, 0.3, 7850.0), Material(1.1e10, 0.3, 450.0)
    post, purlin = Section.i_section(0.2, 0.2, 0.0065, 0.01), Section.tube(0.1, 0.004)
    foot, top, ridge, end = (0, 0, 0), (0, 0, 3), (0, 4, 3.5), (2, 4, 3.5)
    # in the order in which the file names them: ends of a member before what is between
    nodes = [foot, (0, 0, 1.5), top, top, (0, 2, 3.25), ridge, end, (0, 4, 3)]
    return Frame(
        np.array(nodes, float),
        [
            ElementGroup("posts", [(0, 1), (1, 2)], post, steel),
            ElementGroup("roof", [(3, 4), (4, 5)], purlin, steel),
            ElementGroup("roof 2", [(5, 6)], purlin, timber, (0.0, 1.0, 1.0)),
        ],
        {7: ("x", "y", "rx", "ry", "rz")},
        [PointMass(7, 30.0, name="damper"), PointMass(6, 100.0, (1.0, 2.0, 3.0), "crane")],
        {"skin": RigidArm(5, (0.0, 0.1, -0.05))},
        [
            JointSpring("base", (0, None), dict(zip(DIRECTIONS, (1e8, 1e8, 1e9, 2e6, 3e6, 1e6), strict=True))),
            JointSpring("knee", (2, 3), {"rx": 4e5, "ry": 5e5}, ("x", "y", "z", "rz")),
            JointSpring("hanger", (7, 5), {"z": 2e4}),
            JointSpring("wall", (6, None), {"y": 1e5}),
        ],
    )


ROOF = [("E", "roof"), ("E", "roof 2")]
TARGETS = {
    'property = "E"; groups = ["posts"]': (2e11, [("E", "posts")]),
    'property = "E"; groups = ["roof"]': (3e10, ROOF),
    'property = "E"; groups = ["roof"]; scaling = "factor"': (1.0, Factor(ROOF)),
    'property = "E"; groups = "all"; scaling = "factor"': (1.0, Factor([("E",)])),
    'property = "rho"; groups = "all"': (5e3, [("rho",)]),
    'property = "Iy"; groups = ["posts"]; scaling = "factor"': (1.1, Factor([("Iy", "posts")])),
    'property = "mass"; masses = ["crane"]': (80.0, [("mass", "crane")]),
    'property = "mass"; masses = ["damper", "crane"]; scaling = "factor"': (
        0.9,
        Factor([("mass", "damper"), ("mass", "crane")]),
    ),
    'property = "inertia"; masses = ["crane"]; directions = ["rx", "rz"]': (
        1.5,
        [("inertia", "crane", "rx"), ("inertia", "crane", "rz")],
    ),
    'property = "inertia"; masses = ["crane"]; scaling = "factor"': (2.0, Factor([("inertia", "crane")])),
    'property = "stiffness"; springs = ["wall"]': (2e5, [("stiffness", "wall")]),
    'property = "stiffness"; springs = ["base", "knee"]; directions = ["rx"]': (
        5e5,
        [("stiffness", "base", "rx"), ("stiffness", "knee", "rx")],
    ),
    'property = "stiffness"; springs = ["base", "hanger"]; scaling = "factor"': (
        1.2,
        Factor([("stiffness", "base"), ("stiffness", "hanger")]),
    ),
}


@pytest.mark.parametrize("keys", TARGETS)
def test_a_file_is_the_frame_in_python(keys, tmp_path):
    start, targets = TARGETS[keys]
    (tmp_path / "hall.toml").write_text(text(keys, start))
    problem, built = load(tmp_path / "hall.toml"), hall().separable({"p": targets})
    names = problem.model.structure.place_names
    assert (names[0], names[2], names[3]) == ("foot", "top", "eaves")
    structure = problem.model.structure
    # the file numbers the end of a member after what is between, as it comes
    assert set(structure.dofs) == set(built.dofs)
    for theta in ([start], [1.3 * start]):
        for ours, other in ((structure.K(theta), built.K(theta)), (structure.M(theta), built.M(theta))):
            order = [built.dof_of[name] for name in structure.dofs]
            other = other.toarray()[np.ix_(order, order)]
            assert_allclose(ours.toarray(), other, rtol=1e-12, atol=1e-12 * np.abs(other).max())
    seen = structure.observation(problem.data.sensors).toarray()
    expected = built.observation([("skin", "z"), ("skin", "-ry"), (2, "x"), (3, "ry")]).toarray()
    assert_allclose(seen, expected[:, [built.dof_of[name] for name in structure.dofs]])
    assert np.all(np.isfinite(problem.log_prob(problem.start)))


def test_a_free_structure_on_purpose(tmp_path):
    held = text()[text().index("[model.springs.base]") : text().index("[model.springs.knee]")]
    free = text().replace(held, "").replace('[model.springs.wall]\npoint = "end"\nstiffness = { y = 1e5 }\n', "")
    free = free.replace('type = "frame"', 'type = "frame"\nfree = true')
    free = free.replace("[1.0, 2.0, 3.0]\nsd = 0.1", "[1.0, 2.0, 3.0]\nnumbers = [7, 8, 9]\nsd = 0.1")
    # on its damper alone, which moves only up and down
    (tmp_path / "hall.toml").write_text(free)
    problem = load(tmp_path / "hall.toml")
    frequencies = problem.frequencies(problem.start)
    assert np.all(frequencies > 1.0)
    springs = [spring for spring in hall().springs if spring.name in ("knee", "hanger")]
    built = replace(hall(), springs=springs).separable({"p": [("E", "posts")]})
    lam = eigen(built.K(problem.start), built.M(problem.start), 9)[0]
    assert_allclose(frequencies, frequency_hz(lam)[6:], rtol=1e-6)


def test_several_masses_without_names_at_one_point(tmp_path):
    two = text().replace("mass = 30.0", 'mass = 10.0\n\n[[model.masses]]\npoint = "damper"\nmass = 20.0')
    (tmp_path / "hall.toml").write_text(two)
    M = load(tmp_path / "hall.toml").model.structure.M([2e11])
    assert_allclose(M.toarray(), hall().separable({"p": [("E", "posts")]}).M([2e11]).toarray(), atol=1e-9)


BROKEN = {
    "a mechanism": (
        [", rz = 1e6", "{ y = 1e5 }"],
        ["", "{ z = 1e5 }"],
        "model: the structure is a mechanism: it can move without strain in 1 way (the whole turning about z)",
    ),
    "a hinge that lets a part turn": (
        'tied = ["x", "y", "z", "rz"]',
        'tied = ["x", "y", "rz"]',
        "model: the structure is a mechanism: it can move without strain in 1 way",
    ),
    "nothing holds it": (
        ['point = "foot"\n', 'point = "end"\nstiffness = { y', 'damper = ["x", "y", "rx", "ry", "rz"]'],
        ['points = ["foot", "end"]\n', 'points = ["end", "foot"]\nstiffness = { y', ""],
        "model.supports: must restrain the structure (a spring to the ground does too); set free = true if",
    ),
    "I without a web": (
        "flange = 0.01",
        "flange = 0.1",
        "model.sections.post.i.flange: must be thinner",
    ),
    "I and tube": (
        "tube = {",
        "i = { height = 0.2, width = 0.2, web = 0.0065, flange = 0.01 }\ntube = {",
        "model.sections.purlin: must have either rectangle, or tube, or i, or A, Iy, Iz and J",
    ),
    "two ends at one place": (
        "ridge = [0.0, 4.0, 3.5]",
        "ridge = [0.0, 0.0, 3.0]",
        "model.members.1.to: must not be at the place of from: the member would have no length (got 'ridge')",
    ),
    "a spring at an unknown point": (
        'point = "foot"',
        'point = "cellar"',
        "model.springs.base: must be one of foot, top, eaves, ridge, end, damper (got 'cellar')",
    ),
    "a spring of both kinds": (
        'point = "foot"',
        'point = "foot"\npoints = ["top", "foot"]',
        "model.springs.base: must have either point (to the ground) or points (between two)",
    ),
    "a spring of three points": (
        '["top", "eaves"]',
        '["top", "eaves", "end"]',
        "model.springs.knee.points: must have at most 2 items",
    ),
    "a spring from a point to itself": (
        '["top", "eaves"]',
        '["top", "top"]',
        "model.springs.knee: ends must differ (got ('top', 'top'))",
    ),
    "a spring of nothing": (
        "stiffness = { z = 2e4 }\n",
        "",
        "model.springs.hanger: must have a stiffness or a tied direction",
    ),
    "elastic and tied": (
        'tied = ["x", "y", "z", "rz"]',
        'tied = ["x", "y", "z", "rx"]',
        "model.springs.knee: must be either elastic or tied in a direction (got 'rx' as both)",
    ),
    "tied to the ground": (
        "stiffness = { y = 1e5 }",
        'tied = ["y"]',
        "model.springs.wall: must have two ends to be tied; a support holds one to the ground",
    ),
    "tied at a distance": (
        "eaves = [0.0, 0.0, 3.0]",
        "eaves = [0.0, 0.0, 3.1]",
        "model: spring 'knee': tied nodes must be at the same place (got a distance of 0.1 m)",
    ),
    "a stiffness along nothing": ("{ y = 1e5 }", "{ up = 1e5 }", "model.springs.wall.stiffness.up"),
    "a negative stiffness": (
        "{ y = 1e5 }",
        "{ y = -1e5 }",
        "model.springs.wall.stiffness.y: must be greater",
    ),
    "an offset from an unknown point": (
        '[model.offsets.skin]\npoint = "ridge"',
        '[model.offsets.skin]\npoint = "roof"',
        "model.offsets.skin.point: must be one of foot, top, eaves, ridge, end, damper (got 'roof')",
    ),
    "an offset with the name of a point": (
        "[model.offsets.skin]",
        "[model.offsets.top]",
        "model.offsets.top: must not have the name of a point",
    ),
    "a sensor off the mesh": (
        '["skin", "z"]',
        '["sky", "z"]',
        "measurement.sensors.0: must be at a place that exists in the model (got ['sky', 'z'])",
    ),
    "masses of one name": (
        'point = "damper"\nmass',
        'point = "damper"\nname = "crane"\nmass',
        "model.masses: must have distinct names (got ['crane', 'crane'])",
    ),
    "a loose mass": (
        'damper = ["x", "y", "rx", "ry", "rz"]',
        'damper = ["x", "y", "rx", "ry"]',
        "model: nodes: a node without an element must be fixed, tied or have mass (got nodes [7])",
    ),
}


def complaint(folder, content):
    (folder / "hall.toml").write_text(content)
    with pytest.raises(ConfigurationError) as caught:
        load(folder / "hall.toml")
    return str(caught.value)


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_structure(name, tmp_path):
    old, new, expected = BROKEN[name]
    content = text()
    for before, after in zip(*([x] if isinstance(x, str) else x for x in (old, new)), strict=True):
        assert content.count(before) >= 1, before
        content = content.replace(before, after, 1)
    assert f"  {expected}" in complaint(tmp_path, content)


MISTAKEN = {
    'property = "G"; groups = ["roof"]': "property: must be 'E', 'rho', 'A', 'Iy', 'Iz', 'J', 'mass', 'inertia' ",
    'property = "E"; groups = "roof"': "groups",
    'property = "E"; masses = ["crane"]': "masses: must be left out: E belongs to groups",
    'property = "E"; groups = ["roof"]; directions = ["x"]': "directions: must be left out: E belongs to groups",
    'property = "E"; groups = ["roof", "roof"]': "groups: E of roof is already updated by p",
    'property = "mass"; groups = ["roof"]': "masses: must name a mass",
    'property = "mass"; masses = ["end"]': "masses: must be among damper, crane (got 'end')",
    'property = "inertia"; masses = ["damper"]': "inertia of 'damper' is 0: name a direction",
    'property = "inertia"; masses = ["damper"]; scaling = "factor"; directions = ["rx"]': (
        "inertia along rx of mass 'damper' is 0, a factor changes nothing"
    ),
    'property = "stiffness"': "springs: must name a spring",
    'property = "stiffness"; springs = ["roof"]': "springs: must be among base, knee, hanger, wall (got 'roof')",
    'property = "stiffness"; springs = ["knee"]; directions = ["x"]': (
        "directions: must be among those of knee: rx, ry (got 'x')"
    ),
    'property = "stiffness"; springs = ["base"]': "values in N/m and N·m/rad cannot be equal",
    'property = "stiffness"; springs = ["hanger", "knee"]': "values in N/m and N·m/rad cannot be equal",
    'property = "stiffness"; springs = ["wall"]; scaling = "log"': "scaling: must be 'absolute' or 'factor'",
}


@pytest.mark.parametrize("keys", MISTAKEN)
def test_a_parameter_that_stands_for_nothing(keys, tmp_path):
    found = complaint(tmp_path, text(keys, 1.0))
    assert "  parameters.0" in found
    assert MISTAKEN[keys] in found


def test_two_parameters_of_one_spring(tmp_path):
    whole = text('property = "stiffness"; springs = ["base"]; scaling = "factor"', 1.0)
    second = PARAMETER.format(
        'property = "stiffness"\nsprings = ["base"]\ndirections = ["ry"]', start=1e6, lower=1e5, upper=1e7
    )
    found = complaint(tmp_path, whole + second.replace('"p"', '"q"'))
    assert "  parameters.1.springs: stiffness of base along ry is already updated by p" in found


def test_what_moves_is_named_by_the_points_of_the_file(tmp_path):
    found = complaint(tmp_path, text().replace('tied = ["x", "y", "z", "rz"]', 'tied = ["x", "y", "rz"]'))
    assert "in 1 way (eaves z, between eaves and ridge z, ridge z, end z move most)" in found
