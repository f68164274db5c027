"""The paired modes of a structure as its sensors see them, with their derivatives."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.fem.modes.blocks import BlockModel
from fmu.fem.modes.modal import BlockPrediction, frequency_gradient, frequency_hz
from fmu.fem.pairing.rules import IndexPairing, Observation, PairedSolve, Pairing, RankPairing, ShapePairing
from fmu.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


Solved = dict[int, tuple[FloatArray, FloatArray]]
"""Eigenvalues and shapes by block."""


@dataclass(frozen=True)
class ModalPrediction:
    """What a modal test would have given at n parameter vectors, if the model were right.

    Attributes
    ----------
    frequencies : ndarray, shape (n, n_modes), Hz; NaN where a solve failed
    shapes : ndarray, shape (n, n_sensors, n_modes)
        Mass-normalised at the sensors, of either sign.
    frequency_slopes : ndarray, shape (n, n_modes, n_parameters), or None
    shape_slopes : ndarray, shape (n, n_sensors, n_modes, n_parameters), or None
    """

    frequencies: FloatArray
    shapes: FloatArray
    frequency_slopes: FloatArray | None = None
    shape_slopes: FloatArray | None = None


def with_rows[Batch: "DataclassInstance"](batch: Batch, rows: BoolArray, other: Batch) -> Batch:
    """Return a dataclass of arrays (n, …) with those of `other` in the rows given; None stays None."""
    replaced = {}
    for field in fields(batch):
        mine = getattr(batch, field.name)
        if mine is not None:
            mine = mine.copy()
            mine[rows] = getattr(other, field.name)
        replaced[field.name] = mine
    return type(batch)(**replaced)


class SensorView:
    """A model, full or reduced, with its pairing and the sensors that look at it.

    Parameters
    ----------
    model : BlockModel
    pairing : Pairing
    sensors : scipy.sparse.csr_array, shape (n_sensors, n_dof)
        See `fmu.fem.modes.separable.SeparableModel.observation`.
    """

    def __init__(self, model: BlockModel, pairing: Pairing, sensors: Any) -> None:
        self.model, self.pairing, self._sensors = model, pairing, sensors
        self._n_sensors = sensors.shape[0]

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what is prepared when needed."""
        prepared = ("_solve", "_compared", "_rows")
        return {name: value for name, value in self.__dict__.items() if name not in prepared}

    # prepared when they are first needed: many problems have no errors of shapes, and never look

    @cached_property
    def _solve(self) -> PairedSolve:
        return self.pairing.bind(self.model)

    @cached_property
    def _compared(self) -> dict[int, Observation]:
        return self.pairing.observe(self.model) if isinstance(self.pairing, ShapePairing) else {}

    @cached_property
    def _rows(self) -> list[Any]:
        return [self._sensors[:, block.dofs] for block in self.model.blocks]

    def __call__(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return what the sensors see at theta (n, n_parameters)."""
        block, rank, solved = self._paired(theta, gradient)
        n, m = block.shape
        p = self.model.n_parameters
        seen = BlockPrediction(np.full((n, m), np.nan), np.full((n, self._n_sensors, m), np.nan))
        if gradient:
            slopes = np.full((n, m, p), np.nan), np.full((n, self._n_sensors, m, p), np.nan)
            seen = seen._replace(eigenvalue_slopes=slopes[0], shape_slopes=slopes[1])
        for b in np.unique(block[block >= 0]):
            row, column = np.nonzero(block == b)
            ranks = rank[row, column]
            count = int(ranks.max()) + 1
            found = self.model.blocks[b].seen(theta, count, self._rows[b], gradient, solved.get(int(b)))
            seen.eigenvalues[row, column] = found.eigenvalues[row, ranks]
            seen.shapes[row, :, column] = found.shapes[row, :, ranks]
            if gradient:
                seen.eigenvalue_slopes[row, column] = found.eigenvalue_slopes[row, ranks]  # type: ignore[index]
                seen.shape_slopes[row, :, column] = found.shape_slopes[row, :, ranks]  # type: ignore[index]
        frequencies = frequency_hz(seen.eigenvalues)
        if not gradient:
            return ModalPrediction(frequencies, seen.shapes)
        assert seen.eigenvalue_slopes is not None  # narrowed for the type checker: asked for above
        slopes_hz = frequency_gradient(frequencies, seen.eigenvalue_slopes)
        return ModalPrediction(frequencies, seen.shapes, slopes_hz, seen.shape_slopes)

    def _paired(self, theta: FloatArray, gradient: bool) -> tuple[IntArray, IntArray, Solved]:
        """Return block and rank of the paired modes, (n, n_modes), and the modes of the blocks solved on the way.

        Block and rank are −1 in rows where a solve failed.
        """
        fixed = self._fixed()
        if fixed is not None:
            block, rank = np.array(fixed.block), np.array(fixed.rank)
            return np.tile(block, (len(theta), 1)), np.tile(rank, (len(theta), 1)), {}
        if not isinstance(self.pairing, ShapePairing):
            modes = self._solve(theta)
            failed = np.isnan(modes.eigenvalues).any(axis=1, keepdims=True)
            return np.where(failed, -1, modes.block), np.where(failed, -1, modes.rank), {}
        solved, shapes = {}, {}
        for b in self._compared:
            n_candidates = self.pairing.n_candidates(self.model, b)
            solved[b] = self.model.blocks[b].modes(theta, self.model.blocks[b].n_required(n_candidates, gradient))
            shapes[b] = solved[b][1][:, :, :n_candidates]
        block, rank, _ = self.pairing.assigned(self._compared, shapes)
        values = [lam[:, : shapes[b].shape[2]] for b, (lam, _) in solved.items()]
        failed = np.isnan(np.concatenate(values, axis=1)).any(axis=1, keepdims=True)
        return np.where(failed, -1, block), np.where(failed, -1, rank), solved

    def _fixed(self) -> RankPairing | None:
        """Return the pairing if it is the same everywhere: in a single block a number is a rank."""
        if isinstance(self.pairing, IndexPairing) and len(self.model.blocks) == 1:
            numbers = self.pairing.numbers
            return RankPairing((0,) * len(numbers), tuple(number - 1 for number in numbers))
        return self.pairing if isinstance(self.pairing, RankPairing) else None
