"""Decks of constraints that contradict themselves, are cut short, name what is not there, or are huge."""

from __future__ import annotations

from tests.validation.hostile_bases import Base

DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
NODES = {1: (0, 0, 0), 2: (1, 0, 0), 3: (1, 1, 0), 4: (0, 1, 0), 5: (2, 2, 1)}
_PROBLEM = """\
name = "deck"
reduction = false
[model]
type = "matrices"
mesh = "{mesh}"
dofs = [{dofs}]
[[model.stiffness]]
file = "K.csv"
powers = {{ k = 1 }}
[[model.mass]]
file = "M.csv"

[measurement]
frequencies = [0.14]
sd = [0.01]

[[parameters]]
name = "k"
start = 1.0
lower = 0.5
upper = 2.0
"""
GRIDS = "".join(f"GRID,{node},,{x}.,{y}.,{z}.\n" for node, (x, y, z) in NODES.items())
LINES = "*NODE, NSET=ALL\n" + "".join(f"{node}, {x}., {y}., {z}.\n" for node, (x, y, z) in NODES.items())

STORED = "*STEP\n*FREQUENCY, SOLVER=MATRIXSTORAGE\n4\n*END STEP\n"
ON_NODES = "*SURFACE, NAME=S, TYPE=NODE\nALL\n"
COUPLING = "*COUPLING, REF NODE=5, SURFACE={}, CONSTRAINT NAME=C\n*KINEMATIC\n"


def _diagonal() -> bytes:
    """Return the rows of a diagonal matrix, one row per degree of freedom of the nodes."""
    n = 6 * len(NODES)
    return "".join(",".join(str(float(1 + i) * (i == j)) for j in range(n)) + "\n" for i in range(n)).encode()


def base(mesh: str, text: str) -> Base:
    """Return a problem whose mesh is a deck."""
    dofs = ", ".join(f'[{node}, "{direction}"]' for node in NODES for direction in DIRECTIONS)
    files = {"K.csv": _diagonal(), "M.csv": _diagonal(), mesh: text.encode()}
    return Base(_PROBLEM.format(mesh=mesh, dofs=dofs), files)


