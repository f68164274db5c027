"""Double-precision solutions of A x = b from single-precision factors of A, which take half the memory.

Let F be the product of the factors. It differs from A by rounding, which matters only for the lowest eigenvalues
of A: all other eigenvalues of F⁻¹ A are nearly 1. If A is positive definite, F is the preconditioner for conjugate
gradients, in a form that allows for the rounding of F⁻¹ (Golub & Ye 1999, *SIAM J. Sci. Comput.* 21, 1305–1320,
algorithm 2.1), and a few steps are enough. If A is indefinite, F is used for iterative refinement,

    x ← x + F⁻¹ (b − A x),

whose error is multiplied by I − F⁻¹ A in each step (Higham 2002, *Accuracy and Stability of Numerical Algorithms*,
chapter 12).

If the spectral radius of I − F⁻¹ A is below 1, F and A have equally many negative eigenvalues: with A = F + E, no
F + t E with t in [0, 1] is singular. The radius is estimated by power iteration from a random vector. The number
of negative eigenvalues is thus checked, not proven.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
import scipy.sparse as sp

from fmu.numbers import significant, whole
from fmu.types import FloatArray


class SingleFactor(Protocol):
    """Single-precision factors of a matrix; see `fmu.fem.modes.solver.Factor`."""

    negative: int

    @property
    def n_entries(self) -> int:
        """Number of entries in the factors."""
        ...

    @property
    def n_bytes(self) -> int:
        """Bytes of memory for the factors."""
        ...

    def solve(self, loads: FloatArray) -> FloatArray:
        """Return F⁻¹ b for b (n, m)."""
        ...


type Solve = Callable[[FloatArray], FloatArray]
"""Maps b (n, m) to F⁻¹ b."""

# Relative error in the energy norm at which conjugate gradients end, and relative change at which refinement ends.
_CONVERGED = 1e-12
# Steps of conjugate gradients, of refinement, and of power iteration. A step of refinement that leaves a larger
# share of the error than _SLOW is too slow.
_STEPS, _REFINED, _POWER, _SLOW = 100, 60, 10, 0.5
# Right-hand sides that are solved for together, because each takes several vectors.
_TOGETHER = 8
# Shares of the diagonal that are added to a definite matrix until its factors in single precision exist.
_ADDED = (0.0, 3e-8, 3e-7)


class StalledError(MemoryError):
    """Raised if single-precision factors are too inaccurate. Double precision is then needed."""

    def __init__(self, why: str) -> None:
        super().__init__(
            f"factors in double precision do not fit, and those in single precision are too inaccurate: {why}; "
            "hold the structure if it is free, and coarsen or condense the model"
        )


class RefinedFactor:
    """Single-precision factors of a matrix A, with solutions as accurate as in double precision.

    Parameters
    ----------
    matrix : sparse array, shape (n, n)
    make : callable
        ``make(matrix, is_definite)`` returns single-precision factors. It raises LinAlgError if the matrix is
        singular, or if `is_definite` is True and the matrix is not positive definite.
    is_definite : bool
        Whether A is expected to be positive definite. If its factors as a definite matrix cannot be computed or
        are too inaccurate, A is factorised as an indefinite matrix instead.

    Raises
    ------
    StalledError
        If the factors are too inaccurate.
    LinAlgError
        If the matrix is singular.
    """

    L: FloatArray | None = None
    is_single = True

    def __init__(
        self, matrix: sp.csr_array, make: Callable[[sp.csr_array, bool], SingleFactor], is_definite: bool
    ) -> None:
        self._matrix, self.negative = sp.csr_array(matrix), 0
        definite = self._definite_factor(make) if is_definite else None
        self._is_definite = definite is not None
        self._factor = definite or make(self._matrix, False)
        if not self._is_definite:
            require_same_inertia(self._matrix, self._factor.solve)
            self.negative = self._factor.negative

    @property
    def n_entries(self) -> int:
        """Number of entries in the factors."""
        return self._factor.n_entries

    @property
    def n_bytes(self) -> int:
        """Bytes of memory for the factors and the matrix."""
        return self._factor.n_bytes + 12 * self._matrix.nnz

    def solve(self, loads: FloatArray) -> FloatArray:
        """Return A⁻¹ b for b of shape (n,) or (n, m). Raise StalledError if the iterations do not converge."""
        by = conjugate_gradients if self._is_definite else refine
        columns = loads.reshape(len(loads), -1)
        strips = (columns[:, first : first + _TOGETHER] for first in range(0, columns.shape[1], _TOGETHER))
        found = [by(self._matrix, self._factor.solve, strip) for strip in strips]
        return np.concatenate(found, axis=1).reshape(loads.shape) if found else np.zeros_like(loads)

    def _definite_factor(self, make: Callable[[sp.csr_array, bool], SingleFactor]) -> SingleFactor | None:
        """Return factors for which conjugate gradients converge for a random b, or None if none are found.

        The first attempt factorises A itself. Further attempts add a small share of its diagonal before
        factorising.
        """
        probe = np.random.default_rng(0).standard_normal((self._matrix.shape[0], 1))
        for share in _ADDED:
            factor = None  # before the next factors take memory
            added = sp.diags_array(share * self._matrix.diagonal())
            try:
                factor = make(sp.csr_array(self._matrix + added) if share else self._matrix, True)
                conjugate_gradients(self._matrix, factor.solve, probe)
            except (np.linalg.LinAlgError, StalledError):
                continue
            return factor
        return None


def conjugate_gradients(A: sp.csr_array, solve: Solve, loads: FloatArray) -> FloatArray:
    """Return A⁻¹ b (n, m) for b (n, m) and a positive definite A, iterating each column separately.

    Raises
    ------
    StalledError
        If a column has not converged after 100 steps, or A or the preconditioner F is not positive definite.
    """
    x, r = np.zeros_like(loads), np.array(loads, dtype=float)
    z = _solve_scaled(solve, r)
    p, gamma, energy = z.copy(), np.sum(r * z, axis=0), np.zeros(loads.shape[1])
    (of,) = np.nonzero(np.any(loads != 0.0, axis=0))  # the columns that have not converged
    for _ in range(_STEPS):
        if not len(of):
            break
        Ap = A @ p[:, of]
        curvature = np.sum(p[:, of] * Ap, axis=0)
        if not (np.all(curvature > 0.0) and np.all(gamma[of] > 0.0)):
            raise StalledError("the matrix or its factors in single precision are not positive definite")
        alpha = gamma[of] / curvature
        x[:, of] += alpha * p[:, of]
        before, r[:, of] = r[:, of], r[:, of] - alpha * Ap
        energy[of] += alpha * gamma[of]  # of x, xᵀ A x
        z[:, of] = _solve_scaled(solve, r[:, of])
        changed, gamma_before = np.sum((r[:, of] - before) * z[:, of], axis=0), gamma[of]
        gamma[of] = np.sum(r[:, of] * z[:, of], axis=0)
        p[:, of] = z[:, of] + changed / gamma_before * p[:, of]
        of = of[np.abs(gamma[of]) > _CONVERGED**2 * energy[of]]
    _require_none_left(len(of), _STEPS)
    return x


def refine(A: sp.csr_array, solve: Solve, loads: FloatArray) -> FloatArray:
    """Return A⁻¹ b (n, m) for b (n, m), by iterative refinement of each column until only rounding remains.

    Raises
    ------
    StalledError
        If a column has not converged after 60 steps.
    """
    x = _solve_scaled(solve, loads)
    (of,) = np.nonzero(np.any(loads != 0.0, axis=0))
    last = np.full(loads.shape[1], np.inf)
    for _ in range(_REFINED):
        if not len(of):
            break
        change = _solve_scaled(solve, loads[:, of] - A @ x[:, of])
        size = np.linalg.norm(change, axis=0) / np.linalg.norm(x[:, of] + change, axis=0)
        is_better = size < last[of]  # not when only rounding remains
        x[:, of] += np.where(is_better, change, 0.0)
        is_done = (size <= _CONVERGED) | (~is_better & (last[of] <= np.sqrt(_CONVERGED)))
        last[of] = size
        of = of[~is_done]
    _require_none_left(len(of), _REFINED)
    return x


def _require_none_left(left: int, steps: int) -> None:
    """Raise StalledError if solutions are left that have not converged after all steps."""
    if left:
        raise StalledError(f"{whole(left)} solutions have not converged after {whole(steps)} steps")


def require_same_inertia(A: sp.csr_array, solve: Solve) -> None:
    """Raise StalledError if a step of refinement leaves more than half of the error.

    Otherwise A and F have equally many negative eigenvalues. The share that is left is estimated by power
    iteration.
    """
    x = np.random.default_rng(0).standard_normal((A.shape[0], 1))
    kept = np.inf
    for _ in range(_POWER):
        x /= np.linalg.norm(x)
        x = x - _solve_scaled(solve, A @ x)
        kept = float(np.linalg.norm(x))
    if not kept <= _SLOW:
        raise StalledError(f"a step of refinement leaves {significant(kept, 2)} of the error")


def _solve_scaled(solve: Solve, loads: FloatArray) -> FloatArray:
    """Return F⁻¹ b for b (n, m). Columns are scaled to a largest entry of 1, to suit single precision."""
    size = np.max(np.abs(loads), axis=0)
    size = np.where(size > 0.0, size, 1.0)
    return solve(loads / size) * size
