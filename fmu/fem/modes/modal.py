"""Modes of a structure, merged from its decoupled blocks, which may be full or reduced."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmu.fem.modes.block import Block
from fmu.fem.modes.eigensolver import SingularMassError, eigen
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import coefficients, weighted_sum
from fmu.numbers import significant
from fmu.types import BoolArray, FloatArray, IntArray

# An eigenvalue this small relative to the highest of interest belongs to a rigid-body mode. If K is singular to
# the last digit, the eigenvalue is 0 exactly (`fmu.fem.modes.eigensolver`); matrices exported with ten digits
# leave more.
RIGID = 1e-9
# An eigenvalue below zero by more than this share of the largest of the modes in use is not rounding. These modes
# lie far below the structure's highest mode, and rounding errors are relative to the highest mode.
NEGATIVE = 1e-6
_EQUAL = 1e-6
_TIE, _FAR = 1e-8, 5.0
"""Weight of ln²(f/f_measured) that is subtracted from the MAC, and largest |ln(f/f_measured)| that counts. At most
2.5e-7 is thus subtracted."""


def is_rigid(eigenvalues: FloatArray) -> BoolArray:
    """Return a mask (..., m) of the rigid-body modes among a structure's lowest m modes.

    They are the modes with eigenvalues up to `RIGID` times the largest, including negative ones. NaN counts as
    elastic.
    """
    return eigenvalues <= RIGID * np.fmax.reduce(eigenvalues, axis=-1, keepdims=True)


def frequency_hz(eigenvalue: FloatArray) -> FloatArray:
    """Convert eigenvalues λ to frequencies √λ / 2π in Hz, with NaN if λ is clearly negative.

    Parameters
    ----------
    eigenvalue : ndarray, shape (..., m), (rad/s)²
        Eigenvalues of one structure's modes along the last axis. A negative λ is attributed to rounding, and
        counts as zero, if |λ| is at most 1e-6 of the largest |λ| of these modes.
    """
    if np.count_nonzero(eigenvalue < 0.0):
        scale = np.fmax.reduce(np.abs(eigenvalue), axis=-1, keepdims=True)
        eigenvalue = np.where(eigenvalue < -NEGATIVE * scale, np.nan, np.maximum(eigenvalue, 0.0))
    return np.sqrt(eigenvalue) / (2.0 * np.pi)


def frequency_gradient(frequency: FloatArray, eigenvalue_gradient: FloatArray) -> FloatArray:
    """Return the frequency gradients ∂f/∂θ = ∂λ/∂θ / (8 π² f), which are not finite where f is 0.

    Parameters
    ----------
    frequency : ndarray, shape (n, m), Hz
    eigenvalue_gradient : ndarray, shape (n, m, n_parameters)
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return eigenvalue_gradient / (8.0 * np.pi**2 * frequency[..., None])


