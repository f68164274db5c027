"""A tower of rigid floors: a storey's nodes follow one node in x, y and rz, u = T q, as with `rigidDiaphragm`."""

import numpy as np
import scipy.sparse as sp

from fmu.fem.frame.components import ElementGroup, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.frame.updates import Factor
from tests.models.written import Planted, dense_frequencies, write_problem

STOREYS, COLUMNS, BAY, HEIGHT = 12, (4, 3), 6.0, 3.2
CONCRETE = Material(E=3.2e10, nu=0.2, rho=2400.0)
COLUMN, BEAM = Section(0.16, 2.1e-3, 2.1e-3, 3.6e-3), Section(0.12, 1.6e-3, 0.9e-3, 1.5e-3)
TRUTH = {"lower columns": 0.9, "upper columns": 1.1, "beams": 0.8}
MODES, SD = 6, 5e-3
PRIOR = 'prior = { distribution = "normal", mean = 1.0, sd = 0.2 }'


def matrices():
    """Return K of each group of members, M and the degrees of freedom of the floors and nodes."""
    x, y = (BAY * np.arange(m) for m in COLUMNS)
    plan = np.array([(a, b) for a in x for b in y])
    nodes = np.concatenate([np.column_stack([plan, np.full(len(plan), HEIGHT * s)]) for s in range(STOREYS + 1)])
    n, (nx, ny) = len(plan), COLUMNS
    posts = [np.stack([s * n + np.arange(n), (s + 1) * n + np.arange(n)], axis=1) for s in range(STOREYS)]
    beams = [(i * ny + j, i * ny + j + 1) for i in range(nx) for j in range(ny - 1)]
    beams += [(i * ny + j, (i + 1) * ny + j) for i in range(nx - 1) for j in range(ny)]
    floors = np.concatenate([s * n + np.array(beams) for s in range(1, STOREYS + 1)])
    half = STOREYS // 2
    groups = [
        ElementGroup("lower columns", np.concatenate(posts[:half]), COLUMN, CONCRETE, (1.0, 0.0, 0.0)),
        ElementGroup("upper columns", np.concatenate(posts[half:]), COLUMN, CONCRETE, (1.0, 0.0, 0.0)),
        ElementGroup("beams", floors, BEAM, CONCRETE, (0.0, 0.0, 1.0)),
    ]
    held = dict.fromkeys(range(n), ("x", "y", "z", "rx", "ry", "rz"))
    model = Frame(nodes, groups, held).separable({g.name: Factor([("E", g.name)]) for g in groups})
    index = {name: i for i, name in enumerate(model.dofs)}
    rows, columns, weights, dofs = [], [], [], []

    def follow(node, direction, column, weight):
        rows.append(index[node, direction])
        columns.append(column)
        weights.append(weight)

    mass = []
    for s in range(1, STOREYS + 1):
        centre, own = plan.mean(axis=0) + np.array([0.8, -0.5]), np.arange(s * n, (s + 1) * n)
        first = len(dofs)
        dofs += [(1000 + s, d) for d in ("x", "y", "rz")]
        area = np.prod(plan.max(axis=0))
        mass += [700.0 * area] * 2 + [700.0 * area * np.sum(plan.max(axis=0) ** 2) / 12.0]
        for node in own.tolist():
            dx, dy = nodes[node, :2] - centre
            for direction, along in (("x", first), ("y", first + 1), ("rz", first + 2)):
                follow(node, direction, along, 1.0)
            follow(node, "x", first + 2, -dy)
            follow(node, "y", first + 2, dx)
            for direction in ("z", "rx", "ry"):
                follow(node, direction, len(dofs), 1.0)
                dofs.append((node, direction))
                mass.append(0.0)
    T = sp.csr_array((weights, (rows, columns)), shape=(model.n_dof, len(dofs)))
    of_group = {}
    for term in model.K_terms:
        of_group[groups[int(np.flatnonzero(term.powers)[0])].name] = T.T @ term.matrix @ T
    return of_group, sp.diags_array(mass).tocsr(), dofs


def write(folder, prior=PRIOR, top='pairing = "index"'):
    """Write the problem, whose lowest modes are measured, and return it."""
    of_group, M, dofs = matrices()

    def frequencies(theta):
        return dense_frequencies(sum(theta[name] * K for name, K in of_group.items()), M, MODES)

    measured = frequencies(TRUTH)
    terms = {"stiffness": [(K, {name: 1}) for name, K in of_group.items()], "mass": [(M, {})]}
    path = write_problem(
        folder,
        "tower",
        terms,
        dofs,
        TRUTH,
        dict.fromkeys(TRUTH, (0.3, 2.0)),
        measured,
        SD * measured,
        prior=prior,
        top=top,
    )
    return Planted(path, TRUTH, frequencies)
