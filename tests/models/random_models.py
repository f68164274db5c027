"""A generator of models: free or held, masses lumped, consistent or singular, stiff and soft terms, double modes,
springs that are nearly singular.

Each is a structure of springs and masses or of beams, built from a seed alone, with an updating problem on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

import fmu
from fmu.fem.frame.components import ElementGroup, Material, Section
from fmu.fem.frame.frame import Frame
from tests.models.extended_precision import elastic_modes, long_sum

STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)
WEAK = 1e-9
"""Stiffness of a nearly singular spring across it, of that along it."""
MASSES = ("consistent", "lumped", "without rotations", "reduced integration")


@dataclass(frozen=True)
class RandomModel:
    """A model of a seed.

    Attributes
    ----------
    model : fmu.SeparableModel
    parameters : tuple of fmu.Parameter
    free, double, mechanism, weak : bool
        Whether nothing holds it; its modes come in pairs; a part of it can move without strain; a body is held by
        a spring that is nearly singular.
    masses : str
        One of `MASSES`.
    decades : float
        Between the stiffest and the softest term.
    nodes : ndarray, shape (n_nodes, 3)
        Of the structure, without the body beside it.
    """

    model: fmu.SeparableModel
    parameters: tuple[fmu.Parameter, ...]
    free: bool
    double: bool
    mechanism: bool
    weak: bool
    masses: str
    decades: float
    nodes: np.ndarray

    @property
    def n_rigid(self) -> int:
        """How many motions strain nothing, by construction."""
        return 6 * self.free + 3 * self.mechanism

    def modes(self, theta, count, changed=None):
        """Return the lowest elastic λ (count,) and shapes (n, count), in extended precision.

        At theta (n_parameters,); `n` are the degrees of freedom of the structure, the first of the model;
        `changed` returns another K.
        """
        n = self.model.n_dof - 3 * self.mechanism
        K, M = (long_sum(terms, theta)[:n, :n] for terms in (self.model.K_terms, self.model.M_terms))
        K = K if changed is None else changed(K)
        return elastic_modes(K, M, count, self._rigid_motions() if self.free else None)

    def _rigid_motions(self):
        x, y, z = self.nodes.T
        one, no = np.ones(len(x)), np.zeros(len(x))
        motions = [
            (one, no, no, no, no, no),
            (no, one, no, no, no, no),
            (no, no, one, no, no, no),
            (no, -z, y, one, no, no),
            (z, no, -x, no, one, no),
            (-y, x, no, no, no, one),
        ]
        of_nodes = np.stack([np.stack(motion, axis=1).ravel() for motion in motions], axis=1)
        return np.concatenate([of_nodes, of_nodes[-6:-3]]) if self.weak else of_nodes

    def __str__(self) -> str:
        kinds = [name for name in ("free", "double", "mechanism", "weak") if getattr(self, name)]
        n = len(self.model.K_terms)
        return (
            f"{self.model.n_dof} DOF, {n} term{'s' * (n != 1)} over {self.decades:.1f} decades, "
            f"{self.masses} mass{''.join(f', {kind}' for kind in kinds)}"
        )


def random_model(seed, most_dofs=5000):
    """Return the `RandomModel` of a seed, of 50 to `most_dofs` degrees of freedom."""
    rng = np.random.default_rng(seed)
    n_dof = int(np.exp(rng.uniform(np.log(50.0), np.log(most_dofs))))
    free, double, mechanism = rng.random() < 0.3, rng.random() < 0.3, rng.random() < 0.15
    masses = MASSES[rng.integers(len(MASSES))]
    n_terms, decades = int(rng.integers(1, 21)), float(rng.choice([0.1, 1.0, 3.0, 6.0, 8.0]))
    nodes, elements = _lattice(rng, max(n_dof // 6, 9), double)
    ends = [] if free else np.flatnonzero(nodes[:, 0] == 0.0).tolist()
    held = dict.fromkeys(ends, ("x", "y", "z", "rx", "ry", "rz"))
    section = Section(A=3e-3, Iy=4e-6, Iz=4e-6 if double else 7e-6, J=7e-6)
    whole = Frame(nodes, [ElementGroup("all", elements, section, STEEL, (0.1, 0.2, 1.0))], held).separable({})
    M = sp.csr_array(whole.M([]))
    group = np.minimum(
        (nodes[elements].mean(axis=1)[:, 0] / (nodes[:, 0].max() + 1e-9) * n_terms).astype(int), n_terms - 1
    )
    stiffness = 10.0 ** (-decades * rng.permutation(np.linspace(0.0, 1.0, n_terms)))
    terms = []
    for g in range(n_terms):
        own = elements[group == g]
        if not len(own):
            continue
        part = Frame(nodes, [ElementGroup("all", elements, section, STEEL, (0.1, 0.2, 1.0))], held)
        K = _of_elements(part, elements, group == g)
        terms.append((sp.csr_array(K * stiffness[g]), f"k{g}"))
    names = [name for _, name in terms]
    M = _mass(M, masses, whole.dofs, rng)
    dofs = list(whole.dofs)
    if mechanism:  # a body beside the structure that nothing holds
        terms = [(sp.csr_array(sp.block_diag([K, sp.csr_array((3, 3))])), name) for K, name in terms]
        M = sp.csr_array(sp.block_diag([M, 5.0 * np.eye(3)]))
        dofs += [(10**6, d) for d in "xyz"]
    weak = not (double or mechanism) and rng.random() < 0.4
    if weak:  # a body at the last node, on a spring that is stiff along one direction alone
        along = rng.standard_normal(3)
        spring = np.mean(terms[0][0].diagonal()) * (np.outer(along, along) + WEAK * np.eye(3))
        last = [dofs.index((len(nodes) - 1, d)) for d in "xyz"]
        apart = sp.csr_array((np.ones(6), (np.tile(range(3), 2), [*last, *range(len(dofs), len(dofs) + 3)])))
        apart.data[apart.indices >= len(dofs)] = -1.0
        empty = sp.csr_array((3, 3))
        terms = [(sp.csr_array(sp.block_diag([K, empty])), name) for K, name in terms]
        terms[0] = (sp.csr_array(terms[0][0] + apart.T @ spring @ apart), terms[0][1])
        M = sp.csr_array(sp.block_diag([M, 5.0 * np.eye(3)]))
        dofs += [(10**6, d) for d in "xyz"]
    model = fmu.SeparableModel.from_terms(names, terms, [M], dofs)
    parameters = tuple(fmu.Parameter(name, 1.0, 0.7, 1.3) for name in names)
    return RandomModel(
        model, parameters, bool(free), bool(double), bool(mechanism), bool(weak), masses, decades, nodes
    )


def _lattice(rng, n_nodes, double):
    """Return nodes (n, 3) and elements (m, 2) of a square mast, whose modes are double, or of a leaning grid."""
    if double:
        levels = max(n_nodes // 4, 3)
        corner = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)], dtype=float) * 0.5
        nodes = np.array([(float(level), *c) for level in range(levels) for c in corner])
        ring = [(4 * a + b, 4 * a + (b + 1) % 4) for a in range(levels) for b in range(4)]
        legs = [(4 * a + b, 4 * a + 4 + b) for a in range(levels - 1) for b in range(4)]
        return nodes, np.array(ring + legs)
    width = int(rng.integers(2, 6))
    length = max(n_nodes // width, 3)
    nodes = np.array([(float(i), 0.9 * j + 0.05 * i, 0.1 * j * j) for i in range(length) for j in range(width)])
    along = [(i * width + j, (i + 1) * width + j) for i in range(length - 1) for j in range(width)]
    across = [(i * width + j, i * width + j + 1) for i in range(length) for j in range(width - 1)]
    return nodes, np.array(along + across)


def _of_elements(frame, elements, chosen):
    """Return the stiffness of some of the elements of a frame, on all its degrees of freedom."""
    groups = [
        ElementGroup(str(on), elements[chosen == on], frame.groups[0].section, STEEL, frame.groups[0].y_direction)
        for on in (True, False)
        if (chosen == on).any()
    ]
    model = Frame(frame.nodes, groups, frame.supports).separable({"own": [("E", "True")]})
    return next(2.1e11 * term.matrix for term in model.K_terms if any(term.powers))


def _mass(M, kind, dofs, rng):
    """Return a mass matrix of a kind, from the consistent one."""
    if kind == "consistent":
        return M
    turns = np.array([direction.startswith("r") for _, direction in dofs])
    lumped = np.where(turns, 1e-3, 1.0) * np.mean(M.diagonal()[~turns])
    if kind == "lumped":
        return sp.diags_array(lumped).tocsr()
    if kind == "without rotations":
        return sp.diags_array(np.where(turns, 0.0, lumped)).tocsr()
    # by few points of integration: sums of rank one over neighbouring degrees of freedom
    n = len(dofs)
    m, near, each = max(n // 3, 12), 24, 8
    first = rng.integers(0, n - near + 1, size=(m, 1))
    columns = first + rng.permuted(np.tile(np.arange(near), (m, 1)), axis=1)[:, :each]
    entries = (rng.random(m * each), (np.repeat(np.arange(m), each), columns.ravel()))
    rows = sp.csr_array(entries, shape=(m, n))
    return sp.csr_array(float(np.mean(lumped)) * (rows.T @ rows))
