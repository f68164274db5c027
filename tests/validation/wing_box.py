"""A wing box of flat shell elements of any fineness: skins, spars and ribs, clamped at the root.

The elements are rectangles of four nodes with six degrees of freedom each: a bilinear membrane with two internal
bubble modes (Wilson, Taylor, Doherty & Ghaboussi 1973), a plate with assumed shear strains (MITC4; Bathe & Dvorkin
1985, *Int. J. Numer. Meth. Eng.* 21, 367–383), and a small stiffness of the rotation about the normal. Masses are
lumped at the nodes, with the rotatory inertia of the plate.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy.sparse as sp

from fmu.types import FloatArray, IntArray

E, NU, RHO = 7.0e10, 0.33, 2700.0
"""Aluminium: N/m², –, kg/m³."""
LENGTH, CHORD, HEIGHT = 8.0, 1.6, 0.32
"""Of the box, m."""
SKIN, SPAR, RIB = 6e-3, 8e-3, 4e-3
"""Thicknesses, m."""
GROUPS = ("root skin", "middle skin", "tip skin", "spars", "ribs")
_DRILLING = 1e-3
"""Stiffness of the rotation about the normal, as a share of the shear stiffness of the element."""
_GAUSS = tuple(product((-1.0 / np.sqrt(3.0), 1.0 / np.sqrt(3.0)), repeat=2))
_CORNERS = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])


@dataclass(frozen=True)
class Panel:
    """A plane of rectangular elements.

    Attributes
    ----------
    nodes : ndarray of int, shape (n_elements, 4)
        Nodes of each element, counter-clockwise from its lowest corner.
    sides : tuple of float
        Sides of an element along its first and second axis, m.
    axes : tuple of int
        The global axes (0 x, 1 y, 2 z) of the element's first axis, its second and its normal.
    thickness : float
    """

    nodes: IntArray
    sides: tuple[float, float]
    axes: tuple[int, int, int]
    thickness: float


def element_stiffness(a: float, b: float, t: float) -> FloatArray:
    """Return the stiffness (24, 24) of a rectangle a × b of thickness t at a modulus of 1 N/m²; u v w θx θy θz."""
    K = np.zeros((24, 24))
    plane = np.array([[1.0, NU, 0.0], [NU, 1.0, 0.0], [0.0, 0.0, 0.5 * (1.0 - NU)]]) / (1.0 - NU**2)
    shear = 0.5 / (1.0 + NU)
    area = 0.25 * a * b
    in_plane, bending = np.array([0, 1]), np.array([2, 3, 4])
    membrane, plate = np.zeros((12, 12)), np.zeros((12, 12))
    for r, s in _GAUSS:
        _, dx, dy = _shape(r, s, a, b)
        B = np.zeros((3, 12))  # u v of four nodes, then the two bubble modes in u and in v
        B[0, 0:8:2], B[1, 1:8:2], B[2, 0:8:2], B[2, 1:8:2] = dx, dy, dy, dx
        by_x, by_y = -4.0 * r / a, -4.0 * s / b  # slopes of the bubbles 1 − r² and 1 − s², in u and in v
        B[0, 8], B[2, 9], B[2, 10], B[1, 11] = by_x, by_y, by_x, by_y
        membrane += t * area * B.T @ plane @ B
        C = np.zeros((3, 12))  # curvatures of w θx θy: the normal turns by βx = θy, βy = −θx
        C[0, 2::3], C[1, 1::3], C[2, 2::3], C[2, 1::3] = dx, -dy, dy, -dx
        plate += t**3 / 12.0 * area * C.T @ plane @ C
        S = np.zeros((2, 12))
        # γxz from the middles of the sides along x, γyz from those along y
        for weight, at in ((0.5 * (1.0 - s), -1.0), (0.5 * (1.0 + s), 1.0)):
            M, mx, _ = _shape(0.0, at, a, b)
            S[0, 0::3] += weight * mx
            S[0, 2::3] += weight * M
        for weight, at in ((0.5 * (1.0 - r), -1.0), (0.5 * (1.0 + r), 1.0)):
            M, _, my = _shape(at, 0.0, a, b)
            S[1, 0::3] += weight * my
            S[1, 1::3] -= weight * M
        plate += 5.0 / 6.0 * shear * t * area * S.T @ S
    condensed = membrane[:8, :8] - membrane[:8, 8:] @ np.linalg.solve(membrane[8:, 8:], membrane[8:, :8])
    rows = (6 * np.arange(4)[:, None] + in_plane).ravel()
    K[np.ix_(rows, rows)] = condensed
    rows = (6 * np.arange(4)[:, None] + bending).ravel()
    K[np.ix_(rows, rows)] += plate
    rows = 6 * np.arange(4) + 5
    K[np.ix_(rows, rows)] += _DRILLING * shear * t * a * b * ((1.0 + _DRILLING) * np.eye(4) - 0.25)
    return K


def _shape(r: float, s: float, a: float, b: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the bilinear functions (4,) and their derivatives by x and y."""
    R, S = _CORNERS.T
    N = 0.25 * (1.0 + R * r) * (1.0 + S * s)
    return N, 0.25 * R * (1.0 + S * s) * 2.0 / a, 0.25 * S * (1.0 + R * r) * 2.0 / b


