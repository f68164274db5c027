"""Customary rules for sensor selection, which compare mode shapes and ignore the parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from fmu.analysis.plan.sensors.choice import Limits
from fmu.fem.modes.modal import mac
from fmu.types import FloatArray, IntArray


def effective_independence(shapes: FloatArray, groups: IntArray, limits: Limits) -> tuple[int, ...]:
    """Return candidates chosen by effective independence (Kammer 1991, *J. Guid. Control Dyn.* 14, 251–259).

    The candidate that contributes least to the linear independence of the mode shapes is removed repeatedly, until
    `limits.count` candidates are left beside the mounted ones. A candidate's contribution is the sum over its
    directions of the entries in diag Φ(ΦᵀΦ)⁻¹Φᵀ, where Φ contains the mode shapes at the candidates that are left.
    Mounted candidates are never removed, and are not part of the result. Budget and minimum distance are ignored.

    Parameters
    ----------
    shapes : ndarray, shape (rows, m)
        Mode shapes at the reference parameters.
    groups : ndarray of int, shape (n_candidates, d)
        Channel indices of each candidate, padded with −1.
    limits : Limits
    """
    shapes = np.concatenate([shapes, np.zeros((1, shapes.shape[1]))])
    left = list(range(len(groups)))
    while len(left) > limits.count + len(limits.mounted):
        rows = groups[left]
        phi = shapes[rows.ravel()]
        contribution = np.sum(phi * (phi @ np.linalg.pinv(phi.T @ phi)), axis=1).reshape(rows.shape).sum(axis=1)
        fixed = np.isin(left, limits.mounted)
        left.pop(int(np.argmin(np.where(fixed, np.inf, contribution))))
    return tuple(k for k in left if k not in limits.mounted)


def kinetic_energy(energy: FloatArray, groups: IntArray, limits: Limits) -> tuple[int, ...]:
    """Choose the candidates with the most kinetic energy in the modes; budget and minimum distance are ignored.

    Parameters
    ----------
    energy : ndarray, shape (rows,)
        Kinetic energy φ_q (Mφ)_q at each channel, summed over the modes, each of unit modal mass.
    groups, limits
        As in `effective_independence`.
    """
    score = np.sum(np.append(energy, 0.0)[groups], axis=1)
    return _best(score, limits)


def smallest_auto_mac(shapes: FloatArray, groups: IntArray, limits: Limits) -> tuple[int, ...]:
    """Choose sensors so that the AutoMAC has small off-diagonal entries (Carne & Dohrmann 1995).

    Effective independence first chooses one candidate per mode, or `limits.count` candidates if this is fewer.
    Then candidates are added one at a time until `limits.count` are chosen. The candidate added is the one that
    minimises the largest off-diagonal entry. Budget and minimum distance are ignored.
    """
    few = Limits(min(limits.count, shapes.shape[1]), limits.mounted, limits.cost)
    found = list(effective_independence(shapes, groups, few))
    padded = np.concatenate([shapes, np.zeros((1, shapes.shape[1]))])
    products = np.einsum("gdi,gdj->gij", padded[groups], padded[groups])
    while len(found) < limits.count:
        total = np.sum(products[[*limits.mounted, *found]], axis=0)
        largest = largest_off_diagonal(total + products)
        largest[[*limits.mounted, *found]] = np.inf
        found.append(int(np.argmin(largest)))
    return tuple(found)


def within_budget(rule: Callable[[Limits], tuple[int, ...]], limits: Limits) -> tuple[int, ...]:
    """Apply a selection rule with as many sensors as the budget allows; return () if it allows none."""
    for count in range(limits.count, 0, -1):
        chosen = rule(replace(limits, count=count))
        if limits.is_affordable(chosen):
            return chosen
    return ()


def largest_off_diagonal(products: FloatArray) -> FloatArray:
    """Return the largest MAC between two different mode shapes, shape (…), given their products ΦᵀΦ (…, m, m).

    It is 0 for a single mode, or if no sensor moves.
    """
    m = products.shape[-1]
    if m == 1:
        return np.zeros(products.shape[:-2])
    size = np.diagonal(products, axis1=-2, axis2=-1)
    scale = size[..., :, None] * size[..., None, :]
    found = np.divide(products**2, scale, out=np.zeros_like(products), where=scale > 0.0)
    found[..., range(m), range(m)] = 0.0
    return np.asarray(np.max(found, axis=(-2, -1)))


def auto_mac(shapes: FloatArray, rows: Sequence[int]) -> FloatArray:
    """Return the AutoMAC (m, m) of mode shapes (rows, m), restricted to the given rows."""
    picked = shapes[list(rows)]
    return mac(picked, picked)


def _best(score: FloatArray, limits: Limits) -> tuple[int, ...]:
    order = [int(k) for k in np.argsort(-score, kind="stable") if int(k) not in limits.mounted]
    return tuple(order[: limits.count])
