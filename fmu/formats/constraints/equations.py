"""Linear constraint equations. Each gives one dependent degree of freedom as a weighted sum of others.

This package calls a dependent degree of freedom "a dependent".
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from math import isfinite
from typing import NamedTuple

import numpy as np

from fmu.formats.matrices.limits import DofName, RefusedError
from fmu.formats.shown import names_shown
from fmu.types import DIRECTIONS, FloatArray

RANK = 1e-10
"""Smallest singular value, relative to the largest, at which a matrix still determines the dependents."""
NEGLIGIBLE = 1e-14
"""Weights below this, relative to the largest in an equation, are rounding errors."""


class Equation(NamedTuple):
    """Constraint equation for one dependent degree of freedom: u_dependent = Σ weight · u.

    Attributes
    ----------
    dependent : (node id, direction)
    weights : mapping of (node id, direction) to float
        Weights of other degrees of freedom, along the axes of each node; rotations are in rad. Empty if the
        dependent degree of freedom does not move.
    source : str
        The file entry that gives the equation, for messages: ``"RBE2 11"``.
    """

    dependent: DofName
    weights: Mapping[DofName, float]
    source: str


def explicit_equation(terms: Iterable[tuple[DofName, float]], source: str) -> Equation:
    """Solve Σ factor · u = 0 for the first degree of freedom.

    The factors of a repeated degree of freedom are added.

    Raises
    ------
    RefusedError
        If there are no terms, the factor of the first degree of freedom is zero, or a weight is not finite.
    """
    row: dict[DofName, float] = {}
    for name, factor in terms:
        row[name] = row.get(name, 0.0) + factor
    first = next(iter(row), None)
    if first is None or not row[first]:
        where = " has no terms" if first is None else f": the factor of {show_name(first)} is zero"
        raise RefusedError(f"must have equations that determine their first degree of freedom ({source}{where})")
    weights = {name: -a / row[first] for name, a in row.items() if name != first and a}
    if not all(map(isfinite, weights.values())):
        raise RefusedError(
            f"must have equations with finite weights ({source}: those of {show_name(first)} are not)"
        )
    return Equation(first, weights, source)


def solve_for_dependents(
    rows: Sequence[Mapping[DofName, float]], dependents: Sequence[DofName], source: str
) -> list[Equation]:
    """Solve the rows Σ coefficient · u = 0 of one constraint for `dependents`; return one equation for each.

    Parameters
    ----------
    rows : sequence of mapping of (node id, direction) to float
        Coefficients; there must be as many rows as dependents.
    dependents : sequence of (node id, direction)
    source : str
        The file entry, for messages.

    Raises
    ------
    RefusedError
        If the rows do not determine the dependents.
    """
    names = list(dict.fromkeys(name for row in rows for name in row))
    column = {name: k for k, name in enumerate(names)}
    R = np.zeros((len(rows), len(names)))
    for i, row in enumerate(rows):
        for name, value in row.items():
            R[i, column[name]] += value
    if any(name not in column for name in dependents):
        return _refuse(dependents, source)
    wanted = [column[name] for name in dependents]
    rest = [k for k in range(len(names)) if k not in set(wanted)]
    scale = np.max(np.abs(R), axis=1, initial=0.0)
    if len(rows) != len(wanted) or not np.all(scale > 0.0):
        return _refuse(dependents, source)
    R /= scale[:, None]
    unit = np.max(np.abs(R[:, wanted]), axis=0)
    if not np.all(unit > 0.0) or np.linalg.cond(R[:, wanted] / unit) > 1.0 / RANK:
        return _refuse(dependents, source)
    weights = -np.linalg.solve(R[:, wanted], R[:, rest])
    return equations_of(dependents, [names[k] for k in rest], weights, source)


def equations_of(
    dependents: Sequence[DofName], names: Sequence[DofName], weights: FloatArray, source: str
) -> list[Equation]:
    """Return one equation per dependent, with the weights in its row of `weights`, shape (n_dependents, n_names).

    Weights that are mere rounding errors are dropped.
    """
    found = []
    for dependent, row in zip(dependents, np.asarray(weights), strict=True):
        keep = np.flatnonzero(np.abs(row) > NEGLIGIBLE * np.max(np.abs(row), initial=0.0))
        found.append(Equation(dependent, {names[k]: float(row[k]) for k in keep.tolist()}, source))
    return found


def turning_name(name: DofName, turning: Collection[int]) -> DofName:
    """Return the name of a degree of freedom, with rx for x, ry for y, rz for z if its node is among `turning`.

    CalculiX numbers the rotations of a rigid body as displacements 1 to 3 of a node of their own.
    """
    node, direction = name
    return (node, f"r{direction}") if node in turning and direction in DIRECTIONS[:3] else name


def show_name(name: DofName) -> str:
    """Return a readable name for a degree of freedom, such as ``node 8 x``."""
    return f"node {name[0]} {name[1]}"


def _refuse(dependents: Sequence[DofName], source: str) -> list[Equation]:
    which = names_shown([show_name(name) for name in dependents])
    raise RefusedError(f"must have constraints that determine their dependents ({source} does not: {which})")
