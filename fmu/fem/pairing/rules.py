"""Rules that pair computed modes with measured modes.

Pairing by number takes the k-th mode of the sorted spectrum, whatever its shape (the paper). Pairing by shape is
the one-to-one assignment that maximises the sum of MAC values. A beam's eigenvalues within one plane are simple,
so that the assignment by shape usually cannot change inside a decoupled block. Where the assignment is verified to
be constant, each mode has a fixed rank within its block, and eigenvalues suffice.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal, Protocol

import numpy as np
import scipy.sparse as sp

from fmu.fem.modes.block import Observation, Solved
from fmu.fem.modes.modal import BlockModel, FixedModes, ModalSolution, is_rigid
from fmu.types import FloatArray, IntArray

SPARE = 3
"""Number of modes beyond the highest reference of a block that may be candidates."""
SOFTNESS = 0.02
"""Temperature τ of the weights exp(MAC/τ): a shape with MAC 0 costs 1/τ = 50 nats."""
_FAR_BELOW = 1e-3
"""Share of the lowest measured frequency below which a mode is a rigid-body mode."""
AT_ONCE = 16
"""Number of points whose shapes are compared at once, which limits the memory."""


class PairedSolve(Protocol):
    """A pairing bound to a model, which solves at theta (n, n_parameters) and returns the paired modes."""

    def __call__(self, theta: FloatArray, gradient: bool = False) -> ModalSolution:
        """Return the paired modes, with the gradients of their eigenvalues if `gradient`."""
        ...

    def locate(self, theta: FloatArray, gradient: bool) -> tuple[IntArray, IntArray, Solved]:
        """Return block and rank of the paired modes, (n, n_modes), and the modes of the blocks solved for.

        Block and rank are −1 in rows where a solve failed. With `gradient`, as many modes are solved for as
        `Block.seen` needs for derivatives.
        """
        ...


@dataclass(frozen=True)
class RankPairing:
    """Pairing of measured mode i with mode ``rank[i]`` (from 0) of block ``block[i]``, at every theta."""

    block: tuple[int, ...]
    rank: tuple[int, ...]
    is_constant: ClassVar[bool] = True

    def bind(self, model: BlockModel) -> PairedSolve:
        """Return the solver of these blocks only, which solves for shapes only if gradients are requested."""
        return FixedModes(model, self.block, self.rank)

    def counts(self, model: BlockModel) -> dict[int, int]:
        """Return a dict from block index to the number of its lowest modes that contain the paired modes."""
        pairs = sorted(zip(self.block, self.rank, strict=True))
        return {block: rank + 1 for block, rank in pairs}


@dataclass(frozen=True)
class IndexPairing:
    """The paper's pairing, of measured mode i with mode ``numbers[i]`` (from 1) of the sorted spectrum.

    Attributes
    ----------
    numbers : tuple of int
    n_rigid : int
        Number of rigid-body modes that were added to the measured numbers, which start at the first elastic mode.
    """

    numbers: tuple[int, ...]
    n_rigid: int = field(default=0, repr=False)
    name: ClassVar[str] = "index"
    by_shape: ClassVar[Literal[False]] = False
    is_soft: ClassVar[bool] = False
    softness = 0.0
    is_constant: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not self.numbers or min(self.numbers) < 1 or len(set(self.numbers)) < len(self.numbers):
            raise ValueError(f"numbers: must be distinct and count from 1 (got {self.numbers})")

    def bind(self, model: BlockModel) -> PairedSolve:
        """Return the solver that sorts the spectra of all blocks together and takes the modes of these numbers."""
        return _IndexSolve(self, model)

    def counts(self, model: BlockModel) -> dict[int, int]:
        """Return a dict from block index to the number of its lowest modes that may be paired."""
        return {b: min(max(self.numbers), block.n_modes) for b, block in enumerate(model.blocks) if block.n_modes}

    def find_needed(
        self, model: BlockModel, eigenvalues: Mapping[int, FloatArray], shapes: Mapping[int, FloatArray]
    ) -> tuple[RankPairing | None, dict[int, int]]:
        """Return None and a dict of the modes needed per block; see `ShapePairing.find_needed`."""
        values = [eigenvalues[b] for b in sorted(eigenvalues)]
        highest = np.sort(np.concatenate(values, axis=1), axis=1)[:, max(self.numbers) - 1]
        # one mode more than was ever among the lowest shows that no mode is missing
        counts = (int(np.max(np.sum(lam <= highest[:, None], axis=1))) + 1 for lam in values)
        return None, {b: min(c, eigenvalues[b].shape[1]) for b, c in zip(sorted(eigenvalues), counts, strict=True)}

    def identity(self) -> tuple[bytes, tuple[sp.csr_array, ...]]:
        """Return the bytes and sparse matrices that identify the rule, together with the name of its class."""
        return repr(self).encode(), ()


@dataclass(frozen=True)
class _IndexSolve:
    pairing: IndexPairing
    model: BlockModel

    def __call__(self, theta: FloatArray, gradient: bool = False) -> ModalSolution:
        numbers = self.pairing.numbers
        return self.model.spectrum(theta, max(numbers), gradient).columns(np.array(numbers) - 1)

    def locate(self, theta: FloatArray, gradient: bool) -> tuple[IntArray, IntArray, Solved]:
        numbers = self.pairing.numbers
        if len(self.model.blocks) == 1:  # a number is a rank, so that nothing is solved for
            rank = np.tile(np.array(numbers) - 1, (len(theta), 1))
            return np.zeros_like(rank), rank, {}
        modes = self(theta)
        failed = np.isnan(modes.eigenvalues).any(axis=1, keepdims=True)
        return np.where(failed, -1, modes.block), np.where(failed, -1, modes.rank), {}


@dataclass(frozen=True, eq=False)
class ShapePairing:
    """One-to-one assignment of computed modes to reference shapes by MAC.

    Attributes
    ----------
    rows : scipy.sparse.csr_array, shape (q, n_dof)
        The coordinates at which shapes are compared, one per row, from
        `fmu.fem.modes.separable.SeparableModel.observation`.
    shapes : ndarray, shape (q, n_modes)
        Reference shapes at these coordinates: measured shapes, or shapes of the model before updating.
    margin : int
        Number of candidates of each block beyond the number of references: modes below the references that were
        not measured, such as rigid-body modes, and a few modes above.
    """

    rows: sp.csr_array
    shapes: FloatArray
    margin: int = SPARE
    name: ClassVar[str] = "shape"
    by_shape: ClassVar[Literal[True]] = True
    is_soft: ClassVar[bool] = False
    softness = 0.0
    is_constant: ClassVar[bool] = False

    def bind(self, model: BlockModel) -> PairedSolve:
        """Return the solver that assigns by MAC among the modes of every block in which a reference moves."""
        return _ShapeSolve(self, model)

    def n_candidates(self, model: BlockModel, b: int) -> int:
        """Return the number of modes that block `b` offers as candidates."""
        return min(self.shapes.shape[1] + self.margin, model.blocks[b].n_modes)

    def counts(self, model: BlockModel) -> dict[int, int]:
        """Return a dict from block index to the number of its lowest modes that may be paired."""
        return {b: self.n_candidates(model, b) for b in self.observe(model)}

    def observe(self, model: BlockModel) -> dict[int, Observation]:
        """Return a dict from each block in which a reference moves to its `Observation` of shapes."""
        observed = {}
        for b, block in enumerate(model.blocks):
            seen = self.rows[:, block.dofs]
            inside = np.flatnonzero(np.diff(seen.indptr))
            if block.n_modes and np.any(self.shapes[inside]):
                observed[b] = block.observe(seen[inside], self.shapes[inside])
        return observed

    def find_needed(
        self, model: BlockModel, eigenvalues: Mapping[int, FloatArray], shapes: Mapping[int, FloatArray]
    ) -> tuple[RankPairing | None, dict[int, int]]:
        """Return the pairing as fixed ranks if exact, else None, and a dict of the modes needed per block.

        Parameters
        ----------
        model : BlockModel
        eigenvalues : mapping of int to ndarray, shape (n, n_candidates)
        shapes : mapping of int to ndarray, shape (n, size, n_candidates)
            Modes of each block of `counts` at points that cover the parameter box, its corners among them.
        """
        fixed = self.constant(model, shapes)
        if fixed is None:
            return None, {b: lam.shape[1] for b, lam in eigenvalues.items()}
        ranks = list(zip(fixed.block, fixed.rank, strict=True))
        return fixed, {b: 1 + max(r for owner, r in ranks if owner == b) for b in fixed.block}

    def constant(self, model: BlockModel, shapes: Mapping[int, FloatArray]) -> RankPairing | None:
        """Return the assignment by MAC as fixed ranks if it is the same at every theta sampled, else None."""
        observed = self.observe(model)
        found: RankPairing | None = None
        for first in range(0, len(next(iter(shapes.values()))), AT_ONCE):
            part = {b: of_block[first : first + AT_ONCE] for b, of_block in shapes.items()}
            block, rank, _ = self.assign_modes(observed, part)
            fixed = RankPairing(tuple(map(int, block[0])), tuple(map(int, rank[0])))
            if np.any(block != block[0]) or np.any(rank != rank[0]) or found not in (None, fixed):
                return None
            found = fixed
        return found

    def assign_modes(
        self, observed: Mapping[int, Observation], shapes: Mapping[int, FloatArray]
    ) -> tuple[IntArray, IntArray, IntArray]:
        """Return block, rank and candidate column of the mode assigned to each reference, (n, n_modes).

        Parameters
        ----------
        observed : mapping of int to Observation
            From `observe`.
        shapes : mapping of int to ndarray, shape (n, size, n_candidates)
            Modes of each of these blocks.
        """
        reference_size = np.sum(self.shapes**2, axis=0)[:, None]
        similarity, label = [], []
        for b, (observe, reference) in observed.items():
            seen = observe(shapes[b])
            cross = reference.T @ seen
            size = reference_size * np.sum(seen**2, axis=1)[:, None, :]
            similarity.append(np.divide(cross**2, size, out=np.zeros_like(cross), where=size > 0.0))
            label += [(b, r) for r in range(seen.shape[2])]
        column = assign(np.nan_to_num(np.concatenate(similarity, axis=2)))
        return np.array(label)[column, 0], np.array(label)[column, 1], column

    def identity(self) -> tuple[bytes, tuple[sp.csr_array, ...]]:
        """Return the bytes and sparse matrices that identify the rule, together with the name of its class."""
        return repr(self.margin).encode() + np.ascontiguousarray(self.shapes).tobytes(), (self.rows,)


@dataclass(frozen=True, eq=False)
class SoftPairing(ShapePairing):
    """Pairing of every measured mode with every candidate, with normalised weights exp(MAC/τ).

    The solver is that of `ShapePairing` and gives the modes of the one-to-one assignment. A soft pairing is never
    constant, because all candidates are needed everywhere.

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

    def constant(self, model: BlockModel, shapes: Mapping[int, FloatArray]) -> RankPairing | None:
        """Return None: a soft pairing is never constant."""
        return None