def bulk_data() -> dict[str, str]:
    """Return decks of Nastran."""
    thru = "RBE2,{},1,123456,2,THRU,900000000\n"
    chain = "".join(f"MPC,1,{k},1,1.,{k + 1},1,-1.\n" for k in range(100, 20100))
    long_nodes = "".join(f"GRID,{k},,{k}.,0.,0.\n" for k in range(100, 20101))
    mean = "".join(f",{k},{k + 1},{k + 2},{k + 3},{k + 4},{k + 5},{k + 6},{k + 7}\n" for k in range(100, 20092, 8))
    return {
        "circle of equations": GRIDS + "MPC,1,1,1,1.,2,1,-1.\nMPC,1,2,1,1.,1,1,-.5\n",
        "circle of a rigid link and a mean": GRIDS + "RBE2,1,5,123456,2\nRBE3,2,,5,123456,1.,123,2,3\n,4\n",
        "long circle": GRIDS + long_nodes + chain + "MPC,1,20100,1,1.,100,1,-.5\n",
        "long chain": GRIDS + long_nodes + chain + "MPC,1,20100,1,1.,2,1,-1.\n",
        "chain that grows": GRIDS + long_nodes
        + "".join(f"MPC,1,{k},1,1.,{k + 1},1,-1.1\n,,{k + 1},1,-1.1\n" for k in range(100, 20100)),
        "dependent twice": GRIDS + "RBE2,1,1,123456,2\nRBE2,2,3,123456,2\n",
        "the same entry twice": GRIDS + "RBE2,1,1,123456,2\n" * 2,
        "dependent on itself": GRIDS + "RBE2,1,1,123456,1\n",
        "dependent and held": GRIDS + "RBE2,1,1,123456,2\nSPC1,1,3,2\n",
        "dependent and held by all nodes": GRIDS + "RBE2,1,1,123456,2\nSPC1,1,123456,1,THRU,5\n",
        "all dependent": GRIDS + "RBE2,1,1,123456,2,3,4,5\nSPC1,1,123456,1\n",
        "unknown node": GRIDS + "RBE2,1,1,123456,77\n",
        "unknown reference": GRIDS + "RBE2,1,77,123456,1\n",
        "no components": GRIDS + "RBE2,1,1,,2\n",
        "components of eight": GRIDS + "RBE2,1,1,12345678,2\n",
        "no dependents": GRIDS + "RBE2,1,1,123456\n",
        "cut short": GRIDS + "RBE2,1\n",
        "empty entry": GRIDS + "RBE2\nRBE3\nRBAR\nMPC\nMPCADD\n",
        "mean without weights": GRIDS + "RBE3,1,,5,123456,,123,1,2\n",
        "mean of one": GRIDS + "RBE3,1,,5,123456,1.,123,1\n",
        "mean on a line": GRIDS + "RBE3,1,,5,123456,1.,123,1,2\n",
        "mean of itself": GRIDS + "RBE3,1,,5,123,1.,123,5,1,2\n",
        "mean of weights NaN": GRIDS + "RBE3,1,,5,123456,NAN.,123,1,2\n,3\n",
        "mean of huge weights": GRIDS + "RBE3,1,,5,123456,1.+300,123,1,2\n,3\n",
        "mean of tiny and huge weights": GRIDS + "RBE3,1,,5,123456,1.+200,123,1\n,1.-200,123,2,3\n",
        "mean with half a UM": GRIDS + "RBE3,1,,5,3,1.,3,1,2\n,UM,2\n",
        "mean with UM elsewhere": GRIDS + "RBE3,1,,5,3,1.,3,1,2\n,UM,4,3\n",
        "bar without length": GRIDS + "GRID,6,,0.,0.,0.\nRBAR,1,1,6,123,123\n",
        "bar of seven": GRIDS + "RBAR,1,1,2,123456,1\n",
        "bar of letters": GRIDS + "RBAR,1,1,2,abc\n",
        "equation without factor": GRIDS + "MPC,1,1,1,0.,2,1,1.\n",
        "equation of infinite factors": GRIDS + "MPC,1,1,1,1.+999,2,1,1.+999\n",
        "equation of tiny factors": GRIDS + "MPC,1,1,1,1.-300,2,1,1.+300\n",
        "equation of one term": GRIDS + "MPC,1,1,1,1.\n",
        "equation of a node that is not there": GRIDS + "MPC,1,1,1,1.,99,1,-1.\n",
        "equation of a negative node": GRIDS + "MPC,1,-1,1,1.,2,1,-1.\n",
        "bar from a node to itself": GRIDS + "RBAR,1,1,1,123456\n",
        "equation of two components": GRIDS + "MPC,1,1,12,1.,2,1,1.\n",
        "selected and not there": "CEND\nMPC=9\nBEGIN BULK\n" + GRIDS + "MPC,1,1,1,1.,2,1,1.\n",
        "sets within themselves": "CEND\nMPC=9\nBEGIN BULK\n" + GRIDS + "MPC,1,1,1,1.,2,1,1.\nMPCADD,9,9,1\n",
        "huge THRU": GRIDS + thru.format(1),
        "many huge THRU": GRIDS + "".join(thru.format(k) for k in range(1, 2000)),
        "mean of twenty thousand": GRIDS + long_nodes + "RBE3,1,,5,123456,1.,123,1,2\n" + mean,
        "places at infinity": GRIDS.replace("2.,2.,1.", "1.+200,2.,1.") + "RBE2,1,5,123456,2\n",
        "axes that are not there": GRIDS.replace("GRID,5,,2.,2.,1.", "GRID,5,,2.,2.,1.,77") + "RBE2,1,5,123456,2\n",
    }  # fmt: skip


