"""A basis of modes that were solved for in full: where a box is too wide for one that serves all of it.

Proper orthogonal decomposition of the modes at given points, in the inner product of Ā = K + s M at an anchor, in
which the energy of an error is the relative error of an eigenvalue (Quarteroni, Manzoni & Negri 2016, *Reduced
Basis Methods for Partial Differential Equations*, chapter 6). It is accurate near these points; elsewhere nothing
is known of it.
"""

from __future__ import annotations

import numpy as np

from fmu.fem.modes.full_block import FullBlock
from fmu.fem.reduced.anchors import Anchors
from fmu.fem.reduced.learning import balance_directions
from fmu.types import FloatArray

# Directions with a smaller share of the energy of the strongest are rounding.
_ROUNDING = 1e-13


def snapshot_basis(
    block: FullBlock, anchors: Anchors, theta: FloatArray, count: int, size: int, tolerance: float
) -> FloatArray:
    """Return the `size` directions (n_dof, size) that hold most of the lowest modes at theta (n, n_parameters).

    Parameters
    ----------
    block : FullBlock
    anchors : Anchors
    theta : ndarray, shape (n, n_parameters)
        Points where a solve fails are left out.
    count : int
        Modes at each point.
    size : int
    tolerance : float
        Relative error of an eigenvalue below which a mode does not gain from more directions.
    """
    lam, phi = block.modes(theta, count)
    known = np.isfinite(lam).all(axis=1)
    sigma = np.maximum(lam[known] + anchors.shift, np.finfo(float).tiny)
    modes = (phi[known] / np.sqrt(sigma)[:, None]).transpose(1, 0, 2).reshape(block.size, -1)
    energy, U = np.linalg.eigh(modes.T @ (anchors.first @ modes))
    kept = energy > _ROUNDING * energy[-1]
    root, U = np.sqrt(energy[kept]), U[:, kept]
    Q, _ = balance_directions(root[:, None] * U.T, tolerance, size, size)
    return np.asarray((modes @ (U / root)) @ Q)
