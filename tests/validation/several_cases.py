"""The cases shear-4dof-repeated and shear-12dof-damage: simulated tests of buildings, several of each.

    python -m tests.validation.several_cases fmu/cases

Their files say what was simulated, and the truth.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.linalg import eigh

from fmu.fem.modes.modal import fix_sign
from fmu.types import FloatArray
from tests.matrix_files import write_matrix

REPEATED, DAMAGE = "shear-4dof-repeated", "shear-12dof-damage"
SEED = 1906

N_TESTS, STOREYS = 30, 4
MEANS, SPREAD, NOISE = np.array([1.0, 0.93, 1.04, 0.98]), 0.04, 0.005
STIFFNESS, MASS = 2e6, 1000.0

FRAMES = ("x", "west", "east")
GROUPS = tuple(f"{frame} {storey}" for storey in range(1, STOREYS + 1) for frame in FRAMES)
OF_FRAMES = {"x": 100e6, "west": 35e6, "east": 35e6}
FLOORS = np.array([3500.0, 2700.0, 2700.0, 1800.0])
HALF = 2.5
HEIGHT = 3.0
"""Of a storey in the pictures, m."""
MODES, SD_FREQUENCY, SD_SHAPE = 8, 0.005, 0.01
PATTERNS: dict[str, dict[str, float]] = {
    "reference": {},
    "pattern 1": {"west 1": 0.18},
    "pattern 2": {"west 1": 0.18, "x 3": 0.15},
}
SIGNS = {"reference 1": "+++-----", "reference 2": "+++-----", "one": "--+-++-+", "two": "-+--+-+-"}
"""The sign of every shape that the noise was added to: that of its largest component."""
TESTS = (("reference 1", "reference"), ("reference 2", "reference"), ("one", "pattern 1"), ("two", "pattern 2"))


def chain(storey: int, n: int = STOREYS) -> FloatArray:
    """Return the drift of a storey, from 1, as a linear form in the displacements of the floors."""
    drift = np.zeros(n)
    drift[storey - 1] = 1.0
    if storey > 1:
        drift[storey - 2] = -1.0
    return drift


def repeated() -> tuple[FloatArray, FloatArray]:
    """Return the factors of the stiffnesses in every test, (30, 4), and the measured frequencies, Hz."""
    rng = np.random.default_rng(SEED)
    values = MEANS + SPREAD * rng.standard_normal((N_TESTS, STOREYS))
    found = []
    for factors in values:
        K = sum(k * STIFFNESS * np.outer(chain(s), chain(s)) for s, k in enumerate(factors, 1))
        found.append(np.sqrt(eigh(K, MASS * np.eye(STOREYS), eigvals_only=True)) / (2 * np.pi))
    f = np.array(found)
    return values, f / (1.0 + NOISE * rng.standard_normal(f.shape))


def stiffness(group: str) -> FloatArray:
    """Return the matrix of a frame in a storey; displacements of a floor: x, y of the west and of the east side.

    There are two frames in the direction x, north and south, with one parameter.
    """
    frame, storey = group.split()
    drift = chain(int(storey))
    turn = np.array([0.0, -0.5 / HALF, 0.5 / HALF])  # the rotation of a floor
    sides = {"west": [[0.0, 1.0, 0.0]], "east": [[0.0, 0.0, 1.0]]}
    sides["x"] = [[1.0, 0.0, 0.0] + sign * HALF * turn for sign in (-1.0, 1.0)]
    each = OF_FRAMES[frame] / len(sides[frame])
    return sum(each * np.outer(np.kron(drift, side), np.kron(drift, side)) for side in sides[frame])


def mass() -> FloatArray:
    """Return the mass matrix of rigid square floors."""
    M = np.zeros((12, 12))
    for floor, m in enumerate(FLOORS):
        y, turn = np.array([0.0, 0.5, 0.5]), np.array([0.0, -0.5 / HALF, 0.5 / HALF])
        x, inertia = np.array([1.0, 0.0, 0.0]), m * (2.0 * HALF) ** 2 / 6.0
        of_floor = slice(3 * floor, 3 * floor + 3)
        M[of_floor, of_floor] = m * (np.outer(x, x) + np.outer(y, y)) + inertia * np.outer(turn, turn)
    return M


def damaged() -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return frequencies, Hz, and shapes (12, 8) of every test."""
    rng, found = np.random.default_rng(SEED), {}
    truth = 1.0 + 0.08 * rng.standard_normal(len(GROUPS))
    for name, state in TESTS:
        left = truth * (1.0 - np.array([PATTERNS[state].get(group, 0.0) for group in GROUPS]))
        K = sum(k * stiffness(group) for k, group in zip(left, GROUPS, strict=True))
        values, shapes = eigh(K, mass())
        f = np.sqrt(values[:MODES]) / (2 * np.pi) / (1.0 + SD_FREQUENCY * rng.standard_normal(MODES))
        shapes = fix_sign(shapes[:, :MODES]) / np.linalg.norm(shapes[:, :MODES], axis=0)
        shapes *= [float(f"{sign}1") for sign in SIGNS[name]]
        shapes = shapes + SD_SHAPE * rng.standard_normal(shapes.shape)
        found[name] = f, shapes / np.abs(shapes).max(axis=0)
    return found


