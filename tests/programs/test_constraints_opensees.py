"""Each constraint of OpenSees: K(θ) has the frequencies, and shapes at dependent nodes, of OpenSees at new θ."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.fem.modes.eigensolver import eigen
from fmu.types import DIRECTIONS

ops = pytest.importorskip("openseespy.opensees", reason="needs openseespy: make test-programs")

START, LOWER, UPPER = [3e10, 2e4], [1e10, 1e4], [6e10, 4e4]
NEW = np.array([2.37e10, 3.1e4])
CORNERS = {1: (0.0, 0.0), 2: (6.0, 0.3), 3: (6.7, 5.4), 4: (-0.2, 4.6)}


def storeys(theta, levels):
    """Make columns on four corners through so many levels; levels have masses, the last one theta[1]."""
    ops.model("basic", "-ndm", 3, "-ndf", 6)
    ops.geomTransf("Linear", 1, 1.0, 0.0, 0.0)
    ops.geomTransf("Linear", 2, 0.0, 0.0, 1.0)
    tag = 0
    for level in range(levels + 1):
        for corner, (x, y) in CORNERS.items():
            ops.node(10 * level + corner, x, y, 3.0 * level)
            if level == 0:
                ops.fix(corner, *[1] * 6)
    for level in range(1, levels + 1):
        section = (0.09, float(theta[0]), 1.2e10, 1e-3, 7e-4, 6e-4)
        mass = float(theta[1]) / 4 if level == levels else 4e3
        for corner in CORNERS:
            tag += 1
            ops.element(
                "elasticBeamColumn",
                tag,
                10 * level + corner - 10,
                10 * level + corner,
                *section,
                1,
                "-mass",
                300.0,
            )
            ops.mass(10 * level + corner, mass, mass, mass, 50.0, 60.0, 70.0)
        for one, other in ((1, 2), (2, 3), (3, 4), (4, 1)):
            tag += 1
            ops.element(
                "elasticBeamColumn", tag, 10 * level + one, 10 * level + other, *section, 2, "-mass", 200.0
            )


def equal_dof(theta):
    storeys(theta, 2)
    ops.equalDOF(21, 23, 1, 2)
    ops.equalDOF(11, 12, 2, 6)


def diaphragms(theta):
    storeys(theta, 2)
    for level in (1, 2):
        centre = 10 * level + 9
        ops.node(centre, 3.2, 2.4, 3.0 * level)
        ops.fix(centre, 0, 0, 1, 1, 1, 0)
        ops.rigidDiaphragm(3, centre, *(10 * level + corner for corner in CORNERS))


def rigid_links(theta):
    storeys(theta, 1)
    ops.node(50, 3.0, 2.5, 3.6)
    ops.mass(50, 900.0, 900.0, 900.0, 40.0, 50.0, 60.0)
    ops.rigidLink("beam", 11, 50)


@pytest.mark.parametrize("build", [equal_dof, diaphragms, rigid_links])
def test_frequencies_and_shapes_at_values_that_were_not_exported(build):
    model = fmu.from_opensees(build, ["E", "m"], START, LOWER, UPPER)
    lam, phi = eigen(model.K(NEW), model.M(NEW), 6)
    ops.wipe()
    build(NEW)
    there = np.array(ops.eigen("-fullGenLapack", 6))
    sensors = list(model.motions)
    seen = np.array(
        [[ops.nodeEigenvector(node, k + 1)[DIRECTIONS.index(d)] for k in range(6)] for node, d in sensors]
    )
    ops.wipe()
    assert sensors
    assert_allclose(np.sqrt(lam), np.sqrt(there), rtol=1e-6)
    ours = model.observation(sensors) @ phi
    cosines = np.abs(np.sum(ours * seen, axis=0)) / np.linalg.norm(ours, axis=0) / np.linalg.norm(seen, axis=0)
    assert_allclose(cosines, 1.0, rtol=1e-6)
