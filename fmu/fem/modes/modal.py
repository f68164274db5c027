"""Modes of a structure as the union of the modes of its decoupled blocks, full or reduced."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import ThreadpoolController

from fmu.fem.modes.terms import Term, coefficient_gradients, monomial
from fmu.types import BoolArray, FloatArray, IntArray

# An eigenvalue this small relative to the highest of interest is that of a rigid-body mode. Where K is singular to
# the last digit it is 0 exactly (`fmu.fem.modes.eigensolver`); matrices exported with ten digits leave more.
RIGID = 1e-9
# An eigenvalue below zero by more than this share of the largest of a set is not rounding. The set is that of the
# measured modes, far below the highest mode of the structure, to which rounding is relative.
NEGATIVE = 1e-6
_EQUAL = 1e-6


def is_rigid(eigenvalues: FloatArray) -> BoolArray:
    """Return a mask of the rigid-body modes among the lowest modes of a structure, shape (..., m)."""
    return eigenvalues <= RIGID * np.fmax.reduce(eigenvalues, axis=-1, keepdims=True)


def frequency_hz(eigenvalue: FloatArray) -> FloatArray:
    """Return √λ / 2π, NaN for a clearly negative λ: the structure has no such vibration.

    Parameters
    ----------
    eigenvalue : ndarray, shape (..., m), (rad/s)²
        Modes of one structure along the last axis. A λ below zero by less than 1e-6 of the largest |λ| of these
        modes is a rigid-body mode with rounding, and counts as zero.
    """
    if np.count_nonzero(eigenvalue < 0.0):
        scale = np.fmax.reduce(np.abs(eigenvalue), axis=-1, keepdims=True)
        eigenvalue = np.where(eigenvalue < -NEGATIVE * scale, np.nan, np.maximum(eigenvalue, 0.0))
    return np.sqrt(eigenvalue) / (2.0 * np.pi)


def frequency_gradient(frequency: FloatArray, eigenvalue_gradient: FloatArray) -> FloatArray:
    """Return ∂f/∂θ = ∂λ/∂θ / (8 π² f); not finite for a rigid-body mode.

    Parameters
    ----------
    frequency : ndarray, shape (n, m), Hz
    eigenvalue_gradient : ndarray, shape (n, m, n_parameters)
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return eigenvalue_gradient / (8.0 * np.pi**2 * frequency[..., None])


