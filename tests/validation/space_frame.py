"""A space frame of any size: a double-layer grid, square on square offset, held along the edges of its top layer.

Each member is one beam element with rigid joints, six degrees of freedom a joint.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

import fmu
from fmu.fem.frame.components import ElementGroup, Material, Section
from fmu.types import FloatArray

BAY, DEPTH = 1.2, 0.85
"""Length of a bay and distance of the layers, m."""
STEEL, TUBE = Material(E=2.1e11, nu=0.3, rho=7850.0), Section.tube(0.06, 0.003)
HELD = ("x", "y", "z")


def matrices(bays: tuple[int, int]) -> tuple[list[sp.csr_array], sp.csr_array]:
    """Return the stiffness of each layer and of the webs of each diagonal at a modulus of 1 N/m², and the mass.

    The mass is lumped: 1.5 times the diagonal of the consistent matrix, which is exact for bars along their axis.
    """
    nx, ny = bays
    top = np.arange((nx + 1) * (ny + 1)).reshape(nx + 1, ny + 1)
    bottom = top.size + np.arange(nx * ny).reshape(nx, ny)
    nodes = np.concatenate([_layer(nx + 1, ny + 1, 0.0, DEPTH), _layer(nx, ny, 0.5, 0.0)])
    members = {
        "top": [(top[:-1], top[1:]), (top[:, :-1], top[:, 1:])],
        "bottom": [(bottom[:-1], bottom[1:]), (bottom[:, :-1], bottom[:, 1:])],
        "webs1": [(bottom, top[:-1, :-1]), (bottom, top[1:, 1:])],
        "webs2": [(bottom, top[1:, :-1]), (bottom, top[:-1, 1:])],
    }
    groups = []
    for name, pairs in members.items():
        ends = np.concatenate([np.stack([one.ravel(), other.ravel()], axis=1) for one, other in pairs])
        groups.append(ElementGroup(name, ends, TUBE, STEEL, y_direction=(0.1, 0.2, 1.0)))
    edges = np.unique(np.concatenate([top[0], top[-1], top[:, 0], top[:, -1]]))
    frame = fmu.Frame(nodes=nodes, groups=groups, supports={int(node): HELD for node in edges})
    model = frame.separable({name: [("E", name)] for name in members})
    mass = sum(term.matrix.diagonal() for term in model.M_terms)
    return [sp.csr_array(term.matrix) for term in model.K_terms], sp.csr_array(sp.diags_array(1.5 * mass))


def _layer(nx: int, ny: int, offset: float, height: float) -> FloatArray:
    i, j = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
    return np.stack([BAY * (i.ravel() + offset), BAY * (j.ravel() + offset), np.full(i.size, height)], axis=1)