def write(folder: Path) -> None:
    """Write both problem files, and the matrices that they name."""
    for name, text in ((REPEATED, repeated_text()), (DAMAGE, damage_text())):
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    own = folder / DAMAGE
    own.mkdir(exist_ok=True)
    write_matrix(own / "mass.mtx", mass())
    for group in GROUPS:
        write_matrix(own / f"{group.replace(' ', '-')}.mtx", stiffness(group))


def repeated_text() -> str:
    """Return the problem file of shear-4dof-repeated."""
    storeys = "".join(
        STOREY.format(
            s=s,
            rows=",\n".join(f"    [{', '.join(map(_typed, row))}]" for row in STIFFNESS * np.outer(drift, drift)),
        )
        for s, drift in ((s, chain(s)) for s in range(1, STOREYS + 1))
    )
    tests = "".join(
        f'\n[[tests]]\nname = "{t}"\nfrequencies = [{_row(f, 4)}]\n' for t, f in enumerate(repeated()[1], 1)
    )
    return REPEATED_HEAD + storeys + REPEATED_MASS + tests


def damage_text() -> str:
    """Return the problem file of shear-12dof-damage."""
    places = [(f"floor {floor}", side) for floor in range(1, STOREYS + 1) for side in ("", " west", " east")]
    dofs = [[f"{floor}{side}", "y" if side else "x"] for floor, side in places]
    terms = "".join(TERM.format(group=group, file=group.replace(" ", "-")) for group in GROUPS)
    parameters = "".join(FACTOR.format(group=group) for group in GROUPS)
    tests = ""
    for (name, state), (f, shapes) in zip(TESTS, damaged().values(), strict=True):
        rows = "\n".join(f"    [{_row(shape, 3)}]," for shape in shapes.T)
        tests += TEST.format(name=name, state=state, f=_row(f, 4), rows=rows, sensors=_lines(dofs))
    return DAMAGE_HEAD.format(dofs=_lines(dofs)) + terms + DAMAGE_MASS + drawn_text() + tests + parameters


def drawn_text() -> str:
    """Return points and lines of the pictures: floors, corner columns, and a brace for each frame of a storey."""
    corners = {"sw": (-HALF, -HALF), "se": (HALF, -HALF), "ne": (HALF, HALF), "nw": (-HALF, HALF)}
    sides = {"": (0.0, 0.0), " west": (-HALF, 0.0), " east": (HALF, 0.0)}
    points, lines = [], []
    for floor in range(STOREYS + 1):
        places = {f"{floor} {corner}": at for corner, at in corners.items()}
        places |= {f"floor {floor}{side}": at for side, at in sides.items()} if floor else {}
        points += [f'"{name}" = [{x}, {y}, {floor * HEIGHT}]' for name, (x, y) in places.items()]
    names = list(corners)
    for floor in range(1, STOREYS + 1):
        for k, (a, b, frame) in enumerate(
            zip(names, names[1:] + names[:1], ("x", "east", "x", "west"), strict=True)
        ):
            lines += [LINE.format(f"{floor} {a}", f"{floor} {b}"), LINE.format(f"{floor - 1} {a}", f"{floor} {a}")]
            a, b = (a, b) if k < 2 else (b, a)  # braces of opposite faces are parallel
            lines.append(LINE.format(f"{floor - 1} {a}", f"{floor} {b}") + BRACE.format(f"{frame} {floor}"))
    return "\n[model.points]\n" + "\n".join(points) + "\n" + "".join(lines)


