"""Each constraint of CalculiX that is read: frequencies, and shapes at dependent nodes, at values not exported.

CalculiX eliminates the dependent degrees of freedom before it writes its matrices; the deck gives their motions.
"""

import shutil
import subprocess

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.static import MassMoments, uniform_motion
from fmu.formats.calculix_dat import read_displacements, read_frequencies

pytestmark = pytest.mark.skipif(shutil.which("ccx") is None, reason="needs CalculiX (ccx)")

PLACES = {
    1 + i + 4 * (j + 3 * k): (0.1 * i, 0.05 * j, 0.08 * k) for k in range(2) for j in range(3) for i in range(4)
}
TIP = [node for node, place in PLACES.items() if place[0] > 0.29]
A, B, C = TIP[:3]
NOMINAL = {"E": 2.1e11, "rho": 7850.0, "m": 3.0}
STEPS = [{"E": 2.4e11}, {"rho": 7000.0}, {"m": 4.0}]
NEW = {"E": 1.83e11, "rho": 8123.0, "m": 1.7}
AXES = "1.,1.,0.,-1.,1.,0."
COUPLED = "*COUPLING,REF NODE=900,SURFACE=S,CONSTRAINT NAME=C1\n*KINEMATIC\n"
SURFACE = f"*SURFACE,NAME=S,TYPE=NODE\nTIP\n{COUPLED}"
SECOND = (
    "*SURFACE,NAME=S2,TYPE=NODE\n3\n11\n19\n*COUPLING,REF NODE=901,SURFACE=S2,CONSTRAINT NAME=C2\n*KINEMATIC\n1,3"
)
KINDS = {
    "none": ("", set()),
    "equation": (
        f"*EQUATION\n2\n900,1,1.,{A},1,-1.\n3\n900,2,2.,{A},2,-1.,{B},2,-1.\n5\n900,3,-3.,{A},3,.5,{B},3,-.2,{C},1,.1,\n"
        f"{C},2,1.2",
        {900},
    ),
    "chain": (
        f"*EQUATION\n2\n900,1,1.,{A},1,-1.\n3\n{A},1,2.,{B},1,-1.,{C},1,-1.\n2\n{C},1,1.,{TIP[4]},1,-1.\n*BOUNDARY\n900,2,3",
        {900, A, C},
    ),
    "rigid body": ("*RIGID BODY,NSET=TIP,REF NODE=900,ROT NODE=901", set(TIP)),
    "rigid body without a node for its rotation": ("*RIGID BODY,NSET=TIP,REF NODE=900", set(TIP)),
    "coupling": (f"{SURFACE}1,3", set(TIP)),
    "coupling held about two axes": (
        f"{SURFACE}1,3\n*BOUNDARY\n900,4,5", set(TIP),
    ),
    "coupling of the faces of solids, in two lines": (
        f"*SURFACE,NAME=S\nLAST,S4\n{COUPLED}1,2\n3,3", set(TIP),
    ),
    "a coupling after a rigid body": (f"*RIGID BODY,NSET=TIP,REF NODE=900\n{SECOND}", {3, 11, 19, *TIP}),
    "a rigid body after a coupling": (f"{SECOND}\n*RIGID BODY,NSET=TIP,REF NODE=900", {3, 11, 19, *TIP}),
    "two rigid bodies": (
        "*RIGID BODY,NSET=TIP,REF NODE=900\n*NSET,NSET=MID\n3,11,19,901\n*RIGID BODY,NSET=MID,REF NODE=901",
        {3, 11, 19, *TIP},
    ),
    "a rigid body after one with a node for its rotation": (
        "*NODE\n950,.35,.05,.2\n*RIGID BODY,NSET=TIP,REF NODE=900,ROT NODE=950\n*NSET,NSET=MID\n3,11,19\n"
        "*RIGID BODY,NSET=MID,REF NODE=901", {3, 11, 19, *TIP},
    ),
    "equations along turned axes": (
        f"*TRANSFORM,NSET=TIP\n{AXES}\n*EQUATION\n2\n900,1,1.,{A},1,-1.\n3\n{B},2,1.,{C},2,-1.,{A},1,.3\n*BOUNDARY\n900,2,3",
        {900, B},
    ),
    "supports along turned axes": (
        f"*NSET,NSET=TWO\n{A},{B}\n*TRANSFORM,NSET=TWO\n{AXES}\n*BOUNDARY\n{A},1,1\n{B},1,1\n{B},3,3\n900,1,3",
        {A, B},
    ),
    "supports along cylindrical axes": (
        f"*TRANSFORM,NSET=TIP,TYPE=C\n.1,-.2,0.,.1,-.2,1.\n*BOUNDARY\n{A},1,1\n{B},2,2\n900,1,3", {A, B},
    ),
}  # fmt: skip


