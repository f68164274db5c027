"""Upper bound on the information of any sensor choice, by convex relaxation (Joshi & Boyd 2009).

Each candidate gets a weight between 0 and 1, instead of being chosen or not. The information of mode shapes with
unknown scales is a Schur complement of a matrix that is linear in the weights, so the expected information is
concave in them. In the notation of `fmu.analysis.plan.sensors.information`, the Schur complement at weights v is
at most Σ_q v_q (j_q − φ_q b)(j_q − φ_q b)ᵀ for any vectors b, with equality for the b that belong to v. Let
value(w) be the expected information at any weights w, A(w) the information matrix there, and A₀ this matrix
without sensors. The best choice v then has at most the information

    value(w) + g·v − ½ E tr V (A(w) − A₀), g_q = ½ E Σ_i ‖Fᵀ(j_q − φ_q b)‖², V = FFᵀ,

where the sum is over the modes i, and V is the derivative of 2 value with respect to A at w. This expression is
largest if v selects the candidates with the largest g (per cost). With the b of w, g is the gradient. If some mode
hardly moves the weighted sensors, w does not determine that mode's b; the b for a mixture of w and uniform weights
then gives a tighter bound. Bounds are computed at regular intervals during an ascent in w; the smallest is used.

References
----------
Joshi & Boyd (2009), *IEEE Trans. Signal Process.* 57, 451–462; Bhattacharyya & Beck (2019), arXiv 1906.05953.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmu.analysis.plan.sensors.choice import Limits
from fmu.analysis.plan.sensors.information import Readings, State
from fmu.types import BoolArray, FloatArray

_STEPS = 150
_ENOUGH = 1e-3  # relative to the value
_ARMIJO, _SHORTEST = 1e-4, 1e-10
_MIXED = (0.0, 0.003, 0.03)  # shares of uniform weights
_EVERY = 8  # steps between two bounds
_STALLED = 1e-5  # relative increase of the value between two bounds


class Relaxed(NamedTuple):
    """Result of the convex relaxation.

    Attributes
    ----------
    bound : float
        Upper bound on the expected information of any choice, in nats.
    weights : ndarray, shape (n_candidates,)
        Weights that nearly attain the largest relaxed information.
    """

    bound: float
    weights: FloatArray


def relax(readings: Readings, limits: Limits, steps: int = _STEPS) -> Relaxed:
    """Bound the information of all choices within the limits on number and cost.

    The minimum distance between sensors is ignored, which leaves the bound valid. With a budget, the number of
    sensors is ignored too. The ascent is a projected gradient method with Barzilai–Borwein steps. It ends when the
    bound exceeds the relaxed information by less than 0.1 % (or 0.001 nats, if this is more), when the relaxed
    information hardly increases, or after `steps` steps.
    """
    by_cost = np.isfinite(limits.budget)
    price = limits.cost if by_cost else np.ones(len(limits.cost))
    free = np.ones(len(price), dtype=bool)
    free[list(limits.mounted)] = False
    price = np.where(free, price, 0.0)
    amount = min(limits.budget if by_cost else float(limits.count), float(np.sum(price)))
    if amount <= 0.0 or not free.any():
        w = np.where(free, 0.0, 1.0)
        return Relaxed(_at(readings, w).value, w)
    uniform = w = np.where(free, amount / np.sum(price), 1.0)
    here = _at(readings, w)
    bound, step, last = np.inf, 0.1 / max(float(np.max(here.slope)), 1e-300), -np.inf
    for k in range(steps + 1):
        if k % _EVERY == 0 or k == steps:
            for share in _MIXED:
                g = here.slope if not share else _majorant(readings, here, (1.0 - share) * w + share * uniform)
                best = float(g @ _best(g, price, amount, free))
                bound = min(bound, here.value + best - here.used)
            if bound - here.value < _ENOUGH * max(1.0, here.value) or here.value - last < _STALLED * here.value:
                break
            last = here.value
        while True:
            target = _project(w + step * here.slope, price, amount, free)
            ahead, new = float(here.slope @ (target - w)), _at(readings, target)
            if new.value >= here.value + _ARMIJO * ahead or step * np.max(np.abs(here.slope)) < _SHORTEST:
                break
            step *= 0.5
        moved, bent = target - w, here.slope - new.slope
        curvature = float(moved @ bent)
        step = float(moved @ moved) / curvature if curvature > 0.0 else 4.0 * step
        if new.value > here.value:
            w, here = target, new
    return Relaxed(bound, w)


class _Point(NamedTuple):
    """Value and gradient at given weights; `used` is ½ E tr V (A − A₀), and F satisfies FFᵀ = V."""

    value: float
    slope: FloatArray
    used: float
    F: FloatArray


def _state(readings: Readings, w: FloatArray) -> State:
    """Return the information if each candidate counts with its weight in w (n_candidates,)."""
    weight = np.zeros(readings.shapes.shape[1])
    for column in readings.groups.T:
        np.add.at(weight, column[column >= 0], w[column >= 0])
    rows = np.flatnonzero(weight > 0.0)
    phi, j, own = readings.shapes[:, rows], readings.slopes[:, rows], weight[rows]
    n, q, m, p = j.shape
    N = np.einsum("q,nqm->nm", own, phi**2)
    b = np.einsum("nqm,nqmp->nmp", own[:, None] * phi, j) / np.where(N > 0.0, N, 1.0)[..., None]
    flat = (np.sqrt(own)[:, None, None] * j).reshape(n, q * m, p)
    matrix = readings.prior + np.swapaxes(flat, 1, 2) @ flat - np.einsum("nm,nmp,nmr->npr", N, b, b)
    return State(matrix, b, N)


def _at(readings: Readings, w: FloatArray) -> _Point:
    state = _state(readings, w)
    F = readings.weights_of_directions(state)
    used = 0.5 * float(np.mean(np.einsum("npt,npr,nrt->n", F, state.matrix - readings.prior, F)))
    return _Point(readings.value(state), _by_candidate(readings, F, state.lost), used, F)


def _majorant(readings: Readings, here: _Point, mixed: FloatArray) -> FloatArray:
    """Return g, shape (n_candidates,), with the b that belong to the weights `mixed`.

    The module docstring defines g and b.
    """
    return _by_candidate(readings, here.F, _state(readings, mixed).lost)


def _by_candidate(readings: Readings, F: FloatArray, b: FloatArray) -> FloatArray:
    n, q, m, p = readings.slopes.shape
    found = (readings.slopes.reshape(n, q * m, p) @ F).reshape(n, q, m, -1)
    found -= readings.shapes[..., None] * (b @ F)[:, None]
    by_row = 0.5 * np.mean(np.einsum("nqmt,nqmt->nq", found, found), axis=0)
    return np.asarray(np.sum(np.where(readings.groups >= 0, by_row[readings.groups], 0.0), axis=1))


def _best(slope: FloatArray, price: FloatArray, amount: float, free: BoolArray) -> FloatArray:
    """Return weights v (n_candidates,) that maximise slope·v for 0 ≤ v ≤ 1 and price·v ≤ amount.

    Mounted candidates, where `free` is False, have weight 1.
    """
    v = np.where(free, 0.0, 1.0)
    per_price = slope / np.where(free, price, 1.0)
    left = amount
    for k in np.argsort(-per_price, kind="stable"):
        if free[k] and left > 0.0:
            v[k] = min(1.0, left / price[k])
            left -= v[k] * price[k]
    return v


def _project(w: FloatArray, price: FloatArray, amount: float, free: BoolArray) -> FloatArray:
    """Project weights w (n_candidates,) onto 0 ≤ v ≤ 1 and price·v = amount, by bisection.

    Mounted candidates, where `free` is False, get weight 1.
    """
    low, high = -np.max(np.abs(w)) - 1.0, np.max(np.abs(w)) + 1.0
    scale = 1.0 / np.min(price[free])
    low, high = low * scale, high * scale
    for _ in range(100):
        middle = 0.5 * (low + high)
        if price @ np.clip(w - middle * price, 0.0, 1.0) > amount:
            low = middle
        else:
            high = middle
    return np.where(free, np.clip(w - high * price, 0.0, 1.0), 1.0)
