"""Stability checks for a structure: its strain-free motions, and the mass that moves in them."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from fmu.fem.frame.components import DIRECTIONS
from fmu.fem.modes.eigensolver import (
    NEGATIVE,
    ZERO,
    clear_factor,
    is_semidefinite,
    lowest,
)
from fmu.fem.modes.separable import RigidArm, SeparableModel
from fmu.fem.modes.solver import LARGE, scale_matrix, unit_diagonal
from fmu.numbers import listed, names_in_words
from fmu.types import FloatArray

# Motions that agree to this tolerance are the same: in a soft structure, motions of zero energy are no more
# accurate.
_SAME = 1e-4
_SHOWN = 4


class MechanismError(ValueError):
    """Raised when a structure has strain-free motions that are not intended."""


@dataclass(frozen=True, eq=False)
class FreeMotions:
    """Motions of a structure with zero or negative strain energy.

    Attributes
    ----------
    shapes : ndarray, shape (n_dof, n)
        Basis of the strain-free motions, m and rad.
    rigid : ndarray, shape (6, r), or None
        Strain-free rigid-body motions of the whole structure: translation, m, and rotation, rad, about the centre
        of the nodes. None if they are unknown; see `rigid_motions`.
    negative : ndarray, shape (n_dof, n_negative)
        Motions with negative strain energy, which no real structure has. If a decoupled block of more than
        `fmu.fem.modes.eigensolver.DENSE_LIMIT` degrees of freedom has such motions, only one of them is given
        here, and no motion of that block is in `shapes`.
    """

    shapes: FloatArray
    rigid: FloatArray | None
    negative: FloatArray

    @property
    def count(self) -> int:
        """Number of independent strain-free motions."""
        return self.shapes.shape[1]


def free_motions(model: SeparableModel, theta: ArrayLike) -> FreeMotions:
    """Return the motions with zero or negative strain energy at theta (n_parameters,), usually the starting point.

    The motions are computed block by block, as eigenvectors of K scaled to a unit diagonal. Metres and radians,
    and stiff and soft parts, thus count equally.

    Raises
    ------
    ValueError
        If K is not finite.
    """
    K = sp.csr_array(model.K(theta))
    if not np.all(np.isfinite(K.data)):
        raise ValueError("the stiffness matrix must be finite")
    at = np.atleast_1d(np.asarray(theta, dtype=float))
    zero, negative = _lowest_motions(model, K, at)
    return FreeMotions(zero, rigid_motions(model, zero), negative)


def _lowest_motions(
    model: SeparableModel, matrix: sp.csr_array, theta: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the motions with zero and with negative energy xᵀ A x of a symmetric matrix A, each (n_dof, n).

    If a block of more than `fmu.fem.modes.eigensolver.DENSE_LIMIT` degrees of freedom has motions with negative
    energy, only one motion of that block is returned. If A is K at `theta` (n_parameters,), the factorisations of
    blocks with at least `LARGE` degrees of freedom are stored for the first solve.
    """
    zero, negative = ([np.zeros((model.n_dof, 0))] for _ in range(2))
    for dofs in model.blocks:
        S, scale = unit_diagonal(matrix[dofs][:, dofs])
        made = partial(clear_factor, S, scale)
        if theta is not None and len(dofs) >= LARGE and model.last_factor(dofs).at(theta, made) is not None:
            continue
        lam, vectors = lowest(S)
        for found, wanted in ((zero, (lam < ZERO) & (lam > -NEGATIVE)), (negative, lam <= -NEGATIVE)):
            motions = np.zeros((model.n_dof, int(np.sum(wanted))))
            motions[dofs] = scale[:, None] * vectors[:, wanted]
            found.append(motions)
    return np.concatenate(zero, axis=1), np.concatenate(negative, axis=1)


