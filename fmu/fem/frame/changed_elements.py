"""Which elements of a structure each parameter changes, found from the terms of K and M."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from fmu.fem.modes.separable import Geometry, SeparableModel
from fmu.fem.modes.static import ROTATIONS, TRANSLATIONS
from fmu.types import BoolArray, IntArray

_BALANCED = 1e-9
"""Largest resultant of forces that count as balanced, relative to the stiffness that causes the forces."""


def geometry_of(model: SeparableModel) -> Geometry:
    """Return the geometry of a model. Raise ValueError if it has none."""
    if model.geometry is None:
        raise ValueError("model: must have a geometry to be drawn (got none)")
    return model.geometry


class Elements(NamedTuple):
    """Which elements of a structure each parameter changes.

    Attributes
    ----------
    changed : ndarray of bool, shape (n_elements, n_parameters)
        The elements that a parameter certainly changes.
    hidden : ndarray of bool, shape (n_elements, n_parameters)
        The elements that a parameter may change. Where nodes follow other nodes, as in an RBE2, several elements
        may act on the same degrees of freedom. If terms with different parameters act on these degrees of freedom,
        the matrices do not show which parameter changes which element.
    """

    changed: BoolArray
    hidden: BoolArray


def changed_elements(model: SeparableModel) -> BoolArray:
    """Return a mask of the elements that each parameter changes, shape (n_elements, n_parameters).

    Elements that a parameter only may change are left out; see `Elements.hidden`. Raise ValueError if the model
    has no geometry.
    """
    return find_elements(model).changed


def find_elements(model: SeparableModel) -> Elements:
    """Return the elements that each parameter changes or may change.

    If both ends of an element are free, a parameter changes it if a term with that parameter couples the ends. If
    one end is fixed, a parameter changes the element if a term with that parameter causes forces at the free end
    that are not in equilibrium under a rigid translation of the structure, or under equal rotations of all nodes
    if the term acts on rotations only, as torsion does. For an element with a fixed end, mass terms count only for
    parameters that change no stiffness.

    Raises
    ------
    ValueError
        If the model has no geometry.
    """
    geometry = geometry_of(model)
    a, b = np.asarray(geometry.elements).T
    nodes, dofs = np.array([(row, i) for row, _, seen in model.locate_motions() for i in seen]).T
    has = sp.csr_array((np.ones(len(dofs)), (nodes, dofs)), shape=(len(geometry.nodes), model.n_dof))
    free = has.sum(axis=1) > 0
    ends, end = free[a] & free[b], np.where(free[a], a, b)
    inside, beside = _overlapping(has, a, b, ends, end)
    changed, hidden = np.zeros((2, len(a), model.n_parameters), dtype=bool)
    translation, rotation = np.zeros((2, model.n_dof, 3))
    for (_, direction), i in model.dof_of.items():
        for motion, names in ((translation, TRANSLATIONS), (rotation, ROTATIONS)):
            if direction in names:
                motion[i, names.index(direction)] = 1.0
    stiff = np.any([np.array(term.powers) != 0 for term in model.K_terms], axis=0)
    for terms, of in ((model.K_terms, np.ones_like(stiff)), (model.M_terms, ~stiff)):
        touched: dict[bytes, BoolArray] = {}  # by the parameters that the terms have
        for term in terms:
            if term.constant and not beside.any():
                continue
            joined = (has @ abs(term.matrix) @ has.T).tocsr()
            diagonal = np.abs(term.matrix.diagonal())
            turns_only = terms is model.K_terms and not diagonal[translation.any(axis=1)].any()
            forces = np.abs(term.matrix @ (rotation if turns_only else translation)).max(axis=1)
            loaded = has @ (forces > _BALANCED * diagonal)
            by = np.array(term.powers) != 0
            own = np.where(ends, np.asarray(joined[a, b]) > 0, loaded[end] > 0)
            changed[np.ix_(ends & own, by)] = True
            changed[np.ix_(~ends & own, by & of)] = True
            touched[by.tobytes()] = touched.get(by.tobytes(), False) | own
        several = np.sum(list(touched.values()), axis=0) > 1
        for by, own in touched.items():
            hidden[np.ix_(own & (inside | beside & several), np.frombuffer(by, dtype=bool))] = True
    return Elements(changed & ~hidden, changed & hidden)


def _overlapping(
    has: sp.csr_array, a: IntArray, b: IntArray, ends: BoolArray, end: IntArray
) -> tuple[BoolArray, BoolArray]:
    """Return masks of the elements within one rigid body, and of those that share both ends with another element.

    Ends are shared if their nodes have a degree of freedom in common, as in the matrix `has` (n_nodes, n_dof), or
    if both are fixed. The elements in `ends` have two free ends, `a` and `b`, and the others one, `end`.
    """
    inside, beside = np.zeros((2, len(a)), dtype=bool)
    shared = (has @ has.T).tocsr()
    p, q, one = a[ends], b[ends], end[~ends]
    inside[ends] = np.asarray(shared[p, q]) > 0
    same = shared[p][:, p].multiply(shared[q][:, q]) + shared[p][:, q].multiply(shared[q][:, p])
    beside[ends] = np.diff(same.tocsr().indptr) > 1
    beside[~ends] = np.diff(shared[one][:, one].tocsr().indptr) > 1
    return inside, beside
