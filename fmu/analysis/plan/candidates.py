"""Candidate sensors of a planned test: their places, their costs, and the sensors already mounted.

A channel is one place and direction; a triaxial sensor has up to three. Channels are the rows of the mode-shape
matrices.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmu.analysis.plan.sensors.choice import Limits, near_pairs
from fmu.arguments import ArgumentError, first_repeated
from fmu.fem.modes.separable import SeparableModel
from fmu.numbers import significant
from fmu.types import Dof, FloatArray, IntArray

_TRANSLATIONS = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidate sensors of a plan.

    Attributes
    ----------
    sensors : tuple of (place, direction)
        All channels, one per row of the mode shapes.
    groups : ndarray of int, shape (n_candidates, d)
        Channel indices of each candidate: one, or up to three for a triaxial sensor, padded with −1.
    mounted : tuple of int
        Candidates that are already mounted.
    cost : ndarray, shape (n_candidates,)
    """

    sensors: tuple[Dof, ...]
    groups: IntArray
    mounted: tuple[int, ...]
    cost: FloatArray

    def rows(self, chosen: Sequence[int]) -> list[int]:
        """Return the channel indices of the chosen candidates, candidate by candidate."""
        return [int(row) for k in chosen for row in self.groups[k] if row >= 0]

    def places(self, structure: SeparableModel) -> FloatArray | None:
        """Return the coordinates of the candidates in m, (n_candidates, 3), or None if a coordinate is unknown."""
        if structure.geometry is None:
            return None
        nodes, row_of = np.asarray(structure.geometry.nodes), structure.geometry.row_of
        found = np.empty((len(self.groups), 3))
        for k, rows in enumerate(self.groups):
            place, offset = self.sensors[rows[0]][0], np.zeros(3)
            if place in structure.arms:
                arm = structure.arms[place]
                place, offset = arm.node, np.array(arm.offset)
            if place not in row_of:
                return None
            found[k] = nodes[row_of[place]] + offset
        return found

    def limits(self, count: int, budget: float, places: FloatArray | None, distance: float) -> Limits:
        """Return the limits for choosing `count` candidates in addition to the mounted ones.

        Raises
        ------
        ValueError
            If there are fewer candidates than sensors, the budget is too small for a single one, or a minimum
            distance is given but coordinates are unknown.
        """
        free = len(self.groups) - len(self.mounted)
        if count > free:
            raise ArgumentError("sensors", f"must be at most {free}, the number of candidates", count)
        cheapest = float(np.min(np.delete(self.cost, self.mounted)))
        if budget < cheapest:
            rule = f"must be at least {significant(cheapest)}, the cost of the cheapest candidate"
            raise ArgumentError("budget", rule, budget)
        near = None
        if distance > 0.0:
            if places is None:
                rule = "must be 0 where the coordinates of candidates are not known"
                raise ArgumentError("min_distance", rule, distance)
            near = near_pairs(places, distance)
        return Limits(count, self.mounted, self.cost, budget, near)


def find_candidates(
    structure: SeparableModel,
    given: Sequence[Dof] | None,
    mounted: Sequence[Dof],
    exclude: Collection[Any],
    triaxial: bool,
    costs: Mapping[Any, float],
) -> Candidates:
    """Return the candidate sensors on a structure that has system matrices.

    Parameters
    ----------
    structure : SeparableModel
    given : sequence of (place, direction), optional
        Channels that sensors may measure. Defaults to all translations of the nodes.
    mounted : sequence of (place, direction)
        Channels that are already mounted.
    exclude : collection of place
        Places where no sensor can be mounted.
    triaxial : bool
        Whether one sensor reads all candidate directions at its place.
    costs : mapping of place to float
        Costs of the sensors at these places; 1 at all others.

    Raises
    ------
    ValueError
        If a sensor or a place does not exist, a sensor is given twice, a cost is not positive, or no candidate is
        left.
    """
    require_sensors(given, mounted, structure.sees, "must be a place and a direction that are free to move")
    require_places({place for place, _ in structure.dof_of} | _places(structure), exclude, costs)
    every = given
    if every is None:
        every = [dof for dof in structure.dofs if dof[1] in _TRANSLATIONS and structure.sees(dof)]
    return group_candidates(every, mounted, exclude, triaxial, costs)


def _places(structure: SeparableModel) -> set[Any]:
    """Return the places of a structure, such as supports, that may have no free degree of freedom.

    These are the drawn points, the ends of rigid arms, and the places with constrained motion.
    """
    drawn = set() if structure.geometry is None else set(structure.geometry.row_of)
    return drawn | set(structure.arms) | {place for place, _ in structure.motions}


def require_sensors(
    candidates: Sequence[Dof] | None, mounted: Sequence[Dof], exists: Callable[[Dof], bool], rule: str
) -> None:
    """Raise ValueError, with `rule` in its message, if a candidate or mounted sensor does not exist."""
    for key, sensors in (("candidates", candidates or ()), ("mounted", mounted)):
        for i, sensor in enumerate(sensors):
            if not exists(sensor):
                raise ArgumentError(f"{key}.{i}", rule, repr(list(sensor)))


def require_places(there: Collection[Any], exclude: Collection[Any], costs: Collection[Any]) -> None:
    """Raise ValueError if an excluded place, or a place with a cost, does not exist."""
    for key, places in (("exclude", exclude), ("costs", costs)):
        unknown = next((place for place in places if place not in there), None)
        if unknown is not None:
            raise ArgumentError(key, "must name places of the model", repr(unknown))


def group_candidates(
    given: Sequence[Dof],
    mounted: Sequence[Dof],
    exclude: Collection[Any],
    triaxial: bool,
    costs: Mapping[Any, float],
) -> Candidates:
    """Group existing channels into candidates.

    Channels in `given` that are mounted or at excluded places are left out. `find_candidates` describes the
    arguments. Raise ValueError if a channel is given twice, a cost is not positive, or no candidate is left.
    """
    for key, sensors in (("candidates", given), ("mounted", mounted)):
        twice = first_repeated([(place, direction) for place, direction in sensors])
        if twice is not None:
            raise ArgumentError(f"{key}.{twice}", "must be given once", repr(list(sensors[twice])))
    fixed = [(place, direction) for place, direction in mounted]
    free = [dof for dof in dict.fromkeys(given) if dof[0] not in exclude and dof not in fixed]
    if not free:
        raise ArgumentError("candidates", "must have a place that is not excluded or taken", "none")
    sensors = (*fixed, *free)
    keys: dict[object, list[int]] = {}
    for row, (place, direction) in enumerate(sensors):
        is_fixed = row < len(fixed)
        keys.setdefault((is_fixed, place) if triaxial else (is_fixed, place, direction), []).append(row)
    groups = np.full((len(keys), max(map(len, keys.values()))), -1, dtype=np.int64)
    for k, rows in enumerate(keys.values()):
        groups[k, : len(rows)] = rows
    cost = np.array([float(costs.get(sensors[rows[0]][0], 1.0)) for rows in groups])
    if np.any(cost <= 0.0):
        raise ArgumentError("costs", "must be positive", float(cost.min()))
    taken = tuple(k for k, rows in enumerate(groups) if rows[0] < len(fixed))
    return Candidates(sensors, groups, taken, cost)
