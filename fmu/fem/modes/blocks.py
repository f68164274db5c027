"""A structure as its decoupled blocks, full or reduced: the view that pairing works on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from fmu.fem.modes.modal import BlockPrediction, FullBlock
from fmu.fem.modes.separable import SeparableModel
from fmu.types import FloatArray, IntArray


class Block(Protocol):
    """One decoupled part of a structure: an exact, independent eigenproblem.

    Attributes
    ----------
    dofs : ndarray of int, shape (n,)
        Its degrees of freedom in the model.
    size : int
        Unknowns of the eigenproblem.
    n_modes, n_trained : int
        How many modes have a finite frequency, and how many of the lowest ones it gives.
    is_reduced : bool
        Whether it is a reduced model of its degrees of freedom.
    massless : bool
        Whether degrees of freedom of the full block have no mass.
    """

    is_reduced: bool
    massless: bool
    dofs: IntArray
    size: int
    n_modes: int
    n_trained: int

    def eigenvalues(self, theta: FloatArray, count: int) -> FloatArray:
        """Return the lowest eigenvalues, shape (n, count), (rad/s)²."""
        ...

    def modes(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return eigenvalues (n, count) and mass-normalised shapes (n, size, count)."""
        ...

    def eigenvalue_gradient(self, theta: FloatArray, lam: FloatArray, phi: FloatArray) -> FloatArray:
        """Return ∂λ/∂θ, shape (n, m, n_parameters)."""
        ...

    def observe(self, rows: Any, reference: FloatArray) -> tuple[Callable[[FloatArray], FloatArray], FloatArray]:
        """Return a map of shapes (n, size, m) to (n, q', m), and the references (q', n_modes) beside it.

        With sparse `rows` (q, size) of the block's own degrees of freedom, the coordinates at which shapes are
        compared, and `reference` (q, n_modes): the mapped shapes have the norms that the shapes have in those
        coordinates, and the same products with the references.
        """
        ...

    def n_required(self, count: int, gradient: bool) -> int:
        """Return how many modes it takes to say how the lowest are seen, and how they move if `gradient`."""
        ...

    def seen(
        self,
        theta: FloatArray,
        count: int,
        rows: Any,
        gradient: bool = False,
        solved: tuple[FloatArray, FloatArray] | None = None,
    ) -> BlockPrediction:
        """Return the lowest modes as the sensors of sparse `rows` (n_sensors, size) see them.

        With `solved`, what `modes` returned for `n_required` modes or more, if that is at hand.
        """
        ...


@dataclass(frozen=True)
class ModalSolution:
    """Chosen modes of a structure at n parameter vectors.

    Attributes
    ----------
    eigenvalues : ndarray, shape (n, m), (rad/s)²; NaN where a solve failed or is not to be trusted
    gradient : ndarray, shape (n, m, n_parameters), or None
    block, rank : ndarray of int, shape (n, m)
        The mode's block and its number (from 0) within it.
    """

    eigenvalues: FloatArray
    gradient: FloatArray | None
    block: IntArray
    rank: IntArray

    def columns(self, picked: IntArray) -> ModalSolution:
        """Return the modes at the given columns alone."""
        gradient = None if self.gradient is None else self.gradient[:, picked]
        return ModalSolution(self.eigenvalues[:, picked], gradient, self.block[:, picked], self.rank[:, picked])


@dataclass(frozen=True, eq=False)
class BlockModel:
    """A structure as its independent blocks, full or reduced.

    Attributes
    ----------
    blocks : tuple of Block
    n_parameters : int
    """

    blocks: tuple[Block, ...]
    n_parameters: int

    @classmethod
    def full(cls, model: SeparableModel) -> BlockModel:
        """Return the unreduced blocks of `model`."""
        return cls(tuple(FullBlock(model, dofs) for dofs in model.blocks), model.n_parameters)

    @property
    def n_modes(self) -> int:
        """How many modes have a finite frequency."""
        return sum(block.n_modes for block in self.blocks)

    def spectrum(self, theta: FloatArray, count: int, gradient: bool = False) -> ModalSolution:
        """Return the lowest `count` modes of the whole structure, ascending over the blocks.

        A reduced block gives only the modes that it was trained for. Where one more of them might have been
        among the lowest, the row is NaN: it takes the full model.

        Raises
        ------
        ValueError
            If the structure has fewer modes.
        """
        available = sum(min(count, block.n_modes) for block in self.blocks)
        if not 1 <= count <= available:
            raise ValueError(f"count: must lie in 1..{available}, the modes of the structure (got {count})")
        values, slopes = [], []
        for block in self.blocks:
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
        known = ~np.isnan(merged).any(axis=1)  # sorted last, NaN would let the others move up
        for block, lam in zip(self.blocks, values, strict=True):
            if lam.shape[1] < min(count, block.n_modes):
                known &= lowest[:, -1] < lam[:, -1]
        if np.count_nonzero(known) < len(known):
            lowest[~known] = np.nan
        widths = [lam.shape[1] for lam in values]
        owner, rank = np.repeat(np.arange(len(widths)), widths), np.concatenate([np.arange(w) for w in widths])
        chosen = np.concatenate(slopes, axis=1)[row, order] if gradient else None
        return ModalSolution(lowest, chosen, owner[order], rank[order])
