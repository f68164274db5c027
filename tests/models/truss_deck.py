"""A footbridge: a truss deck with masses at its nodes, rotations without any, and 17 groups of members.

As in studies of damage, a parameter is the relative change of a group's stiffness, K = K₀ + Σ_g θ_g K_g. Its
bounds are −1, where the group is gone, and 10.
"""

import numpy as np
import scipy.sparse as sp

from fmu.fem.frame.components import ElementGroup, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.frame.updates import Factor
from tests.models.written import Planted, dense_frequencies, write_problem

BAYS, LENGTH, WIDTH, HEIGHT = 40, 60.0, 3.0, 1.8
STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)
CHORD, BRACE = Section(6e-3, 1e-5, 1e-5, 2e-6), Section(2e-3, 2e-6, 2e-6, 1e-6)
CROSS = Section(3e-3, 6e-6, 6e-6, 2e-6)
MODES, SD = 8, 5e-3
TRUTH = {f"change {g}": c for g, c in enumerate([0.1, -0.15, 0.0, 0.1, -0.1, 0.05, 0.12, -0.2, *[0.0] * 9], 1)}
PRIOR = 'prior = { distribution = "normal", mean = 0.0, sd = 0.3 }'


def deck():
    """Return nodes (n, 3) and, for each of the 17 groups, its members (n, 2) and section."""
    x = np.linspace(0.0, LENGTH, BAYS + 1)
    tops = x[1:-2] + 0.5 * LENGTH / BAYS
    sides = [(x, 0.0, 0.0), (x, WIDTH, 0.0), (tops, 0.0, HEIGHT), (tops, WIDTH, HEIGHT)]
    lines = [np.stack([at, np.full_like(at, y), np.full_like(at, z)], axis=1) for at, y, z in sides]
    nodes = np.concatenate(lines)
    first = np.cumsum([0] + [len(at) for at, _, _ in sides])
    line = [np.arange(first[i], first[i + 1]) for i in range(4)]
    chords = [np.stack([of[:-1], of[1:]], axis=1) for of in line]
    members = []
    for one, other in ((0, 1), (2, 3)):
        for side in (one, other):
            members += [(part, CHORD) for part in np.array_split(chords[side], 2)]
    for low, high in ((0, 2), (1, 3)):
        m = len(line[high])
        falling = np.stack([line[low][1 : m + 1], line[high]], axis=1)
        rising = np.stack([line[low][2 : m + 2], line[high]], axis=1)
        members += [(part, BRACE) for part in (*np.array_split(falling, 2), *np.array_split(rising, 1))]
    floor = np.stack([line[0], line[1]], axis=1)
    roof = np.stack([line[2], line[3]], axis=1)
    lateral = np.stack([line[0][:-1], line[1][1:]], axis=1)
    members += [(floor, CROSS), (roof, CROSS), (lateral, BRACE)]
    return nodes, members


def matrices():
    """Return K of every group, M and the degrees of freedom: 941, of which 474 have no mass."""
    nodes, members = deck()
    groups = [ElementGroup(str(g), *of, STEEL, (0.02, 0.3, 1.0)) for g, of in enumerate(members)]
    ends = {0: ("x", "y", "z"), BAYS: ("y", "z"), BAYS + 1: ("z",), 2 * BAYS + 1: ("z",)}
    frame = Frame(nodes, groups, ends)
    model = frame.separable({str(g): Factor([("E", str(g))]) for g in range(len(groups))})
    of_group = [None] * len(groups)
    for term in model.K_terms:
        of_group[int(np.flatnonzero(term.powers)[0])] = term.matrix
    heavy = np.array([direction in "xyz" for _, direction in model.dofs], dtype=float)
    floor = np.array([nodes[node, 2] == 0.0 for node, _ in model.dofs])
    return of_group, sp.diags_array(heavy * np.where(floor, 350.0, 120.0)).tocsr(), model.dofs


def write(folder, prior=PRIOR, top='pairing = "index"'):
    """Write the problem, whose lowest modes are measured, and return it."""
    of_group, M, dofs = matrices()
    nominal = sum(of_group)

    def frequencies(theta):
        changed = sum(c * K for c, K in zip(theta.values(), of_group, strict=True))
        return dense_frequencies(nominal + changed, M, MODES)

    measured = frequencies(TRUTH)
    terms = [(nominal, {})] + [(K, {name: 1}) for name, K in zip(TRUTH, of_group, strict=True)]
    path = write_problem(
        folder,
        "truss-deck",
        {"stiffness": terms, "mass": [(M, {})]},
        dofs,
        TRUTH,
        dict.fromkeys(TRUTH, (-1.0, 10.0)),
        measured,
        SD * measured,
        prior=prior,
        top=top,
        start=0.0,
    )
    return Planted(path, TRUTH, frequencies)
