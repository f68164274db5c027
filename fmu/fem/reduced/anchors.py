"""Points of a box at which K is factorised, and what is known of K everywhere from there.

If every term K_k is positive semidefinite, then

    K(θ) + s M(θ) ≥ α (K(θ̄) + s M(θ̄)),    α = min over the terms of c_k(θ) / c_k(θ̄)

(the min-θ bound; Patera & Rozza 2007, *Reduced Basis Approximation and A Posteriori Error Estimation for
Parametrized Partial Differential Equations*, section 4.2.2). One anchor θ̄ in the middle of the box serves where
no coefficient changes by more than a factor of some tens. Where a stiffness may vanish there are several.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg as sl

from fmu.fem.modes.eigensolver import is_clearly_definite, is_semidefinite, unit_diagonal
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.modal import is_rigid
from fmu.fem.modes.solver import Factor, Matrix, factorise
from fmu.fem.modes.terms import Term, coefficients
from fmu.fem.reduced.space import Space
from fmu.types import FloatArray, IntArray

# A box in which a coefficient changes by more than this factor is halved, and has two anchors.
_WIDE = 30.0
# Where α is a smaller share than this of the largest ratio, an anchor says little.
_FAR = 1e-3
_MOST = 8
# Modes of the anchors beyond those that are asked for.
_GUARDS = 3
_HALVED = 20  # times, the way out of a region
NO_MODES = "the eigenproblem of K and M has no solution"


class SingularAnchorError(ValueError):
    """A motion of the structure has neither stiffness nor mass somewhere in the box, or negative mass.

    Attributes
    ----------
    parameter : int or None
        The parameter that is zero there.
    """

    def __init__(self, message: str, parameter: int | None = None) -> None:
        super().__init__(message)
        self.parameter = parameter


class Far(NamedTuple):
    """A point that no anchor is near to.

    Attributes
    ----------
    theta : ndarray, shape (n_parameters,)
    parameter : int
        The one that takes it there.
    value : float
        From which on, found by bisection.
    is_above : bool
        Whether that is so above the value, or below.
    is_negative : bool
        Whether K is negative there for some motion.
    """

    theta: FloatArray
    parameter: int
    value: float
    is_above: bool
    is_negative: bool


class Anchors:
    """The factorised points of one block.

    Parameters
    ----------
    block : FullBlock
    lower, upper : ndarray, shape (n_parameters,)
        The box.

    Attributes
    ----------
    theta : ndarray, shape (n_anchors, n_parameters)
        The first lies in the middle of the box.
    shift : float
        s of K + s M, above 0 where the structure is free at an anchor: of the size of its lowest elastic λ.
    proven : bool
        Whether all terms are positive semidefinite, with coefficients that are not negative in the box. Where they
        are not, α is estimated: it is the smallest eigenvalue of the reduced matrices.

    Raises
    ------
    SingularAnchorError
        If K + s M is singular at an anchor.
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
        """Leave out the factors, which cannot travel."""
        return {name: value for name, value in self.__dict__.items() if name != "first"} | {"_factors": {}}

    @property
    def _terms(self) -> tuple[Term, ...]:
        return (*self.block.K_terms, *(self.block.M_terms if self.shift else ()))

    def _is_definite_at_anchors(self) -> bool:
        try:
            return all(
                is_clearly_definite(self.factor(a), unit_diagonal(self.matrix(a))[1])
                for a in range(len(self.theta))
            )
        except (np.linalg.LinAlgError, SingularAnchorError):
            return False

    def matrix(self, a: int) -> Matrix:
        """Return K + s M at anchor `a`."""
        ((K, M),) = self.block._matrices(self.theta[a : a + 1])
        return K + self.shift * M if self.shift else K

    @cached_property
    def first(self) -> Matrix:
        """K + s M at the first anchor: the inner product of training."""
        return self.matrix(0)

    def factor(self, a: int) -> Factor:
        """Return the factors of K + s M at anchor `a`."""
        if a not in self._factors:
            try:
                found = factorise(self.matrix(a))
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

    def modes(self, count: int) -> Space:
        """Return the space of the full model's lowest modes at all anchors, `count` of each and a few more."""
        if self._modes is None or self._modes.size < count:
            space = Space.empty(self.block, self.shift)
            for at in self.theta:
                _, shapes = self.block.modes(at[None], min(count + _GUARDS, self.block.n_modes))
                if np.isfinite(shapes).all():
                    space = space.grown(shapes[0], self.first)
            if not space.size:
                raise SingularAnchorError(NO_MODES)
            self._modes = space
        return self._modes

    def nearest(self, theta: FloatArray, space: Space) -> tuple[IntArray, FloatArray]:
        """Return for every theta (n, p) the anchor that bounds it best, and α, not positive where none does."""
        low, tight = self._tight(theta)
        best = np.argmax(tight, axis=0)
        alpha = low[best, np.arange(len(theta))]
        return best, alpha if self.proven else self._estimate_alpha(theta, best, space)

    def stretch(self, theta: FloatArray) -> FloatArray:
        """Return by what factor K + s M exceeds that at the first anchor at most, at theta (n, p).

        Infinite where the terms do not tell.
        """
        if not self.proven:
            return np.full(len(theta), np.inf)
        return np.asarray(np.max(self._ratios(theta, self.theta[0]), axis=1))

    def far(self, theta: FloatArray, space: Space) -> Far | None:
        """Return where K is farthest from every anchor, of theta (n, p); None if it is far nowhere."""

        def near(points: FloatArray) -> FloatArray:
            if self.proven:
                return np.asarray(np.max(self._tight(points)[1], axis=0))
            return self._estimate_alpha(points, np.zeros(len(points), dtype=int), space)

        tight = near(theta)
        i = int(np.argmin(tight))
        if tight[i] >= _FAR:
            return None
        back = np.where(np.eye(theta.shape[1], dtype=bool), self.theta[0], theta[i])  # one parameter each
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
        """Return α of every anchor at theta (n, p), and how near K is to it, both of shape (n_anchors, n)."""
        ratios = np.stack([self._ratios(theta, at) for at in self.theta])  # (n_anchors, n, n_terms)
        low, high = np.min(ratios, axis=2), np.max(ratios, axis=2)
        # a term that an anchor leaves out is as far from it as from a small share of what it is in the middle
        left_out = _WIDE * self._ratios(theta, self.theta[0])
        high = np.where(np.isinf(high), np.max(np.where(np.isinf(ratios), left_out, ratios), axis=2), high)
        with np.errstate(invalid="ignore", divide="ignore"):
            return low, np.where(low > 0.0, low / np.maximum(high, 1.0), -1.0)

    def _ratios(self, theta: FloatArray, at: FloatArray) -> FloatArray:
        here, there = coefficients(self._terms, theta), coefficients(self._terms, at[None])
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = here / there
        # a term that the anchor leaves out adds to K whatever it is, as long as it is not negative
        return np.where(there == 0.0, np.where(here >= 0.0, np.inf, -np.inf), np.where(there < 0.0, np.nan, ratio))

    def _estimate_alpha(self, theta: FloatArray, best: IntArray, space: Space) -> FloatArray:
        alpha = np.empty(len(theta))
        for i in range(len(theta)):
            (A, A0), (M, M0) = space.assemble(np.stack([theta[i], self.theta[best[i]]]))
            A, A0 = A + self.shift * M, A0 + self.shift * M0
            alpha[i] = sl.eigh(A, A0, eigvals_only=True, subset_by_index=[0, 0], check_finite=False)[0]
        return alpha


def anchor_points(terms: Sequence[Term], lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return anchors (n_anchors, p) of a box: its middle, and the middles of parts where a stiffness changes much.

    A part is halved where a coefficient changes by more than a factor of `_WIDE`, along the parameter that
    changes it most, until there are `_MOST`. Of parameters that change no stiffness the middle serves.
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
        if low[j] == 0.0:  # further down no anchor but the face itself can follow
            face = below.copy()
            face[j] = 0.0
            anchors += [_middle(low, face), _middle(low, below), _middle(above, high)]
            parts += [(above, high), (low, face)]
        else:
            anchors += [_middle(low, below), _middle(above, high)]
            parts += [(low, below), (above, high)]
    return np.stack(anchors[:_MOST])


def _middle(lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return the geometric mean of positive bounds that are far apart, the mean of others."""
    with np.errstate(invalid="ignore"):
        return np.where((lower > 0.0) & (upper > 2.0 * lower), np.sqrt(lower * upper), 0.5 * (lower + upper))