class _ShapeSolve:
    def __init__(self, pairing: ShapePairing, model: BlockModel) -> None:
        self.pairing, self.model = pairing, model
        self.observed = pairing.observe(model)

    def __call__(self, theta: FloatArray, gradient: bool = False) -> ModalSolution:
        solved, merged, (block, rank, column) = self._solve(theta, gradient=False)
        # where a block failed, modes of other blocks must not take its references
        merged[np.any(np.isnan(merged), axis=1)] = np.nan
        lam = np.take_along_axis(merged, column, axis=1)
        if not gradient:
            return ModalSolution(lam, None, block, rank)
        slopes = np.concatenate(
            [self.model.blocks[b].eigenvalue_gradient(theta, *modes) for b, modes in solved.items()], axis=1
        )
        return ModalSolution(lam, np.take_along_axis(slopes, column[..., None], axis=1), block, rank)

    def locate(self, theta: FloatArray, gradient: bool) -> tuple[IntArray, IntArray, Solved]:
        solved, merged, (owner, rank, _) = self._solve(theta, gradient)
        failed = np.isnan(merged).any(axis=1, keepdims=True)
        return np.where(failed, -1, owner), np.where(failed, -1, rank), solved

    def _solve(
        self, theta: FloatArray, gradient: bool
    ) -> tuple[Solved, FloatArray, tuple[IntArray, IntArray, IntArray]]:
        """Return the modes of each block, the eigenvalues of all candidates, and the result of `assign_modes`."""
        solved: Solved = {}
        values, shapes = [], {}
        for b in self.observed:
            block, count = self.model.blocks[b], self.pairing.n_candidates(self.model, b)
            lam, phi = solved[b] = block.modes(theta, block.n_required(count, gradient))
            values.append(lam[:, :count])
            shapes[b] = phi[:, :, :count]
        return solved, np.concatenate(values, axis=1), self.pairing.assign_modes(self.observed, shapes)


