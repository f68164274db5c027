"""The matrix T in u = T q, assembled from equations whose dependents may follow other dependents.

In the equations u = C u + P q, C contains the weights of the dependents and P selects the independent degrees of
freedom q, so T = (I − C)⁻¹ P. Without circular dependencies C is nilpotent, and

    (I − C)⁻¹ = (I + C)(I + C²)(I + C⁴) …

A chain of n equations therefore takes only about log₂ n of these sparse factors. The matrices of the constrained
structure are K_q = Tᵀ K T and M_q = Tᵀ M T.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from fmu.formats.constraints.equations import Equation, show_name
from fmu.formats.matrices.limits import MOST_ENTRIES, DofName, RefusedError
from fmu.formats.shown import names_shown

TOLD = 6
"""Largest number of degrees of freedom named in a message."""


class Transformation(NamedTuple):
    """The matrix T in u = T q, with names for its rows and columns.

    Attributes
    ----------
    T : csr_array, shape (n_dof, n_independent)
    dofs : list of (node id, direction)
        Names of the rows: the given degrees of freedom, then any others that appear in the equations.
    independent : list of (node id, direction)
        Names of the columns.
    """

    T: sp.csr_array
    dofs: list[DofName]
    independent: list[DofName]


def transformation(
    equations: Sequence[Equation], dofs: Sequence[DofName], held: Collection[DofName] = ()
) -> Transformation:
    """Return T in u = T q, where q are the degrees of freedom that are neither dependent nor fixed.

    Parameters
    ----------
    equations : sequence of Equation
        In any order; a dependent may follow other dependents.
    dofs : sequence of (node id, direction)
        Row names of the unconstrained matrices.
    held : collection of (node id, direction)
        Fixed degrees of freedom.

    Raises
    ------
    RefusedError
        If a degree of freedom is dependent twice, or both dependent and fixed; if dependencies are circular; or if
        T has too many entries or one that is not finite. Unless there are too many entries, the message names
        degrees of freedom.
    """
    still = set(held)
    source = _check_dependents(equations, still)
    names = list(dict.fromkeys([*dofs, *source, *(name for one in equations for name in one.weights)]))
    index = {name: i for i, name in enumerate(names)}
    n = len(names)
    counts = [len(one.weights) for one in equations]
    row = np.repeat(np.array([index[one.dependent] for one in equations], dtype=np.int64), counts)
    column = np.array([index[name] for one in equations for name in one.weights], dtype=np.int64)
    entry = np.array([w for one in equations for w in one.weights.values()], dtype=float)
    C = sp.csr_array((entry, (row, column)), shape=(n, n))
    _check_circles(C, names, source)
    free = np.array(
        [i for i, name in enumerate(names) if name not in source and name not in still], dtype=np.int64
    )
    P = sp.csr_array((np.ones(len(free)), (free, np.arange(len(free)))), shape=(n, len(free)))
    T, power = sp.csr_array(P + C @ P), C
    while True:  # ends: C is nilpotent
        power = sp.csr_array(power @ power)
        if not power.nnz:
            break
        T = sp.csr_array(T + power @ T)
        if max(power.nnz, T.nnz) > MOST_ENTRIES:
            raise RefusedError(f"must have constraints of at most {MOST_ENTRIES} weights in all")
    if not np.all(np.isfinite(T.data)):
        wrong = int(np.flatnonzero(~np.isfinite(T.data))[0])
        name = names[int(np.searchsorted(T.indptr, wrong, side="right")) - 1]
        raise RefusedError(f"must have constraints with finite weights (those of {show_name(name)} are not)")
    return Transformation(T, names, [names[i] for i in free.tolist()])


def _check_dependents(equations: Sequence[Equation], held: set[DofName]) -> dict[DofName, str]:
    """Return the constraint that defines each dependent, keyed by the dependent.

    Raise RefusedError if two constraints define the same dependent, or a support fixes it.
    """
    source: dict[DofName, str] = {}
    for one in equations:
        name = one.dependent
        if name in source:
            by = f"{show_name(name)} in {source[name]} and {one.source}"
            raise RefusedError(f"must have each dependent degree of freedom once ({by})")
        if name in held:
            raise RefusedError(
                f"must have no dependent degree of freedom that is held ({show_name(name)}, of {one.source}, is)"
            )
        source[name] = one.source
    return source


def _check_circles(C: sp.csr_array, names: Sequence[DofName], source: dict[DofName, str]) -> None:
    """Raise RefusedError if the nonzeros of C form a circular dependency."""
    _, label = connected_components(C, directed=True, connection="strong")
    _, first, count = np.unique(label, return_index=True, return_counts=True)
    alone = C.diagonal() != 0.0
    if np.any(count > 1):
        here = np.flatnonzero(label == label[first[count > 1].min()])
    elif np.any(alone):
        here = np.flatnonzero(alone)[:1]
    else:
        return
    which = names_shown([show_name(names[i]) for i in here[:TOLD].tolist()])
    by = names_shown(list(dict.fromkeys(source[names[i]] for i in here.tolist()))[:TOLD])
    raise RefusedError(f"must have no constraints that follow each other in a circle ({which}, of {by})")