def input_decks() -> dict[str, str]:
    """Return decks of CalculiX."""
    nested = "*NSET, NSET=S0\n1, 2\n" + "".join(
        f"*NSET, NSET=S{k}\n" + f"S{k - 1}," * 16 + "\n" for k in range(1, 60)
    )
    return {
        "circle": LINES + "*EQUATION\n2\n1,1,1.,2,1,1.\n2\n2,1,1.,1,1,.5\n",
        "terms cut short": LINES + "*EQUATION\n9\n1,1,1.\n",
        "absurd number of terms": LINES + "*EQUATION\n9999999999\n1,1,1.\n",
        "terms of letters": LINES + "*EQUATION\n2\na,b,c,d,e,f\n",
        "terms of a ninth component": LINES + "*EQUATION\n2\n1,9,1.,2,1,1.\n",
        "factors that are not finite": LINES + "*EQUATION\n2\n1,1,nan,2,1,inf\n",
        "dependent twice": LINES + "*EQUATION\n2\n1,1,1.,2,1,1.\n2\n1,1,1.,3,1,1.\n",
        "dependent and held": LINES + "*BOUNDARY\n1,1,3\n*EQUATION\n2\n1,1,1.,2,1,1.\n",
        "body of nothing": LINES + "*RIGID BODY, NSET=NONE, REF NODE=5, ROT NODE=4\n",
        "body of its reference": LINES + "*RIGID BODY, NSET=ALL, REF NODE=5, ROT NODE=5\n",
        "body without numbers": LINES + "*RIGID BODY, NSET=ALL, REF NODE=, ROT NODE=x\n",
        "two bodies of the same nodes": LINES + "*RIGID BODY, NSET=ALL, REF NODE=5, ROT NODE=4\n" * 2,
        "coupling of no surface": LINES + COUPLING.format("S2") + "1,3\n" + STORED,
        "coupling of faces of shells": LINES
        + "*ELEMENT, TYPE=S4, ELSET=E\n1,1,2,3,4\n*SURFACE, NAME=S\nE, S1\n"
        + COUPLING.format("S")
        + "1,3\n"
        + STORED,
        "coupling of faces that are not there": LINES
        + "*SURFACE, NAME=S\n9, S77\n"
        + COUPLING.format("S")
        + "1,3\n"
        + STORED,
        "coupling of faces of a set that is not there": LINES
        + "*SURFACE, NAME=S\nNONE, S1\n"
        + COUPLING.format("S")
        + "1,3\n"
        + STORED,
        "coupling of no directions": LINES + ON_NODES + COUPLING.format("S") + STORED,
        "coupling of directions backwards": LINES + ON_NODES + COUPLING.format("S") + "3,1\n" + STORED,
        "coupling of a ninth direction": LINES + ON_NODES + COUPLING.format("S") + "1,9\n" + STORED,
        "coupling of nodes that are not there": LINES
        + ON_NODES.replace("ALL", "77")
        + COUPLING.format("S")
        + "1,3\n"
        + STORED,
        "coupling without a reference": LINES
        + ON_NODES
        + COUPLING.format("S").replace("REF NODE=5, ", "")
        + "1,3\n"
        + STORED,
        "two couplings of the same nodes": LINES + ON_NODES + (COUPLING.format("S") + "1,3\n") * 2 + STORED,
        "surface in a huge set, often": LINES
        + "*NSET, NSET=A, GENERATE\n1, 4000000, 1\n*SURFACE, NAME=S, TYPE=NODE\n"
        + "A\n" * 50
        + COUPLING.format("S")
        + "1,3\n"
        + STORED,
        "coupling that is held": LINES
        + ON_NODES
        + COUPLING.format("S")
        + "1,3\n*BOUNDARY\nALL, ENCASTRE\n"
        + STORED,
        "axes of zero": LINES + "*TRANSFORM, NSET=ALL\n0.,0.,0.,0.,0.,0.\n",
        "axes of NaN": LINES + "*TRANSFORM, NSET=ALL\nnan,0.,0.,0.,nan,0.\n",
        "sets within sets": LINES + nested + "*RIGID BODY, NSET=S59, REF NODE=5, ROT NODE=4\n",
        "endless set": LINES + "*NSET, NSET=A, GENERATE\n1, 9999999999, 1\n",
        "set that runs backwards": LINES + "*NSET, NSET=A, GENERATE\n9, 1, -1\n",
        "constraints that are not read": LINES + "*MPC\nBEAM,1,2\n*COUPLING\n1,2\n*KINEMATIC\n1,6\n",
    }
