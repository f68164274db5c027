"""What the posterior asks of a structural model, and the block-wise view that pairing works on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from fmu.fem.modal import FullBlock
from fmu.fem.separable import SeparableModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@runtime_checkable
class ModalModel(Protocol):
    """A map from parameters to the frequencies of the measured modes.

    Attributes
    ----------
    n_parameters, n_modes : int
    """

    n_parameters: int
    n_modes: int

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, shape (n, n_modes), at theta (n, n_parameters); NaN where a solve failed."""
        ...

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies (n, n_modes) and their gradients (n, n_modes, n_parameters)."""
        ...


class Block(Protocol):
    """One decoupled part of a structure: an exact, independent eigenproblem."""

    dofs: IntArray
    size: int

    def eigenvalues(self, theta: FloatArray, count: int) -> FloatArray:
        """Return the lowest eigenvalues, shape (n, count), (rad/s)²."""
        ...

    def modes(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return eigenvalues (n, count) and mass-normalised shapes (n, size, count)."""
        ...

    def eigenvalue_gradient(self, theta: FloatArray, lam: FloatArray, phi: FloatArray) -> FloatArray:
        """Return ∂λ/∂θ, shape (n, m, n_parameters)."""
        ...

    def observe(
        self, dofs: IntArray, reference: FloatArray
    ) -> tuple[Callable[[FloatArray], FloatArray], FloatArray]:
        """Return a map of shapes (n, size, m) to (n, q', m), and the references (q', n_modes) beside it.

        With `dofs` (q,) the block's own degrees of freedom at which shapes are compared and `reference`
        (q, n_modes): the mapped shapes have the norms that the shapes have at those degrees of freedom, and
        the same products with the references.
        """
        ...


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

    def spectrum(self, theta: FloatArray, count: int) -> tuple[FloatArray, IntArray, IntArray]:
        """Return the lowest `count` modes of the whole structure, sorted over the blocks.

        Returns
        -------
        eigenvalues : ndarray, shape (n, count), ascending
        block, rank : ndarray of int, shape (n, count)
            Which block a mode belongs to and its number (from 0) there.
        """
        parts = [block.eigenvalues(theta, min(count, block.size)) for block in self.blocks]
        label = np.array([(b, r) for b, part in enumerate(parts) for r in range(part.shape[1])])
        merged = np.concatenate(parts, axis=1)
        if merged.shape[1] < count:
            raise ValueError(f"count: the structure has {merged.shape[1]} modes (got {count})")
        order = np.argsort(merged, axis=1, kind="stable")[:, :count]
        return np.take_along_axis(merged, order, axis=1), label[order, 0], label[order, 1]
