"""Rules that pair computed modes with measured modes.

Pairing by number takes the k-th mode of the sorted spectrum, whatever its shape, as in Boulkaibet et al.
(`fmu.paper.published`). Pairing by shape is the one-to-one assignment that maximises the sum of MAC values. A
beam's eigenvalues within one plane are simple, so the assignment by shape usually cannot change inside a decoupled
block. If the assignment is verified to be constant, each mode has a fixed rank within its block, and only
eigenvalues need to be computed.

A mode's rank is its index (from 0) among the modes of its block.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
import scipy.sparse as sp

from fmu.fem.modes.block import Block, Observation, Solved, shapes_at
from fmu.fem.modes.modal import ModalSolution, assign, frequency_hz, solve_spectrum
from fmu.types import FloatArray, IntArray

SPARE = 3
"""Number of candidate modes beyond a block's highest reference mode."""
SOFTNESS = 0.02
"""Temperature τ of the weights exp(MAC/τ): from MAC 1 to MAC 0, the logarithm of the weight falls by 1/τ = 50."""
AT_ONCE = 16
"""Number of points whose shapes are compared at once, which limits the memory."""
Observed = Mapping[int, Observation] | None
"""Observations of the blocks whose shapes are compared, keyed by block index; None if not known yet."""


class Pairing(ABC):
    """A rule that decides which computed modes are paired with the measured modes, and solves for them.

    Attributes
    ----------
    is_constant : bool
        Whether the pairing is the same at every theta.
    """

    is_constant: ClassVar[bool] = False

    def observe(self, blocks: Sequence[Block]) -> dict[int, Observation]:
        """Return the `Observation` of each block whose shapes are compared, keyed by block; empty by default."""
        return {}

    @abstractmethod
    def counts(self, blocks: Sequence[Block]) -> dict[int, int]:
        """Return how many of each block's lowest modes must be computed for all paired modes, keyed by block."""

    @abstractmethod
    def solve(
        self, blocks: Sequence[Block], theta: FloatArray, gradient: bool = False, observed: Observed = None
    ) -> ModalSolution:
        """Return the paired modes at theta (n, n_parameters), with eigenvalue gradients if `gradient`.

        `observed` is the result of `observe`, if it is already known.
        """

    @abstractmethod
    def locate(
        self, blocks: Sequence[Block], theta: FloatArray, gradient: bool, observed: Observed = None
    ) -> tuple[IntArray, IntArray, Solved]:
        """Return the block and rank of each paired mode, (n, n_modes) each, and the solved modes keyed by block.

        If the pairing depends on solved modes, block and rank are −1 in rows where a solve failed. The dict is
        empty unless shapes are compared. With `gradient`, its modes are enough for derivatives by `Block.seen`.
        """


@dataclass(frozen=True)
class RankPairing(Pairing):
    """Pairing of measured mode i with the mode of rank ``rank[i]`` in block ``block[i]``, at every theta."""

    block: tuple[int, ...]
    rank: tuple[int, ...]
    is_constant: ClassVar[bool] = True

    def counts(self, blocks: Sequence[Block]) -> dict[int, int]:
        """Return how many of a block's lowest modes must be computed, for each block that has paired modes."""
        pairs = sorted(zip(self.block, self.rank, strict=True))
        return {block: rank + 1 for block, rank in pairs}

    @cached_property
    def _labels(self) -> tuple[IntArray, IntArray]:
        """Blocks and ranks as rows (1, n_modes), to be repeated for each theta."""
        return np.array(self.block)[None], np.array(self.rank)[None]

    @cached_property
    def _columns(self) -> list[IntArray]:
        """Indices of the measured modes in each block, in ascending order of block index."""
        return [np.flatnonzero(self._labels[0][0] == b) for b in np.unique(self.block)]

    @cached_property
    def _parts(self) -> list[tuple[int, int, slice | IntArray]]:
        """For each block with paired modes: its index, the number of modes to solve for, and the paired ranks."""
        parts: list[tuple[int, int, slice | IntArray]] = []
        for columns in self._columns:
            ranks = self._labels[1][0, columns]
            parts.append((self.block[columns[0]], int(ranks.max()) + 1, _as_slice(ranks)))
        return parts

    @cached_property
    def _order(self) -> IntArray:
        """Permutation (n_modes,) from modes sorted by block to the order of the measured modes."""
        return np.argsort(np.concatenate(self._columns))

    def solve(
        self, blocks: Sequence[Block], theta: FloatArray, gradient: bool = False, observed: Observed = None
    ) -> ModalSolution:
        """Return the paired modes. Only their blocks are solved, and shapes are computed only if `gradient`."""
        values, slopes = [], []
        for b, count, ranks in self._parts:
            block = blocks[b]
            if gradient:
                lam, phi = block.modes(theta, count)
                slopes.append(block.eigenvalue_gradient(theta, lam[:, ranks], phi[:, :, ranks]))
            else:
                lam = block.eigenvalues(theta, count)
            values.append(lam[:, ranks])
        owner, rank, _ = self.locate(blocks, theta, gradient)
        return ModalSolution(
            self._join_columns(values), self._join_columns(slopes) if gradient else None, owner, rank
        )

    def locate(
        self, blocks: Sequence[Block], theta: FloatArray, gradient: bool, observed: Observed = None
    ) -> tuple[IntArray, IntArray, Solved]:
        """Return each mode's block and rank, (n, n_modes) each, at theta (n, n_parameters), and an empty dict."""
        block, rank = self._labels
        return block.repeat(len(theta), axis=0), rank.repeat(len(theta), axis=0), {}

    def _join_columns(self, parts: list[FloatArray]) -> FloatArray:
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)[:, self._order]


