"""A folded shell as Ansys exports it: six degrees of freedom a node, drilling nearly without stiffness."""

import numpy as np
import scipy.sparse as sp

from tests.models.written import Planted, dense_frequencies, write_problem

CELLS, SIZE, E, NU, RHO = (10, 6), (0.5, 0.3), 7e10, 0.33, 2700.0
DRILLING = 1e-7
"""Stiffness of a drilling rotation, relative to that of bending at the node."""
TRUTH = {"web": 2.9e-3, "flange": 4.2e-3}
"""Thickness of the two plates, m."""
MODES, SD = 6, 3e-3
PRIOR = 'prior = { distribution = "normal", mean = 3.5e-3, sd = 5e-4 }'


def element(a, b):
    """Return membrane (8 × 8), bending and shear (12 × 12) stiffness of a quadrilateral of unit thickness."""
    at = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])

    def derivatives(s, t):
        N = 0.25 * (1 + at[:, 0] * s) * (1 + at[:, 1] * t)
        Nx = 0.25 * at[:, 0] * (1 + at[:, 1] * t) * 2 / a
        Ny = 0.25 * at[:, 1] * (1 + at[:, 0] * s) * 2 / b
        return N, Nx, Ny

    D = E / (1 - NU**2) * np.array([[1, NU, 0], [NU, 1, 0], [0, 0, 0.5 * (1 - NU)]])
    membrane, bending, shear = np.zeros((8, 8)), np.zeros((12, 12)), np.zeros((12, 12))
    g = 1 / np.sqrt(3)
    for s in (-g, g):
        for t in (-g, g):
            _, Nx, Ny = derivatives(s, t)
            B = np.zeros((3, 8))
            B[0, ::2], B[1, 1::2], B[2, ::2], B[2, 1::2] = Nx, Ny, Ny, Nx
            membrane += B.T @ D @ B * a * b / 4
            C = np.zeros((3, 12))  # w, rx, ry: u = z ry, v = −z rx
            C[0, 2::3], C[1, 1::3], C[2, 2::3], C[2, 1::3] = Nx, -Ny, Ny, -Nx
            bending += C.T @ D @ C * a * b / 4 / 12
    N, Nx, Ny = derivatives(0, 0)
    S = np.zeros((2, 12))
    S[0, ::3], S[0, 2::3], S[1, ::3], S[1, 1::3] = Nx, N, Ny, -N
    shear += S.T @ S * a * b * 5 / 6 * E / (2 * (1 + NU))
    return membrane, bending, shear


def plate(axes, nodes_of):
    """Return the terms t and t³ of K and that of M of a plate in axes (3, 3), as blocks of pairs of nodes."""
    (nx, ny), (a, b) = CELLS, np.array(SIZE) / CELLS
    membrane, bending, shear = element(a, b)
    thin, thick, mass = {}, {}, {}
    turn = np.kron(np.eye(2), axes)

    def add(into, block, dofs):
        for i, (p, d) in enumerate(dofs):
            for j, (q, e) in enumerate(dofs):
                into.setdefault((p, q), np.zeros((6, 6)))[d, e] += block[i, j]

    for i in range(nx):
        for j in range(ny):
            corner = [nodes_of[i, j], nodes_of[i + 1, j], nodes_of[i + 1, j + 1], nodes_of[i, j + 1]]
            in_plane = [(node, d) for node in corner for d in (0, 1)]
            across = [(node, d) for node in corner for d in (2, 3, 4)]
            add(thin, membrane, in_plane)
            add(thin, shear, across)
            add(thick, bending, across)
            drill = DRILLING * np.trace(bending) / 12 * np.eye(4)
            add(thick, drill, [(node, 5) for node in corner])
            for node in corner:
                m = RHO * a * b / 4
                block = np.zeros((6, 6))
                block[:3, :3] = m * np.eye(3)
                mass[node, node] = mass.get((node, node), 0.0) + block
    thin, thick = ({nodes: turn.T @ local @ turn for nodes, local in of.items()} for of in (thin, thick))
    return thin, thick, mass


def assembled(blocks, n):
    """Return blocks (6, 6) by pairs of nodes as a sparse matrix of n nodes."""
    pairs, values = np.array(list(blocks)), np.array(list(blocks.values()))
    rows, columns = np.broadcast_arrays(
        6 * pairs[:, 0, None, None] + np.arange(6)[:, None], 6 * pairs[:, 1, None, None] + np.arange(6)
    )
    whole = sp.csr_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=(6 * n, 6 * n))
    whole.eliminate_zeros()
    return whole


def matrices():
    """Return the terms of K and M, with powers of the two thicknesses, and the degrees of freedom."""
    nx, ny = CELLS
    web = {(i, j): i * (ny + 1) + j for i in range(nx + 1) for j in range(ny + 1)}
    n = len(web)
    flange = {(i, 0): web[i, ny] for i in range(nx + 1)}
    for i in range(nx + 1):
        for j in range(1, ny + 1):
            flange[i, j] = n
            n += 1
    upright = np.eye(3)
    folded = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=float)  # its y is the global z
    free = np.array(
        [6 * node + d for node in range(n) for d in range(6) if node not in {web[0, j] for j in range(ny + 1)}]
    )
    stiff, heavy = [], []
    for name, axes, nodes in (("web", upright, web), ("flange", folded, flange)):
        thin, thick, mass = (assembled(of, n)[free][:, free] for of in plate(axes, nodes))
        stiff += [(thin, {name: 1}), (thick, {name: 3})]
        heavy += [(mass, {name: 1})]
    names = ("x", "y", "z", "rx", "ry", "rz")
    return stiff, heavy, [(int(i) // 6, names[int(i) % 6]) for i in free]


def write(folder, prior=PRIOR, top='pairing = "index"'):
    """Write the problem, whose lowest modes are measured, and return it."""
    stiff, heavy, dofs = matrices()

    def total(terms, theta):
        return sum(np.prod([theta[p] ** power for p, power in powers.items()]) * A for A, powers in terms)

    def frequencies(theta):
        return dense_frequencies(total(stiff, theta), total(heavy, theta), MODES)

    measured = frequencies(TRUTH)
    path = write_problem(
        folder,
        "folded-shell",
        {"stiffness": stiff, "mass": heavy},
        dofs,
        TRUTH,
        dict.fromkeys(TRUTH, (1.5e-3, 6e-3)),
        measured,
        SD * measured,
        prior=prior,
        top=top,
        start=3.5e-3,
    )
    return Planted(path, TRUTH, frequencies)
