"""Reference shapes for pairing, computed from the model before updating, and the number of rigid-body modes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp

from fmu.arguments import ArgumentError
from fmu.fem.modes.block import Block
from fmu.fem.modes.modal import (
    assign,
    count_modes,
    frequency_hz,
    is_rigid,
    join_shapes,
    mac,
    solve_spectrum,
    why_unsolved,
)
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.pairing.rules import SPARE, ShapePairing
from fmu.types import FloatArray, IntArray

_FAR_BELOW = 1e-3
"""Share of the lowest measured frequency below which a mode is a rigid-body mode."""
_REACH, _MOST = 1.5, 200
"""Multiple of the highest measured frequency up to which counterparts of measured modes are sought, and largest
number of modes among which they are sought."""
_BETTER = 0.3
"""Higher modes are candidates too if the MAC of one of them with a measured shape exceeds the MAC of every lower
mode by this value."""


def reference_modes(
    blocks: Sequence[Block],
    theta: FloatArray,
    sensors: sp.csr_array,
    rows: sp.csr_array,
    n_modes: int,
    counterparts: tuple[int, ...] = (),
    model: SeparableModel | None = None,
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
    model : SeparableModel, optional
        The model of the blocks, which names nodes in messages.

    Raises
    ------
    ValueError
        If the blocks cannot be solved at theta, or the sensors see too few modes.
    """
    picked = counterparts or tuple(range(1, n_modes + 1))
    n_total = count_modes(blocks)
    count = min(max(picked) + SPARE, n_total)
    while True:
        shapes, ranks = _visible_modes(blocks, theta, sensors, rows, count, model)
        if len(shapes) >= max(picked):
            columns = np.array(picked) - 1
            margin = SPARE + max(0, int(ranks[columns].max()) + 1 - n_modes)
            return ShapePairing(rows, shapes[columns].T, margin)
        if count == n_total:
            what = f"mode {max(picked)}" if counterparts else f"the {n_modes} measured modes"
            raise ValueError(f"sensors: must see {what} (they see {len(shapes)})")
        count = min(2 * count, n_total)


def margin_for_shapes(
    blocks: Sequence[Block],
    theta: FloatArray,
    rows: sp.csr_array,
    shapes: FloatArray,
    measured_hz: FloatArray | None = None,
) -> int:
    """Return the `margin` of a pairing with measured shapes (q, n_modes) at `rows`.

    It allows for the rigid-body modes and `SPARE` more. A structure may have many modes below those that were
    measured, such as modes of light parts or in another plane. So the measured shapes are also compared with
    higher modes of the model at theta (n_parameters,), up to 1.5 times the highest measured frequency. If these
    fit a shape clearly better, the margin reaches them.
    """
    n_modes, n_total = shapes.shape[1], count_modes(blocks)
    highest_hz = 0.0 if measured_hz is None else float(measured_hz.max())
    margin = SPARE + count_rigid(blocks, theta, n_modes)
    point, most = np.atleast_2d(theta), min(max(_MOST, n_modes), n_total)
    count = min(2 * (n_modes + margin), most)
    while True:
        spectrum = solve_spectrum(blocks, point, count)
        computed_hz = frequency_hz(spectrum.eigenvalues)[0]
        below = computed_hz <= _REACH * highest_hz
        if count == most or not below[-1]:
            break
        count = min(2 * count, most)
    among_lowest = spectrum.rank[0] < n_modes + margin
    tried = below | among_lowest
    rank, near = spectrum.rank[0][tried], among_lowest[tried]
    if near.all():
        return margin
    solved = {b: min(count, block.n_modes) for b, block in enumerate(blocks)}
    fit = mac((rows @ join_shapes(blocks, point, spectrum, solved))[:, tried], shapes)
    best = assign(fit[None], computed_hz[tried][None], measured_hz)[0]
    better = fit[np.arange(n_modes), best] > np.max(fit[:, near], axis=1, initial=0.0) + _BETTER
    return max(margin, SPARE + int(rank[best[better]].max(initial=-1)) + 1 - n_modes)


def count_rigid(blocks: Sequence[Block], theta: FloatArray, n_modes: int, elastic_hz: float = np.inf) -> int:
    """Return the number of rigid-body modes at theta (n_parameters,).

    A mode counts as rigid if its frequency is negligible compared with the highest computed frequency. If a very
    stiff spring causes that highest frequency, elastic modes would count as rigid too. If a measured frequency
    `elastic_hz` is given, a rigid-body mode must therefore lie far below it too.
    """
    count = min(n_modes + 7, count_modes(blocks))  # at most six rigid-body modes, and one elastic mode
    lam = solve_spectrum(blocks, np.atleast_2d(theta), count).eigenvalues[0]
    is_far_below = lam <= (_FAR_BELOW * 2.0 * np.pi * elastic_hz) ** 2
    return int(np.sum(is_rigid(lam) & is_far_below))


def _visible_modes(
    blocks: Sequence[Block],
    theta: FloatArray,
    sensors: sp.csr_array,
    rows: sp.csr_array,
    count: int,
    model: SeparableModel | None,
) -> tuple[FloatArray, IntArray]:
    """Return the elastic modes that the sensors see: shapes at `rows`, (n, q), and ranks in their blocks, (n,)."""
    point = np.atleast_2d(theta)
    spectrum = solve_spectrum(blocks, point, count)
    if np.isnan(spectrum.eigenvalues).any():
        counts = {b: min(count, block.n_modes) for b, block in enumerate(blocks)}
        why = why_unsolved(blocks, theta, counts, model) or "the solver failed"
        raise ArgumentError("start", "must have modes", f"none: {why}", "; correct the model, or the start")
    shapes = np.ascontiguousarray(join_shapes(blocks, point, spectrum).T)
    compared, seen = shapes @ rows.T, shapes @ sensors.T
    # mass-normalised shapes have similar sizes: a shape that is tiny at the sensors is only rounding there
    elastic = ~is_rigid(spectrum.eigenvalues[0])
    visible = np.max(np.abs(seen), axis=1) > 1e-3 * np.max(np.abs(compared))
    return compared[elastic & visible], spectrum.rank[0][elastic & visible]