def wing_box(cells: tuple[int, int, int], n_ribs: int = 15) -> tuple[FloatArray, dict[str, list[Panel]]]:
    """Return the nodes (n, 3) of a box of cells along x, y and z, and the panels of each group.

    The number of cells along x must be a multiple of 3 (n_ribs + 1).
    """
    nx, ny, nz = cells
    grid = np.full((nx + 1, ny + 1, nz + 1), -1)
    bays = nx // (n_ribs + 1)
    ribs = [bays * k for k in range(1, n_ribs + 2)]
    used = np.zeros(grid.shape, dtype=bool)
    used[:, :, [0, nz]] = True
    used[:, [0, ny], :] = True
    used[ribs] = True
    grid[used] = np.arange(used.sum())
    i, j, k = np.nonzero(used)
    h = LENGTH / nx, CHORD / ny, HEIGHT / nz
    nodes = np.stack([h[0] * i, h[1] * j, h[2] * k], axis=1)

    def quads(of: IntArray) -> IntArray:
        return np.stack([of[:-1, :-1], of[1:, :-1], of[1:, 1:], of[:-1, 1:]], axis=-1).reshape(-1, 4)

    third = nx // 3
    groups: dict[str, list[Panel]] = {name: [] for name in GROUPS}
    for part, name in enumerate(GROUPS[:3]):
        along = slice(part * third, (part + 1) * third + 1)
        for z in (0, nz):
            groups[name].append(Panel(quads(grid[along, :, z]), h[:2], (0, 1, 2), SKIN))
    for y in (0, ny):
        groups["spars"].append(Panel(quads(grid[:, y, :]), (h[0], h[2]), (0, 2, 1), SPAR))
    for x in ribs:
        groups["ribs"].append(Panel(quads(grid[x]), h[1:], (1, 2, 0), RIB))
    return nodes, groups


def matrices(
    nodes: FloatArray, groups: dict[str, list[Panel]]
) -> tuple[dict[str, sp.csr_array], sp.csr_array, IntArray]:
    """Return the stiffness of each group at a modulus of 1 N/m², the mass, and the free degrees of freedom."""
    n = 6 * len(nodes)
    free = np.setdiff1d(np.arange(n), (6 * np.flatnonzero(nodes[:, 0] == 0.0)[:, None] + np.arange(6)).ravel())
    mass, stiffness = np.zeros(n), {}
    for name, panels in groups.items():
        K = sp.csr_array((n, n))
        for panel in panels:
            turn = _turn(panel.axes)
            element = turn @ element_stiffness(*panel.sides, panel.thickness) @ turn.T
            dofs = (6 * panel.nodes[:, :, None] + np.arange(6)).reshape(len(panel.nodes), 24)
            rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None, :])
            data = np.broadcast_to(0.5 * (element + element.T), rows.shape)
            kept = data.ravel() != 0.0
            K = K + sp.csr_array((data.ravel()[kept], (rows.ravel()[kept], columns.ravel()[kept])), shape=(n, n))
            lump = 0.25 * RHO * panel.thickness * panel.sides[0] * panel.sides[1]
            turning = lump * (panel.thickness**2 + 0.1 * max(panel.sides) ** 2) / 12.0
            for d in range(6):
                np.add.at(mass, 6 * panel.nodes.ravel() + d, lump if d < 3 else turning)
        stiffness[name] = sp.csr_array(K[free][:, free])
    return stiffness, sp.csr_array(sp.diags_array(mass[free])), free


def _turn(axes: tuple[int, int, int]) -> FloatArray:
    """Return the matrix (24, 24) from an element's displacements to global ones."""
    turn = np.zeros((3, 3))
    for local, axis in enumerate(axes):
        turn[axis, local] = 1.0
    sign = np.linalg.det(turn)  # rotations are axial vectors
    return np.kron(np.eye(4), np.block([[turn, np.zeros((3, 3))], [np.zeros((3, 3)), sign * turn]]))