def deck(kind, values, step):
    cells = [(i, j) for i in range(3) for j in range(2)]
    lines = ["*NODE,NSET=ALL", *(f"{n},{x:.9g},{y:.9g},{z:.9g}" for n, (x, y, z) in PLACES.items())]
    lines += ["900,.35,.05,.2", "901,.1,.0,.3", "*ELEMENT,TYPE=C3D8,ELSET=A"]
    for e, (i, j) in enumerate(cells, 1):
        first = 1 + i + 4 * j
        ring = [first, first + 1, first + 5, first + 4]
        lines.append(",".join(map(str, (e, *ring, *(n + 12 for n in ring)))))
    lines += ["*NSET,NSET=TIP", *(f"{n}," for n in TIP), "*NSET,NSET=FIX"]
    lines += [f"{n}," for n, place in PLACES.items() if place[0] == 0.0]
    lines += [
        "*ELSET,ELSET=LAST",
        "5,6",
        "*ELEMENT,TYPE=MASS,ELSET=M",
        "700,900",
        "*MASS,ELSET=M",
        f"{values['m']:.9g}",
    ]
    lines += ["*MATERIAL,NAME=S", "*ELASTIC", f"{values['E']:.9g},.3", "*DENSITY", f"{values['rho']:.9g}"]
    lines += ["*SOLID SECTION,ELSET=A,MATERIAL=S", "*BOUNDARY", "FIX,1,3", KINDS[kind][0], "*STEP", step]
    return "\n".join([*lines, "*NODE PRINT,NSET=ALL,GLOBAL=YES", "U", "*END STEP"]) + "\n"


def solve(folder, kind, values, step="*FREQUENCY,SOLVER=MATRIXSTORAGE\n6"):
    folder.mkdir()
    (folder / "job.inp").write_text(deck(kind, NOMINAL | values, step))
    subprocess.run(["ccx", "job"], cwd=folder, check=True, capture_output=True, timeout=60)
    return folder


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "none"])
def test_frequencies_and_shapes_at_values_that_were_not_exported(kind, tmp_path):
    changed = [values for values in STEPS if "m" not in values or "900,1,3" not in KINDS[kind][0]]
    exports = []
    for k, values in enumerate([{}, *changed]):
        folder = solve(tmp_path / str(k), kind, values)
        read = fmu.read_model(folder / "job.sti", mesh=folder / "job.inp")
        names = {name for one in changed for name in one}
        at = {name: x for name, x in (NOMINAL | values).items() if name in names}
        exports.append(fmu.Export(at, read, name=f"step {k}"))
    model = fmu.from_exports(exports)
    folder = solve(tmp_path / "new", kind, NEW, "*FREQUENCY\n6")
    printed = read_frequencies(folder / "job.dat")
    theta = [NEW[name] for name in model.names]
    lam, phi = eigen(model.K(theta), model.M(theta), len(printed))
    assert_allclose(np.sqrt(lam) / (2 * np.pi), printed, rtol=1e-6)
    there = read_displacements(folder / "job.dat", len(printed))
    dependents = KINDS[kind][1]
    assert dependents <= {node for node, _ in model.motions}
    sensors = [(node, d) for node in there for d in "xyz" if model.sees((node, d))]
    theirs = np.array([there[node][:, "xyz".index(d)] for node, d in sensors])
    ours = model.observation(sensors) @ phi
    ours *= np.sign(np.sum(ours * theirs, axis=0))
    assert_allclose(ours, theirs, atol=2e-5 * np.abs(theirs).max())


