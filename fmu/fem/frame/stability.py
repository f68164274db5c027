"""Whether a structure holds together: motions without strain, and what mass they move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from fmu.fem.frame.motion import rigid_in_words, rigid_motions, what_moves
from fmu.fem.modes.eigensolver import NEGATIVE, ZERO, lowest, scaled, unit_diagonal
from fmu.fem.modes.separable import SeparableModel
from fmu.types import FloatArray


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
        S, scale = unit_diagonal(K[dofs][:, dofs])
        lam, vectors = lowest(S)
        full = np.zeros((model.n_dof, len(lam)))
        full[dofs] = scale[:, None] * vectors
        zero.append(full[:, (lam < ZERO) & (lam > -NEGATIVE)])
        negative.append(full[:, lam <= -NEGATIVE])
    found = np.concatenate(zero, axis=1)
    return FreeMotions(found, rigid_motions(model, found), np.concatenate(negative, axis=1))


def require_stable(
    model: SeparableModel, theta: ArrayLike, free: bool = False, label: Callable[[Any], str] = str
) -> None:
    """Raise ValueError if the structure can move without strain, or its mass is negative or missing.

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
    loose = _without_mass(model, theta, motions.shapes)
    if loose.shape[1]:
        raise ValueError(
            "the structure is a mechanism: what has neither stiffness nor mass can move "
            f"({what_moves(model, loose, label)})"
        )
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


def _require_mass(model: SeparableModel, theta: ArrayLike, label: Callable[[Any], str]) -> None:
    """Raise ValueError if a mass is negative, or there is none at all; degrees of freedom may have none."""
    M = sp.csr_array(model.M(theta))
    if not np.all(np.isfinite(M.data)):
        raise ValueError("the mass matrix must be finite")
    if M.nnz == 0 or abs(M).max() == 0.0:
        raise ValueError("the mass matrix must have entries (all of it is zero)")
    negative = [np.zeros((model.n_dof, 0))]
    for dofs in model.blocks:
        S, scale = unit_diagonal(M[dofs][:, dofs])
        lam, vectors = lowest(S)
        full = np.zeros((model.n_dof, int(np.sum(lam <= -NEGATIVE))))
        full[dofs] = scale[:, None] * vectors[:, lam <= -NEGATIVE]
        negative.append(full)
    found = np.concatenate(negative, axis=1)
    if found.shape[1]:
        moving = what_moves(model, found, label)
        raise ValueError(f"the mass matrix must not be negative for any motion (it is where {moving})")


def _without_mass(model: SeparableModel, theta: ArrayLike, motions: FloatArray) -> FloatArray:
    """Return the motions among those without strain, (n_dof, n), that move no mass."""
    if not motions.shape[1]:
        return motions
    _, scale = unit_diagonal(sp.csr_array(model.K(theta)))
    N = np.linalg.qr(motions / scale[:, None])[0]
    M = scaled(model.M(theta), scale)
    energy, turned = np.linalg.eigh(N.T @ (M @ N))
    return np.asarray(scale[:, None] * (N @ turned[:, energy <= ZERO * M.diagonal().max()]))
