"""Decoupled blocks that are solved in full, with derivatives of their modes.

Small blocks are solved in batches, others one theta at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from itertools import islice
from typing import ClassVar, Literal

import numpy as np
import scipy.sparse as sp

from fmu.engines.base import Engine, Work
from fmu.engines.blas import single_thread
from fmu.fem.modes.block import Block
from fmu.fem.modes.derivatives import CLOSE, by_bordered_system
from fmu.fem.modes.eigensolver import DENSE_LIMIT, SingularMassError, clear_factor, eigen, rank
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.solver import LARGE, Matrix, ScaledFactor, unit_diagonal
from fmu.fem.modes.stacks import SMALL, assemble, lowest_modes
from fmu.fem.modes.terms import ParametricMatrix, Term, coefficient_gradients, weighted_sum
from fmu.types import BoolArray, FloatArray, IntArray

# Up to this size a dense solve for the derivatives of a shape takes less time than a sparse solve.
_DENSE_SLOPES = 128
# Number of modes beyond the requested ones that a large block computes, because training starts from them.
_FURTHER = 3
# Memory of a worker, beside the block and its factors: bytes of Python with the libraries, copies of the stiffness
# matrix while it is factorised, and vectors of an eigenproblem.
LIBRARIES, COPIES = int(0.35 * 2**30), 6
_VECTORS = 120
_RECOMPUTED = ("_stacks",)


def full_blocks(model: SeparableModel) -> tuple[FullBlock, ...]:
    """Return the unreduced blocks of `model`."""
    return tuple(FullBlock(model, dofs) for dofs in model.blocks)


class FullBlock(Block):
    """A decoupled block of a structure, unreduced.

    Parameters
    ----------
    model : SeparableModel
    dofs : ndarray of int
        The model's degrees of freedom that belong to the block, one entry of ``model.blocks``.

    Attributes
    ----------
    K_terms, M_terms : tuple of Term
    n_modes : int
        Number of modes with a finite frequency if all mass coefficients are positive: fewer than `size` if M is
        singular. It is an upper bound if the mass terms do not add up to a semidefinite matrix.
    constant : bool
        Whether no parameter changes the block.
    """

    is_reduced: ClassVar[Literal[False]] = False

    def __init__(self, model: SeparableModel, dofs: IntArray) -> None:
        self.K_terms, self.M_terms = _restrict_terms(model.K_terms, dofs), _restrict_terms(model.M_terms, dofs)
        super().__init__(dofs, self.K_terms, self.M_terms)
        self.size = len(dofs)
        known = _rank_of_all(self.M_terms)
        self.n_modes = self.n_trained = _count_nonempty(self.M_terms) if known is None else known
        self.massless = self.n_modes < self.size
        self.constant = self.constant_mass and all(term.constant for term in self.K_terms)
        self._constant_rank = known if len(self.M_terms) == 1 else None
        self._last: tuple[bytes, FloatArray, FloatArray] | None = None
        self._last_factor = model.last_factor(dofs) if self.size >= LARGE else None
        self._engine: Engine | None = None

    def __getstate__(self) -> dict[str, object]:
        """Return the state for pickling.

        It omits the engine, which a worker lacks, and data that can be recomputed.
        """
        kept = {name: value for name, value in self.__dict__.items() if name not in _RECOMPUTED}
        return kept | {"_last": None, "_engine": None}

    @cached_property
    def _stacks(self) -> tuple[FloatArray, FloatArray]:
        """Dense stiffness and mass terms of a small block, each an array of shape (n_terms, size, size)."""
        K, M = (np.stack([term.matrix.toarray() for term in terms]) for terms in (self.K_terms, self.M_terms))
        return K, M

    def _matrices(self, theta: FloatArray) -> Iterator[tuple[Matrix, Matrix]]:
        """Yield K and M at each theta (n, n_parameters) in turn."""
        return zip(self._add_up(self._K_map, theta), self._add_up(self._M_map, theta), strict=True)

    def _masses(self, theta: FloatArray) -> Iterator[Matrix]:
        """Yield M at each theta (n, n_parameters) in turn."""
        return self._add_up(self._M_map, theta)

    def _add_up(self, matrix: ParametricMatrix, theta: FloatArray) -> Iterator[Matrix]:
        dense = self.size <= DENSE_LIMIT
        return (matrix.add_up(weights, dense) for weights in matrix.coefficients(theta))

    def modes(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return eigenvalues (n, count) and mass-normalised shapes (n, size, count), with NaN on failure.

        A block of more than `DENSE_LIMIT` degrees of freedom stores its last solve at a single theta, because
        several quantities are needed at the starting point. A block that no parameter changes is solved again only
        for another `count`. A block with at least `LARGE` degrees of freedom computes a few extra modes for
        `at_least`. Within `spread_over`, the engine's workers solve a block of more than `DENSE_LIMIT` degrees of
        freedom at several theta in parallel. Results are bitwise independent of the engine and of the other theta.
        """
        times = 1
        if self.constant:
            times, theta = len(theta), theta[:1]
        wanted = self._count_with_further(count)
        if not (len(theta) == 1 and (self.constant or self.size > DENSE_LIMIT)):
            lam, phi = self._solve_all(theta, wanted)
            return lam[..., :count], phi[..., :count]
        at = b"" if self.constant else theta.tobytes()
        if self._last is None or self._last[0] != at or self._last[1].shape[1] != wanted:
            self._last = (at, *self._solve_all(theta, wanted))
        lam, phi = (of[..., :count] for of in self._last[1:])
        return np.repeat(lam, times, axis=0), np.repeat(phi, times, axis=0)

    def at_least(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return `modes` at theta (1, n_parameters): `count` modes, or more if the last solve there computed more.

        This can save a solve, but the last digits may depend on earlier solves.
        """
        last = self._last
        if last is not None and last[0] == theta.tobytes() and last[1].shape[1] >= count:
            return last[1:]
        return self.modes(theta, count)

    def _count_with_further(self, count: int) -> int:
        return min(count + _FURTHER, self.n_modes) if self.size >= LARGE and count else count

    def clear_factor(self, theta: FloatArray) -> ScaledFactor | None:
        """Return the factors of K at theta (n_parameters,), or None if K is not clearly definite.

        A block with at least `LARGE` degrees of freedom stores the factors for the latest theta.
        """
        return self._keep_factor(
            theta, lambda: clear_factor(*unit_diagonal(next(self._add_up(self._K_map, theta[None]))))
        )

    def _factor_of(self, theta: FloatArray, S: Matrix, scale: FloatArray) -> ScaledFactor | None:
        return self._keep_factor(theta, lambda: clear_factor(S, scale))

    def _keep_factor(self, theta: FloatArray, make: Callable[[], ScaledFactor | None]) -> ScaledFactor | None:
        return make() if self._last_factor is None else self._last_factor.at(theta, make)

    @contextmanager
    def spread_over(self, engine: Engine) -> Iterator[None]:
        """Within a ``with`` block, let an engine's workers do lengthy solves. This does not change the results."""
        before, self._engine = self._engine, engine
        try:
            yield
        finally:
            self._engine = before

    def run_tasks[Shared, Task, Result](
        self, work: Work[Shared, Task, Result], shared: Shared, tasks: Iterable[Task], of_factors: int = 0
    ) -> list[Result]:
        """Run ``work(shared, task, None)`` for each task, in this process or in the workers of `spread_over`.

        The next task is taken from `tasks` only when a worker is free. A block with at least `LARGE` degrees of
        freedom uses no more workers than fit in the free memory, if that is known.

        Parameters
        ----------
        work : callable
            A function defined at module level, whose result depends on its arguments alone.
        shared : object
            Data that all tasks need: the block, or an object that contains it. It is sent to each worker once.
        tasks : iterable
            No task may be None.
        of_factors : int
            Bytes of the factors that each worker computes for itself.

        Returns
        -------
        list
            One result per task, in order.
        """
        engine, waiting = self._engine, enumerate(tasks)
        begun = list(islice(waiting, 1 if engine is None else self._workers_that_fit(engine, of_factors)))
        if engine is None or len(begun) < 2:
            with single_thread():
                return [work(shared, task, None) for part in (begun, waiting) for _, task in part]
        numbers, found = [number for number, _ in begun], dict[int, Result]()

        def follow(i: int, result: Result) -> Task | None:
            found[numbers[i]] = result
            numbers[i], following = next(waiting, (-1, None))
            return following

        engine.run_tasks(work, shared, [task for _, task in begun], follow)
        return [found[number] for number in range(len(found))]

    def _workers_that_fit(self, engine: Engine, of_factors: int) -> int:
        """Return how many workers fit in memory, if each holds the block and factors of `of_factors` bytes.

        Return the number of all workers if the free memory is unknown or the block is smaller than `LARGE`.
        """
        free = engine.free_memory()
        if free is None or self.size < LARGE:
            return engine.workers
        _, needed = memory_of_terms(self.K_terms, self.M_terms)
        return min(engine.workers, free // (needed + of_factors + 8 * self.size * _VECTORS))

    def _solve_all(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return eigenvalues (n, count) and shapes (n, size, count).

        A block of more than `DENSE_LIMIT` degrees of freedom is solved at each theta in a separate task.
        """
        if len(theta) < 2 or self.size <= DENSE_LIMIT:
            return self._solve_each(theta, count)
        kept = None if self._last_factor is None else self._last_factor.factor
        of_factors = 0 if kept is None else kept.n_bytes
        found = self.run_tasks(_solve_there, self, ((point[None], count) for point in theta), of_factors)
        lam, phi = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return lam, phi

    def _solve_each(self, theta: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
        lam = np.full((len(theta), count), np.nan)
        phi = np.full((len(theta), self.size, count), np.nan)
        if count == 0:
            return lam, phi
        has_rank_of_all = np.all(self._M_map.coefficients(theta) > 0, axis=1)
        if self.size <= SMALL:
            self._solve_together(theta, has_rank_of_all, lam, phi)
        alone = np.flatnonzero(np.isnan(lam[:, 0]))
        for i, (K, M) in zip(alone, self._matrices(theta[alone]), strict=True):
            if not (_is_finite(K) and _is_finite(M)):
                continue
            try:
                finite = self._rank(M, has_rank_of_all[i])
                lam[i], phi[i] = eigen(K, M, count, finite, partial(self._factor_of, theta[i]))
            except SingularMassError:
                continue
        return lam, phi

    def _solve_together(
        self, theta: FloatArray, has_rank_of_all: BoolArray, lam: FloatArray, phi: FloatArray
    ) -> None:
        """Solve many small eigenproblems in one batch, and write their modes into `lam` and `phi`.

        `has_rank_of_all` (n,) marks the theta at which all mass coefficients are positive. Rows that cannot be
        solved in a batch stay NaN.
        """
        maps = zip(self._stacks, (self._K_map, self._M_map), strict=True)
        K, M = (assemble(terms, matrix.coefficients(theta)) for terms, matrix in maps)
        finite = np.isfinite(K).all(axis=(1, 2)) & np.isfinite(M).all(axis=(1, 2))
        rows = np.flatnonzero(finite & has_rank_of_all & self._has_semidefinite_masses)
        if len(rows) and lam.shape[1] <= self._rank(M[rows[0]], is_that_of_all=True):
            lam[rows], phi[rows] = lowest_modes(K[rows], M[rows], lam.shape[1])

    @cached_property
    def _has_semidefinite_masses(self) -> bool:
        """Whether all mass terms are positive semidefinite. Sums with positive weights then have the same rank."""
        try:
            return all(rank(term.matrix) >= 0 for term in self.M_terms)
        except SingularMassError:
            return False

    def _rank(self, M: Matrix, is_that_of_all: bool) -> int:
        if not (self.constant_mass or (is_that_of_all and self._has_semidefinite_masses)):
            return rank(M)
        if self._constant_rank is None:  # the rank takes a factorisation
            self._constant_rank = rank(M)
        return self._constant_rank

    def _slopes_seen(
        self, theta: FloatArray, count: int, rows: Matrix, lam: FloatArray, phi: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        phi = phi[:, :, :count]
        lam_slopes = np.full((len(theta), count, self.n_parameters), np.nan)
        shape_slopes = np.full((len(theta), rows.shape[0], count, self.n_parameters), np.nan)
        for i, (K, M) in enumerate(self._matrices(theta)):
            if not np.all(np.isfinite(phi[i])):
                continue
            if self.size > _DENSE_SLOPES:
                K, M = sp.csc_array(K), sp.csc_array(M)
            dK, dM = (_slopes_times(terms, theta[i], phi[i]) for terms in (self.K_terms, self.M_terms))
            for k in range(count):
                slope, lam_slopes[i, k] = by_bordered_system(K, M, lam[i, k], phi[i, :, k], dK[k], dM[k])
                shape_slopes[i, :, k] = rows @ slope
        return lam_slopes, shape_slopes

    def _forms(self, phi: FloatArray, of_mass: bool, left: FloatArray | None = None) -> FloatArray:
        left = phi if left is None else left
        if self.size <= SMALL:
            return np.sum(left[:, None] * (self._stacks[of_mass] @ phi[:, None]), axis=2)
        terms = self.M_terms if of_mass else self.K_terms
        pairs = list(zip(left, phi, strict=True))
        return np.stack(
            [np.stack([np.sum(one * (term.matrix @ shape), axis=0) for one, shape in pairs]) for term in terms],
            axis=1,
        )

    def _apply(self, phi: FloatArray, weights: FloatArray, of_mass: bool) -> FloatArray:
        found = np.zeros(phi.shape)
        for k, term in enumerate(self.M_terms if of_mass else self.K_terms):
            for i, shape in enumerate(phi):
                found[i] += (term.matrix @ shape) * weights[i, k]
        return found

    def _products(self, x: FloatArray, of_mass: bool) -> FloatArray:
        terms = self.M_terms if of_mass else self.K_terms
        return np.stack([[term.matrix @ one for term in terms] for one in x])

    def _sum_products(self, x: FloatArray, of_mass: bool) -> FloatArray:
        terms = self.M_terms if of_mass else self.K_terms
        return np.stack([sum(t.matrix @ of for t, of in zip(terms, one, strict=True)) for one in x])

    def _traces(self, left: FloatArray, right: FloatArray, of_mass: bool) -> FloatArray:
        n, size, m, q = left.shape
        turned = self._products(right.reshape(n, size, m * q), of_mass).reshape(n, -1, size, m, q)
        return np.einsum("nsmq,nksmq->nkm", left, turned)

    def _shape_slopes_along(
        self, theta: FloatArray, lam: FloatArray, phi: FloatArray, dK_phi: FloatArray, dM_phi: FloatArray | None
    ) -> FloatArray:
        slopes = np.full(dK_phi.shape, np.nan)
        dM_phi = np.zeros(dK_phi.shape) if dM_phi is None else dM_phi
        for i, (K, M) in enumerate(self._matrices(theta)):
            if not np.all(np.isfinite(phi[i])):
                continue
            if self.size > _DENSE_SLOPES:
                K, M = sp.csc_array(K), sp.csc_array(M)
            for k in range(dK_phi.shape[2]):
                one = dK_phi[i, :, k], dM_phi[i, :, k]
                if not (np.any(one[0]) or np.any(one[1])):
                    slopes[i, :, k] = 0.0  # a zero direction needs no factorisation
                    continue
                gap = np.abs(lam[i] - lam[i, k])
                close = gap <= CLOSE * np.maximum(np.abs(lam[i]), np.abs(lam[i, k]))
                close[k] = False
                beside = phi[i][:, close] if np.any(close) else None
                slopes[i, :, k] = by_bordered_system(K, M, lam[i, k], phi[i, :, k], *one, beside)[0]
        return slopes


def _solve_there(block: FullBlock, task: tuple[FloatArray, int], _: object) -> tuple[FloatArray, FloatArray]:
    return block._solve_each(*task)


def memory_of_terms(K_terms: Sequence[Term], M_terms: Sequence[Term]) -> tuple[int, int]:
    """Return the bytes that a process needs to hold the terms, and the bytes that it needs to factorise K as well.

    Both include Python and its libraries, but not the factors themselves.
    """
    stored, stiffness = (sum(12 * term.matrix.nnz for term in of) for of in ((*K_terms, *M_terms), K_terms))
    return LIBRARIES + stored, LIBRARIES + stored + COPIES * stiffness


def _rank_of_all(M_terms: tuple[Term, ...]) -> int | None:
    """Return the rank of M for positive coefficients of all terms: the number of modes with a finite frequency.

    Return None if the sum of the terms, each scaled to a largest entry of 1, is not semidefinite.
    """
    total = weighted_sum(M_terms, np.array([1.0 / max(abs(term.matrix).max(), 1e-300) for term in M_terms]))
    try:
        return rank(total)
    except SingularMassError:
        return None


def _count_nonempty(M_terms: tuple[Term, ...]) -> int:
    """Return the number of rows in which any mass term has an entry: an upper bound on the rank of M."""
    return int(np.sum(np.any([np.diff(term.matrix.indptr) > 0 for term in M_terms], axis=0)))


def _is_finite(matrix: Matrix) -> bool:
    return bool(np.all(np.isfinite(matrix.data if sp.issparse(matrix) else matrix)))


def _slopes_times(terms: tuple[Term, ...], theta: FloatArray, phi: FloatArray) -> FloatArray:
    """Return ∂A/∂theta_j φ, shape (m, size, n_parameters), for shapes φ (size, m); A is the sum of `terms`."""
    forms = np.stack([(term.matrix @ phi).T for term in terms], axis=-1)
    return np.asarray(forms @ coefficient_gradients(terms, theta[None])[0])


def _restrict_terms(terms: tuple[Term, ...], dofs: IntArray) -> tuple[Term, ...]:
    if len(dofs) == terms[0].matrix.shape[0]:  # a single block: the matrices need not be copied
        restricted = terms
    else:
        restricted = tuple(Term(sp.csr_array(t.matrix[dofs][:, dofs]), t.powers) for t in terms)
    nonzero = tuple(t for t in restricted if abs(t.matrix).max() > 0.0)
    return nonzero or (Term(sp.csr_array((len(dofs), len(dofs))), (0,) * len(terms[0].powers)),)
