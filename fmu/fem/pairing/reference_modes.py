"""Reference shapes for pairing, computed from the model before updating, and the number of rigid-body modes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp

from fmu.fem.modes.block import Block
from fmu.fem.modes.modal import count_modes, is_rigid, join_shapes, solve_spectrum
from fmu.fem.pairing.rules import SPARE, ShapePairing
from fmu.types import FloatArray, IntArray

_FAR_BELOW = 1e-3
"""Share of the lowest measured frequency below which a mode is a rigid-body mode."""


def reference_modes(
    blocks: Sequence[Block],
    theta: FloatArray,
    sensors: sp.csr_array,
    rows: sp.csr_array,
    n_modes: int,
    counterparts: tuple[int, ...] = (),
) -> ShapePairing:
    """Return a pairing by shape whose references are the model's elastic modes that the sensors can see.

    It is used if no shapes were measured. A mode that moves none of the sensors cannot have been measured. The
    references are the lowest `n_modes` visible modes in ascending order or, if given, the `counterparts`.

    Parameters
    ----------
    blocks : sequence of Block
        Unreduced.
    theta : ndarray, shape (n_parameters,)
        Parameters of the reference model, usually before updating.
    sensors, rows : scipy.sparse.csr_array, each with n_dof columns
        The sensors, and the coordinates at which the shapes will be compared, one per row.
    n_modes : int
        Number of measured modes.
    counterparts : tuple of int, optional
        For each measured mode, the number (from 1) of its counterpart among the visible modes.

    Raises
    ------
    ValueError
        If the sensors see too few modes.
    """
    picked = counterparts or tuple(range(1, n_modes + 1))
    n_total = count_modes(blocks)
    count = min(max(picked) + SPARE, n_total)
    while True:
        shapes, ranks = _visible_modes(blocks, theta, sensors, rows, count)
        if len(shapes) >= max(picked):
            columns = np.array(picked) - 1
            margin = SPARE + max(0, int(ranks[columns].max()) + 1 - n_modes)
            return ShapePairing(rows, shapes[columns].T, margin)
        if count == n_total:
            what = f"mode {max(picked)}" if counterparts else f"the {n_modes} measured modes"
            raise ValueError(f"sensors: must see {what} (they see {len(shapes)})")
        count = min(2 * count, n_total)


def count_rigid(blocks: Sequence[Block], theta: FloatArray, n_modes: int, elastic_hz: float = np.inf) -> int:
    """Return the number of rigid-body modes at theta (n_parameters,).

    A mode counts as rigid if its frequency is negligible compared with the highest computed frequency. With a very
    stiff spring, this would be true of all other modes. If a measured frequency `elastic_hz` is given, a
    rigid-body mode must therefore lie far below it too.
    """
    count = min(n_modes + 7, count_modes(blocks))  # at most six rigid-body modes, and one elastic mode
    lam = solve_spectrum(blocks, np.atleast_2d(theta), count).eigenvalues[0]
    is_far_below = lam <= (_FAR_BELOW * 2.0 * np.pi * elastic_hz) ** 2
    return int(np.sum(is_rigid(lam) & is_far_below))


def _visible_modes(
    blocks: Sequence[Block], theta: FloatArray, sensors: sp.csr_array, rows: sp.csr_array, count: int
) -> tuple[FloatArray, IntArray]:
    """Return the elastic modes that the sensors see: shapes at `rows`, (n, q), and ranks in their blocks, (n,)."""
    point = np.atleast_2d(theta)
    spectrum = solve_spectrum(blocks, point, count)
    shapes = np.ascontiguousarray(join_shapes(blocks, point, spectrum).T)
    compared, seen = shapes @ rows.T, shapes @ sensors.T
    # mass-normalised shapes have similar sizes: a shape that is tiny at the sensors is only rounding there
    elastic = ~is_rigid(spectrum.eigenvalues[0])
    visible = np.max(np.abs(seen), axis=1) > 1e-3 * np.max(np.abs(compared))
    return compared[elastic & visible], spectrum.rank[0][elastic & visible]
