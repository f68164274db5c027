"""Predicted modes of a structure at the sensors: the paired modes, or all candidates with their MAC."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.sparse as sp

from fmu.fem.modes.block import Block, BlockPrediction
from fmu.fem.modes.modal import BlockModel, frequency_gradient, frequency_hz
from fmu.fem.modes.solver import Matrix
from fmu.fem.pairing.rules import PairedSolve, ShapePairing
from fmu.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

UNSEEN = 1e-12
"""Squared norm of a shape at the sensors, relative to the largest, below which the shape is rounding only."""


@dataclass(frozen=True)
class ModalPrediction:
    """Prediction of the result of a modal test at n parameter vectors.

    Attributes
    ----------
    frequencies : ndarray, shape (n, n_modes), Hz; NaN where a solve failed
    shapes : ndarray, shape (n, n_sensors, n_modes)
        Shapes at the sensors, mass-normalised, of either sign.
    frequency_slopes : ndarray, shape (n, n_modes, n_parameters), or None
    shape_slopes : ndarray, shape (n, n_sensors, n_modes, n_parameters), or None
    frequency_variance, shape_variance : ndarray, of the shapes of frequencies (Hz²) and shapes, or None
        Variances of the errors of a surrogate, independent of each other; None if the model is no surrogate.
    frequency_variance_slopes, shape_variance_slopes : ndarray, with a last axis of n_parameters, or None
    frequency_variance_by_noise : ndarray, shape (n, n_modes, n_noise), or None
        Derivatives with respect to inferred standard deviations, on which a discrepancy's variances depend.
    """

    frequencies: FloatArray
    shapes: FloatArray
    frequency_slopes: FloatArray | None = None
    shape_slopes: FloatArray | None = None
    frequency_variance: FloatArray | None = None
    shape_variance: FloatArray | None = None
    frequency_variance_slopes: FloatArray | None = None
    shape_variance_slopes: FloatArray | None = None
    frequency_variance_by_noise: FloatArray | None = None

    @property
    def failed(self) -> BoolArray:
        """Mask of the modes that have no solution, shape (n, n_modes)."""
        return np.isnan(self.frequencies)


@dataclass(frozen=True)
class Candidates:
    """Candidate modes, at n parameter vectors, for a pairing with m measured modes.

    Attributes
    ----------
    frequencies : ndarray, shape (n, k), Hz; NaN where a solve failed
    shapes : ndarray, shape (n, n_sensors, k)
        Shapes at the sensors if shapes were measured, otherwise empty: n_sensors = 0.
    mac : ndarray, shape (n, m, k)
        MAC with the measured shapes or the references; −inf for a mode that moves none of the coordinates
        compared.
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
        """Mask of the modes that have no solution, shape (n, k)."""
        return np.isnan(self.frequencies)


def with_rows[Batch: "DataclassInstance"](batch: Batch, rows: BoolArray, other: Batch) -> Batch:
    """Return a copy of a dataclass of arrays (n, …) with `rows` taken from `other`; None remains None."""
    replaced = {}
    for name, mine in vars(batch).items():
        if mine is not None:
            mine = mine.copy()
            mine[rows] = vars(other)[name]
        replaced[name] = mine
    return type(batch)(**replaced)


def join_batches[Batch: "DataclassInstance"](parts: Sequence[Batch]) -> Batch:
    """Return the batches, dataclasses of arrays (n, …), joined along the first axis; None remains None."""
    columns = {name: [vars(part)[name] for part in parts] for name in vars(parts[0])}
    return type(parts[0])(**{n: None if c[0] is None else np.concatenate(c) for n, c in columns.items()})