def _as_slice(indices: IntArray) -> slice | IntArray:
    """Return consecutive indices as a slice, so that NumPy makes no copy; return other indices unchanged."""
    first = int(indices[0])
    consecutive = np.array_equal(indices, np.arange(first, first + len(indices)))
    return slice(first, first + len(indices)) if consecutive else indices


@dataclass(frozen=True)
class IndexPairing(Pairing):
    """Pairing of measured mode i with mode ``numbers[i]`` (from 1) in the sorted spectrum, as in Boulkaibet et al.

    Raise ValueError if there are no numbers, or if they are not distinct and positive.

    Attributes
    ----------
    numbers : tuple of int
    n_rigid : int
        Number of rigid-body modes, already added to `numbers`, if the measured numbers start at the first elastic
        mode; otherwise 0.
    """

    numbers: tuple[int, ...]
    n_rigid: int = field(default=0, repr=False)
    name: ClassVar[str] = "index"
    by_shape: ClassVar[Literal[False]] = False
    is_soft: ClassVar[bool] = False
    softness = 0.0

    def __post_init__(self) -> None:
        if not self.numbers or min(self.numbers) < 1 or len(set(self.numbers)) < len(self.numbers):
            raise ValueError(f"numbers: must be distinct and count from 1 (got {self.numbers})")

    def solve(
        self, blocks: Sequence[Block], theta: FloatArray, gradient: bool = False, observed: Observed = None
    ) -> ModalSolution:
        """Return the modes with these numbers in the merged, sorted spectrum of all blocks."""
        return solve_spectrum(blocks, theta, max(self.numbers), gradient).columns(np.array(self.numbers) - 1)

    def locate(
        self, blocks: Sequence[Block], theta: FloatArray, gradient: bool, observed: Observed = None
    ) -> tuple[IntArray, IntArray, Solved]:
        """Return the paired modes' blocks and ranks, and an empty dict; with one block, nothing is solved."""
        if len(blocks) == 1:  # a number is a rank, so that nothing is solved for
            rank = np.tile(np.array(self.numbers) - 1, (len(theta), 1))
            return np.zeros_like(rank), rank, {}
        modes = self.solve(blocks, theta)
        failed = np.isnan(modes.eigenvalues).any(axis=1, keepdims=True)
        return np.where(failed, -1, modes.block), np.where(failed, -1, modes.rank), {}

    def counts(self, blocks: Sequence[Block]) -> dict[int, int]:
        """Return how many of the lowest modes in each block may be paired, keyed by block index."""
        return {b: min(max(self.numbers), block.n_modes) for b, block in enumerate(blocks) if block.n_modes}

    def find_needed(
        self, blocks: Sequence[Block], eigenvalues: Mapping[int, FloatArray], shapes: Mapping[int, FloatArray]
    ) -> tuple[RankPairing | None, dict[int, int]]:
        """Return None, and how many modes each block needs; see `ShapePairing.find_needed`."""
        values = [eigenvalues[b] for b in sorted(eigenvalues)]
        highest = np.sort(np.concatenate(values, axis=1), axis=1)[:, max(self.numbers) - 1]
        # one mode more than was ever among the lowest shows that no mode is missing
        counts = (int(np.max(np.sum(lam <= highest[:, None], axis=1))) + 1 for lam in values)
        return None, {b: min(c, eigenvalues[b].shape[1]) for b, c in zip(sorted(eigenvalues), counts, strict=True)}

    def identity(self) -> tuple[bytes, tuple[sp.csr_array, ...]]:
        """Return the bytes and sparse matrices that, with the class name, identify the rule."""
        return repr(self).encode(), ()