def mac(phi: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the modal assurance criterion between two sets of shapes (Allemang & Brown 1982).

    MAC = |φᵀψ|² / (φᵀφ · ψᵀψ) at the measured coordinates. A shape that is zero there has MAC 0 with all.

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


def fix_sign(shapes: FloatArray) -> FloatArray:
    """Return shapes with signs that do not depend on the solver: the largest component of each is positive.

    Of components that are equally large to a relative 1e-6, as in an antisymmetric mode, the first counts, so that
    rounding decides nothing.

    Parameters
    ----------
    shapes : ndarray, shape (..., n, m)
        Columns are shapes. One with NaN is left as it is.
    """
    size = np.abs(shapes)
    first = np.argmax(size >= (1.0 - _EQUAL) * np.max(size, axis=-2, keepdims=True), axis=-2)
    leading = np.take_along_axis(shapes, first[..., None, :], axis=-2)
    return np.where(leading < 0.0, -shapes, shapes)


class CoefficientMap:
    """The coefficients of a set of terms and their derivatives, with the common case (c_k = theta_j) made fast."""

    def __init__(self, terms: Sequence[Term]) -> None:
        self.terms = tuple(terms)
        self.n_parameters = len(self.terms[0].powers)
        self._linear = [k for k, t in enumerate(self.terms) if sorted(filter(None, t.powers)) == [1]]
        self._source = [self.terms[k].powers.index(1) for k in self._linear]
        self._general = [k for k, t in enumerate(self.terms) if k not in self._linear and not t.constant]
        self._slopes = np.zeros((len(self.terms), self.n_parameters))
        self._slopes[self._linear, self._source] = 1.0

    def __call__(self, theta: FloatArray) -> FloatArray:
        """Return c_k(theta), shape (n, n_terms)."""
        if len(self._linear) == len(self.terms):
            return theta.take(self._source, axis=1)
        value = np.ones((len(theta), len(self.terms)))
        value[:, self._linear] = theta[:, self._source]
        for k in self._general:
            value[:, k] = monomial(theta, self.terms[k].powers)
        return value

    def contract(self, theta: FloatArray, forms: FloatArray) -> FloatArray:
        """Return Σ_k forms[:, k] ∂c_k/∂theta, shape (n, m, n_parameters), for forms of shape (n, n_terms, m)."""
        # einsum without `optimize` adds term by term, so that a result does not depend on the rest of the batch
        if self._general:
            return np.einsum("nkm,nkj->nmj", forms, coefficient_gradients(self.terms, theta))
        return np.einsum("nkm,kj->nmj", forms, self._slopes)


class BlockPrediction(NamedTuple):
    """Modes of one block as the sensors see them.

    Attributes
    ----------
    eigenvalues : ndarray, shape (n, m), (rad/s)²
    shapes : ndarray, shape (n, n_sensors, m), mass-normalised, of either sign
    eigenvalue_slopes : ndarray, shape (n, m, n_parameters), or None
    shape_slopes : ndarray, shape (n, n_sensors, m, n_parameters), or None
    """

    eigenvalues: FloatArray
    shapes: FloatArray
    eigenvalue_slopes: FloatArray | None = None
    shape_slopes: FloatArray | None = None


class Block:
    """One decoupled part of a structure: an independent eigenproblem, full or reduced.

    Parameters
    ----------
    dofs : ndarray of int, shape (n,)
        Its degrees of freedom in the model.
    K_terms, M_terms : sequence of Term
        Its stiffness and mass terms.

    Attributes
    ----------
    size : int
        Unknowns of the eigenproblem.
    n_modes, n_trained : int
        Number of modes with a finite frequency, and how many of the lowest ones are accurate.
    is_reduced : bool
        Whether it approximates a full block.
    massless : bool
        Whether degrees of freedom of the full block have no mass.
    constant_mass : bool
        Whether no parameter changes its mass.
    """

    is_reduced = False
    size: int
    n_modes: int
    n_trained: int
    massless: bool

    def __init__(self, dofs: IntArray, K_terms: Sequence[Term], M_terms: Sequence[Term]) -> None:
        self.dofs = dofs
        self.n_parameters = len(K_terms[0].powers)
        self._K_map, self._M_map = CoefficientMap(K_terms), CoefficientMap(M_terms)
        self.constant_mass = all(term.constant for term in M_terms)

    def modes(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the lowest eigenvalues (n, count) and mass-normalised shapes (n, size, count).

        At theta (n, n_parameters); NaN where the solver fails.
        """
        raise NotImplementedError

    def eigenvalues(self, theta: FloatArray, count: int) -> FloatArray:
        """Return the lowest eigenvalues, shape (n, count), (rad/s)²; NaN where the solver fails."""
        return self.modes(theta, count)[0]

    def eigenvalue_gradient(self, theta: FloatArray, lam: FloatArray, phi: FloatArray) -> FloatArray:
        """Return ∂λ/∂θ, shape (n, m, n_parameters), of modes from `modes` (Fox & Kapoor 1968, eq. 5).

        ∂λ/∂θ_j = φᵀ (∂K/∂θ_j − λ ∂M/∂θ_j) φ, with φᵀ M φ = 1; for simple eigenvalues.
        """
        gradient = self._K_map.contract(theta, self._forms(phi, of_mass=False))
        if self.constant_mass:
            return gradient
        return gradient - lam[..., None] * self._M_map.contract(theta, self._forms(phi, of_mass=True))

    def _forms(self, phi: FloatArray, of_mass: bool) -> FloatArray:
        """Return φᵀ K_k φ, or φᵀ M_k φ, of every term, shape (n, n_terms, m)."""
        raise NotImplementedError

    def coordinates(self, rows: Any) -> Any:
        """Return sparse sensor rows (n_sensors, n) on the block's degrees of freedom as rows on its unknowns."""
        return rows

    def compress_rows(self, rows: Any, reference: FloatArray) -> tuple[Any, FloatArray]:
        """Return fewer rows and references (_, n_modes), from `coordinates`, with the same norms and products."""
        return rows, reference

    def observe(self, rows: Any, reference: FloatArray) -> tuple[Callable[[FloatArray], FloatArray], FloatArray]:
        """Return how shapes are compared with references: a map of shapes (n, size, m), and the references there.

        Parameters
        ----------
        rows : sparse, shape (q, n)
            The coordinates of comparison on the block's degrees of freedom.
        reference : ndarray, shape (q, n_modes)
        """
        raise NotImplementedError

    def n_required(self, count: int, gradient: bool) -> int:
        """Return how many modes `seen` needs to return the lowest `count`, with derivatives if `gradient`."""
        return count

    def seen(
        self,
        theta: FloatArray,
        count: int,
        rows: Any,
        gradient: bool = False,
        solved: tuple[FloatArray, FloatArray] | None = None,
    ) -> BlockPrediction:
        """Return the lowest modes as sensors see them, with derivatives if `gradient`.

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        count : int
        rows : array or sparse, shape (n_sensors, size)
            From `coordinates`.
        gradient : bool
        solved : tuple of ndarray, optional
            The result of `modes` for `n_required` modes or more, if it is at hand.
        """
        lam, phi = solved or self.modes(theta, self.n_required(count, gradient))
        seen = BlockPrediction(lam[:, :count], self._at(rows, phi[:, :, :count]))
        if not gradient:
            return seen
        lam_slopes, shape_slopes = self._slopes_seen(theta, count, rows, lam, phi)
        return seen._replace(eigenvalue_slopes=lam_slopes, shape_slopes=shape_slopes)

    def _at(self, rows: Any, phi: FloatArray) -> FloatArray:
        """Return shapes (n, size, m) as the sensors see them, (n, n_sensors, m)."""
        raise NotImplementedError

    def _slopes_seen(
        self, theta: FloatArray, count: int, rows: Any, lam: FloatArray, phi: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return ∂λ (n, count, n_parameters) and ∂φ at the sensors (n, n_sensors, count, n_parameters)."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class Picked:
    """Maps shapes (n, size, m) to some of their degrees of freedom (q,); travels to other processes."""

    dofs: IntArray

    def __call__(self, phi: FloatArray) -> FloatArray:
        """Return the shapes there, (n, q, m)."""
        return phi[:, self.dofs]


@dataclass(frozen=True, eq=False)
class Mapped:
    """Maps shapes (n, size, m) by a matrix (q, size); travels to other processes."""

    matrix: FloatArray

    def __call__(self, phi: FloatArray) -> FloatArray:
        """Return the shapes there, (n, q, m)."""
        return self.matrix @ phi


@dataclass(frozen=True)
class ModalSolution:
    """Chosen modes of a structure at n parameter vectors.

    Attributes
    ----------
    eigenvalues : ndarray, shape (n, m), (rad/s)²; NaN where a solve failed or is not accurate
    gradient : ndarray, shape (n, m, n_parameters), or None
    block, rank : ndarray of int, shape (n, m)
        The mode's block and its number (from 0) within it.
    """

    eigenvalues: FloatArray
    gradient: FloatArray | None
    block: IntArray
    rank: IntArray

    @property
    def failed(self) -> BoolArray:
        """Which modes have no solution, shape (n, m)."""
        return np.isnan(self.eigenvalues)

    def columns(self, picked: IntArray) -> ModalSolution:
        """Return only the modes in the given columns."""
        gradient = None if self.gradient is None else self.gradient[:, picked]
        return ModalSolution(self.eigenvalues[:, picked], gradient, self.block[:, picked], self.rank[:, picked])


@dataclass(frozen=True, eq=False)
class BlockModel:
    """A structure as its independent blocks, full (`fmu.fem.modes.full_block.full_model`) or reduced.

    Attributes
    ----------
    blocks : tuple of Block
    n_parameters : int
    """

    blocks: tuple[Block, ...]
    n_parameters: int

    def __iter__(self) -> Iterator[Any]:
        return iter(self.blocks)

    def __len__(self) -> int:
        return len(self.blocks)

    def __getitem__(self, number: int) -> Any:
        return self.blocks[number]

    @property
    def n_modes(self) -> int:
        """Number of modes with a finite frequency."""
        return sum(block.n_modes for block in self.blocks)

    def spectrum(self, theta: FloatArray, count: int, gradient: bool = False) -> ModalSolution:
        """Return the lowest `count` modes of the whole structure, ascending over the blocks.

        A reduced block gives only the modes that it was trained for. Where one more of them might have been
        among the lowest, the row is NaN: the full model is needed there.

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
        known = ~np.isnan(merged).any(axis=1)  # NaN is sorted last: the modes above would move down
        for block, lam in zip(self.blocks, values, strict=True):
            if lam.shape[1] < min(count, block.n_modes):
                known &= lowest[:, -1] < lam[:, -1]
        if np.count_nonzero(known) < len(known):
            lowest[~known] = np.nan
        widths = [lam.shape[1] for lam in values]
        owner, rank = np.repeat(np.arange(len(widths)), widths), np.concatenate([np.arange(w) for w in widths])
        chosen = np.concatenate(slopes, axis=1)[row, order] if gradient else None
        return ModalSolution(lowest, chosen, owner[order], rank[order])

    def shapes(
        self, theta: FloatArray, modes: ModalSolution, counts: Mapping[int, int] | None = None
    ) -> FloatArray:
        """Return the mass-normalised shapes, (n_dof, m), of modes at one theta (1, n_parameters).

        For full blocks only. A shape is zero in every block but its own; its sign is that of `fix_sign`. `counts`
        says how many modes of a block were solved for to find these, if they were: they are then not solved for
        again.
        """
        block, rank = modes.block[0], modes.rank[0]
        shapes = np.zeros((sum(len(of.dofs) for of in self.blocks), len(block)))
        for b in np.unique(block):
            columns = np.flatnonzero(block == b)
            _, phi = self.blocks[b].modes(theta, (counts or {}).get(int(b), int(rank[columns].max()) + 1))
            shapes[np.ix_(self.blocks[b].dofs, columns)] = phi[0][:, rank[columns]]
        return fix_sign(shapes)


class FixedModes:
    """Fixed ranks of fixed blocks of a model; everything that does not depend on theta is prepared once.

    Parameters
    ----------
    model : BlockModel
    block, rank : sequence of int
        For each mode, its block and its number (from 0) within that block.
    """

    def __init__(self, model: BlockModel, block: Sequence[int], rank: Sequence[int]) -> None:
        # as rows (1, m), to be repeated for each theta
        self._labels = np.array(block)[None], np.array(rank)[None]
        self._parts: list[tuple[Block, int, Any]] = []
        columns = []
        for b in np.unique(block):
            columns.append(np.flatnonzero(self._labels[0][0] == b))
            ranks = self._labels[1][0, columns[-1]]
            self._parts.append((model.blocks[b], int(ranks.max()) + 1, _as_slice(ranks)))
        self._order = np.argsort(np.concatenate(columns))

    def __call__(self, theta: FloatArray, gradient: bool = False) -> ModalSolution:
        """Return these modes at theta (n, n_parameters); eigenvalues alone are cheaper."""
        values, slopes = [], []
        for block, count, ranks in self._parts:
            if gradient:
                lam, phi = block.modes(theta, count)
                slopes.append(block.eigenvalue_gradient(theta, lam[:, ranks], phi[:, :, ranks]))
            else:
                lam = block.eigenvalues(theta, count)
            values.append(lam[:, ranks])
        owner, rank, _ = self.locate(theta)
        return ModalSolution(
            self._join_columns(values), self._join_columns(slopes) if gradient else None, owner, rank
        )

    def locate(self, theta: FloatArray, gradient: bool = False) -> tuple[IntArray, IntArray, dict[int, Any]]:
        """Return block and rank of the modes at theta (n, n_parameters), shapes (n, m); nothing is solved."""
        block, rank = self._labels
        return block.repeat(len(theta), axis=0), rank.repeat(len(theta), axis=0), {}

    def _join_columns(self, parts: list[FloatArray]) -> FloatArray:
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)[:, self._order]


def _as_slice(indices: IntArray) -> Any:
    """Return consecutive indices as a slice, which NumPy takes without copying, others as they are."""
    first = int(indices[0])
    consecutive = np.array_equal(indices, np.arange(first, first + len(indices)))
    return slice(first, first + len(indices)) if consecutive else indices


class _OneThread:
    """A context in which BLAS uses one thread: many small eigenproblems are slower with more.

    The process has its own setting back afterwards. Where there is one thread already nothing is touched:
    threadpoolctl's own context takes as long as a reduced eigenproblem.
    """

    def __enter__(self) -> None:
        self._limited = [(blas, n) for blas in _libraries() if (n := blas.num_threads) not in (None, 1)]
        for blas, _ in self._limited:
            blas.set_num_threads(1)

    def __exit__(self, *exception: object) -> None:
        for blas, n in self._limited:
            blas.set_num_threads(n)


single_thread = _OneThread


@cache
def _libraries() -> tuple[Any, ...]:
    # NumPy and SciPy each bring a BLAS of their own: both must be loaded before the controller looks for them
    import numpy.linalg  # noqa: F401
    import scipy.linalg  # noqa: F401

    return tuple(ThreadpoolController().select(user_api="blas").lib_controllers)
