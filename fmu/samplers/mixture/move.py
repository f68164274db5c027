"""A move for any emcee ``EnsembleSampler`` that proposes candidates from a Gaussian mixture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from emcee.model import Model
from emcee.moves import Move, StretchMove
from emcee.state import State
from numpy.typing import ArrayLike

from fmu.arguments import check_arguments, shown
from fmu.box import find_inside
from fmu.samplers.local import accept
from fmu.samplers.mixture.proposal import Mixture, Points, fit_mixture
from fmu.samplers.mixture.quadratic import of_moments
from fmu.samplers.mixture.warp import Warp
from fmu.types import BoolArray, FloatArray

_FIRST_FIT = 10
"""Number of warm-up steps before the first fit of the mixture, which is refitted whenever their number doubles."""
_MOST_POINTS = 4000
_FAR = 10.0
"""Walkers whose log-probability is this far below the median, plus one per coordinate, are not used in a fit."""


@check_arguments
class MixtureMove(Move):
    """emcee move that proposes independent candidates from a mixture of truncated Gaussians fitted to the walkers.

    As in other emcee moves, the walkers are divided at random into two halves that move in turn. The mixture q for
    one half is fitted only to the positions and log-probabilities of the other half. A walker at x moves to its
    candidate x* with probability min(1, P(x*) q(x)/(P(x) q(x*))). Since q does not depend on the moving half,
    every step leaves the posterior invariant, without any warm-up. If no mixture can be fitted to the other half,
    emcee's stretch move is made instead.

    ``run_mcmc(..., tune=True)`` is a warm-up: after 10, 20, 40, ... steps the mixture is fitted to all walkers in
    the later half of these steps. Discard the warm-up draws. The mixture is then frozen, which also leaves the
    posterior invariant. A frozen mixture is better, because it is fitted to more points, and later steps need no
    fit.

    A candidate does not depend on its walker's position, so walkers cross between separate modes. A walker may,
    however, be stuck for long where the mixture's density is far too low. Add another move to avoid this:
    ``moves=[(fmu.MixtureMove(problem), 0.8), (emcee.moves.DEMove(), 0.2)]``.

    Parameters
    ----------
    density : LogDensity, optional
        Object with the bounds ``lower`` and ``upper``, shape (ndim,), such as an `UpdatingProblem`.
    lower, upper : array_like, shape (ndim,), optional
        Bounds that replace those of `density`. Without bounds, candidates may lie where the log-probability is
        -inf.

    Raises
    ------
    ValueError
        If `density` has no bounds, the bounds differ in shape, or a lower bound is not below its upper bound.

    References
    ----------
    Goodman & Weare (2010), CAMCoS 5, 65-80, section 2 (moves that use the complementary walkers); Tierney (1994),
    Ann. Statist. 22, 1701-1762, section 2.3.3 (independence chains).
    """

    def __init__(
        self, density: Any = None, *, lower: ArrayLike | None = None, upper: ArrayLike | None = None
    ) -> None:
        below, above = (getattr(density, name, None) for name in ("lower", "upper"))
        if density is not None and (below is None or callable(below)):
            raise ValueError(f"density: must have lower and upper, shape (ndim,) (got {shown(density)})")
        lower = next((end for end in (lower, below) if end is not None), -np.inf)
        upper = next((end for end in (upper, above) if end is not None), np.inf)
        self.lower, self.upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        if self.lower.ndim and self.upper.ndim and self.lower.shape != self.upper.shape:
            raise ValueError(f"upper: must have the shape of lower, {self.lower.shape} (got {self.upper.shape})")
        if not np.all(self.lower < self.upper):
            raise ValueError(f"upper: must exceed lower {self.lower} (got {self.upper})")
        self.frozen: Proposal | None = None
        self._seen: list[tuple[FloatArray, FloatArray]] = []
        self._otherwise = StretchMove()

    def propose(self, model: Model, state: State) -> tuple[State, BoolArray]:
        """Propose a move for every walker; return emcee's new state and a mask of moved walkers, (walkers,)."""
        n = len(state.coords)
        half = np.arange(n) % 2
        model.random.shuffle(half)
        accepted = np.zeros(n, dtype=bool)
        for moved in (half == 0, half == 1):
            s, log_prob = state.coords[moved], state.log_prob[moved]
            q, factor = self.candidates(s, state.coords[~moved], state.log_prob[~moved], model.random)
            reached, blobs = model.compute_log_prob_fn(q)
            with np.errstate(invalid="ignore"):  # a walker may have started at log-probability -inf
                gain = np.where(np.isfinite(reached), reached - log_prob + factor, -np.inf)
            accepted[moved] = accept(model.random, gain)
            state = self.update(state, State(q, log_prob=reached, blobs=blobs), accepted, moved)
        return state, accepted

    def candidates(
        self, s: FloatArray, c: FloatArray, log_prob: FloatArray, random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Return candidates x* for the walkers x, and the logarithms of the acceptance factors q(x)/q(x*).

        The density q is the frozen mixture or, if nothing is frozen yet, a mixture fitted to the other walkers. If
        that fit is impossible, the candidates and factors come from emcee's stretch move.

        Parameters
        ----------
        s, c : ndarray, shape (n, ndim), (m, ndim)
            Positions of the walkers that move, and of the other walkers.
        log_prob : ndarray, shape (m,)
            Log-probabilities of the other walkers.
        random : RandomState

        Returns
        -------
        q : ndarray, shape (n, ndim)
            The candidates.
        factor : ndarray, shape (n,)
            The logarithms of the acceptance factors.
        """
        proposal = self.frozen or Proposal.fit_points(c, log_prob, self.lower, self.upper)
        if proposal is None:  # the other half does not span the space
            found: tuple[FloatArray, FloatArray] = self._otherwise.get_proposal(s, [c], random)
            return found
        rng = np.random.default_rng(random.randint(2**32, size=8, dtype=np.uint32))
        q = np.clip(proposal.draw(rng, len(s)), self.lower, self.upper)
        return q, proposal.log_density(s) - proposal.log_density(q)

    def tune(self, state: State, accepted: BoolArray) -> None:
        """Record the last step and, after 10, 20, 40, ... steps, fit the mixture to the later half of all steps.

        emcee calls this method if ``tune=True``. If a fit fails, the earlier mixture is kept.
        """
        self._seen.append((state.coords.copy(), state.log_prob.copy()))
        steps = len(self._seen)
        doublings = np.log2(steps / _FIRST_FIT)
        if doublings >= 0 and doublings == int(doublings):
            later = self._seen[steps // 2 :]
            x, log_prob = (np.concatenate(each) for each in zip(*later, strict=True))
            every = -(-len(x) // _MOST_POINTS)
            found = Proposal.fit_points(x[::every], log_prob[::every], self.lower, self.upper)
            self.frozen = self.frozen if found is None else found


@dataclass(frozen=True, eq=False)
class Proposal:
    """Proposal density: a mixture in the scaled coordinates u = (theta − offset)/scale, which are of order one.

    Attributes
    ----------
    mixture : Mixture
    offset, scale : ndarray, shape (ndim,)
    """

    mixture: Mixture
    offset: FloatArray
    scale: FloatArray

    @classmethod
    def fit_points(
        cls, position: FloatArray, log_prob: FloatArray, lower: FloatArray, upper: FloatArray
    ) -> Proposal | None:
        """Fit a proposal to points (n, ndim); return None if they are too few or the fit fails.

        Points with a log-probability that is not finite or far below the median are left out. A coordinate with
        two finite bounds is scaled by the distance between them; any other coordinate is scaled by the standard
        deviation of the points.
        """
        ndim = position.shape[1]
        near = np.isfinite(log_prob)
        near[near] = log_prob[near] >= np.median(log_prob[near]) - _FAR - ndim if near.any() else False
        x, spread = position[near], np.ptp(position[near], axis=0) if near.any() else np.zeros(ndim)
        if len(np.unique(x, axis=0)) < ndim + 2 or not np.all(spread > 0):
            return None
        lower, upper = np.broadcast_to(lower, ndim), np.broadcast_to(upper, ndim)
        is_boxed = np.isfinite(lower) & np.isfinite(upper)
        offset = np.where(is_boxed, lower, x.mean(axis=0))
        scale = np.where(is_boxed, upper - lower, x.std(axis=0))
        points = Points((x - offset) / scale, log_prob[near], np.ones(len(x)))
        warp = Warp((lower - offset) / scale, (upper - offset) / scale, np.zeros(ndim, dtype=bool))
        try:
            start = Mixture([of_moments(points.position, points.weight)], np.ones(1), warp)
            for mixture in (fit_mixture(points, start), start):
                if np.isfinite(mixture.log_density(points.position)).all():
                    return cls(mixture, offset, scale)
        except np.linalg.LinAlgError:
            pass
        return None

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Return `n` independent draws of theta, shape (n, ndim)."""
        return self.offset + self.scale * self.mixture.draw(rng, n)

    def log_density(self, theta: FloatArray) -> FloatArray:
        """Return the log-density at theta (n, ndim), shape (n,), up to a constant.

        It is -inf outside the bounds.
        """
        u, warp = (theta - self.offset) / self.scale, self.mixture.warp
        inside, _ = find_inside(u, warp.lower, warp.upper)
        found = np.full(len(u), -np.inf)
        found[inside] = self.mixture.log_density(u[inside])
        return found
