"""A bracket of second-order solids with reduced integration (C3D20R), exported by CalculiX.

Two blocks of unlike meshes tied together (``*TIE``), a concentrated mass (``*MASS``) and a grounded spring
(``SPRING1``). Eight points of integration an element leave a fifth of the mass matrix without rank.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np

from tests.models.written import Planted

EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
NOMINAL = {"E foot": 7e10, "E arm": 2e11, "rho": 2700.0}
TRUTH = {"E foot": 7.4e10, "E arm": 1.9e11, "rho": 2750.0}
LARGE, SMALL = ((7, 5, 4), (7, 5, 4)), ((3, 2, 2), (3, 1, 3))
"""Elements of the two blocks: 4700 degrees of freedom, and 500."""
MODES, SD = 6, 2e-3


def block(first, x, cells):
    """Return nodes and elements of twenty nodes of a part from x[0] to x[1], with a section of 0.1 × 0.08 m."""
    steps, index, nodes, elements = 2 * np.array(cells), {}, {}, []

    def node(at):
        if at not in index:
            index[at] = first + len(index)
            part = np.array(at) / steps
            nodes[index[at]] = (x[0] + (x[1] - x[0]) * part[0], 0.1 * part[1], 0.08 * part[2])
        return index[at]

    corners = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (0, 0, 2), (2, 0, 2), (2, 2, 2), (0, 2, 2)]
    for cell in np.ndindex(*cells):
        places = np.array(corners) + 2 * np.array(cell)
        places = np.concatenate([places, [(places[a] + places[b]) // 2 for a, b in EDGES]])
        elements.append([node(tuple(place)) for place in places.tolist()])
    return nodes, elements


def deck(values, cells=LARGE, step="8"):
    """Return the deck with these values of the parameters; `step` follows ``*FREQUENCY``."""
    foot, its = block(1, (0.0, 0.3), cells[0])
    arm, others = block(5001, (0.3, 0.6), cells[1])
    nodes = {**foot, **arm}
    lines = ["*NODE,NSET=ALL", *(f"{n},{x:.9g},{y:.9g},{z:.9g}" for n, (x, y, z) in nodes.items())]
    for name, first, elements in (("FOOT", 1, its), ("ARM", 5001, others)):
        lines.append(f"*ELEMENT,TYPE=C3D20R,ELSET={name}")
        for number, of in enumerate(elements, first):
            words = [str(n) for n in (number, *of)]
            lines += [",".join(words[:11]) + ",", ",".join(words[11:])]
    clamped = [n for n, place in foot.items() if place[0] == 0.0]
    slave = [n for n, place in arm.items() if abs(place[0] - 0.3) < 1e-9]
    ends = [e for e, of in enumerate(its, 1) if max(foot[n][0] for n in of) > 0.299]
    tip = max(arm, key=lambda n: arm[n])
    middle = max((n for n in foot), key=lambda n: (abs(foot[n][0] - 0.15) < 0.03, foot[n][2], foot[n][1]))
    lines += ["*ELEMENT,TYPE=MASS,ELSET=LUMP", f"6001,{tip}", "*MASS,ELSET=LUMP", "0.8"]
    lines += ["*ELEMENT,TYPE=SPRING1,ELSET=GROUND", f"6002,{middle}"]
    lines += [
        "*NSET,NSET=FIX",
        *(f"{n}," for n in clamped),
        "*SURFACE,NAME=S,TYPE=NODE",
        *(f"{n}," for n in slave),
    ]
    lines += ["*SURFACE,NAME=M", *(f"{e},S4" for e in ends), "*TIE,NAME=T", "S,M"]
    for name, E in (("FOOT", values["E foot"]), ("ARM", values["E arm"])):
        lines += [f"*MATERIAL,NAME=OF{name}", "*ELASTIC", f"{E!r},.3", "*DENSITY", repr(values["rho"])]
        lines += [f"*SOLID SECTION,ELSET={name},MATERIAL=OF{name}"]
    lines += ["*SPRING,ELSET=GROUND", "2,", "4.e7,"]
    lines += ["*BOUNDARY", "FIX,1,3", "*STEP", f"*FREQUENCY{step}", "*END STEP"]
    return "\n".join(lines) + "\n"


def run(folder, name, text):
    """Run CalculiX on a deck and return the path of its files without suffix."""
    folder = Path(folder)
    (folder / f"{name}.inp").write_text(text)
    subprocess.run(["ccx", name], cwd=folder, check=True, capture_output=True, timeout=300)
    return folder / name


def own_frequencies(folder, values, cells=LARGE, count=MODES):
    """Return the frequencies that CalculiX computes itself, Hz; it prints eight digits of the eigenvalues."""
    from fmu.formats.calculix_dat import read_frequencies

    path = run(folder, "own", deck(values, cells, f"\n{count + 2}")).with_suffix(".dat")
    return np.asarray(read_frequencies(path)[:count])


def write(folder, cells=LARGE):
    """Export the matrices, write the problem with frequencies of the truth by CalculiX itself, and return it."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    changed = {"nominal": {}, "foot": {"E foot": 9e10}, "arm": {"E arm": 2.5e11}, "rho": {"rho": 3200.0}}
    changed["all"] = {"E foot": 6e10, "E arm": 2.2e11, "rho": 2500.0}
    text = ['name = "bracket"', 'pairing = "index"', "[model]", 'type = "exports"']
    for name, values in changed.items():
        path = run(folder, name, deck(NOMINAL | values, cells, ",SOLVER=MATRIXSTORAGE\n8"))
        given = NOMINAL if name == "nominal" else values
        row = ", ".join(f'"{key}" = {value!r}' for key, value in given.items())
        check = "check = true" if name == "all" else ""
        text += ["[[model.exports]]", f'stiffness = "{path.name}.sti"', f"values = {{{row}}}", check]
    measured = own_frequencies(folder, TRUTH, cells)
    text += ["[measurement]", f"frequencies = {measured.tolist()}", f"sd = {(SD * measured).tolist()}"]
    for key, value in NOMINAL.items():
        text += ["[[parameters]]", f'name = "{key}"', 'unit = "1"', f"start = {value!r}"]
        text += [f"lower = {0.7 * value!r}", f"upper = {1.3 * value!r}"]
        text += [f'prior = {{ distribution = "normal", mean = {value!r}, sd = {0.05 * value!r} }}']
    path = folder / "bracket.toml"
    path.write_text("\n".join(text) + "\n")
    return Planted(path, TRUTH, lambda theta: own_frequencies(folder, theta, cells))