def _row(values: FloatArray, places: int) -> str:
    return ", ".join(f"{x:.{places}f}" for x in values)


def _typed(x: float) -> str:
    return f"{x / 1e6:.1f}e6" if x else "0.0"


def _lines(pairs: Sequence[Sequence[str]]) -> str:
    """Return pairs of strings in TOML, three in a line."""
    each = [f'["{place}", "{direction}"],' for place, direction in pairs]
    return "\n".join("    " + " ".join(each[i : i + 3]) for i in range(0, len(each), 3))


REPEATED_HEAD = """\
# Thirty tests of a shear building of four storeys, simulated: the structure itself varies from test to test, as
# joints, temperature and load do that nobody recorded.
#
# In test t the stiffness of storey s is k_s 2 MN/m under floors of 1 t, with k_s drawn anew from a normal
# distribution: means 1.00, 0.93, 1.04, 0.98, standard deviation 0.04 each, independent. The errors of the
# frequencies are 0.5 %. Written by tests/validation/several_cases.py.
#
# Four frequencies of one test are met by two other buildings too, (1.7, 0.6, 1.3, 0.7) one of them. The priors of
# the means say that the drawings are right to some 10 %, which leaves one.

name = "shear-4dof-repeated"
description = "thirty tests of four storeys that vary from test to test (simulated): their means and scatter"
pairing = "index"

[[error]]
of = "frequencies"
kind = "relative"
sd = 0.005

[model]
type = "matrices"
dofs = [["floor 1", "x"], ["floor 2", "x"], ["floor 3", "x"], ["floor 4", "x"]]
"""
STOREY = """
[[model.stiffness]]
matrix = [
{rows}
]
powers = {{ k{s} = 1 }}

[[parameters]]
name = "k{s}"
start = 1.0
lower = 0.6
upper = 1.4
prior = {{ distribution = "normal", mean = 1.0, sd = 0.1 }}
varies = "population"
"""
REPEATED_MASS = """
[[model.mass]]
matrix = [
    [1000.0, 0.0, 0.0, 0.0],
    [0.0, 1000.0, 0.0, 0.0],
    [0.0, 0.0, 1000.0, 0.0],
    [0.0, 0.0, 0.0, 1000.0]
]
"""
DAMAGE_HEAD = """\
# Four tests of a building of four storeys and two bays in each direction, simulated: two of it as it was built,
# and one of each of two damage patterns. It is a shear form in the manner of the IASC-ASCE benchmark structure
# (Johnson, Lam, Katafygiotis & Beck 2004, J. Eng. Mech. 130(1), 3-15) with round numbers: rigid floors of
# 5 m x 5 m move in x and y and turn.
#
# In each storey one parameter is a factor on the stiffness of the frames in x, 100 MN/m, and one on each of the
# frames in y, west and east, 35 MN/m each. Pattern 1: the west frame of storey 1 has lost 18 %. Pattern 2: the
# frames in x of storey 3 have lost 15 % besides. Errors: 0.5 % of the frequencies, 0.01 in the components of
# shapes of unit length. Points and lines are for the pictures: a brace stands for a frame of a storey. Written by
# tests/validation/several_cases.py.

name = "shear-12dof-damage"
description = "a storey frame before and after damage (simulated): which of twelve groups has lost how much"
reference = "reference"

[[error]]
of = "frequencies"
kind = "relative"
sd = 0.005

[[error]]
of = "shapes"
sd = 0.01

[model]
type = "matrices"
dofs = [
{dofs}
]
"""
TERM = """
[[model.stiffness]]
file = "shear-12dof-damage/{file}.mtx"
powers = {{ "{group}" = 1 }}
"""
DAMAGE_MASS = """
[[model.mass]]
file = "shear-12dof-damage/mass.mtx"
"""
LINE = """
[[model.lines]]
points = ["{}", "{}"]
"""
BRACE = """\
parameters = ["{}"]
"""
TEST = """
[[tests]]
name = "{name}"
group = "{state}"
frequencies = [{f}]
sensors = [
{sensors}
]
shapes = [
{rows}
]
"""
FACTOR = """
[[parameters]]
name = "{group}"
start = 1.0
lower = 0.4
upper = 1.6
prior = {{ distribution = "normal", mean = 1.0, sd = 0.2 }}
varies = "damage"
"""


if __name__ == "__main__":
    write(Path(sys.argv[1]))
