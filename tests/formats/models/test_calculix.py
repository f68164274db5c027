"""CalculiX is run, and its matrices have the frequencies and shapes that it finds itself."""

import shutil
import subprocess

import numpy as np
import pytest
from scipy.sparse.linalg import eigsh

import fmu

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
*NODE
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
*BOUNDARY
{held}
*STEP
*FREQUENCY{solver}
3
*NODE FILE, OUTPUT=2D
U
*END STEP
"""


def plate(solver=""):
    """A clamped plate of 8 × 4 shells of 0.1 m; node 1000 + 10 i + j."""
    nodes = [f"{1000 + 10 * i + j}, {0.1 * i}, {0.1 * j}, 0." for i in range(9) for j in range(5)]
    quads = [
        f"{4 * i + j + 1}, "
        + ", ".join(str(1000 + 10 * (i + a) + j + b) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)))
        for i in range(8)
        for j in range(4)
    ]
    held = [f"{1000 + 10 * i + j}, 1, 3" for i in (0, 1) for j in range(5)]
    return PLATE.format(nodes="\n".join(nodes), quads="\n".join(quads), held="\n".join(held), solver=solver)


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