@pytest.mark.parametrize("kind", [kind for kind in KINDS if "rigid" in kind or "coupling" in kind])
def test_weighed_mass_and_centre_of_bodies_that_turn(kind, tmp_path):
    """They are those of the solid without the body, and of the mass at the reference node."""
    read = {}
    for name in ("none", kind):
        folder = solve(tmp_path / name, name, {})
        read[name] = fmu.read_model(folder / "job.sti", mesh=folder / "job.inp")
    free = read["none"]
    places = dict(zip(free.nodes.tolist(), free.coordinates, strict=True))
    rows = np.array([d == "x" for _, d in free.dofs], dtype=float)
    carried = [*((free.mass @ rows) * rows), NOMINAL["m"]]
    mass = sum(carried)
    at = [places[node] for node in (*(node for node, _ in free.dofs), 900)]
    centre = sum(m * place for m, place in zip(carried, at, strict=True)) / mass
    one = read[kind]
    model = fmu.SeparableModel.from_terms(
        ["E"], [(one.stiffness, "E")], [one.mass], one.dofs, fmu.Geometry.of_mesh(one), one.motions
    )
    for d in "xyz":
        motion = uniform_motion(model, d)
        assert_allclose(motion @ (one.mass @ motion), mass, rtol=1e-9)
    if "held" not in kind:
        assert_allclose(MassMoments(model, np.ones(1), True)(np.ones((1, 1)))[0], [[mass, *centre]], rtol=1e-9)


SOLID = f"*SOLID SECTION,ELSET=A,MATERIAL=S\n*MATERIAL,NAME=S\n*ELASTIC\n{NOMINAL['E']:.9g},.3\n*DENSITY\n7850.\n"
CUBE = "0,0,0 1,0,0 1,1,0 0,1,0 0,0,1 1,0,1 1,1,1 0,1,1"
FIRST, MORE, NEW_SUPPORTS = (
    "*BOUNDARY\n1,1,3\n2,1,3\n3,1,3",
    "*BOUNDARY\n7,1",
    "*BOUNDARY,OP=NEW\n5,1,3\n6,1,3\n8,3",
)
STORED, STATIC = "*FREQUENCY,SOLVER=MATRIXSTORAGE\n2\n*END STEP", "*STATIC\n*CLOAD\n4,1,1.\n*END STEP"


@pytest.mark.parametrize(
    "steps",
    [
        (FIRST, "*STEP", MORE, STORED),
        (FIRST, "*STEP", NEW_SUPPORTS, STORED),
        (FIRST, "*STEP", NEW_SUPPORTS, MORE, STORED),
        (FIRST, "*STEP", MORE, NEW_SUPPORTS, STORED),
        (FIRST, NEW_SUPPORTS, "*STEP", STORED),
        (FIRST, "*STEP", STATIC, "*STEP", NEW_SUPPORTS, STORED),
        (FIRST, "*STEP", NEW_SUPPORTS, STATIC, "*STEP", MORE, STORED),
        (FIRST, "*STEP", STORED, "*STEP", NEW_SUPPORTS, STATIC),
        (f"*TRANSFORM,NSET=ALL\n{AXES}", FIRST, "*STEP", NEW_SUPPORTS, MORE, STORED),
    ],
)
def test_supports_are_those_of_the_step_with_the_matrices(steps, tmp_path):
    """CalculiX names the degrees of freedom that it keeps."""
    nodes = "".join(f"{n},{place}\n" for n, place in enumerate(CUBE.split(), 1))
    text = f"*NODE,NSET=ALL\n{nodes}*ELEMENT,TYPE=C3D8,ELSET=A\n1,1,2,3,4,5,6,7,8\n{SOLID}"
    (tmp_path / "job.inp").write_text("\n".join([text, *steps, ""]))
    subprocess.run(["ccx", "job"], cwd=tmp_path, check=True, capture_output=True, timeout=60)
    rows = [row.split(".") for row in (tmp_path / "job.dof").read_text().split()]
    kept = {(int(node), "xyz"[int(k) - 1]) for node, k in rows}
    mesh = fmu.read_mesh(tmp_path / "job.inp")
    supported = mesh.held | {one.dependent for one in mesh.equations}
    assert supported == {(node, d) for node in range(1, 9) for d in "xyz"} - kept
