"""Upper bound of the information of any choice of sensors, by convex relaxation (Joshi & Boyd 2009).

A weight between 0 and 1 of each candidate replaces the choice. The information matrix of shapes with unknown scales
is a Schur complement of a matrix that is linear in the weights, so that the expected information is concave in
them. At any weights w, the best choice v has at most value(w) + ∇value(w)·(v − w), which is largest for the
candidates with the largest derivatives (per cost). Each step of the ascent gives such a bound; the smallest counts.

References
----------
Joshi & Boyd (2009), *IEEE Trans. Signal Process.* 57, 451–462; Bhattacharyya & Beck (2019), arXiv 1906.05953.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmu.analysis.plan.choice import Limits
from fmu.analysis.plan.information import Readings, State
from fmu.types import BoolArray, FloatArray

_STEPS = 150
_ENOUGH = 1e-3  # relative to the value
_ARMIJO, _SHORTEST = 1e-4, 1e-10


class Relaxed(NamedTuple):
    """The relaxed choice.

    Attributes
    ----------
    bound : float
        Expected information that no choice exceeds, in nats.
    weights : ndarray, shape (n_candidates,)
        Weights with nearly this information.
    """

    bound: float
    weights: FloatArray


def relax(readings: Readings, limits: Limits, steps: int = _STEPS) -> Relaxed:
    """Return an upper bound of the information of all choices within the limits of number and cost.

    The smallest distance is ignored, which leaves the bound valid. The ascent is a projected gradient with steps
    of Barzilai and Borwein; it ends when the bound exceeds the value by 0.1 %.
    """
    by_cost = np.isfinite(limits.budget)
    price = limits.cost if by_cost else np.ones(len(limits.cost))
    free = np.ones(len(price), dtype=bool)
    free[list(limits.mounted)] = False
    price = np.where(free, price, 0.0)
    amount = min(limits.budget if by_cost else float(limits.count), float(np.sum(price)))
    if amount <= 0.0 or not free.any():
        w = np.where(free, 0.0, 1.0)
        return Relaxed(_value(readings, w)[0], w)
    w = np.where(free, amount / np.sum(price), 1.0)
    value, slope = _value(readings, w)
    bound, step = np.inf, 0.1 / max(float(np.max(slope)), 1e-300)
    for _ in range(steps):
        bound = min(bound, value + float(slope @ (_best(slope, price, amount, free) - w)))
        if bound - value < _ENOUGH * max(1.0, value):
            break
        while True:
            target = _project(w + step * slope, price, amount, free)
            ahead = float(slope @ (target - w))
            new, new_slope = _value(readings, target)
            if new >= value + _ARMIJO * ahead or step * np.max(np.abs(slope)) < _SHORTEST:
                break
            step *= 0.5
        moved, bent = target - w, slope - new_slope
        curvature = float(moved @ bent)
        step = float(moved @ moved) / curvature if curvature > 0.0 else 4.0 * step
        w, value, slope = target, new, new_slope
        if not np.any(moved):
            break
    return Relaxed(bound, w)


def _value(readings: Readings, w: FloatArray) -> tuple[float, FloatArray]:
    """Return the expected information at weights w (n_candidates,), and its derivatives."""
    weight = np.zeros(readings.shapes.shape[1])
    for column in readings.groups.T:
        np.add.at(weight, column[column >= 0], w[column >= 0])
    used = np.flatnonzero(weight > 0.0)
    phi, j, own = readings.shapes[:, used], readings.slopes[:, used], weight[used]
    n, q, m, p = j.shape
    N = np.einsum("q,nqm->nm", own, phi**2)
    b = np.einsum("nqm,nqmp->nmp", own[:, None] * phi, j) / np.where(N > 0.0, N, 1.0)[..., None]
    flat = (np.sqrt(own)[:, None, None] * j).reshape(n, q * m, p)
    matrix = readings.prior + np.swapaxes(flat, 1, 2) @ flat - np.einsum("nm,nmp,nmr->npr", N, b, b)
    state = State(matrix, b, N)
    F = readings.weights_of_directions(state)
    n, q, m, p = readings.slopes.shape
    lost = b @ F
    found = (readings.slopes.reshape(n, q * m, p) @ F).reshape(n, q, m, -1)
    found -= readings.shapes[..., None] * lost[:, None]
    by_row = 0.5 * np.mean(np.einsum("nqmt,nqmt->nq", found, found), axis=0)
    return readings.value(state), np.sum(np.where(readings.groups >= 0, by_row[readings.groups], 0.0), axis=1)


def _best(slope: FloatArray, price: FloatArray, amount: float, free: BoolArray) -> FloatArray:
    """Return the weights of the largest slope·v, with 0 ≤ v ≤ 1 and price·v ≤ amount; 1 where they are fixed."""
    v = np.where(free, 0.0, 1.0)
    per_price = slope / np.where(free, price, 1.0)
    left = amount
    for k in np.argsort(-per_price, kind="stable"):
        if free[k] and left > 0.0:
            v[k] = min(1.0, left / price[k])
            left -= v[k] * price[k]
    return v


def _project(w: FloatArray, price: FloatArray, amount: float, free: BoolArray) -> FloatArray:
    """Return the nearest weights with 0 ≤ v ≤ 1 and price·v = amount, by bisection; 1 where they are fixed."""
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
