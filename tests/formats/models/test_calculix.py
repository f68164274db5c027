"""CalculiX is run, and its matrices have the frequencies and shapes that it finds itself."""

import shutil
import subprocess
from functools import partial

import numpy as np
import pytest
from scipy.sparse.linalg import eigsh

import fmu
from fmu.fem.modes.static import uniform_motion
from fmu.formats.calculix_dat import read_displacements
from fmu.formats.matrices.calculix import _apart, _Expansion

COLUMN = """\
** a column of four bricks
*NODE, NSET=ALL
{nodes}
*ELEMENT, TYPE=C3D8, ELSET=BRICKS
{bricks}
*MATERIAL, NAME=STEEL
*ELASTIC
2.1e11, 0.3
*DENSITY
7850.
*SOLID SECTION, ELSET=BRICKS, MATERIAL=STEEL
*BOUNDARY
101, 1, 3
102, 1, 3
103, 1, 3
104, 1, 3
*STEP
*FREQUENCY{solver}
6
*NODE PRINT, NSET=ALL
U
*END STEP
"""


def column(solver=""):
    """A deck of bricks of 0.3 × 0.4 × 0.5 m; node 100 k + 1 … 100 k + 4 at the height of floor k."""
    corners = [(0.0, 0.0), (0.3, 0.0), (0.3, 0.4), (0.0, 0.4)]
    nodes = [
        f"{100 * k + i}, {x}, {y}, {0.5 * (k - 1)}" for k in range(1, 6) for i, (x, y) in enumerate(corners, 1)
    ]
    bricks = [
        ", ".join(map(str, [k, *(100 * k + i for i in (1, 2, 3, 4)), *(100 * (k + 1) + i for i in (1, 2, 3, 4))]))
        for k in range(1, 5)
    ]
    return COLUMN.format(nodes="\n".join(nodes), bricks="\n".join(bricks), solver=solver)


def run(folder, name, deck):
    """Run CalculiX on a deck, and return the path of its files without suffix."""
    if shutil.which("ccx") is None:
        pytest.skip("CalculiX (ccx) is not installed")
    (folder / f"{name}.inp").write_text(deck)
    done = subprocess.run(["ccx", name], cwd=folder, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout[-500:]
    return folder / name


def frequencies(model, count):
    return np.sqrt(eigsh(model.stiffness, count, model.mass, sigma=0.0)[0]) / (2.0 * np.pi)


def own(path, count):
    """The eigenvalues that CalculiX prints, as frequencies in Hz."""
    lines = [line.split() for line in path.with_suffix(".dat").read_text().splitlines()]
    rows = [line for line in lines if len(line) == 5 and line[0].isdecimal()]
    return np.sqrt([float(row[1]) for row in rows[:count]]) / (2.0 * np.pi)


def test_frequencies_of_its_matrices_are_its_own(tmp_path):
    stored = run(tmp_path, "stored", column(", SOLVER=MATRIXSTORAGE"))
    solved = run(tmp_path, "solved", column())
    model = fmu.read_model(stored.with_suffix(".sti"), mesh=stored.with_suffix(".inp"))
    assert model.dofs[0] == (201, "x")
    assert len(model.dofs) == 48
    assert model.nodes.tolist() == [100 * k + i for k in range(1, 6) for i in range(1, 5)]
    assert model.kinds == ("hexahedron",) * 4
    np.testing.assert_allclose(frequencies(model, 6), own(solved, 6), rtol=1e-6)  # it prints 7 digits


PLATE = """\
*NODE, NSET=ALL
{nodes}
*ELEMENT, TYPE=S4, ELSET=PLATE
{quads}
*MATERIAL, NAME=STEEL
*ELASTIC
2.1e11, 0.3
*DENSITY
7850.
*SHELL SECTION, ELSET=PLATE, MATERIAL=STEEL
0.02
{more}
*BOUNDARY
{held}
*STEP
*FREQUENCY{solver}
3
*NODE FILE, OUTPUT=2D
U
*NODE PRINT, NSET=ALL
U
*END STEP
"""


def plate(solver="", more="**"):
    """A clamped plate of 8 × 4 shells of 0.1 m; node 1000 + 10 i + j."""
    nodes = [f"{1000 + 10 * i + j}, {0.1 * i}, {0.1 * j}, 0." for i in range(9) for j in range(5)]
    quads = [
        f"{4 * i + j + 1}, "
        + ", ".join(str(1000 + 10 * (i + a) + j + b) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)))
        for i in range(8)
        for j in range(4)
    ]
    held = [f"{1000 + 10 * i + j}, 1, 3" for i in (0, 1) for j in range(5)]
    return PLATE.format(
        nodes="\n".join(nodes), quads="\n".join(quads), held="\n".join(held), solver=solver, more=more
    )


