"""Whether a structure holds together: motions without strain, and mass everywhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from fmu.fem.modal import DENSE_LIMIT, eigen, symmetric_factor
from fmu.fem.motion import rigid_in_words, rigid_motions, what_moves
from fmu.fem.separable import SeparableModel

FloatArray = NDArray[np.float64]

# Of a matrix scaled to a unit diagonal: a smaller eigenvalue cannot be told from zero. Rounding in assembled beams
# stays below 1e-15; a cantilever of 1000 elements has 5e-13.
ZERO = 2e-14
# Of the same: further below zero is no rounding, not even of matrices exported with ten digits.
NEGATIVE = 1e-8
_AT_ONCE = 12


@dataclass(frozen=True, eq=False)
class FreeMotions:
    """The motions of a structure that take no energy.

    Attributes
    ----------
    shapes : ndarray, shape (n_dof, n)
        A basis of them, m and rad.
    rigid : ndarray, shape (6, r)
        Those among them that move the whole structure as a rigid body: its translation, m, and rotation, rad,
        about its centre. None for a model that does not know its geometry.
    negative : ndarray, shape (n_dof, n_negative)
        Motions whose energy is negative, which no structure has.
    """

    shapes: FloatArray
    rigid: FloatArray | None
    negative: FloatArray

    @property
    def count(self) -> int:
        """How many independent motions there are."""
        return self.shapes.shape[1]


def free_motions(model: SeparableModel, theta: ArrayLike) -> FreeMotions:
    """Return the motions without strain at theta (n_parameters,), where the stiffness is as it is meant to be.

    Block by block, by the eigenvalues of K scaled to a unit diagonal, which makes metres and radians, stiff and
    soft parts alike.

    Raises
    ------
    ValueError
        If K is not finite.
    """
    K = sp.csr_array(model.K(theta))
    if not np.all(np.isfinite(K.data)):
        raise ValueError("the stiffness matrix must be finite")
    zero, negative = [np.zeros((model.n_dof, 0))], [np.zeros((model.n_dof, 0))]
    for dofs in model.blocks:
        lam, shapes = _lowest(K[dofs][:, dofs])
        full = np.zeros((model.n_dof, len(lam)))
        full[dofs] = shapes
        zero.append(full[:, (lam < ZERO) & (lam > -NEGATIVE)])
        negative.append(full[:, lam <= -NEGATIVE])
    found = np.concatenate(zero, axis=1)
    return FreeMotions(found, rigid_motions(model, found), np.concatenate(negative, axis=1))


def require_stable(
    model: SeparableModel, theta: ArrayLike, free: bool = False, label: Callable[[Any], str] = str
) -> None:
    """Raise ValueError if the structure can move without strain, or a part of it has no mass.

    Parameters
    ----------
    model : SeparableModel
    theta : array_like, shape (n_parameters,)
        As a rule the start.
    free : bool
        Whether the structure is free on purpose: then its motions as a rigid body (up to six where the geometry is
        not known) are no mistake, and only others are.
    label : callable
        Gives what to call a node.

    Raises
    ------
    ValueError
        Saying how many motions there are and what moves in them, which motion has negative energy, or where there
        is no mass.
    """
    _require_mass(model, theta, label)
    motions = free_motions(model, theta)
    if motions.negative.shape[1]:
        moving = what_moves(model, motions.negative, label)
        raise ValueError(f"the stiffness matrix must not be negative for any motion (it is where {moving})")
    rigid = np.zeros((6, 0)) if motions.rigid is None else motions.rigid
    allowed = 0 if not free else 6 if motions.rigid is None else rigid.shape[1]
    if motions.count <= allowed:
        return
    words = [] if free else rigid_in_words(rigid)
    if motions.count > rigid.shape[1]:
        words.append(what_moves(model, motions.shapes, label, rigid))
    n = motions.count - (allowed if free else 0)
    ways = f"in {n} way{'s' if n > 1 else ''}{' beside those of a free body' if free else ''}"
    raise ValueError(f"the structure is a mechanism: it can move without strain {ways} ({'; '.join(words)})")


def _lowest(matrix: Any) -> tuple[FloatArray, FloatArray]:
    """Return the eigenvalues near and below zero of a symmetric matrix scaled to a unit diagonal, and one more.

    With the motions that belong to them, in the matrix's own units, of size one in the scaled ones.
    """
    S, scale = _scaled(matrix)
    n = S.shape[0]
    if n <= DENSE_LIMIT:
        lam, shapes = sl.eigh(S.toarray(), check_finite=False)
    else:
        # pivots tell the signs (Sylvester); Lanczos would not see what lies far below zero
        unit, shift = sp.csr_array(sp.eye_array(n)), NEGATIVE
        while np.any(symmetric_factor(S + shift * unit).U.diagonal() <= 0.0):
            shift *= 10.0
        if shift > NEGATIVE:
            lam, shapes = eigen(S + shift * unit, unit, 1, definite=True)
            return lam - shift, scale[:, None] * shapes
        count = _AT_ONCE
        lam, shapes = eigen(S, unit, count, definite=True)
        while lam[-1] < ZERO and count < n:
            count = min(2 * count, n)
            lam, shapes = eigen(S, unit, count, definite=True)
    return lam, scale[:, None] * shapes


def _scaled(matrix: Any) -> tuple[Any, FloatArray]:
    diagonal = np.abs(matrix.diagonal())
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    return sp.csr_array(sp.diags_array(scale) @ matrix @ sp.diags_array(scale)), scale


def _require_mass(model: SeparableModel, theta: ArrayLike, label: Callable[[Any], str]) -> None:
    M = sp.csr_array(model.M(theta))
    if not np.all(np.isfinite(M.data)):
        raise ValueError("the mass matrix must be finite")
    rule = "the mass matrix must be positive definite"
    none = np.flatnonzero(M.diagonal() <= 0.0)
    if len(none):
        bare = np.zeros((model.n_dof, len(none)))
        bare[none, np.arange(len(none))] = 1.0
        raise ValueError(f"{rule} (it has none where {what_moves(model, bare, label)})")
    for dofs in model.blocks:
        lam, shapes = _lowest(M[dofs][:, dofs])
        wrong = lam < ZERO
        if np.any(wrong):
            full = np.zeros((model.n_dof, int(np.sum(wrong))))
            full[dofs] = shapes[:, wrong]
            raise ValueError(f"{rule} (it is not where {what_moves(model, full, label)})")
