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
