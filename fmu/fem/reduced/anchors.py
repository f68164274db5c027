"""Anchor points in a parameter box, at which K + s M is factorised, and bounds relative to these points.

Let K(θ) be the sum of the terms c_k(θ) K_k. If every matrix K_k is positive semidefinite, then

    K(θ) + s M(θ) ≥ α (K(θ̄) + s M(θ̄)),    α = min over the terms of c_k(θ) / c_k(θ̄)

(the min-θ bound; Patera & Rozza 2007, *Reduced Basis Approximation and A Posteriori Error Estimation for
Parametrized Partial Differential Equations*, section 4.2.2). If the shift s is positive, the terms of M are
included in the condition and in the minimum. One anchor point θ̄ in the middle of the box is enough if no
stiffness parameter changes by more than a factor of about 30. If a stiffness changes more, or may vanish, there
are several anchor points.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg as sl

from fmu.engines.base import Work
from fmu.fem.modes.eigensolver import is_clearly_definite, is_semidefinite
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.modal import is_rigid
from fmu.fem.modes.solver import LARGE, Factor, Matrix, factorise, unit_diagonal
from fmu.fem.modes.terms import Term, coefficients
from fmu.fem.reduced.space import Space
from fmu.types import FloatArray, IntArray

# A box in which a stiffness parameter changes by more than this factor is halved, and has more anchor points.
_WIDE = 30.0
# Where α divided by the largest ratio of coefficients is below this, an anchor point gives no useful bound.
_FAR = 1e-3
_MOST = 8
# Number of modes at the anchor points beyond the requested ones.
_GUARDS = 3
_HALVED = 20  # bisection steps
_STRIP = 32  # right-hand sides of a large block that are solved for together
NO_MODES = "the eigenproblem of K and M has no solution"


class SingularAnchorError(ValueError):
    """Raised if some displacement has neither stiffness nor mass, or has negative mass.

    K + s M is then not positive definite at an anchor point, M is not positive definite for the trial vectors, or
    no modes can be computed.

    Attributes
    ----------
    parameter : int or None
        Index of the first parameter that is zero at the anchor point. It is None if no parameter is zero there, or
        if the error is not due to K + s M at an anchor point.
    """

    def __init__(self, message: str, parameter: int | None = None) -> None:
        super().__init__(message)
        self.parameter = parameter


class NoModesError(ValueError):
    """Raised if no modes can be computed at any of several points.

    Attributes
    ----------
    theta : ndarray, shape (n_parameters,)
        The first of the points.
    """

    def __init__(self, theta: FloatArray) -> None:
        super().__init__(NO_MODES)
        self.theta = theta


class Far(NamedTuple):
    """A point so far from every anchor point that error bounds are poor there.

    Attributes
    ----------
    theta : ndarray, shape (n_parameters,)
        The point.
    parameter : int
        Index of the parameter that contributes most: resetting it to its value at the first anchor point helps
        most.
    value : float
        Value of this parameter beyond which the point is far, found by bisection. It is the point's own value if
        the point stays far even after resetting the parameter.
    is_above : bool
        True if points above `value` are far, False if points below it are.
    is_negative : bool
        Whether K + s M is not positive definite in the reduced space at the point. If the bound is
        `Anchors.proven`, this is not tested and the value is False.
    """

    theta: FloatArray
    parameter: int
    value: float
    is_above: bool
    is_negative: bool


class Anchors:
    """Anchor points for one block, at which K + s M is factorised.

    Parameters
    ----------
    block : FullBlock
    lower, upper : ndarray, shape (n_parameters,)
        Bounds of the box.

    Attributes
    ----------
    theta : ndarray, shape (n_anchors, n_parameters)
        The anchor points; the first lies in the middle of the box.
    shift : float
        The shift s in K + s M. It is 0 if K is clearly positive definite at all anchor points; otherwise it is the
        lowest elastic eigenvalue at the first one (1 if none is found), or more if K is negative for some motion.
    proven : bool
        Whether all terms in K + s M are positive semidefinite, with coefficients that are not negative in the box.
        The factor α in the bound A ≥ α Ā, with A = K + s M at a point and Ā at an anchor point, is then proven.
        Otherwise α is estimated as the smallest eigenvalue ν of A x = ν Ā x in the reduced space.

    Raises
    ------
    SingularAnchorError
        If K + s M is not positive definite at an anchor point, or the block has no modes at the first one.
    """

    def __init__(self, block: FullBlock, lower: FloatArray, upper: FloatArray) -> None:
        self.block = block
        self.theta = anchor_points(block.K_terms, lower, upper)
        self._factors: dict[int, Factor] = {}
        self._modes: Space | None = None
        self.shift = 0.0
        if not self._is_definite_at_anchors():
            lam = block.eigenvalues(self.theta[:1], min(12, block.n_modes))[0]
            if not np.all(np.isfinite(lam)):
                raise SingularAnchorError(NO_MODES)
            elastic = lam[~is_rigid(lam)]
            self.shift = float(elastic[0]) if len(elastic) else 1.0
            self.shift = max(self.shift, -2.0 * float(lam[0]))
            self._factors.clear()
            for a in range(len(self.theta)):
                self.factor(a)
        self.proven = not any(np.any((lower < 0.0) & (np.mod(t.powers, 2) == 1)) for t in self._terms) and all(
            is_semidefinite(t.matrix) for t in self._terms
        )

    def __getstate__(self) -> dict[str, object]:
        """Return the state for pickling. It omits the factors, which cannot be pickled, and the first matrix."""
        return {name: value for name, value in self.__dict__.items() if name != "first"} | {"_factors": {}}

    @property
    def _terms(self) -> tuple[Term, ...]:
        return (*self.block.K_terms, *(self.block.M_terms if self.shift else ()))

    def _is_definite_at_anchors(self) -> bool:
        if self.block.size >= LARGE:
            return all(self._kept_factor(a) is not None for a in range(len(self.theta)))
        try:
            return all(
                is_clearly_definite(self.factor(a), unit_diagonal(self.matrix(a))[1])
                for a in range(len(self.theta))
            )
        except (np.linalg.LinAlgError, SingularAnchorError):
            return False

    def matrix(self, a: int) -> Matrix:
        """Return K + s M at anchor point `a`, dense or sparse like the matrices of the block."""
        ((K, M),) = self.block._matrices(self.theta[a : a + 1])
        return K + self.shift * M if self.shift else K

    @cached_property
    def first(self) -> Matrix:
        """Matrix K + s M at the first anchor point. It defines the inner product used in training."""
        return self.matrix(0)

    def factor(self, a: int) -> Factor:
        """Return the factors of K + s M at anchor point `a`.

        Raise SingularAnchorError if the matrix is not positive definite.
        """
        if a not in self._factors:
            try:
                found = self._kept_factor(a) or factorise(self.matrix(a))
                if found.negative:
                    raise np.linalg.LinAlgError(f"{found.negative} of its eigenvalues are not positive")
            except np.linalg.LinAlgError as error:
                zero = np.flatnonzero(self.theta[a] == 0.0)
                raise SingularAnchorError(
                    f"K + s M is singular, a motion has neither stiffness nor mass: {error}",
                    int(zero[0]) if len(zero) else None,
                ) from error
            self._factors[a] = found
        return self._factors[a]

    def solve(self, a: int, loads: FloatArray) -> FloatArray:
        """Return (K + s M)⁻¹ b at anchor point `a`, for b of shape (n_dof, m).

        For a large block the columns are solved in strips, by the workers of its engine if there is one
        (`FullBlock.spread_over`). Each worker has its own factors. The result is bitwise independent of the
        engine.
        """
        if self.block.size < LARGE or loads.shape[1] <= _STRIP:
            return self.factor(a).solve(loads)
        strips = ((a, loads[:, first : first + _STRIP]) for first in range(0, loads.shape[1], _STRIP))
        return np.concatenate(self.run_tasks(_solve_there, strips), axis=1)

    def run_tasks[Task, Result](self, work: Work[Anchors, Task, Result], tasks: Iterable[Task]) -> list[Result]:
        """Run tasks that need the anchor points, and return their results; see `FullBlock.run_tasks`."""
        return self.block.run_tasks(work, self, tasks, sum(of.n_bytes for of in self._factors.values()))

    def _kept_factor(self, a: int) -> Factor | None:
        """Return the factors of a large block's K at anchor point `a`, or None.

        The result is None if the block is small, if s is not 0, or if K is not clearly positive definite. The
        factors are reused if the block still has them from its last solve.
        """
        if self.shift or self.block.size < LARGE:
            return None
        if a not in self._factors and (found := self.block.clear_factor(self.theta[a])) is not None:
            self._factors[a] = found
        return self._factors.get(a)

    def modes(self, count: int) -> Space:
        """Return the space of the full model's lowest `count` modes, and a few more, at all anchor points.

        Anchor points where the solver fails are skipped. Raise SingularAnchorError if it fails at all of them.
        """
        if self._modes is None or self._modes.size < count:
            space = Space.empty(self.block, self.shift)
            for at in self.theta:
                _, shapes = self.block.at_least(at[None], min(count + _GUARDS, self.block.n_modes))
                if np.isfinite(shapes).all():
                    space = space.grown(shapes[0], self.first)
            if not space.size:
                raise SingularAnchorError(NO_MODES)
            self._modes = space
        return self._modes

    def nearest(self, theta: FloatArray, space: Space) -> tuple[IntArray, FloatArray]:
        """Return the index (n,) of the anchor point with the best bound at each theta (n, p), and its α (n,).

        The bound is K + s M ≥ α (K̄ + s M̄), where the bar marks the anchor point. If no anchor point gives a
        bound, α is not positive.
        """
        low, tight = self._tight(theta)
        best = np.argmax(tight, axis=0)
        alpha = low[best, np.arange(len(theta))]
        return best, alpha if self.proven else self._estimate_alpha(theta, best, space)

    def stretch(self, theta: FloatArray) -> FloatArray:
        """Return γ (n,) for which K + s M at theta (n, p) is at most γ times K + s M at the first anchor point.

        γ is infinite if the bound is not `proven`, or if a term is zero at that point.
        """
        if not self.proven:
            return np.full(len(theta), np.inf)
        return np.asarray(np.max(self._ratios(theta, self.theta[0]), axis=1))

    def far(self, theta: FloatArray, space: Space) -> Far | None:
        """Return the point in theta (n, p) farthest from all anchor points, or None if no point is far.

        If the bound is not `proven`, distances are measured from the first anchor point only.
        """

        def near(points: FloatArray) -> FloatArray:
            if self.proven:
                return np.asarray(np.max(self._tight(points)[1], axis=0))
            return self._estimate_alpha(points, np.zeros(len(points), dtype=int), space)

        tight = near(theta)
        i = int(np.argmin(tight))
        if tight[i] >= _FAR:
            return None
        back = np.where(np.eye(theta.shape[1], dtype=bool), self.theta[0], theta[i])  # each resets one parameter
        closer = near(back)
        j = int(np.argmax(closer))
        outer, inner = float(theta[i, j]), float(self.theta[0, j])
        for _ in range(_HALVED if closer[j] >= _FAR else 0):
            back[j, j] = 0.5 * (outer + inner)
            if near(back[j : j + 1])[0] < _FAR:
                outer = float(back[j, j])
            else:
                inner = float(back[j, j])
        return Far(theta[i], j, outer, outer > self.theta[0, j], not self.proven and tight[i] <= 0.0)

    def _tight(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return each anchor point's bound factor α at theta (n, p), and α over the largest coefficient ratio.

        Both have shape (n_anchors, n). The second array is −1 where α is not positive. A largest ratio below 1
        counts as 1.
        """
        ratios = np.stack([self._ratios(theta, at) for at in self.theta])  # (n_anchors, n, n_terms)
        low, high = np.min(ratios, axis=2), np.max(ratios, axis=2)
        # a term that is zero at an anchor point is compared with a small part of its value at the centre
        left_out = _WIDE * self._ratios(theta, self.theta[0])
        high = np.where(np.isinf(high), np.max(np.where(np.isinf(ratios), left_out, ratios), axis=2), high)
        with np.errstate(invalid="ignore", divide="ignore"):
            return low, np.where(low > 0.0, low / np.maximum(high, 1.0), -1.0)

    def _ratios(self, theta: FloatArray, at: FloatArray) -> FloatArray:
        here, there = coefficients(self._terms, theta), coefficients(self._terms, at[None])
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = here / there
        # a term that is zero at the anchor point does not lower the bound unless its coefficient is negative
        return np.where(there == 0.0, np.where(here >= 0.0, np.inf, -np.inf), np.where(there < 0.0, np.nan, ratio))

    def _estimate_alpha(self, theta: FloatArray, best: IntArray, space: Space) -> FloatArray:
        alpha = np.empty(len(theta))
        for i in range(len(theta)):
            (A, A0), (M, M0) = space.assemble(np.stack([theta[i], self.theta[best[i]]]))
            A, A0 = A + self.shift * M, A0 + self.shift * M0
            alpha[i] = sl.eigh(A, A0, eigvals_only=True, subset_by_index=[0, 0], check_finite=False)[0]
        return alpha


