"""Local maxima of a posterior, from several starts: an optimum found once is not the mode."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from fmu.posterior.maxima.ascent import GaussNewton, ascend
from fmu.posterior.protocol import Problem
from fmu.posterior.scaled import ScaledDensity
from fmu.progress.phases import advanced, phase
from fmu.types import FloatArray

STARTS = 256
_TOLERANCE = 1e-8
_SAME = 1e-3
_VALLEY = 0.1
_ON_THE_WAY = np.linspace(0.0, 1.0, 33)[1:-1, None]
_MOST_POLISHED = 8


@dataclass(frozen=True)
class Maximum:
    """A local maximum within the bounds: theta (ndim,), its log-probability, and from how many starts it came."""

    theta: FloatArray
    log_prob: float
    starts: int


def local_maxima(problem: Problem, starts: int = STARTS, seed: int = 1) -> tuple[Maximum, ...]:
    """Return the distinct local maxima of the log-probability within the bounds, the highest first.

    The starts are the problem's own and points of a scrambled Sobol sequence in its box. Under a likelihood of
    errors in the modes all of them climb by Gauss–Newton steps in lockstep (`fmu.posterior.maxima.ascent`), and
    those that stall at a kink go on by L-BFGS-B (Byrd, Lu, Nocedal & Zhu 1995), the best eight of them; under
    another likelihood every start climbs by L-BFGS-B. Two results are one maximum when there is no valley between
    them: nowhere on the straight line is the log-probability more than a tenth below the lower end.

    Parameters
    ----------
    problem : UpdatingProblem
    starts : int
        At least 1; the first is ``problem.start``. Where modes swap, a maximum may attract few of them:
        cantilever-section by number has nearly all its probability in one that every twelfth start climbs to.
    seed : int

    Raises
    ------
    ValueError
        If `starts` is not positive.
    """
    if starts < 1:
        raise ValueError(f"starts: must be at least 1 (got {starts})")
    scaled = ScaledDensity(problem)
    points = _starting_points(problem, scaled, starts, seed)
    with phase("search", starts):
        return _found(problem, scaled, points)


def _found(problem: Problem, scaled: ScaledDensity, points: FloatArray) -> tuple[Maximum, ...]:
    """Return where the climbs from scaled points (n, ndim) lead to."""
    if not problem.likelihood.of_modes:
        return _merged(problem, [_climb(scaled, u) for u in points])
    ends = ascend(GaussNewton(problem), points, scaled.lower, scaled.upper, tolerance=_TOLERANCE)
    arrived = _merged(problem, _ended(scaled, ends.position[ends.stationary]))
    near: list[Maximum] = []
    lost: list[Maximum] = []
    for stalled in _merged(problem, _ended(scaled, ends.position[~ends.stationary])):
        (near if any(_is_same(problem, stalled, m) for m in arrived) else lost).append(stalled)
    polished = [_climb(scaled, scaled.to_scaled(m.theta), m.starts) for m in lost[:_MOST_POLISHED]]
    return _merged(problem, [*arrived, *near, *polished])


def _starting_points(problem: Problem, scaled: ScaledDensity, starts: int, seed: int) -> FloatArray:
    """Return scaled points (starts, ndim) within the bounds."""
    from scipy.stats import qmc

    lower, upper = np.array([p.prior.box(p.lower, p.upper) for p in problem.parameters]).T
    sobol = qmc.Sobol(problem.ndim, rng=np.random.default_rng(seed))
    unit = sobol.random_base2(int(np.ceil(np.log2(starts))))[: starts - 1]
    theta = np.concatenate([problem.start[None], lower + (upper - lower) * unit])
    return np.clip(scaled.to_scaled(theta), scaled.lower, scaled.upper)


def _ended(scaled: ScaledDensity, u: FloatArray) -> list[Maximum]:
    """Return one maximum for each of the scaled points that has a probability, shape (n, ndim)."""
    theta = scaled.to_theta(u)
    values = scaled.density.log_prob(theta)
    return [Maximum(x, float(v), 1) for x, v in zip(theta, values, strict=True) if np.isfinite(v)]


def _is_same(problem: Problem, one: Maximum, other: Maximum) -> bool:
    if np.all(np.abs(one.theta - other.theta) < _SAME * problem.scale):
        return True
    between = problem.log_prob(one.theta + _ON_THE_WAY * (other.theta - one.theta))
    return bool(np.min(between) >= min(one.log_prob, other.log_prob) - _VALLEY)


def _merged(problem: Problem, maxima: Iterable[Maximum]) -> tuple[Maximum, ...]:
    """Return the distinct ones, the highest first, each with the starts of all that agree with it."""
    distinct: list[Maximum] = []
    for maximum in sorted(maxima, key=lambda m: -m.log_prob):
        for i, known in enumerate(distinct):
            if _is_same(problem, maximum, known):
                distinct[i] = Maximum(known.theta, known.log_prob, known.starts + maximum.starts)
                break
        else:
            distinct.append(maximum)
    return tuple(distinct)


def _climb(scaled: ScaledDensity, start: FloatArray, starts: int = 1) -> Maximum:
    """Climb by L-BFGS-B from a scaled point."""
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
    advanced(starts)
    return Maximum(theta, float(scaled.density.log_prob(theta)), starts)
