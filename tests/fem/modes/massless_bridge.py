"""A bridge as structural programs export it: masses at the nodes along x, y and z, and rotations without any."""

import numpy as np
import scipy.sparse as sp

from fmu.fem.frame.components import ElementGroup, Material, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import Term

STEEL = Material(E=2.1e11, nu=0.3, rho=7850.0)
GIRDERS = Section(A=3.0e-2, Iy=1.2e-3, Iz=2.0e-4, J=1.0e-5), Section(A=3.5e-2, Iy=1.5e-3, Iz=2.4e-4, J=1.0e-5)
CROSS = Section(A=6.0e-3, Iy=8.0e-5, Iz=1.0e-5, J=4.0e-7)
START = np.array([2.1e11, 2.0e11, 1.0])
LOWER, UPPER = np.array([1.7e11, 1.4e11, 0.8]), np.array([2.5e11, 2.6e11, 1.3])


def bridge(stations, free=False):
    """Return two unlike cambered girders of 30 m with cross beams between, in one block.

    theta is E of the girders, E of the cross beams, and what the mass of the deck is multiplied by.
    """
    x = np.linspace(0.0, 30.0, stations)
    camber = 0.4 * np.sin(np.pi * x / 30.0)
    nodes = np.concatenate([np.stack([x, np.full(stations, y), camber], axis=1) for y in (0.0, 5.0)])
    first = np.arange(stations - 1)
    girders = [np.stack([s + first, s + first + 1], axis=1) for s in (0, stations)]
    cross = np.stack([np.arange(stations), stations + np.arange(stations)], axis=1)
    groups = [
        *(ElementGroup(f"girder {i}", girders[i], GIRDERS[i], STEEL, (0, 0, 1)) for i in range(2)),
        ElementGroup("cross", cross, CROSS, STEEL, (0, 0, 1)),
    ]
    ends = {0: ("x", "y", "z"), stations: ("x", "z"), stations - 1: ("y", "z"), 2 * stations - 1: ("z",)}
    frame = Frame(nodes, groups, {} if free else ends)
    model = frame.separable(
        {"E1": [("E", "girder 0"), ("E", "girder 1")], "E2": [("E", "cross")], "deck": [("rho", "cross")]}
    )
    moves = np.array([direction in "xyz" for _, direction in model.dofs], dtype=float)
    place = np.array([nodes[node, 0] for node, _ in model.dofs])
    steel, deck = moves * 4000.0 / stations, moves * (9000.0 + 100.0 * place) / stations
    masses = [Term(sp.diags_array(steel), (0, 0, 0)), Term(sp.diags_array(deck), (0, 0, 1))]
    return SeparableModel(model.K_terms, masses, model.dofs, model.geometry)


def condensed(model, theta, count):
    """Return λ, shapes and ∂λ/∂θ of the lowest modes by static condensation of what has no mass.

    From the flexibility F of what has mass: λ = 1/μ with M^½ F M^½ y = μ y, which errs by rounding of μ_1 alone.
    """
    K, M = model.K(theta).toarray(), model.M(theta).toarray()
    m = np.flatnonzero(np.diag(M) > 0.0)
    s = np.setdiff1d(np.arange(len(K)), m)
    T = np.zeros((len(K), len(m)))
    T[m], T[s] = np.eye(len(m)), -np.linalg.solve(K[np.ix_(s, s)], K[np.ix_(s, m)])
    root = np.sqrt(np.diag(M)[m])
    stiffness = T.T @ K @ T
    flexibility = np.linalg.inv(0.5 * (stiffness + stiffness.T))
    mu, y = np.linalg.eigh(root[:, None] * flexibility * root)
    lam, shapes = 1.0 / mu[: -count - 1 : -1], T @ (y[:, : -count - 1 : -1] / root[:, None])
    slopes = np.zeros((count, model.n_parameters))
    for terms, factor in ((model.K_terms, np.ones(count)), (model.M_terms, -lam)):
        for term in terms:
            for j, power in enumerate(term.powers):
                if power:  # every power here is 1, of one parameter
                    slopes[:, j] += factor * np.sum(shapes * (term.matrix @ shapes), axis=0)
    return lam, shapes, slopes