def own_shapes(path):
    """The displacements of the nodes in each mode that CalculiX writes, {node: (x, y, z)} a mode."""
    modes, reading = [], False
    for line in path.with_suffix(".frd").read_text().splitlines():
        if line.startswith(" -4  DISP"):
            modes.append({})
            reading = True
        elif line.startswith(" -3"):
            reading = False
        elif reading and line.startswith(" -1"):
            modes[-1][int(line[3:13])] = [float(line[13 + 12 * k : 25 + 12 * k]) for k in range(3)]
    return modes


def test_shells_move_as_the_mean_of_the_solids_that_they_become(tmp_path):
    stored = run(tmp_path, "stored", plate(", SOLVER=MATRIXSTORAGE"))
    solved = run(tmp_path, "solved", plate())
    model = fmu.read_model(stored.with_suffix(".sti"), mesh=stored.with_suffix(".inp"))
    assert len(set(model.dofs)) == len(model.dofs)
    assert model.motions[1084, "z"] != {}
    assert (1000, "z") not in model.motions
    structure = fmu.SeparableModel.from_terms(
        ["E"], [(model.stiffness, "E")], [model.mass], model.dofs, fmu.Geometry.of_mesh(model), model.motions
    )
    modes = own_shapes(solved)
    sensors = [(node, d) for node in modes[0] for d in "xyz" if structure.sees((node, d))]
    assert {node for node, _ in sensors} == {1000 + 10 * i + j for i in range(2, 9) for j in range(5)}
    squares, shapes = eigsh(model.stiffness, 3, model.mass, sigma=0.0)
    np.testing.assert_allclose(np.sqrt(squares) / (2.0 * np.pi), own(solved, 3), rtol=1e-6)
    for k, mode in enumerate(modes):
        found = structure.observation(sensors) @ shapes[:, k]
        wanted = np.array([mode[node]["xyz".index(d)] for node, d in sensors])
        scale = found @ wanted / (found @ found)
        assert np.max(abs(scale * found - wanted)) <= 5e-6 * np.max(abs(wanted))  # it prints 6 digits


def test_own_rows_stand_apart_from_those_of_copies():
    """Node 5 has own rows, node 6 one in x; of node 4 it is not certain, as its rows may adjoin the copies."""
    rows = [(5, "x"), (5, "y"), (6, "x"), *2 * [(4, "x"), (4, "y")], (5, "x"), (5, "y"), (6, "x"), *2 * [(6, "y")]]
    dofs, motions, if_loaded = _apart(rows, _Expansion({4: 2, 5: 2, 6: 2}, set()))
    seen = {name: {dofs.index(row): weight for row, weight in of.items()} for name, of in motions.items()}
    assert seen == {
        (5, "x"): {0: 1.0, 7: 0.0}, (5, "y"): {1: 1.0, 8: 0.0}, (6, "x"): {2: 1.0, 9: 0.0},
        (4, "x"): {3: 0.5, 5: 0.5}, (4, "y"): {4: 0.5, 6: 0.5}, (6, "y"): {10: 0.5, 11: 0.5},
    }  # fmt: skip
    assert _apart(3 * [(7, "z")], _Expansion({7: 3}, set()))[1] == {
        (7, "z"): {(8, "z"): 1 / 6, (9, "z"): 2 / 3, (10, "z"): 1 / 6}  # a corner of a quadratic shell
    }
    own = [(6, "z"), (7, "z"), (9, "z"), (7, "z"), (7, "z")]
    assert _apart(own, _Expansion({7: 3}, set()))[1] == {
        (7, "z"): {(10, "z"): 1 / 3, (11, "z"): 2 / 3, (12, "z"): 0.0}  # the own row is the mean of the faces
    }
    assert if_loaded == {(4, d): {dofs[i]: 1.0, dofs[i + 2]: 0.0} for d, i in (("x", 3), ("y", 4))}


MASS = "*ELEMENT, TYPE=MASS, ELSET=M\n100, {}\n*MASS, ELSET=M\n5."
SPRING = "*ELEMENT, TYPE=SPRING1, ELSET=G\n101, {}\n*SPRING, ELSET=G\n2\n1.e7"
BEAM = """\
*NODE, NSET=ALL
1, 0., 0., 0.
2, .2, 0., 0.
3, .4, 0., 0.
4, .6, 0., 0.
*ELEMENT, TYPE=B31, ELSET=B
1, 1, 2
2, 2, 3
3, 3, 4
*BEAM SECTION, ELSET=B, MATERIAL=S, SECTION=RECT
.1, .15
0., 0., -1.
*MATERIAL, NAME=S
*ELASTIC
2.1e11, .3
*DENSITY
7850.
*BOUNDARY
{end}, 1, 6
{more}
*STEP
*FREQUENCY{solver}
3
*NODE PRINT, NSET=ALL
U
*END STEP
"""


