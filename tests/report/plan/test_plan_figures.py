"""Figures of a planned test: the structure is drawn along its axis."""

import numpy as np
import pytest

import fmu
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.report.plan.figures import plot_sensors_on_structure

SECTION, STEEL = Section(A=3e-3, Iy=4e-6, Iz=9e-6, J=7e-6), Material(E=2.1e11, nu=0.3, rho=7850.0)


def along(axis):
    """Return a straight model along an axis, and a problem."""
    nodes = np.zeros((5, 3))
    nodes[:, "xyz".index(axis)] = np.arange(5.0)
    elements = np.array([[k, k + 1] for k in range(4)])
    group = ElementGroup("all", elements, SECTION, STEEL, (0.3, 1.0, 0.2))
    model = Frame(nodes, [group], {0: DIRECTIONS}).separable({"E": [("E", "all")]})
    parameter = fmu.Parameter("E", 1.0, 0.5, 1.5, fmu.Normal(0.1, mean=1.0))
    problem = fmu.UpdatingProblem(model, fmu.ModalData([3.0], sd_hz=0.1), [parameter])
    return model, problem


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_straight_structure_is_seen_from_a_side(axis):
    model, problem = along(axis)
    axes = plot_sensors_on_structure(fmu.plan(problem, 1, draws=4), model)
    drawn = np.nan_to_num(axes.lines[0].get_xydata())
    assert np.ptp(drawn, axis=0).max() == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("direction", "marks"),
    [
        ("z", ["o"]),
        ("-rz", [(3, 0, -180.0)] * 2),
        ("rz", [(3, 0, 0.0)] * 2),
        ("ry", [r"$\circlearrowright$"]),  # in the view of x and z, y points away
        ("-ry", [r"$\circlearrowleft$"]),
    ],
)
def test_rotations_have_two_heads_or_curved_arrows_on_the_structure(direction, marks):
    model, problem = along("x")
    axes = plot_sensors_on_structure(fmu.plan(problem, 1, draws=4, candidates=[(2, direction)]), model)
    _, arrow, *heads = axes.lines
    assert [line.get_marker() for line in heads] == marks
    moved = np.diff(arrow.get_xydata(), axis=0)[0]
    assert np.linalg.norm(moved) == pytest.approx(0.0 if "y" in direction else 0.24)