class SensorView:
    """The paired modes of a model, full or reduced, as seen by its sensors.

    Parameters
    ----------
    model : BlockModel
    solve : PairedSolve
        The pairing bound to the model.
    sensors : scipy.sparse.csr_array, shape (n_sensors, n_dof)
        From `fmu.fem.modes.separable.SeparableModel.observation`.
    """

    def __init__(self, model: BlockModel, solve: PairedSolve, sensors: sp.csr_array) -> None:
        self.model, self._solve, self._sensors = model, solve, sensors

    def __getstate__(self) -> dict[str, object]:
        """Return the state for pickling, without data that are recomputed on demand."""
        return {name: value for name, value in self.__dict__.items() if name != "rows"}

    @cached_property
    def rows(self) -> list[Matrix]:
        """List of the sensor rows of each block, computed on demand: many problems have no errors of shapes."""
        return [block.coordinates(self._sensors[:, block.dofs]) for block in self.model.blocks]

    def __call__(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return frequencies and shapes at the sensors at theta (n, n_parameters), with optional derivatives."""
        block, rank, solved = self._solve.locate(theta, gradient)
        n, m = block.shape
        q, p = self._sensors.shape[0], self.model.n_parameters
        seen = BlockPrediction(np.full((n, m), np.nan), np.full((n, q, m), np.nan))
        if gradient:
            seen = seen._replace(
                eigenvalue_slopes=np.full((n, m, p), np.nan), shape_slopes=np.full((n, q, m, p), np.nan)
            )
        for b in np.unique(block[block >= 0]):
            row, column = np.nonzero(block == b)
            ranks = rank[row, column]
            count = int(ranks.max()) + 1
            found = self.model.blocks[b].seen(theta, count, self.rows[b], gradient, solved.get(int(b)))
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


class _View(NamedTuple):
    """A block, its number of candidates, the coordinates of comparison, and the reference shapes there."""

    block: Block
    n_candidates: int
    rows: Matrix
    reference: FloatArray


class CandidateView:
    """All modes of a model, full or reduced, that are candidates for a pairing.

    Parameters
    ----------
    model : BlockModel
    rule : ShapePairing
    at_sensors : bool
        Whether the rule compares shapes at the sensors, so that the shapes there are needed in addition to their
        MAC. Otherwise a reduced block is compared in a basis of all shapes that the block can represent.
    """

    def __init__(self, model: BlockModel, rule: ShapePairing, at_sensors: bool) -> None:
        self._model, self._rule, self._at_sensors = model, rule, at_sensors
        self._reference_size = np.sum(rule.shapes**2, axis=0)

    def __getstate__(self) -> dict[str, object]:
        """Return the state for pickling, without data that are recomputed on demand."""
        return {name: value for name, value in self.__dict__.items() if name != "_views"}

    @cached_property
    def _views(self) -> list[_View]:
        views = []
        for b in self._rule.observe(self._model):
            block = self._model.blocks[b]
            rows, reference = block.coordinates(self._rule.rows[:, block.dofs]), self._rule.shapes
            if not self._at_sensors:
                rows, reference = block.compress_rows(rows, reference)
            views.append(_View(block, self._rule.n_candidates(self._model, b), rows, reference))
        return views

    def __call__(self, theta: FloatArray, gradient: bool = False) -> Candidates:
        """Return the candidates at theta (n, n_parameters), with derivatives if `gradient`."""
        parts = [self._of_block(view, theta, gradient) for view in self._views]
        names = [field.name for field in fields(Candidates)][: None if gradient else 3]
        # the candidates are on the second axis of frequencies and their slopes, on the third axis of all others
        axes = {"frequencies": 1, "frequency_slopes": 1}
        return Candidates(
            **{name: np.concatenate([vars(p)[name] for p in parts], axis=axes.get(name, 2)) for name in names}
        )

    def _of_block(self, view: _View, theta: FloatArray, gradient: bool) -> Candidates:
        seen = view.block.seen(theta, view.n_candidates, view.rows, gradient)
        kept = slice(None) if self._at_sensors else slice(0)
        f = frequency_hz(seen.eigenvalues)
        mac, mac_slopes = self._alike(view, seen)
        if seen.eigenvalue_slopes is None or seen.shape_slopes is None:
            return Candidates(f, seen.shapes[:, kept], mac)
        slopes = frequency_gradient(f, seen.eigenvalue_slopes)
        return Candidates(f, seen.shapes[:, kept], mac, slopes, seen.shape_slopes[:, kept], mac_slopes)

    def _alike(self, view: _View, seen: BlockPrediction) -> tuple[FloatArray, FloatArray | None]:
        """Return MAC_ik = (ψ_iᵀφ_k)²/(ψ_iᵀψ_i φ_kᵀφ_k), shape (n, m, k), with slopes if shapes have slopes.

        With c = ψᵀφ and l = φᵀφ, ∂MAC = (2 c ψᵀ∂φ)/(ψᵀψ l) − 2 MAC φᵀ∂φ / l.
        """
        phi, psi = np.ascontiguousarray(seen.shapes), view.reference
        length = np.sum(phi**2, axis=1)
        unseen = (length <= UNSEEN * np.max(length, axis=1, keepdims=True))[:, None]
        length = np.where(unseen[:, 0], 1.0, length)[:, None]
        cross = psi.T @ phi
        scale = self._reference_size[:, None] * length
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
