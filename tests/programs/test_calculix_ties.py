"""Sensors at nodes that CalculiX ties (``*TIE``), whose rows its matrices lack: blocks of unlike meshes."""

import shutil
import subprocess

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.fem.modes.eigensolver import eigen
from fmu.formats.calculix_dat import read_displacements, read_frequencies

pytestmark = pytest.mark.skipif(shutil.which("ccx") is None, reason="needs CalculiX (ccx)")

EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]


def block(first, x, cells, kind):
    """Return nodes and elements of a beam's part from x[0] to x[1], with a section of 0.1 × 0.08 m."""
    steps = 2 * np.array(cells)
    index = {}
    nodes, elements = {}, []

    def node(i, j, k):
        if (i, j, k) not in index:
            index[i, j, k] = first + len(index)
            at = np.array([i, j, k]) / steps
            nodes[index[i, j, k]] = (x[0] + (x[1] - x[0]) * at[0], 0.1 * at[1], 0.08 * at[2])
        return index[i, j, k]

    for i in range(cells[0]):
        for j in range(cells[1]):
            for k in range(cells[2]):
                corners = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (0, 0, 2), (2, 0, 2), (2, 2, 2), (0, 2, 2)]
                places = np.array(corners) + 2 * np.array([i, j, k])
                if kind.startswith("C3D20"):
                    places = np.concatenate([places, [(places[a] + places[b]) // 2 for a, b in EDGES]])
                elements.append([node(*place.tolist()) for place in places])
    return nodes, elements


def deck(kind):
    """Return a beam of two tied parts, clamped at one end, whose tied meshes do not match."""
    one, its = block(1, (0.0, 0.3), (3, 2, 2), kind)
    other, others = block(2001, (0.3, 0.6), (3, 3, 1), kind)
    lines = ["*NODE,NSET=ALL"]
    lines += [f"{n},{x:.9g},{y:.9g},{z:.9g}" for n, (x, y, z) in {**one, **other}.items()]
    for name, first, elements in (("A", 1, its), ("B", 2001, others)):
        lines.append(f"*ELEMENT,TYPE={kind},ELSET={name}")
        for e, nodes in enumerate(elements, first):
            words = [str(n) for n in (e, *nodes)]
            lines += [",".join(words[:11]) + ("," if len(words) > 11 else "")]
            lines += [",".join(words[11:])] if len(words) > 11 else []
    clamped = [n for n, place in one.items() if place[0] == 0.0]
    slave = [n for n, place in other.items() if abs(place[0] - 0.3) < 1e-9]
    ends = [e for e, nodes in enumerate(its, 1) if max(one[n][0] for n in nodes) > 0.299]
    lines += [
        "*NSET,NSET=FIX",
        *(f"{n}," for n in clamped),
        "*SURFACE,NAME=S,TYPE=NODE",
        *(f"{n}," for n in slave),
    ]
    lines += ["*SURFACE,NAME=M", *(f"{e},S4" for e in ends), "*TIE,NAME=T", "S,M"]
    lines += ["*MATERIAL,NAME=ST", "*ELASTIC", "2.1e11,.3", "*DENSITY", "7850."]
    lines += [f"*SOLID SECTION,ELSET={name},MATERIAL=ST" for name in "AB"] + ["*BOUNDARY", "FIX,1,3", "*STEP"]
    return "\n".join(lines), slave


@pytest.fixture(params=["C3D8", "C3D20R"])
def tied(request, tmp_path):
    text, slave = deck(request.param)
    (tmp_path / "job.inp").write_text(f"{text}\n*FREQUENCY,SOLVER=MATRIXSTORAGE\n8\n*END STEP\n")
    (tmp_path / "modes.inp").write_text(f"{text}\n*FREQUENCY\n8\n*NODE PRINT,NSET=ALL\nU\n*END STEP\n")
    for name in ("job", "modes"):
        subprocess.run(["ccx", name], cwd=tmp_path, check=True, capture_output=True, timeout=120)
    return tmp_path, slave


def test_shapes_at_tied_nodes_are_those_that_calculix_prints(tied):
    folder, slave = tied
    read = fmu.read_model(folder / "job.sti", mesh=folder / "job.inp", tied_modes=folder / "modes.dat")
    assert not read.notes
    assert {node for node, _ in read.motions} == set(slave)
    assert not set(slave) & {node for node, _ in read.dofs}
    model = fmu.SeparableModel.from_terms(
        ["k"], [(read.stiffness, "k")], [read.mass], read.dofs, fmu.Geometry.of_mesh(read), read.motions
    )
    printed = read_frequencies(folder / "modes.dat")
    eigenvalues, phi = eigen(read.stiffness, read.mass, len(printed))
    assert_allclose(np.sqrt(eigenvalues) / (2 * np.pi), printed, rtol=1e-6)
    there = read_displacements(folder / "modes.dat", len(printed))
    sensors = [(node, d) for node in slave for d in "xyz"]
    ours = model.observation(sensors) @ phi
    theirs = np.array([there[node][:, "xyz".index(d)] for node, d in sensors])
    signs = np.sign(np.sum(ours * theirs, axis=0))
    assert_allclose(ours * signs, theirs, atol=2e-5 * np.abs(theirs).max())


def test_a_sensor_at_a_tied_node_in_a_problem_file(tied):
    folder, slave = tied
    (folder / "beam.toml").write_text(f"""
name = "tied beam"

[model]
type = "matrices"
mesh = "job.inp"
tied_modes = "modes.dat"
stiffness = [{{ file = "job.sti", powers = {{ k = 1 }} }}]
mass = [{{ file = "job.mas" }}]

[[parameters]]
name = "k"
start = 1.0
lower = 0.5
upper = 2.0

[measurement]
frequencies = [{read_frequencies(folder / "modes.dat")[0]:.3f}]
sd = 1.0
sensors = [[{slave[0]}, "y"], [{slave[-1]}, "z"]]
shapes = [[1.0, 0.2]]
""")
    problem = fmu.load(folder / "beam.toml", pairing="index")
    assert np.isfinite(problem.log_prob(problem.start))
