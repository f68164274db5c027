"""A portal frame in OpenSees. fmu calls build(theta), which creates the model but defines no analysis."""

import openseespy.opensees as ops
from numpy.typing import NDArray

SPAN, HEIGHT, PARTS = 6.0, 4.0, 6
"""Span and height in m; number of elements of each member."""
A, I, RHO, E_LEGS = 5.4e-3, 3.9e-5, 7850.0, 2.1e11  # noqa: E741


def build(theta: NDArray) -> None:
    """Create the frame at theta: the beam's Young's modulus in Pa, the feet's rotational stiffness in N·m/rad."""
    E_beam, k = theta
    ops.model("basic", "-ndm", 2, "-ndf", 3)
    steps = [i / PARTS for i in range(PARTS + 1)]
    places = [(0.0, HEIGHT * s) for s in steps]
    places += [(SPAN * s, HEIGHT) for s in steps[1:]] + [(SPAN, HEIGHT * (1.0 - s)) for s in steps[1:]]
    for node, place in enumerate(places, 1):
        ops.node(node, *place)
    ops.geomTransf("Linear", 1)
    for i in range(1, len(places)):
        E = E_beam if PARTS < i <= 2 * PARTS else E_LEGS
        ops.element("elasticBeamColumn", i, i, i + 1, A, E, I, 1, "-mass", RHO * A, "-cMass")
    ops.uniaxialMaterial("Elastic", 1, k)
    for foot, ground in ((1, 101), (len(places), 102)):
        ops.node(ground, *places[foot - 1])
        ops.fix(ground, 1, 1, 1)
        ops.fix(foot, 1, 1, 0)
        ops.element("zeroLength", ground, ground, foot, "-mat", 1, "-dir", 6)