def _solve_there(anchors: Anchors, task: tuple[int, FloatArray], _: object) -> FloatArray:
    a, loads = task
    return anchors.factor(a).solve(loads)


def anchor_points(terms: Sequence[Term], lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return anchor points (n_anchors, p): the middle of the box, and of its parts if a stiffness varies much.

    Each part is divided along the parameter with the largest ratio between its bounds, as long as that ratio
    exceeds `_WIDE` and there are fewer than `_MOST` anchor points. If the lower bound of this parameter is zero,
    the middle of the face where the parameter is zero is an anchor point too. Parameters that change no stiffness,
    or may be negative, do not count.
    """
    varied = np.any([[power != 0 for power in term.powers] for term in terms], axis=0)
    anchors, parts = [_middle(lower, upper)], [(lower, upper)]
    while parts and len(anchors) < _MOST:
        low, high = parts.pop(0)
        with np.errstate(divide="ignore", invalid="ignore"):
            change = np.where(varied & (low >= 0.0) & (high > 0.0), high / low, 1.0)
        j = int(np.argmax(change))
        if not change[j] > _WIDE:
            continue
        cut = np.sqrt(low[j] * high[j]) if low[j] > 0.0 else high[j] / _WIDE
        below, above = high.copy(), low.copy()
        below[j], above[j] = cut, cut
        if low[j] == 0.0:  # the only anchor point further down is on the face where the parameter is zero
            face = below.copy()
            face[j] = 0.0
            anchors += [_middle(low, face), _middle(low, below), _middle(above, high)]
            parts += [(above, high), (low, face)]
        else:
            anchors += [_middle(low, below), _middle(above, high)]
            parts += [(low, below), (above, high)]
    return np.stack(anchors[:_MOST])


def _middle(lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return the middle (p,) of the bounds: the geometric mean if upper > 2 lower > 0, otherwise arithmetic."""
    with np.errstate(invalid="ignore"):
        return np.where((lower > 0.0) & (upper > 2.0 * lower), np.sqrt(lower * upper), 0.5 * (lower + upper))
