"""Search for a posterior's local maxima from several starting points. A single ascent may end at a minor maximum.

Gauss–Newton ascents from all starting points advance together as one array. Among ascents close to the same
maximum, only the highest continues, and equal results are merged.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from fmu.numbers import names_in_words
from fmu.posterior.ascent import Ascent, GaussNewton, ascend, is_close
from fmu.posterior.density import Posterior
from fmu.posterior.parameters import box
from fmu.posterior.scaled import ScaledDensity, ascent_coordinates
from fmu.progress.phases import advance_phase, phase, solves
from fmu.types import FloatArray, IntArray

STARTS = 256
_ROUGH, _TOLERANCE = 0.1, 1e-10
"""Predicted decrease of a step, in nats, below which all ascents pause, and below which the best ascents end."""
_CLOSE = 0.5
"""Of ascents that pause within this many nats of each other, by value and curvature, only the best continues."""
_SAME = 1e-3
_VALLEY = 0.1
_ON_THE_WAY = tuple(np.arange(1, n, 2)[:, None] / n for n in (2, 4, 8, 16, 32))
"""Fractions of the line between two maxima at which `_is_same` looks for a valley, the middle first."""
_MOST_POLISHED, _FIRST = 8, 16
_AT_ONCE, _MOST_STEPS, _HOPELESS, _SIZES = 64, 30, 50.0, (1.0, 0.1, 0.01)
"""Settings of the search with a model discrepancy: number of points that ascend with it from the first step;
largest number of steps; distance below the best converged ascent, in nats, beyond which other ascents are
abandoned; and sizes of the discrepancy at which ascents start, relative to its size in ``problem.start``."""


@dataclass(frozen=True)
class Maximum:
    """A local maximum within the bounds: theta (ndim,), its log-probability, and how many ascents ended there."""

    theta: FloatArray
    log_prob: float
    starts: int


def local_maxima(
    problem: Posterior,
    starts: int = STARTS,
    seed: int = 1,
    near: FloatArray | None = None,
    most_solves: float = np.inf,
) -> tuple[Maximum, ...]:
    """Return the distinct local maxima of the log-probability within the bounds, the highest first.

    The search starts from ``problem.start`` and from scrambled Sobol points in the prior's box. Unless the modal
    residual is used, all points ascend together by Gauss–Newton steps (`ascend`). If several ascents come
    close together just below a maximum, only the highest continues. Of the ascents that stall at a kink, the best
    eight are finished with L-BFGS-B (Byrd, Lu, Nocedal & Zhu 1995). With the modal residual, every point ascends
    by L-BFGS-B. Two results are the same maximum if no valley separates them. This means that on the straight line
    between them, the log-probability is nowhere more than 0.1 below the lower value.

    The likelihood of frequency response functions has many maxima, so the points first ascend on easier
    likelihoods (`FRFLikelihood.easier`). If the model has a discrepancy and `most_solves` is infinite, all points
    first ascend without it, and the highest eight end points then ascend with it. In addition, 64 of the points
    ascend with it from the first step (`_starts_with_discrepancy`).

    Parameters
    ----------
    problem : Posterior
    starts : int
        Number of starting points, at least 1; the first is ``problem.start``. Where modes swap, few ascents
        may reach an important maximum. In the example cantilever-section, with pairing by number, one in
        twelve reaches the maximum with nearly all of the probability.
    seed : int
    near : ndarray, shape (n, ndim), optional
        Further starting points, in SI units. A point outside the bounds is moved to the nearest bound.
    most_solves : float
        Number of solves, above 0, after which no further ascent begins. Solves for easier likelihoods do not
        count. If the number is finite, the ascents run one after the other. The total may exceed it, because an
        ascent that has begun is completed, and the best end points are then refined. With the modal residual and a
        finite number, the search also ends after sixteen ascents if they have found more than eight distinct
        maxima.

    Returns
    -------
    tuple of Maximum

    Raises
    ------
    ValueError
        If `starts` is not positive, or no ascent reaches a finite log-probability.
    """
    if starts < 1:
        raise ValueError(f"starts: must be at least 1 (got {starts})")
    scaled = ascent_coordinates(problem)
    points = _starting_points(problem, scaled, starts, seed)
    if near is not None:
        points = np.concatenate([points, np.clip(scaled.to_scaled(near), scaled.lower, scaled.upper)])
    with phase("search", len(points)):
        n_sizes, at_once = problem.likelihood.n_sizes, points[:_AT_ONCE]
        easier = problem.likelihood.easier() if n_sizes is None or np.isinf(most_solves) else []
        begun = list[FloatArray]()
        for likelihood in easier:
            begun.append(points := _ascend_roughly(problem.with_likelihood(likelihood), points))
        # an easier likelihood may have lost a maximum, so the ends from all of them are starting points
        points = np.concatenate(begun) if begun else points
        if easier and n_sizes is not None:
            points = _starts_with_discrepancy(problem, scaled, at_once, points, n_sizes)
        if not (found := maxima_from(problem, scaled, points, most_solves)):
            raise ValueError(_nowhere(problem, len(points)))
        return found


def _ascend_roughly(problem: Posterior, points: FloatArray) -> FloatArray:
    """Return the highest points, (m, ndim), that ascents from scaled points (n, ndim) reach; m is at most eight.

    Return `points` themselves if none of them has a finite log-probability with a finite gradient.
    """
    scaled = ascent_coordinates(problem)
    ends = ascend(GaussNewton(problem, scaled), points, scaled.lower, scaled.upper, tolerance=_ROUGH, join=True)
    found = leaders(ends)[0]
    return found[:_MOST_POLISHED] if len(found) else points


def _starts_with_discrepancy(
    problem: Posterior, scaled: ScaledDensity, at_once: FloatArray, ends: FloatArray, n_sizes: int
) -> FloatArray:
    """Return scaled points (m, ndim) that a few ascent steps with the model discrepancy reach.

    Near mode crossings the discrepancy's variances change too fast for Gauss–Newton steps, and most ascents do not
    converge. After `_MOST_STEPS`, an ascent is abandoned if it is `_HOPELESS` nats below the highest one that has
    converged. If none of `ends` leads to a maximum, they are retried with a tenth and then a hundredth of the
    discrepancy, because the maxima with a small discrepancy are close to those without it. If nothing is left,
    `ends` are returned.

    Parameters
    ----------
    at_once : ndarray, shape (k, ndim)
        Scaled points that ascend with the discrepancy from the first step.
    ends : ndarray, shape (l, ndim)
        Scaled end points of ascents without it.
    n_sizes : int
        Number of inferred discrepancy parameters, which are the last in theta; if it is 0, nothing is retried.
    """
    quadratic, is_size = GaussNewton(problem, scaled), np.arange(problem.ndim) >= problem.ndim - n_sizes
    theta, reached = scaled.to_theta(ends), list[Ascent]()
    for size in _SIZES:
        begun = scaled.to_scaled(np.where(is_size, size * problem.start, theta))
        points = np.concatenate([np.clip(begun, scaled.lower, scaled.upper), at_once])
        found = ascend(quadratic, points, scaled.lower, scaled.upper, tolerance=_ROUGH, max_steps=_MOST_STEPS)
        reached.append(found)
        if not n_sizes or found.stationary[: len(ends)].any():
            break
        at_once = at_once[:0]
    V, arrived = np.concatenate([e.value for e in reached]), np.concatenate([e.stationary for e in reached])
    worst = np.min(V[arrived], initial=np.inf) + _HOPELESS
    chosen = arrived | (worst > V)
    return np.concatenate([e.position for e in reached])[chosen] if chosen.any() else ends


def maxima_from(
    problem: Posterior, scaled: ScaledDensity, points: FloatArray, most_solves: float = np.inf
) -> tuple[Maximum, ...]:
    """Return the maxima reached from scaled points (n, ndim), the highest first.

    `most_solves` is as in `local_maxima`. If no ascent reaches a finite log-probability, return an empty tuple for
    the modal residual or a plain log-density, and raise ValueError for any other likelihood.
    """
    before = solves()
    if not problem.likelihood.of_modes:
        tops = list[Maximum]()
        for u in points:
            if solves() - before >= most_solves:
                break
            tops.append(_climb(scaled, u))
            if len(tops) == _FIRST and np.isfinite(most_solves) and len(_distinct(problem, tops)) > _MOST_POLISHED:
                break
        return _distinct(problem, tops)
    quadratic = GaussNewton(problem, scaled)
    reached = list[tuple[FloatArray, IntArray]]()
    for together in [points] if np.isinf(most_solves) else points[:, None]:
        if not reached or solves() - before < most_solves:
            ends = ascend(quadratic, together, scaled.lower, scaled.upper, tolerance=_ROUGH, join=True)
            reached.append(leaders(ends))
    highest, starts = (np.concatenate(parts) for parts in zip(*reached, strict=True))
    if not len(highest):
        raise ValueError(_nowhere(problem, len(points)))
    ends = ascend(quadratic, highest, scaled.lower, scaled.upper, tolerance=_TOLERANCE)
    arrived = _merge(problem, _collect_ends(scaled, ends.position[ends.stationary], starts[ends.stationary]))
    near: list[Maximum] = []
    lost: list[Maximum] = []
    for stalled in _merge(
        problem, _collect_ends(scaled, ends.position[~ends.stationary], starts[~ends.stationary])
    ):
        (near if any(_is_same(problem, stalled, m) for m in arrived) else lost).append(stalled)
    polished = [_climb(scaled, scaled.to_scaled(m.theta), m.starts) for m in lost[:_MOST_POLISHED]]
    return _merge(problem, [*arrived, *near, *polished])


def _nowhere(problem: Posterior, n: int) -> str:
    """Return the message that explains why no starting point has a finite gradient."""
    why = ""
    still = np.flatnonzero(~(problem.frequencies(problem.start) > 0.0))
    if len(still):
        labels = names_in_words([str(problem.data.labels[k]) for k in still])
        why = (
            f": mode {labels} has no frequency above 0 Hz at the start. By number, rigid-body motions count as "
            "modes: give the numbers of the measured modes"
        )
    return f"problem: the log-probability must have a finite gradient at one of {n} starts (got none{why})"


def _starting_points(problem: Posterior, scaled: ScaledDensity, starts: int, seed: int) -> FloatArray:
    """Return scaled starting points within the bounds, shape (starts, ndim)."""
    from scipy.stats import qmc

    lower, upper = box(problem.parameters)
    sobol = qmc.Sobol(problem.ndim, rng=np.random.default_rng(seed))
    unit = sobol.random_base2(int(np.ceil(np.log2(starts))))[: starts - 1]
    spread = lower + (upper - lower) * unit
    if scaled.is_log.any():
        low, high = scaled.to_scaled(np.array([lower, upper]))
        spread = np.where(scaled.is_log, scaled.to_theta(low + (high - low) * unit), spread)
    theta = np.concatenate([problem.start[None], spread])
    return np.clip(scaled.to_scaled(theta), scaled.lower, scaled.upper)


def leaders(ends: Ascent) -> tuple[FloatArray, IntArray]:
    """Return the highest point, (n, ndim), and the size, (n,), of each group of close end points.

    The highest group comes first. End points at which the log-probability or its gradient is not finite are left
    out.
    """
    chosen, starts = list[int](), list[int]()
    left = np.argsort(ends.value)
    left = left[np.isfinite(ends.value[left])]
    while left.size:
        first = left[0]
        close = is_close(
            ends.position[left],
            ends.value[left],
            ends.position[first],
            ends.value[first],
            ends.hessian[first],
            _CLOSE,
        )
        close[0] = True
        chosen.append(first)
        starts.append(int(close.sum()))
        left = left[~close]
    return ends.position[chosen], np.array(starts)


def _collect_ends(scaled: ScaledDensity, u: FloatArray, starts: IntArray) -> list[Maximum]:
    """Return the maxima at scaled points u (n, ndim) that have a finite log-probability.

    `starts` (n,) is the number of ascents that ended at each point.
    """
    theta = scaled.to_theta(u)
    values = scaled.density.log_prob(theta)
    return [Maximum(x, float(v), int(n)) for x, v, n in zip(theta, values, starts, strict=True) if np.isfinite(v)]


def _is_same(problem: Posterior, one: Maximum, other: Maximum) -> bool:
    if np.all(np.abs(one.theta - other.theta) < _SAME * problem.scale):
        return True
    least = min(one.log_prob, other.log_prob) - _VALLEY
    away = other.theta - one.theta
    return all(np.min(problem.log_prob(one.theta + t * away)) >= least for t in _ON_THE_WAY)


def _merge(problem: Posterior, maxima: Iterable[Maximum]) -> tuple[Maximum, ...]:
    """Return the distinct maxima, the highest first. The ascent counts of equal maxima are added up."""
    distinct: list[Maximum] = []
    for maximum in sorted(maxima, key=lambda m: -m.log_prob):
        for i, known in enumerate(distinct):
            if _is_same(problem, maximum, known):
                distinct[i] = Maximum(known.theta, known.log_prob, known.starts + maximum.starts)
                break
        else:
            distinct.append(maximum)
    return tuple(distinct)


def _distinct(problem: Posterior, tops: Iterable[Maximum]) -> tuple[Maximum, ...]:
    """Return the distinct maxima with a finite log-probability, the highest first."""
    return _merge(problem, [top for top in tops if np.isfinite(top.log_prob)])


def _climb(scaled: ScaledDensity, start: FloatArray, starts: int = 1) -> Maximum:
    """Return the maximum that L-BFGS-B reaches from a scaled point (ndim,).

    `starts` is the number of ascents that are counted as ending there.
    """
    from scipy.optimize import minimize

    def negative(u: FloatArray) -> tuple[float, FloatArray]:
        value, gradient = scaled.log_prob_and_grad(u)
        if not (np.isfinite(value) and np.all(np.isfinite(gradient))):
            return 1e300, np.zeros_like(u)
        return -value, -gradient

    result = minimize(
        negative,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(scaled.lower, scaled.upper, strict=True)),
        options={"ftol": 1e-13, "gtol": 1e-7, "maxiter": 500, "maxcor": 20},
    )
    theta = scaled.to_theta(result.x)
    advance_phase(starts)
    return Maximum(theta, float(scaled.density.log_prob(theta)), starts)
