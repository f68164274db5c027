"""A structure's predicted modes at the sensors: the paired modes, or all candidates with their MAC."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from fmu.fem.modes.block import Block, BlockPrediction, Observation, Solved
from fmu.fem.modes.modal import frequency_gradient, frequency_hz
from fmu.fem.modes.solver import Matrix
from fmu.fem.pairing.rules import ShapePairing
from fmu.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

UNSEEN = 1e-12
"""Squared norm of a shape at the sensors, relative to the largest, below which the shape is mere rounding."""


@dataclass(frozen=True)
class ModalPrediction:
    """Predicted result of a modal test at n parameter vectors.

    Attributes
    ----------
    frequencies : ndarray, shape (n, n_modes), Hz; NaN where a solve failed or λ is clearly negative
    shapes : ndarray, shape (n, n_sensors, n_modes)
        Shapes at the sensors, with arbitrary signs: mass-normalised for a structure given by matrices, of unit
        length for a surrogate, and in the function's scale for a user's function.
    frequency_slopes : ndarray, shape (n, n_modes, n_parameters), or None
    shape_slopes : ndarray, shape (n, n_sensors, n_modes, n_parameters), or None
    frequency_variance, shape_variance : ndarray, shaped like frequencies (Hz²) and shapes, or None
        Variances of a surrogate's errors, which are mutually independent; None if the model is not a surrogate.
    frequency_variance_slopes, shape_variance_slopes : ndarray, with a last axis of n_parameters, or None
    """

    frequencies: FloatArray
    shapes: FloatArray
    frequency_slopes: FloatArray | None = None
    shape_slopes: FloatArray | None = None
    frequency_variance: FloatArray | None = None
    shape_variance: FloatArray | None = None
    frequency_variance_slopes: FloatArray | None = None
    shape_variance_slopes: FloatArray | None = None

    @property
    def failed(self) -> BoolArray:
        """Mask of modes without a frequency, shape (n, n_modes)."""
        return np.isnan(self.frequencies)


@dataclass(frozen=True)
class Candidates:
    """Candidate modes for pairing with m measured modes, at n parameter vectors.

    Attributes
    ----------
    frequencies : ndarray, shape (n, k), Hz; NaN where a solve failed or λ is clearly negative
    shapes : ndarray, shape (n, n_sensors, k)
        Shapes at the sensors if shapes were measured, otherwise empty: n_sensors = 0.
    mac : ndarray, shape (n, m, k)
        MAC with the measured shapes or the references; −inf for a mode that moves none of the compared
        coordinates, NaN where a solve failed.
    frequency_slopes : ndarray, shape (n, k, n_parameters), or None
    shape_slopes : ndarray, shape (n, n_sensors, k, n_parameters), or None
    mac_slopes : ndarray, shape (n, m, k, n_parameters), or None
    """

    frequencies: FloatArray
    shapes: FloatArray
    mac: FloatArray
    frequency_slopes: FloatArray | None = None
    shape_slopes: FloatArray | None = None
    mac_slopes: FloatArray | None = None

    @property
    def failed(self) -> BoolArray:
        """Mask of modes without a frequency, shape (n, k)."""
        return np.isnan(self.frequencies)


def with_rows[Batch: "DataclassInstance"](batch: Batch, rows: BoolArray, other: Batch) -> Batch:
    """Return a dataclass of arrays (n, …) in which the rows marked in `rows` are replaced by all rows of `other`.

    Attributes that are None stay None.
    """
    replaced = {}
    for name, mine in vars(batch).items():
        if mine is not None:
            mine = mine.copy()
            mine[rows] = vars(other)[name]
        replaced[name] = mine
    return type(batch)(**replaced)


def join_batches[Batch: "DataclassInstance"](parts: Sequence[Batch]) -> Batch:
    """Concatenate dataclasses of arrays (n, …) along the first axis. Attributes that are None stay None."""
    columns = {name: [vars(part)[name] for part in parts] for name in vars(parts[0])}
    return type(parts[0])(**{n: None if c[0] is None else np.concatenate(c) for n, c in columns.items()})


def predict_modes(
    blocks: Sequence[Block],
    located: tuple[IntArray, IntArray, Solved],
    rows: Sequence[Matrix],
    theta: FloatArray,
    gradient: bool,
) -> ModalPrediction:
    """Return the paired modes at the sensors from a full or reduced model, with derivatives if `gradient`.

    A mode and its derivatives are NaN where its solve failed.

    Parameters
    ----------
    blocks : sequence of Block
    located : tuple
        The result of `fmu.fem.pairing.rules.Pairing.locate` at theta.
    rows : sequence of array or sparse, each of shape (n_sensors, size)
        Sensor rows of each block, from `Block.coordinates`.
    theta : ndarray, shape (n, n_parameters)
    gradient : bool
    """
    block, rank, solved = located
    n, m = block.shape
    q, p = rows[0].shape[0], blocks[0].n_parameters
    seen = BlockPrediction(np.full((n, m), np.nan), np.full((n, q, m), np.nan))
    if gradient:
        seen = seen._replace(
            eigenvalue_slopes=np.full((n, m, p), np.nan), shape_slopes=np.full((n, q, m, p), np.nan)
        )
    for b in np.unique(block[block >= 0]):
        row, column = np.nonzero(block == b)
        ranks = rank[row, column]
        count = int(ranks.max()) + 1
        found = blocks[b].seen(theta, count, rows[b], gradient, solved.get(int(b)))
        seen.eigenvalues[row, column] = found.eigenvalues[row, ranks]
        seen.shapes[row, :, column] = found.shapes[row, :, ranks]
        if gradient:
            seen.eigenvalue_slopes[row, column] = found.eigenvalue_slopes[row, ranks]  # type: ignore[index]
            seen.shape_slopes[row, :, column] = found.shape_slopes[row, :, ranks]  # type: ignore[index]
    frequencies = frequency_hz(seen.eigenvalues)
    if seen.eigenvalue_slopes is None:
        return ModalPrediction(frequencies, seen.shapes)
    slopes_hz = frequency_gradient(frequencies, seen.eigenvalue_slopes)
    return ModalPrediction(frequencies, seen.shapes, slopes_hz, seen.shape_slopes)


def predict_candidates(
    blocks: Sequence[Block],
    rule: ShapePairing,
    compared: Mapping[int, Observation],
    at_sensors: bool,
    theta: FloatArray,
    gradient: bool,
) -> Candidates:
    """Return all modes of a full or reduced model that are candidates for pairing.

    Parameters
    ----------
    blocks : sequence of Block
    rule : ShapePairing
    compared : mapping of int to Observation
        Comparison coordinates and reference shapes there, keyed by block index.
    at_sensors : bool
        Whether these coordinates are the sensors. If so, the shapes there are returned in addition to their MAC.
    theta : ndarray, shape (n, n_parameters)
    gradient : bool
        Whether derivatives are needed.
    """
    reference_size = np.sum(rule.shapes**2, axis=0)
    kept = slice(None) if at_sensors else slice(0)
    parts = []
    for b, (rows, reference) in compared.items():
        seen = blocks[b].seen(theta, rule.n_candidates(blocks, b), rows, gradient)
        f = frequency_hz(seen.eigenvalues)
        mac, mac_slopes = _compare(reference, reference_size, seen)
        part = Candidates(f, seen.shapes[:, kept], mac)
        if seen.eigenvalue_slopes is not None and seen.shape_slopes is not None:
            slopes = frequency_gradient(f, seen.eigenvalue_slopes)
            part = Candidates(f, part.shapes, mac, slopes, seen.shape_slopes[:, kept], mac_slopes)
        parts.append(part)
    names = [field.name for field in fields(Candidates)][: None if gradient else 3]
    # the candidates are on the second axis of frequencies and their slopes, on the third axis of all others
    axes = {"frequencies": 1, "frequency_slopes": 1}
    return Candidates(
        **{name: np.concatenate([vars(p)[name] for p in parts], axis=axes.get(name, 2)) for name in names}
    )


def _compare(
    psi: FloatArray, reference_size: FloatArray, seen: BlockPrediction
) -> tuple[FloatArray, FloatArray | None]:
    """Return the MAC between reference i and mode k, (ψ_iᵀφ_k)²/(ψ_iᵀψ_i φ_kᵀφ_k), and its derivatives.

    The MAC has shape (n, m, k). If `seen` has no shape derivatives, the derivatives of the MAC are None. With c =
    ψᵀφ and l = φᵀφ, ∂MAC = (2 c ψᵀ∂φ)/(ψᵀψ l) − 2 MAC φᵀ∂φ / l. A mode that moves none of the coordinates has a
    MAC of −inf with derivatives 0.
    """
    phi = np.ascontiguousarray(seen.shapes)
    length = np.sum(phi**2, axis=1)
    unseen = (length <= UNSEEN * np.max(length, axis=1, keepdims=True))[:, None]
    length = np.where(unseen[:, 0], 1.0, length)[:, None]
    cross = psi.T @ phi
    scale = reference_size[:, None] * length
    mac = cross**2 / scale
    alike = np.where(unseen, -np.inf, mac)
    if seen.shape_slopes is None:
        return alike, None
    n, q, k, p = seen.shape_slopes.shape
    d_phi = np.ascontiguousarray(seen.shape_slopes)
    d_cross = (psi.T @ d_phi.reshape(n, q, k * p)).reshape(n, -1, k, p)
    half_d_length = np.sum(phi[..., None] * d_phi, axis=1)[:, None]
    slopes = 2.0 * (cross / scale)[..., None] * d_cross - 2.0 * (mac / length)[..., None] * half_d_length
    return alike, np.where(unseen[..., None], 0.0, slopes)