@dataclass(frozen=True, eq=False)
class ShapePairing(Pairing):
    """One-to-one assignment of computed modes to reference shapes by MAC.

    Attributes
    ----------
    rows : scipy.sparse.csr_array, shape (q, n_dof)
        The coordinates at which shapes are compared, one per row, from
        `fmu.fem.modes.separable.SeparableModel.observation`.
    shapes : ndarray, shape (q, n_modes)
        Reference shapes at these coordinates: measured shapes, or shapes of the model before updating.
    margin : int
        Number of candidates in each block in excess of the number of references, if the block has enough modes.
        This allows for unmeasured modes below the references, such as rigid-body modes, and for a few modes above.
    measured_hz : ndarray, shape (n_modes,), optional
        Measured frequencies, which decide between modes that have the same shape at these coordinates.
    """

    rows: sp.csr_array
    shapes: FloatArray
    margin: int = SPARE
    measured_hz: FloatArray | None = None
    name: ClassVar[str] = "shape"
    by_shape: ClassVar[Literal[True]] = True
    is_soft: ClassVar[bool] = False
    softness = 0.0

    def solve(
        self, blocks: Sequence[Block], theta: FloatArray, gradient: bool = False, observed: Observed = None
    ) -> ModalSolution:
        """Return the modes assigned by MAC, from all blocks in which a reference shape is nonzero.

        If one of these blocks cannot be solved at a theta, all eigenvalues there are NaN.
        """
        solved, merged, (block, rank, column) = self._solve(blocks, theta, False, observed)
        # where a block failed, modes of other blocks must not take its references
        merged[np.any(np.isnan(merged), axis=1)] = np.nan
        lam = np.take_along_axis(merged, column, axis=1)
        if not gradient:
            return ModalSolution(lam, None, block, rank)
        slopes = np.concatenate(
            [blocks[b].eigenvalue_gradient(theta, *modes) for b, modes in solved.items()], axis=1
        )
        return ModalSolution(lam, np.take_along_axis(slopes, column[..., None], axis=1), block, rank)

    def locate(
        self, blocks: Sequence[Block], theta: FloatArray, gradient: bool, observed: Observed = None
    ) -> tuple[IntArray, IntArray, Solved]:
        """Return the block and rank of each paired mode, and the solved modes keyed by block; see `Pairing`."""
        solved, merged, (owner, rank, _) = self._solve(blocks, theta, gradient, observed)
        failed = np.isnan(merged).any(axis=1, keepdims=True)
        return np.where(failed, -1, owner), np.where(failed, -1, rank), solved

    def _solve(
        self, blocks: Sequence[Block], theta: FloatArray, gradient: bool, observed: Observed
    ) -> tuple[Solved, FloatArray, tuple[IntArray, IntArray, IntArray]]:
        """Return each block's modes, the eigenvalues of all candidates, and the result of `assign_modes`."""
        observed = self.observe(blocks) if observed is None else observed
        solved: Solved = {}
        values, shapes = [], {}
        for b in observed:
            block, count = blocks[b], self.n_candidates(blocks, b)
            lam, phi = solved[b] = block.modes(theta, block.n_required(count, gradient))
            values.append(lam[:, :count])
            shapes[b] = phi[:, :, :count]
        merged = np.concatenate(values, axis=1)
        return solved, merged, self.assign_modes(observed, merged, shapes)

    def n_candidates(self, blocks: Sequence[Block], b: int) -> int:
        """Return the number of candidate modes in block `b`."""
        return min(self.shapes.shape[1] + self.margin, blocks[b].n_modes)

    def counts(self, blocks: Sequence[Block]) -> dict[int, int]:
        """Return how many of the lowest modes in each block may be paired, keyed by block index."""
        return {b: self.n_candidates(blocks, b) for b in self.observe(blocks)}

    def observe(self, blocks: Sequence[Block]) -> dict[int, Observation]:
        """Return an `Observation` for each block in which a reference shape is nonzero, keyed by block index."""
        observed = {}
        for b, block in enumerate(blocks):
            seen = self.rows[:, block.dofs]
            inside = np.flatnonzero(np.diff(seen.indptr))
            if block.n_modes and np.any(self.shapes[inside]):
                observed[b] = block.observe(seen[inside], self.shapes[inside])
        return observed

    def find_needed(
        self, blocks: Sequence[Block], eigenvalues: Mapping[int, FloatArray], shapes: Mapping[int, FloatArray]
    ) -> tuple[RankPairing | None, dict[int, int]]:
        """Return the pairing as fixed ranks, or None if it varies, and how many modes each block needs.

        Parameters
        ----------
        blocks : sequence of Block
        eigenvalues : mapping of int to ndarray, shape (n, n_candidates)
        shapes : mapping of int to ndarray, shape (n, size, n_candidates)
            Modes of each block of `counts` at points that cover the parameter box, including its corners.
        """
        fixed = self.constant(blocks, eigenvalues, shapes)
        if fixed is None:
            return None, {b: lam.shape[1] for b, lam in eigenvalues.items()}
        ranks = list(zip(fixed.block, fixed.rank, strict=True))
        return fixed, {b: 1 + max(r for owner, r in ranks if owner == b) for b in fixed.block}

    def constant(
        self, blocks: Sequence[Block], eigenvalues: Mapping[int, FloatArray], shapes: Mapping[int, FloatArray]
    ) -> RankPairing | None:
        """Return the MAC assignment as fixed ranks, or None unless it is the same at every sampled theta."""
        observed = self.observe(blocks)
        merged = np.concatenate([eigenvalues[b] for b in observed], axis=1)
        found: RankPairing | None = None
        for first in range(0, len(next(iter(shapes.values()))), AT_ONCE):
            part = {b: of_block[first : first + AT_ONCE] for b, of_block in shapes.items()}
            block, rank, _ = self.assign_modes(observed, merged[first : first + AT_ONCE], part)
            fixed = RankPairing(tuple(map(int, block[0])), tuple(map(int, rank[0])))
            if np.any(block != block[0]) or np.any(rank != rank[0]) or found not in (None, fixed):
                return None
            found = fixed
        return found

    def assign_modes(
        self, observed: Mapping[int, Observation], eigenvalues: FloatArray, shapes: Mapping[int, FloatArray]
    ) -> tuple[IntArray, IntArray, IntArray]:
        """Return the block, rank and candidate column of the mode assigned to each reference, (n, n_modes) each.

        Parameters
        ----------
        observed : mapping of int to Observation
            From `observe`.
        eigenvalues : ndarray, shape (n, total number of candidates)
            Eigenvalues of the candidates in all blocks of `observed`, side by side.
        shapes : mapping of int to ndarray, shape (n, size, n_candidates)
            Shapes of the candidates in each of these blocks; a shape with NaN has MAC 0.
        """
        reference_size = np.sum(self.shapes**2, axis=0)[:, None]
        similarity, label = [], []
        for b, (rows, reference) in observed.items():
            seen = shapes_at(rows, shapes[b])
            cross = reference.T @ seen
            size = reference_size * np.sum(seen**2, axis=1)[:, None, :]
            similarity.append(np.divide(cross**2, size, out=np.zeros_like(cross), where=size > 0.0))
            label += [(b, r) for r in range(seen.shape[2])]
        alike = np.nan_to_num(np.concatenate(similarity, axis=2))
        column = assign(alike, frequency_hz(eigenvalues), self.measured_hz)
        return np.array(label)[column, 0], np.array(label)[column, 1], column

    def identity(self) -> tuple[bytes, tuple[sp.csr_array, ...]]:
        """Return the bytes and sparse matrices that, with the class name, identify the rule."""
        measured = b"" if self.measured_hz is None else self.measured_hz.tobytes()
        return repr(self.margin).encode() + np.ascontiguousarray(self.shapes).tobytes() + measured, (self.rows,)


@dataclass(frozen=True, eq=False)
class SoftPairing(ShapePairing):
    """Pairing of every measured mode with every candidate, with normalised weights exp(MAC/τ).

    `solve` and `locate` give the modes of the one-to-one assignment, as in `ShapePairing`. A soft pairing is never
    constant, because all candidates are needed everywhere. Raise ValueError unless τ is positive and finite.

    Attributes
    ----------
    softness : float
        Temperature τ of the weights.
    """

    softness: float = SOFTNESS
    name: ClassVar[str] = "soft"
    is_soft: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not (np.isfinite(self.softness) and self.softness > 0.0):
            raise ValueError(f"softness: must be positive and finite (got {self.softness})")

    def constant(
        self, blocks: Sequence[Block], eigenvalues: Mapping[int, FloatArray], shapes: Mapping[int, FloatArray]
    ) -> RankPairing | None:
        """Return None: a soft pairing is never constant."""
        return None