def require_stable(
    model: SeparableModel, theta: ArrayLike, free: bool = False, label: Callable[[Any], str] = str
) -> None:
    """Raise ValueError if the structure can move without strain, or its mass is negative or missing.

    Parameters
    ----------
    model : SeparableModel
    theta : array_like, shape (n_parameters,)
        Usually the starting point.
    free : bool
        True if the structure is meant to be free. Its rigid-body motions are then allowed. If these are not
        known, up to six strain-free motions are allowed instead.
    label : callable
        Returns a node's name.

    Raises
    ------
    ValueError
        If a matrix is not finite, or the mass matrix is zero. Also if a matrix is not positive semidefinite, or
        degrees of freedom have neither stiffness nor mass; the message then says what moves.
    MechanismError
        If there are strain-free motions that move mass and are not allowed. The message states their number, and
        says what moves.
    """
    _require_mass(model, theta, label)
    motions = free_motions(model, theta)
    if motions.negative.shape[1]:
        moving = what_moves(model, motions.negative, label)
        raise ValueError(f"the stiffness matrix must be positive semidefinite (it is not where {moving})")
    loose = _without_mass(model, theta, motions.shapes)
    if loose.shape[1]:
        raise ValueError(
            "the structure is a mechanism: degrees of freedom with neither stiffness nor mass can move "
            f"({what_moves(model, loose, label)}{_of_reduced_integration(model)})"
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
    raise MechanismError(f"the structure is a mechanism: it can move without strain {ways} ({'; '.join(words)})")


def _of_reduced_integration(model: SeparableModel) -> str:
    """Return a phrase on hourglass motions if the mesh has solids that may have them, or an empty string."""
    mesh = None if model.geometry is None else model.geometry.mesh
    if mesh is None or "hexahedron20" not in mesh.kinds:
        return ""
    return (
        "; if its solids of 20 nodes have reduced integration (C3D20R), they may have such motions where they are "
        "one element wide: use full integration (C3D20), or more elements over the width"
    )


def _require_mass(model: SeparableModel, theta: ArrayLike, label: Callable[[Any], str]) -> None:
    """Raise ValueError if M is not finite, is all zero, or is negative for some motion.

    Some degrees of freedom may be massless.
    """
    M = sp.csr_array(model.M(theta))
    if not np.all(np.isfinite(M.data)):
        raise ValueError("the mass matrix must be finite")
    if M.nnz == 0 or abs(M).max() == 0.0:
        raise ValueError("the mass matrix must have entries (all of it is zero)")
    if all(is_semidefinite(M[dofs][:, dofs]) for dofs in model.blocks):
        return  # there may be hundreds of motions without mass, which are not searched for
    _, negative = _lowest_motions(model, M)
    if negative.shape[1]:
        moving = what_moves(model, negative, label)
        raise ValueError(f"the mass matrix must be positive semidefinite (it is not where {moving})")


def _without_mass(model: SeparableModel, theta: ArrayLike, motions: FloatArray) -> FloatArray:
    """Return the strain-free motions that move no mass, shape (n_dof, n)."""
    if not motions.shape[1]:
        return motions
    _, scale = unit_diagonal(sp.csr_array(model.K(theta)))
    N = np.linalg.qr(motions / scale[:, None])[0]
    M = scale_matrix(model.M(theta), scale)
    energy, turned = np.linalg.eigh(N.T @ (M @ N))
    return np.asarray(scale[:, None] * (N @ turned[:, energy <= ZERO * M.diagonal().max()]))


def rigid_motions(model: SeparableModel, shapes: FloatArray) -> FloatArray | None:
    """Return the rigid-body motions contained in a space of motions.

    Parameters
    ----------
    model : SeparableModel
    shapes : ndarray, shape (n_dof, n)
        A basis of the space, m and rad.

    Returns
    -------
    ndarray, shape (6, r), or None
        Translation, m, and rotation, rad, about the centre of the nodes, one motion per column. None if the model
        has no geometry, the geometry lacks a node, or motions are weighted sums of degrees of freedom.
    """
    named = _rigid_rows(model)
    if named is None:
        return None
    moved, held = named
    if not shapes.shape[1]:
        return np.zeros((6, 0))
    # only motions in which all fixed directions are at rest
    candidates = np.eye(6) if not len(held) else _null_space(held)
    size = _sizes(model)[:, None]
    W = size * (moved @ candidates)
    U, s, Vt = np.linalg.svd(W, full_matrices=False)
    kept = s > _SAME * max(s.max(initial=0.0), 1e-300)
    U, back = U[:, kept], candidates @ (Vt[kept].T / s[kept])
    Y = np.linalg.qr(size * shapes)[0]
    left, cosine, _ = np.linalg.svd(U.T @ Y, full_matrices=False)
    coefficients = back @ left[:, cosine > 1.0 - _SAME]
    length = _length(model)
    coefficients[3:] /= length
    return np.asarray(coefficients)


def rigid_in_words(rigid: FloatArray) -> list[str]:
    """Return phrases that describe rigid-body motions (6, r), translations first."""
    if not rigid.shape[1]:
        return []
    turn = rigid[3:]
    _, s, Vt = np.linalg.svd(turn, full_matrices=True)
    rank = int(np.sum(s > _SAME * np.abs(rigid).max()))
    words = []
    shifts, turns = _axes_in_words(rigid[:3] @ Vt[rank:].T), _axes_in_words(turn @ Vt[:rank].T)
    if shifts:
        words.append(f"every point along {names_in_words(shifts)}")
    if turns:
        words.append(f"the whole turning about {names_in_words(turns)}")
    return words


def what_moves(
    model: SeparableModel,
    shapes: FloatArray,
    label: Callable[[Any], str] = str,
    rigid: FloatArray | None = None,
) -> str:
    """Return a phrase that names the degrees of freedom that move most, such as "a rx, b rx move most".

    Parameters
    ----------
    model : SeparableModel
    shapes : ndarray, shape (n_dof, n)
        A basis of the space of motions.
    label : callable
        Returns a node's name.
    rigid : ndarray, shape (6, r), optional
        Rigid-body motions to remove from that space.
    """
    size = _sizes(model)[:, None]
    Y = np.linalg.qr(size * shapes)[0]
    named = _rigid_rows(model)
    if rigid is not None and rigid.shape[1] and named is not None:
        scaled = rigid * np.array([1.0] * 3 + [_length(model)] * 3)[:, None]
        Q = np.linalg.qr(size * (named[0] @ scaled))[0]
        U, _, _ = np.linalg.svd(Y - Q @ (Q.T @ Y), full_matrices=False)
        Y = U[:, : Y.shape[1] - rigid.shape[1]]
    share = np.sum(Y**2, axis=1)
    share = np.round(share / share.max(), 3)  # equal motions keep the order of the model
    order = np.argsort(-share, kind="stable")
    most = [i for i in order[:_SHOWN].tolist() if share[i] > 0.25]
    names = ", ".join(f"{label(model.dofs[i][0])} {model.dofs[i][1]}" for i in most)
    return f"{names} move{'s' if len(most) == 1 else ''} most"


def _rigid_rows(model: SeparableModel) -> tuple[FloatArray, FloatArray] | None:
    """Return the rigid-body motions at the degrees of freedom (n_dof, 6) and in the fixed directions (n_fixed, 6).

    Rotations are about the centre and scaled by the structure's length. Directions in which no node can move are
    ignored, and so are rotations of nodes in another program's mesh. Return None if the model has no geometry, the
    geometry lacks a node, or motions are weighted sums of the degrees of freedom.
    """
    if model.geometry is None:
        return None
    geometry, row_of = model.geometry, model.geometry.row_of
    nodes = np.asarray(geometry.nodes, dtype=float)
    if model.motions or not all(node in row_of for node, _ in model.dof_of):
        return None
    centre, length = nodes.mean(axis=0), _length(model)

    def row(node: Hashable, direction: str) -> list[float]:
        arm = RigidArm(node, tuple((nodes[row_of[node]] - centre).tolist())).motion(direction)
        return [arm.get(d, 0.0) / (length if d.startswith("r") else 1.0) for d in DIRECTIONS]

    moved = np.array([row(node, d) for node, d in model.dofs])
    rows = np.unique(geometry.elements)
    used = rows.tolist() if geometry.ids is None else np.asarray(geometry.ids)[rows].tolist()
    # in another program's mesh, nodes may lack rotations without being fixed
    known = [d for d in DIRECTIONS[: 6 if geometry.ids is None else 3] if any(d == e for _, e in model.dofs)]
    held = [row(node, d) for node in used for d in known if (node, d) not in model.dof_of]
    return moved, np.array(held).reshape(-1, 6)


def _length(model: SeparableModel) -> float:
    extent = 0.0 if model.geometry is None else float(np.ptp(model.geometry.nodes, axis=0).max())
    return extent if extent > 0.0 else 1.0


def _sizes(model: SeparableModel) -> FloatArray:
    """Return scale factors (n_dof,): 1 for translations, and the structure's length in m for rotations."""
    length = _length(model)
    return np.array([length if direction.startswith("r") else 1.0 for _, direction in model.dofs])


def _null_space(rows: FloatArray) -> FloatArray:
    _, s, Vt = np.linalg.svd(rows, full_matrices=True)
    rank = int(np.sum(s > 1e-9 * s.max(initial=0.0)))
    return Vt[rank:].T


def _axes_in_words(vectors: FloatArray) -> list[str]:
    """Return words for the directions that vectors (3, k) span: axis names, or components if oblique."""
    U, s, _ = np.linalg.svd(vectors, full_matrices=False)
    basis = U[:, s > _SAME * s.max(initial=0.0)]
    along = [k for k in range(3) if np.sum(basis[k] ** 2) > 1.0 - 2.0 * _SAME]
    rest = basis.copy()
    rest[along] = 0.0
    others = np.linalg.svd(rest, full_matrices=False)[0][:, : basis.shape[1] - len(along)].T
    signed = [np.round(v * np.sign(v[np.argmax(np.abs(v))]), 2) + 0.0 for v in others]
    return ["xyz"[k] for k in along] + [f"({listed(v)})" for v in signed]
