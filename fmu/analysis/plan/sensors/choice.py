"""Select sensors greedily by expected information, then exchange one sensor at a time.

If the errors are independent, all parameters matter and only the number of sensors is limited, greedy selection
reaches at least 1 − 1/e of the largest gain (Nemhauser, Wolsey & Fisher 1978, *Math. Program.* 14, 265–294). There
is no such guarantee with a budget, a minimum distance or target quantities, nor for mode shapes of unknown scale,
which are assumed here. `fmu.analysis.plan.sensors.bound` shows how far a choice can be from the best.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fmu.analysis.plan.sensors.information import Readings
from fmu.types import BoolArray, FloatArray, IntArray

_MOST_SWEEPS = 10
_IMPROVED = 2  # number of the best initial choices that are improved by exchanges
_TRIED = 8  # largest number of candidates tried in place of a sensor, the best first
# A gain below this is rounding, in nats.
_LEAST_GAIN = 1e-9
_ROUNDING = 1e-12

Accept = Callable[[Sequence[int]], bool]
"""Function that returns True if a choice of candidates, without the mounted ones, is acceptable."""


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits on a choice of candidates.

    Attributes
    ----------
    count : int
        Number of sensors to choose, in addition to the mounted ones.
    mounted : tuple of int
        Candidates that are part of every choice.
    cost : ndarray, shape (n_candidates,)
    budget : float
        Largest total cost of the chosen sensors; infinite without a budget.
    near : ndarray of bool, shape (n_candidates, n_candidates), or None
        Mask of the candidate pairs that are too close together.
    """

    count: int
    mounted: tuple[int, ...]
    cost: FloatArray
    budget: float = np.inf
    near: BoolArray | None = None

    def find_allowed(self, chosen: Sequence[int]) -> BoolArray:
        """Return a mask (n_candidates,) of the candidates that may still be added to the chosen ones."""
        every = [*self.mounted, *chosen]
        found = np.ones(len(self.cost), dtype=bool)
        found[every] = False
        if self.near is not None and every:
            found &= ~self.near[every].any(axis=0)
        left = self.budget - float(np.sum(self.cost[list(chosen)]))
        return found & (self.cost <= left * (1.0 + _ROUNDING))

    def is_affordable(self, chosen: Sequence[int]) -> bool:
        """Return True if the chosen candidates are within the budget."""
        return float(np.sum(self.cost[list(chosen)])) <= self.budget * (1.0 + _ROUNDING)


def choose(
    readings: Readings, limits: Limits, starts: Sequence[Sequence[int]] = (), accept: Accept | None = None
) -> tuple[int, ...] | None:
    """Choose candidates by greedy selection and exchanges; return them without the mounted ones.

    The most important candidate comes first. The initial choices are greedy ones and those in `starts`, which may
    violate limits and are then repaired. The two best are improved by exchanges, and the better result is
    returned. If `accept` is given, only choices that it accepts are considered, and the result is None if it
    accepts no initial choice.
    """
    found = [greedy(readings, limits)]
    if np.isfinite(limits.budget):
        found.append(greedy(readings, limits, by_cost=True))
    found += [repair(readings, limits, start) for start in starts]
    distinct = {frozenset(one): one for one in found}.values()
    ranked = sorted(distinct, key=lambda one: -readings.value_of([*limits.mounted, *one]))
    good = [one for one in ranked if accept is None or accept(one)][:_IMPROVED]
    if not good:
        return None
    tried = [exchange(readings, limits, one, accept) for one in good]
    best = max(tried, key=lambda one: readings.value_of([*limits.mounted, *one]))
    return in_order(readings, limits, best)


def greedy(
    readings: Readings, limits: Limits, by_cost: bool = False, chosen: Sequence[int] = ()
) -> tuple[int, ...]:
    """Add candidates one at a time, each with the largest gain or, with `by_cost`, the largest gain per cost.

    A single sensor gives no information on a mode shape whose scale is unknown. If no candidate has a gain, the
    first sensor is therefore placed where the modes move most. The choice has fewer than `limits.count` candidates
    if the limits allow no more.
    """
    found = list(chosen)
    state = readings.with_sensors([*limits.mounted, *found])
    while len(found) < limits.count:
        allowed = limits.find_allowed(found)
        if not allowed.any():
            break
        gain = readings.gains(state)
        if not np.any(gain[allowed] > _LEAST_GAIN) and not np.any(state.size):
            gain = visibility(readings)
        k = int(np.argmax(np.where(allowed, gain / limits.cost if by_cost else gain, -np.inf)))
        found.append(k)
        state = readings.with_sensors([k], state)
    return tuple(found)


def repair(readings: Readings, limits: Limits, start: Sequence[int]) -> tuple[int, ...]:
    """Return a choice within the limits: the candidates of `start` that fit, completed by greedy selection."""
    found: list[int] = []
    for k in start:
        if len(found) < limits.count and limits.find_allowed(found)[k]:
            found.append(k)
    return greedy(readings, limits, chosen=found)


def exchange(
    readings: Readings, limits: Limits, chosen: Sequence[int], accept: Accept | None = None
) -> tuple[int, ...]:
    """Exchange one sensor at a time as long as this improves the choice, in at most ten passes over the sensors.

    If `accept` is given, only choices that it accepts are considered.
    """
    found = list(chosen)
    value = readings.value_of([*limits.mounted, *found])
    for _ in range(_MOST_SWEEPS):
        before = value
        for i in range(len(found)):
            rest = found[:i] + found[i + 1 :]
            state = readings.with_sensors([*limits.mounted, *rest])
            gained = readings.value(state) + np.where(limits.find_allowed(rest), readings.gains(state), -np.inf)
            for k in np.argsort(-gained, kind="stable")[:_TRIED]:
                other = [*rest[:i], int(k), *rest[i:]]
                if gained[k] <= value + _LEAST_GAIN:
                    break
                if accept is None or accept(other):
                    found, value = other, float(gained[k])
                    break
        if value <= before + _LEAST_GAIN:
            break
    return tuple(found)


def in_order(readings: Readings, limits: Limits, chosen: Sequence[int]) -> tuple[int, ...]:
    """Sort the chosen sensors by importance, the most important first.

    The least important sensor is found and removed repeatedly.
    """
    left, order = list(chosen), []
    while left:
        values = [readings.value_of([*limits.mounted, *left[:i], *left[i + 1 :]]) for i in range(len(left))]
        order.append(left.pop(int(np.argmax(values))))
    return tuple(reversed(order))


def visibility(readings: Readings) -> FloatArray:
    """Return a measure of how much the modes move each candidate, shape (n_candidates,).

    It is φ² relative to its largest value, summed over the modes and averaged over the draws.
    """
    square = readings.shapes**2
    largest = np.max(square, axis=1, keepdims=True)
    share = np.mean(np.sum(square / np.where(largest > 0.0, largest, 1.0), axis=2), axis=0)
    return np.asarray(np.sum(share[readings.groups], axis=1))


def near_pairs(places: FloatArray, distance: float) -> BoolArray:
    """Return a mask (n, n) of the pairs of places (n, 3) that are closer together than `distance`, in m."""
    square = np.sum((places[:, None] - places[None]) ** 2, axis=2)
    near: IntArray | BoolArray = square < (distance * (1.0 - 1e-9)) ** 2
    np.fill_diagonal(near, False)
    return near.astype(bool)