def reference_modes(
    model: BlockModel,
    theta: FloatArray,
    sensors: sp.csr_array,
    rows: sp.csr_array,
    n_modes: int,
    counterparts: tuple[int, ...] = (),
) -> ShapePairing:
    """Return the pairing with the elastic modes of a reference model that the sensors can see.

    Without measured shapes, a mode that moves none of the sensors cannot have been measured. Of the modes that the
    sensors can see, the lowest `n_modes` are taken in ascending order, or the `counterparts`.

    Parameters
    ----------
    model : BlockModel
        Unreduced.
    theta : ndarray, shape (n_parameters,)
        Parameters of the reference model, usually those before updating.
    sensors, rows : scipy.sparse.csr_array, shape (_, n_dof)
        The sensors, and the coordinates at which the shapes will be compared.
    n_modes : int
        Number of measured modes.
    counterparts : tuple of int, optional
        For each measured mode, the number (from 1) of its counterpart among the modes that the sensors can see.

    Raises
    ------
    ValueError
        If the sensors see too few modes.
    """
    picked = counterparts or tuple(range(1, n_modes + 1))
    n_total = model.n_modes
    count = min(max(picked) + SPARE, n_total)
    while True:
        shapes, ranks = _visible_modes(model, theta, sensors, rows, count)
        if len(shapes) >= max(picked):
            columns = np.array(picked) - 1
            margin = SPARE + max(0, int(ranks[columns].max()) + 1 - n_modes)
            return ShapePairing(rows, shapes[columns].T, margin)
        if count == n_total:
            what = f"mode {max(picked)}" if counterparts else f"the {n_modes} measured modes"
            raise ValueError(f"sensors: must see {what} (they see {len(shapes)})")
        count = min(2 * count, n_total)