QUADRATIC = BEAM.replace("TYPE=B31", "TYPE=B32R").replace("1, 1, 2\n2, 2, 3\n3, 3, 4", "1, 1, 2, 3\n2, 3, 4, 5")
QUADRATIC = QUADRATIC.replace("*ELEMENT", "5, .8, 0., 0.\n*ELEMENT", 1)


def quadratic(solver="", more="**"):
    return QUADRATIC.format(solver=solver, more=more, end=1)


def thick(kind, solver="", more="**"):
    """The same clamped plate, 80 mm thick, of 4 × 2 quadratic squares or 4 × 4 triangles."""
    squares = ((0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1))
    triangles = (
        ((0, 0), (2, 0), (2, 2), (1, 0), (2, 1), (1, 1)),
        ((0, 0), (2, 2), (0, 2), (1, 1), (1, 2), (0, 1)),
    )
    faces = [
        ", ".join(str(1000 + 10 * (i + a) + j + b) for a, b in around)
        for i in range(0, 8, 2)
        for j in (0, 2)
        for around in (triangles if kind == "S6" else [squares])
    ]
    head, _, after = plate(solver, more).partition("TYPE=S4, ELSET=PLATE\n")
    rest = after[after.index("*MATERIAL") :].replace("PLATE, MATERIAL=STEEL\n0.02", "PLATE, MATERIAL=STEEL\n0.08")
    numbered = "\n".join(f"{k}, {face}" for k, face in enumerate(faces, 1))
    return f"{head}TYPE={kind}, ELSET=PLATE\n{numbered}\n{rest}"


def beam(solver="", more="**", end=1):
    return BEAM.format(solver=solver, more=more, end=end)


@pytest.mark.parametrize(
    ("deck", "more", "added"),
    [
        (plate, f"{MASS.format(1084)}\n{SPRING.format(1052)}", 5.0),
        (plate, MASS.format(1020), 5.0),
        (plate, "*NODE, NSET=ALL\n2000, .9, .2, 0.\n*EQUATION\n2\n2000, 1, 1., 1020, 1, -1.", 0.0),
        (partial(beam, end=4), "*NODE, NSET=ALL\n2000, .9, .2, 0.\n*EQUATION\n2\n2000, 1, 1., 1, 1, -1.", 0.0),
        (partial(beam, end=4), MASS.format(1), 5.0),  # its own rows adjoin those of its copies
        (quadratic, "**", 0.0),
        (quadratic, MASS.format(5), 5.0),
        (partial(thick, "S8"), "**", 0.0),
        (partial(thick, "S8R"), MASS.format(1080), 5.0),
        (partial(thick, "S6"), "**", 0.0),
        (beam, f"{MASS.format(4)}\n{SPRING.format(2)}", 5.0),
    ],
)  # fmt: skip
def test_a_node_that_carries_a_mass_or_a_spring_has_rows_of_its_own(tmp_path, deck, more, added):
    solved = run(tmp_path, "solved", deck(more=more))
    weighed = []
    for name, here in (("bare", "**"), ("stored", more)):
        stored = run(tmp_path, name, deck(", SOLVER=MATRIXSTORAGE", here))
        model = fmu.read_model(stored.with_suffix(".sti"), mesh=stored.with_suffix(".inp"))
        structure = fmu.SeparableModel.from_terms(
            ["E"], [(model.stiffness, "E")], [model.mass], model.dofs, fmu.Geometry.of_mesh(model), model.motions
        )
        rigid = [uniform_motion(structure, d) for d in "xyz"]
        weighed.append([motion @ (model.mass @ motion) for motion in rigid])
    np.testing.assert_allclose(np.subtract(*weighed[::-1]), added, atol=1e-9)
    modes = read_displacements(solved.with_suffix(".dat"), 3)
    sensors = [(node, d) for node in modes for d in "xyz" if structure.sees((node, d))]
    assert len(sensors) >= 6
    shapes = structure.observation(sensors) @ eigsh(model.stiffness, 3, model.mass, sigma=0.0)[1]
    theirs = np.array([modes[node][:, "xyz".index(d)] for node, d in sensors])
    shapes *= np.sign(np.sum(shapes * theirs, axis=0))
    np.testing.assert_allclose(shapes, theirs, atol=1e-5 * np.abs(theirs).max())