def mac(phi: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the modal assurance criterion (MAC) between two sets of shapes (Allemang & Brown 1982).

    MAC = |φᵀψ|² / (φᵀφ · ψᵀψ) at the measured coordinates. If a shape is zero there or contains NaN, its MAC with
    every shape is 0.

    Parameters
    ----------
    phi : ndarray, shape (..., n_coordinates, m)
    reference : ndarray, shape (..., n_coordinates, r)

    Returns
    -------
    ndarray, shape (..., r, m)
    """
    cross = np.swapaxes(reference, -1, -2) @ phi
    size = np.sum(reference**2, axis=-2)[..., :, None] * np.sum(phi**2, axis=-2)[..., None, :]
    return np.divide(cross**2, size, out=np.zeros_like(cross), where=size > 0.0)


def assign(
    mac: FloatArray, computed_hz: FloatArray | None = None, measured_hz: FloatArray | None = None
) -> IntArray:
    """Return the mode assigned to each reference, one to one, so that the total MAC is largest.

    Parameters
    ----------
    mac : ndarray, shape (n, n_modes, n_candidates)
    computed_hz, measured_hz : ndarray, shapes (n, n_candidates) and (n_modes,) or (n, n_modes), optional
        Frequencies of the candidates, which may be NaN, and of the references. Where MACs are equal within
        rounding, the nearer frequency decides. The penalty is convex in ln f: modes of one shape keep their order.

    Returns
    -------
    ndarray of int, shape (n, n_modes)
        Candidate indices.

    Notes
    -----
    If the references' best candidates are all different, they are the optimum. The assignment solver is called
    only for rows where two references share their best candidate.
    """
    if computed_hz is not None and measured_hz is not None:
        positive = np.fmax(computed_hz, np.finfo(float).tiny)  # 0 Hz and NaN are the farthest
        off = np.log(positive[..., None, :] / measured_hz[..., :, None])
        mac = mac - _TIE * np.clip(off, -_FAR, _FAR) ** 2
    best = np.argmax(mac, axis=2)
    ordered = np.sort(best, axis=1)
    in_conflict = np.flatnonzero(np.any(ordered[:, 1:] == ordered[:, :-1], axis=1))
    if in_conflict.size:
        from scipy.optimize import linear_sum_assignment
    for i in in_conflict:
        best[i] = linear_sum_assignment(mac[i], maximize=True)[1]
    return best


def fix_sign(shapes: FloatArray) -> FloatArray:
    """Return the shapes with signs chosen so that each shape's largest component by magnitude is positive.

    If the magnitudes of several components are within a relative 1e-6 of the largest, as in an antisymmetric mode,
    the first of these components is made positive. Rounding then does not determine the sign.

    Parameters
    ----------
    shapes : ndarray, shape (..., n, m)
        Columns are shapes. A column of NaN is not changed.
    """
    size = np.abs(shapes)
    first = np.argmax(size >= (1.0 - _EQUAL) * np.max(size, axis=-2, keepdims=True), axis=-2)
    leading = np.take_along_axis(shapes, first[..., None, :], axis=-2)
    return np.where(leading < 0.0, -shapes, shapes)


@dataclass(frozen=True)
class ModalSolution:
    """Selected modes of a structure at n parameter vectors.

    Attributes
    ----------
    eigenvalues : ndarray, shape (n, m), (rad/s)²; NaN where a solve failed or is not accurate
    gradient : ndarray, shape (n, m, n_parameters), or None
    block, rank : ndarray of int, shape (n, m)
        Each mode's block index, and its index (from 0) within that block.
    """

    eigenvalues: FloatArray
    gradient: FloatArray | None
    block: IntArray
    rank: IntArray

    @property
    def failed(self) -> BoolArray:
        """Mask of modes without a solution, shape (n, m)."""
        return np.isnan(self.eigenvalues)

    def columns(self, picked: IntArray) -> ModalSolution:
        """Return the solution for the modes in the given columns only."""
        gradient = None if self.gradient is None else self.gradient[:, picked]
        return ModalSolution(self.eigenvalues[:, picked], gradient, self.block[:, picked], self.rank[:, picked])


def count_modes(blocks: Sequence[Block]) -> int:
    """Return how many modes with a finite frequency a structure with these blocks has."""
    return sum(block.n_modes for block in blocks)


def solve_spectrum(
    blocks: Sequence[Block], theta: FloatArray, count: int, gradient: bool = False
) -> ModalSolution:
    """Return the lowest `count` modes of the whole structure, in ascending order over all its `blocks`.

    A reduced block gives only the modes for which it was trained. If one of its higher modes might be among the
    lowest modes at a theta, all eigenvalues at that theta are NaN, and the full model is needed. They are NaN too
    if a block cannot be solved.

    Raises
    ------
    ValueError
        If `count` is not positive, or the structure has fewer modes.
    """
    available = sum(min(count, block.n_modes) for block in blocks)
    if not 1 <= count <= available:
        raise ValueError(f"count: must lie in 1..{available}, the modes of the structure (got {count})")
    values, slopes = [], []
    for block in blocks:
        n_trained = min(count, block.n_trained)
        if gradient:
            lam, phi = block.modes(theta, n_trained)
            slopes.append(block.eigenvalue_gradient(theta, lam, phi))
        else:
            lam = block.eigenvalues(theta, n_trained)
        values.append(lam)
    merged = np.concatenate(values, axis=1)
    order = np.argsort(merged, axis=1, kind="stable")[:, :count]
    row = np.arange(len(theta))[:, None]
    lowest = merged[row, order]
    known = ~np.isnan(merged).any(axis=1)  # NaN is sorted last, so that the modes above would move down
    for block, lam in zip(blocks, values, strict=True):
        if lam.shape[1] < min(count, block.n_modes):
            known &= lowest[:, -1] < lam[:, -1]
    if np.count_nonzero(known) < len(known):
        lowest[~known] = np.nan
    widths = [lam.shape[1] for lam in values]
    owner, rank = np.repeat(np.arange(len(widths)), widths), np.concatenate([np.arange(w) for w in widths])
    chosen = np.concatenate(slopes, axis=1)[row, order] if gradient else None
    return ModalSolution(lowest, chosen, owner[order], rank[order])


def join_shapes(
    blocks: Sequence[Block], theta: FloatArray, modes: ModalSolution, counts: Mapping[int, int] | None = None
) -> FloatArray:
    """Return the mass-normalised shapes (n_dof, m) of the modes `modes` at one theta (1, n_parameters).

    All blocks must be full. A shape is zero outside its own block. Its sign is set by `fix_sign`. `counts` maps a
    block's index to the number of its modes that were computed to obtain `modes`; if it is given, large blocks are
    not solved again.
    """
    block, rank = modes.block[0], modes.rank[0]
    shapes = np.zeros((sum(len(of.dofs) for of in blocks), len(block)))
    for b in np.unique(block):
        columns = np.flatnonzero(block == b)
        _, phi = blocks[b].modes(theta, (counts or {}).get(int(b), int(rank[columns].max()) + 1))
        shapes[np.ix_(blocks[b].dofs, columns)] = phi[0][:, rank[columns]]
    return fix_sign(shapes)


def why_unsolved(
    blocks: Sequence[Block], theta: FloatArray, counts: Mapping[int, int], model: SeparableModel | None = None
) -> str | None:
    """Return the reason why a full block cannot be solved at theta (n_parameters,), or None if all can.

    `counts` has the number of modes needed of each block, keyed by its index. The `model` of the blocks, if given,
    names the node that is to blame.
    """
    for b, count in counts.items():
        found = _of_block(blocks[b], theta, count)
        if found is not None:
            reason, dof = found
            if dof is None or model is None:
                return reason
            node, direction = model.dofs[dof]
            return f"{reason} at node {model.place_names.get(node, node)} {direction}"
    return None


def _of_block(block: Any, theta: FloatArray, count: int) -> tuple[str, int | None] | None:
    """Return why a block fails and, if one degree of freedom is to blame, its index in the model.

    Return None if the block can be solved.
    """
    K, M = (weighted_sum(terms, coefficients(terms, theta[None])[0]) for terms in (block.K_terms, block.M_terms))
    for name, matrix in (("K", K), ("M", M)):
        if not np.all(np.isfinite(matrix.data)):
            return f"{name} is not finite", None
    try:
        lam, _ = eigen(K, M, count)
    except SingularMassError as error:
        mass = M.diagonal()
        least = int(np.argmin(mass))
        if mass[least] < 0.0:
            return f"M is not positive semidefinite: its diagonal is {significant(mass[least])}", int(
                block.dofs[least]
            )
        said = str(error)
        return (
            f"the eigenvalue solver did not converge ({said})" if said.startswith("eigenproblem") else said
        ), None
    if not np.all(np.isfinite(lam)):
        return "the eigenvalue solver did not converge (an eigenvalue is not finite)", None
    # relative to the largest eigenvalue solved for, as in frequency_hz
    if lam[0] < -NEGATIVE * np.max(np.abs(lam)):
        return f"K is not positive semidefinite: an eigenvalue is {significant(lam[0])} (rad/s)²", None
    return None