def count_rigid(model: BlockModel, theta: FloatArray, n_modes: int, elastic_hz: float = np.inf) -> int:
    """Return the number of rigid-body modes below the elastic modes at theta (n_parameters,).

    If there is a very stiff spring, every other mode has a vanishing share of the highest frequency. If a measured
    frequency `elastic_hz` is given, a rigid-body mode must therefore have a vanishing share of that frequency too.
    """
    count = min(n_modes + 7, model.n_modes)  # at most six rigid-body modes, and one elastic mode
    lam = model.spectrum(np.atleast_2d(theta), count).eigenvalues[0]
    is_far_below = lam <= (_FAR_BELOW * 2.0 * np.pi * elastic_hz) ** 2
    return int(np.sum(is_rigid(lam) & is_far_below))


def assign(mac: FloatArray) -> IntArray:
    """Return the column of the mode assigned to each reference, one to one, with the largest total MAC.

    Parameters
    ----------
    mac : ndarray, shape (n, n_modes, n_candidates)

    Returns
    -------
    ndarray of int, shape (n, n_modes)

    Notes
    -----
    If the best candidates of all references differ, they are the optimum. The assignment solver is called only for
    rows where two references share their best candidate.
    """
    best = np.argmax(mac, axis=2)
    ordered = np.sort(best, axis=1)
    in_conflict = np.flatnonzero(np.any(ordered[:, 1:] == ordered[:, :-1], axis=1))
    if in_conflict.size:
        from scipy.optimize import linear_sum_assignment
    for i in in_conflict:
        best[i] = linear_sum_assignment(mac[i], maximize=True)[1]
    return best


def _visible_modes(
    model: BlockModel, theta: FloatArray, sensors: sp.csr_array, rows: sp.csr_array, count: int
) -> tuple[FloatArray, IntArray]:
    """Return shapes (n, q) at `rows`, and ranks (n,) in their blocks, of elastic modes that sensors see."""
    point = np.atleast_2d(theta)
    spectrum = model.spectrum(point, count)
    shapes = np.ascontiguousarray(model.shapes(point, spectrum).T)
    compared, seen = shapes @ rows.T, shapes @ sensors.T
    # mass-normalised shapes have similar sizes: a shape that is tiny at the sensors is only rounding there
    elastic = ~is_rigid(spectrum.eigenvalues[0])
    visible = np.max(np.abs(seen), axis=1) > 1e-3 * np.max(np.abs(compared))
    return compared[elastic & visible], spectrum.rank[0][elastic & visible]
