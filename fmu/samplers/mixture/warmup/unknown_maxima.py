"""Search for maxima that the mixture misses, starting at points where the mixture's density is too low."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fmu.samplers.kernel import Target
from fmu.samplers.mixture.proposal import MOST, Mixture
from fmu.samplers.mixture.quadratic import Quadratic, climb
from fmu.samplers.mixture.warmup.local_draws import FAR
from fmu.types import BoolArray, FloatArray, IntArray

_UNKNOWN, _VALLEY = 1.0, 3.0
"""The density q of the mixture is too low at a point where log(P/q) exceeds its median by `_UNKNOWN`. Such a point
is near a maximum that the mixture misses if, between the point and its component, the log-density drops by
`_VALLEY`, which is more than local steps can cross."""
_LOWEST = -5.0  # smallest logarithm of a new component's share
_CHECKED = 5  # largest number of points that are checked per fit
_BETWEEN = np.arange(6) / 6.0  # relative positions on the line from the component to the point


class Seen(NamedTuple):
    """Points from which the search for missed maxima may start.

    They are candidates, followed by the chains' positions and then the draws of local steps before the first fit.

    Attributes
    ----------
    position : ndarray, shape (n, ndim)
    log_prob : ndarray, shape (n,)
    log_q : ndarray, shape (n,)
        Combined log-density of all mixtures so far, up to a constant.
    candidates, chains : int
        Numbers of candidates and of chains.
    """

    position: FloatArray
    log_prob: FloatArray
    log_q: FloatArray
    candidates: int
    chains: int

    @property
    def is_chain(self) -> BoolArray:
        """Mask of the points that are current chain positions, shape (n,)."""
        k = np.arange(len(self.position)) - self.candidates
        return np.asarray((k >= 0) & (k < self.chains))


class NewMaximum(NamedTuple):
    """A maximum as a quadratic in unwarped coordinates, and its mass relative to the mixture's, from e⁻⁵ to 1."""

    quadratic: Quadratic
    mass: float


def find_unknown_maxima(mixture: Mixture, seen: Seen, target: Target) -> tuple[list[NewMaximum], IntArray]:
    """Return the maxima that a mixture misses, and the evaluations that the search cost, shape (chains,).

    The search climbs from a point of `seen` under two conditions. First, log w = log P − log q there is well above
    its median. Second, a valley separates the point from the component most likely to have produced it. Chain
    positions come first, because a chain at a low maximum without a component would hardly leave it. Any other
    point must have a log-density that is not far below the chains'. Its log w must also be well above the median
    when q combines all mixtures so far, so that a maximum already known to be minor is not climbed again.

    A summit is a missed maximum if its log w is well above the median, too. At most `_CHECKED` points are checked,
    none once the mixture has `MOST` components.
    """
    u, log_prob, log_q, n, _ = seen
    is_chain = seen.is_chain
    log_w, of_all = log_prob - mixture.log_density(u), log_prob - log_q
    usual = float(np.median(log_w[:n]))
    is_low = log_prob < np.median(log_prob[is_chain]) - FAR - u.shape[1]
    known = ~is_chain & (is_low | (of_all <= np.median(of_all[:n]) + _UNKNOWN))
    found = list[NewMaximum]()
    spent = np.zeros(seen.chains, dtype=np.int64)
    for check in range(_CHECKED):
        unknown = ~known & (log_w > usual + _UNKNOWN)
        if not unknown.any() or len(mixture.quadratics) >= MOST:
            break
        first = unknown & is_chain if np.any(unknown & is_chain) else unknown
        at = int(np.argmax(np.where(first, log_w, -np.inf)))
        owner = mixture.quadratics[int(np.argmax(mixture.responsibilities(u[at : at + 1])[:, 0]))]
        begin, end = owner.position, mixture.warp.to_x(u[at])
        evaluate = _Counted(target)
        between = evaluate(mixture.warp.to_u(begin + _BETWEEN[:, None] * (end - begin)))
        known[at] = True
        if np.min(between) < min(between[0], log_prob[at]) - _VALLEY:
            away = mixture.warp.stretch(u[at])
            summit = climb(evaluate, u[at], owner.hessian / np.outer(away, away))
            if summit.log_prob - mixture.log_density(summit.position[None])[0] > usual + _UNKNOWN:
                log_mass = summit.log_prob - 0.5 * np.linalg.slogdet(summit.hessian / (2.0 * np.pi))[1]
                found.append(NewMaximum(summit, float(np.exp(np.clip(log_mass - usual, _LOWEST, 0.0)))))
                mixture = add_maxima(mixture, found[-1:])
                log_w = log_prob - mixture.log_density(u)
        spent[check % seen.chains] += evaluate.n_solves
    return found, spent


def add_maxima(mixture: Mixture, maxima: Sequence[NewMaximum]) -> Mixture:
    """Return the mixture with a component added at each maximum.

    Later fits correct the weights and shapes of these components.
    """
    if not maxima:
        return mixture
    new = [mixture.warp.quadratic(one.quadratic) for one in maxima]
    weights = np.append(mixture.weights, [one.mass for one in maxima])
    return Mixture([*mixture.quadratics, *new], weights, mixture.warp, mixture.wide)


class _Counted:
    """Callable log-density that counts its solves."""

    def __init__(self, target: Target) -> None:
        self.target, self.n_solves = target, 0

    def __call__(self, u: FloatArray) -> FloatArray:
        """Return the log-densities at points u (n, ndim), shape (n,); -inf outside the bounds or if not finite."""
        found = self.target.evaluate(u)
        self.n_solves += int(found.n_solves.sum())
        return found.log_prob
