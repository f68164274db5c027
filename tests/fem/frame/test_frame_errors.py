"""Wrong input of a frame: parameter, rule and received value."""

import numpy as np
import pytest

from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, PointMass, Section
from fmu.fem.frame.frame import Frame

SECTION = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6)
STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)


def frame(nodes=((0.0, 0, 0), (1.0, 0, 0)), elements=((0, 1),), supports=None, masses=(), names=("g",)):
    groups = [ElementGroup(name, elements, SECTION, STEEL) for name in names]
    return Frame(nodes, groups, {0: DIRECTIONS} if supports is None else supports, masses)


UPDATES = {
    "empty target": (
        {"p": [()]},
        r"p: each target must name a property, one of \('E', .*\) \(got \(\)\)",
    ),
    "property": ({"p": [("I", "g")]}, r"p: property must be one of \('E', 'rho', 'A', .*\) \(got 'I'\)"),
    "group": ({"p": [("E", "h")]}, r"p: group must be one of \['g'\] \(got 'h'\)"),
    "twice": ({"p": [("E", "g")], "q": [("E", "g")]}, r"q: E of group 'g' is updated already"),
}


@pytest.mark.parametrize("case", list(UPDATES))
def test_wrong_updates(case):
    updates, message = UPDATES[case]
    with pytest.raises(ValueError, match=f"^{message}$"):
        frame().separable(updates)


FRAMES = {
    "two groups of one name": ({"names": ("g", "g")}, r"groups: names must be distinct \(got \['g', 'g'\]\)"),
    "direction": ({"supports": {0: ("w",)}}, r"supports: direction must be one of \('x', .*\) \(got 'w'\)"),
    "support node": ({"supports": {2: ("x",)}}, r"supports: node must lie in 0\.\.1 \(got 2\)"),
    "all fixed": (
        {"supports": {0: DIRECTIONS, 1: DIRECTIONS}},
        r"supports: must leave a degree of freedom free \(got all 12 fixed\)",
    ),
    "element node": ({"elements": [(0, 2)]}, r"group 'g': node must lie in 0\.\.1 \(got 2\)"),
    "negative node": ({"elements": [(0, -1)]}, r"group 'g': node must lie in 0\.\.1 \(got -1\)"),
    "triangle": (
        {"elements": [(0, 1, 0)]},
        r"elements: must be pairs of node numbers \(got shape \(1, 3\) of int64\)",
    ),
    "fraction of a node": (
        {"elements": [(0, 0.5)]},
        r"elements: must be pairs of node numbers \(got shape \(1, 2\) of float64\)",
    ),
    "no elements": ({"elements": []}, r"elements: must be pairs of node numbers \(got .*\)"),
    "no length": ({"elements": [(1, 1), (0, 1)]}, r"length: must be positive \(got 0\.0 m\)"),
    "loose node": (
        {"nodes": [[0.0, 0, 0], [1.0, 0, 0], [5.0, 5.0, 5.0]]},
        r"nodes: a node without an element must be fixed, tied or have mass \(got nodes \[2\]\)",
    ),
    "flat nodes": (
        {"nodes": [[0.0, 0], [1.0, 0]]},
        r"nodes: must be finite x, y, z of every node \(got shape \(2, 2\)\)",
    ),
    "NaN node": (
        {"nodes": [[0.0, 0, 0], [np.nan, 0, 0]]},
        r"nodes: must be finite x, y, z of every node \(got shape \(2, 3\)\)",
    ),
    "mass node": ({"masses": [PointMass(7, 1.0)]}, r"masses: node must lie in 0\.\.1 \(got 7\)"),
    "named mass node": ({"masses": [PointMass("tip", 1.0)]}, r"masses: node must lie in 0\.\.1 \(got tip\)"),
}


@pytest.mark.parametrize(
    ("mass", "message"),
    [
        ((1, -1.0), r"mass: must be a finite number of at least 0 \(got -1\.0\)"),
        ((1, np.nan), r"mass: must be a finite number of at least 0 \(got nan\)"),
        ((1, 1.0, (0.0, -1.0, 0.0)), r"inertia\.1: must be a finite number of at least 0 \(got -1\.0\)"),
    ],
)
def test_masses_are_not_negative(mass, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        PointMass(*mass)


@pytest.mark.parametrize("case", list(FRAMES))
def test_wrong_frames(case):
    changes, message = FRAMES[case]
    with pytest.raises(ValueError, match=f"^{message}$"):
        frame(**changes).separable()


def test_node_without_an_element_may_be_fixed():
    nodes = [[0.0, 0, 0], [1.0, 0, 0], [5.0, 5.0, 5.0]]
    assert frame(nodes=nodes, supports={0: DIRECTIONS, 2: DIRECTIONS}).separable().n_dof == 6


@pytest.mark.parametrize("name", ["A", "Iy", "Iz", "J"])
@pytest.mark.parametrize("value", [0.0, -1e-6, np.nan, np.inf])
def test_section_constants_must_be_positive(name, value):
    constants = {"A": 1e-3, "Iy": 1e-6, "Iz": 1e-6, "J": 1e-6} | {name: value}
    with pytest.raises(ValueError, match=rf"^{name}: must be a positive finite number \(got {value}\)$"):
        Section(**constants)


@pytest.mark.parametrize("name", ["width", "height"])
def test_rectangle_must_have_positive_sides(name):
    with pytest.raises(
        ValueError, match=rf"^{name}: must be a positive finite number below 1000000 \(got -0.1\)$"
    ):
        Section.rectangle(**({"width": 0.1, "height": 0.1} | {name: -0.1}))


@pytest.mark.parametrize(("name", "value"), [("E", 0.0), ("rho", np.inf)])
def test_material_constants_must_be_positive(name, value):
    with pytest.raises(ValueError, match=rf"^{name}: must be a positive finite number \(got {value}\)$"):
        Material(**({"E": 1.0, "nu": 0.3, "rho": 1.0} | {name: value}))


@pytest.mark.parametrize("nu", [-1.0, 0.51, np.nan])
def test_poisson_ratio(nu):
    with pytest.raises(
        ValueError, match=rf"^nu: must be a finite number above -1 and of at most 0\.5 \(got {nu}\)$"
    ):
        Material(E=1.0, nu=nu, rho=1.0)
