"""The search for local maxima of a posterior from several starts, since a single optimum need not be the mode.

Gauss–Newton ascents from all starts run in lockstep as one array. Ascents close to the same maximum are continued
from the highest point only, and equal results are merged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fmu.numbers import names_in_words
from fmu.posterior.density import Posterior
from fmu.posterior.parameters import box
from fmu.posterior.scaled import ScaledDensity, ascent_coordinates
from fmu.progress.phases import advance_phase, phase, solves
from fmu.types import BoolArray, FloatArray, IntArray

STARTS = 256
_ROUGH, _TOLERANCE = 0.1, 1e-10
"""Predicted decrease of a step, in nats, below which all ascents pause, and below which the best ascents end."""
_CLOSE = 0.5
"""Ascents that pause less than this below the same maximum by its curvature, in nats, are continued as one."""
_SAME = 1e-3
_VALLEY = 0.1
_ON_THE_WAY = np.linspace(0.0, 1.0, 33)[1:-1, None]
_MOST_POLISHED, _FIRST = 8, 16
Quadratic = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
"""A function of u (n, ndim) that returns V = −log P (n,), its gradient and its Gauss–Newton Hessian."""

FIRST_DAMPING, MOST_DAMPING = 1e-2, 1e12


@dataclass(frozen=True)
class Maximum:
    """A local maximum theta (ndim,) within the bounds, its log-probability and the count of starts reaching it."""

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

    The starts are the problem's own start and points of a scrambled Sobol sequence in the box of the priors. If
    the errors are those of computed modes, all starts ascend by Gauss–Newton steps in lockstep (`ascend`). Just
    below a maximum, only the highest of several points close to one another continues. Of the ascents that stall
    at a kink, the best eight continue by L-BFGS-B (Byrd, Lu, Nocedal & Zhu 1995). For other errors, every start
    ascends by L-BFGS-B. Two results count as one maximum if no valley separates them: on the straight line between
    the two points, the log-probability is nowhere more than 0.1 below the lower of the two values.

    Parameters
    ----------
    problem : UpdatingProblem
    starts : int
        Number of starts, at least 1; the first is ``problem.start``. Where modes swap, few starts may lead to an
        important maximum: in the example cantilever-section, with pairing by number, one start in twelve reaches
        the maximum with nearly all of the probability.
    seed : int
    near : ndarray, shape (n, ndim), optional
        Further starts, SI units.
    most_solves : float
        Largest number of solves. With a finite limit the starts ascend one after the other, and no ascent begins
        once the limit is reached. Without errors of modes, no ascent begins either after sixteen ascents have led
        to more than eight maxima, as in a density that is hollow.

    Raises
    ------
    ValueError
        If `starts` is not positive, or no start has a log-probability with a finite gradient.
    """
    if starts < 1:
        raise ValueError(f"starts: must be at least 1 (got {starts})")
    scaled = ascent_coordinates(problem)
    points = _starting_points(problem, scaled, starts, seed)
    if near is not None:
        points = np.concatenate([points, np.clip(scaled.to_scaled(near), scaled.lower, scaled.upper)])
    with phase("search", len(points)):
        for easier in problem.likelihood.easier():
            points = _ascend_roughly(problem.with_likelihood(easier), points)
        return maxima_from(problem, scaled, points, most_solves)


def _ascend_roughly(problem: Posterior, points: FloatArray) -> FloatArray:
    """Return the highest points that ascents from scaled points (n, ndim) reach, (m, ndim)."""
    scaled = ascent_coordinates(problem)
    ends = ascend(GaussNewton(problem, scaled), points, scaled.lower, scaled.upper, tolerance=_ROUGH)
    found = leaders(ends)[0]
    return found[:_MOST_POLISHED] if len(found) else points


def maxima_from(
    problem: Posterior, scaled: ScaledDensity, points: FloatArray, most_solves: float = np.inf
) -> tuple[Maximum, ...]:
    """Return the tuple of maxima reached from scaled points (n, ndim), the highest first; see `local_maxima`."""
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
        if solves() - before < most_solves:
            ends = ascend(quadratic, together, scaled.lower, scaled.upper, tolerance=_ROUGH)
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
    """Return the message that explains why no start has a finite gradient."""
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
    """Return the scaled starting points (starts, ndim) within the bounds."""
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
    """Return the highest of each group of close end points, (n, ndim), and the size of each group, (n,)."""
    chosen, starts = list[int](), list[int]()
    left = np.argsort(ends.value)
    left = left[np.isfinite(ends.value[left])]
    while left.size:
        first = left[0]
        away = ends.position[left] - ends.position[first]
        close = 0.5 * np.einsum("ni,ij,nj->n", away, ends.hessian[first], away) <= _CLOSE
        close &= ends.value[left] - ends.value[first] <= _CLOSE
        close[0] = True
        chosen.append(first)
        starts.append(int(close.sum()))
        left = left[~close]
    return ends.position[chosen], np.array(starts)


def _collect_ends(scaled: ScaledDensity, u: FloatArray, starts: IntArray) -> list[Maximum]:
    """Return the list of maxima at scaled points (n, ndim) of finite log-probability, with their `starts` (n,)."""
    theta = scaled.to_theta(u)
    values = scaled.density.log_prob(theta)
    return [Maximum(x, float(v), int(n)) for x, v, n in zip(theta, values, starts, strict=True) if np.isfinite(v)]


def _is_same(problem: Posterior, one: Maximum, other: Maximum) -> bool:
    if np.all(np.abs(one.theta - other.theta) < _SAME * problem.scale):
        return True
    between = problem.log_prob(one.theta + _ON_THE_WAY * (other.theta - one.theta))
    return bool(np.min(between) >= min(one.log_prob, other.log_prob) - _VALLEY)


def _merge(problem: Posterior, maxima: Iterable[Maximum]) -> tuple[Maximum, ...]:
    """Return the tuple of distinct maxima, the highest first; the starts of equal maxima are added up."""
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
    """Return the tuple of distinct maxima with a finite log-probability, the highest first."""
    return _merge(problem, [top for top in tops if np.isfinite(top.log_prob)])


def _climb(scaled: ScaledDensity, start: FloatArray, starts: int = 1) -> Maximum:
    """Return the maximum that L-BFGS-B reaches from a scaled point (ndim,)."""
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


@dataclass(frozen=True)
class Ascent:
    """The results of `ascend`.

    Attributes
    ----------
    position : ndarray, shape (n, ndim)
        Final points.
    value : ndarray, shape (n,)
        V at the final points.
    hessian : ndarray, shape (n, ndim, ndim)
        Gauss–Newton Hessian of V at the final points.
    stationary : ndarray of bool, shape (n,)
        Whether each final point is stationary.
    steps : int
        Number of steps performed.
    """

    position: FloatArray
    value: FloatArray
    hessian: FloatArray
    stationary: BoolArray
    steps: int


class GaussNewton:
    """V = −log P of a problem, in the coordinates u of a `ScaledDensity`, by default (θ − offset)/scale.

    With the residuals r (errors divided by their standard deviations) and their Jacobian J, ∇²V is approximated by
    JᵀJ plus the curvature of the prior; the terms r_i ∇²r_i are neglected (Nocedal & Wright 2006, section 10.3).
    Inferred standard deviations contribute their Fisher information (Fisher scoring).
    """

    def __init__(self, problem: Posterior, scaled: ScaledDensity | None = None) -> None:
        self.problem = problem
        self._scaled = ScaledDensity(problem) if scaled is None else scaled

    def __call__(self, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return V, its gradient and its Gauss–Newton Hessian; V is infinite where the model fails."""
        p, scaled = self.problem, self._scaled
        theta = scaled.to_theta(u)
        log_likelihood, slope, information = p.quadratic(theta)
        value = -log_likelihood - np.asarray(p.log_prior(theta))
        prior_slope, prior_curvature = p.prior.quadratic(theta, scaled.scale)
        stretch = scaled.stretch(theta)
        if scaled.is_log.any():
            prior_slope = prior_slope / scaled.scale * stretch
            j = np.flatnonzero(scaled.is_log)
            prior_curvature[:, j, j] = 1.0  # as −log p = u²/2 + sd u for a log-normal density of θ
        gradient = -slope * stretch - prior_slope
        hessian = information * (stretch[..., :, None] * stretch[..., None, :]) + prior_curvature
        failed = ~(np.isfinite(value) & np.all(np.isfinite(gradient), axis=1))
        hessian[failed] = np.eye(p.ndim)
        return np.where(failed, np.inf, value), np.where(failed[:, None], 0.0, gradient), hessian


def ascend(
    quadratic: Quadratic,
    start: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    tolerance: float = 1e-9,
    max_steps: int = 100,
) -> Ascent:
    """Ascend from every start to a local maximum of −V within a box, by the Levenberg–Marquardt method.

    Each step minimises the quadratic model with an enlarged diagonal within the box. The enlargement follows the
    ratio of actual and predicted decrease (Nocedal & Wright 2006, sections 4.1 and 10.3). At a kink, where
    computed modes swap, the quadratic model is invalid, and the ascent does not end at a stationary point.

    Parameters
    ----------
    quadratic : callable
    start : ndarray, shape (n, ndim)
        Starts within the box. Starts with an infinite V are returned unchanged.
    lower, upper : ndarray, shape (ndim,)
        Limits of the box.
    tolerance : float
        A point is stationary if the predicted decrease of V is smaller than this, in nats.
    max_steps : int
        Largest number of steps.

    Returns
    -------
    Ascent
    """
    u = start.copy()
    V, g, H = quadratic(u)
    damping = np.full(len(u), FIRST_DAMPING)
    stationary = np.zeros(len(u), dtype=bool)
    i = np.arange(u.shape[1])
    going = np.flatnonzero(np.isfinite(V))
    advance_phase(len(u) - len(going))
    step = 0
    for step in range(max_steps):  # noqa: B007
        stationary[going] = decrement(u[going], g[going], H[going], lower, upper) < tolerance
        on = going[~stationary[going] & (damping[going] < MOST_DAMPING)]
        advance_phase(len(going) - len(on))
        going = on
        if not going.size:
            break
        damped = _invertible(H[going])
        damped[:, i, i] *= 1.0 + damping[going, None]
        s = _box_step(u[going], g[going], damped, lower, upper)
        new_V, new_g, new_H = quadratic(u[going] + s)
        predicted = np.maximum(_predicted_decrease(s, g[going], H[going]), np.finfo(float).tiny)
        ratio = (V[going] - new_V) / predicted
        better, damping[going] = adjust_damping(damping[going], ratio)
        moved = going[better]
        u[moved] += s[better]
        V[moved], g[moved], H[moved] = new_V[better], new_g[better], new_H[better]
    return Ascent(np.clip(u, lower, upper), V, H, stationary, step)


def adjust_damping(damping: ArrayLike, ratio: ArrayLike) -> tuple[BoolArray, FloatArray]:
    """Return whether steps are accepted, and the damping of the next steps.

    Parameters
    ----------
    damping : array_like
        Relative enlargement of the diagonal in the last steps.
    ratio : array_like
        Ratio of the actual and the predicted change of V in the last steps.
    """
    ratio = np.asarray(ratio)
    better = ratio > 1e-4
    change = np.where(better, np.where(ratio > 0.75, 0.2, np.where(ratio < 0.25, 3.0, 1.0)), 5.0)
    return better, np.maximum(damping * change, 1e-10)


def find_pressed(u: FloatArray, g: FloatArray, lower: FloatArray, upper: FloatArray) -> BoolArray:
    """Return a mask of the coordinates that are at a bound and in which V decreases outwards, shape (n, ndim)."""
    return ((u <= lower) & (g > 0)) | ((u >= upper) & (g < 0))


def decrement(u: FloatArray, g: FloatArray, H: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return the predicted decrease of V in an undamped step, (n,); coordinates of `find_pressed` are held."""
    held = find_pressed(u, g, lower, upper)
    s = _newton(g, _invertible(H), held, np.zeros_like(u))
    return -0.5 * np.sum(np.where(held, 0.0, g) * s, axis=1)


def _box_step(u: FloatArray, g: FloatArray, A: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return steps that decrease the model g·s + sᵀAs/2 within the box, shape (n, ndim).

    The exact minimum in a box is a quadratic programme. Three cheap candidates are enough, since the damping
    corrects a poor step: the Newton step clipped to the box, the Newton step shortened to the first bound, and an
    active-set step. The latter fixes coordinates at the bounds that they would cross and solves for the remaining
    coordinates, until all are inside.
    """
    # coordinates at a bound in which V decreases outwards are held
    held = find_pressed(u, g, lower, upper)
    s = _newton(g, A, held, np.zeros_like(u))
    # the fraction of the step at which the first coordinate reaches its bound
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(s > 0, (upper - u) / s, np.where(s < 0, (lower - u) / s, np.inf))
    cut = s * np.clip(room.min(axis=1), 0.0, 1.0)[:, None]
    candidates = [np.clip(u + s, lower, upper) - u, cut]
    for _ in range(u.shape[1]):  # each pass holds at least one more coordinate
        outside = ((u + s < lower) | (u + s > upper)) & ~held
        if not outside.any():
            break
        held = held | outside
        s = _newton(g, A, held, np.where(outside, np.clip(u + s, lower, upper) - u, s))
    candidates.append(np.clip(u + s, lower, upper) - u)
    best = np.argmax([_predicted_decrease(c, g, A) for c in candidates], axis=0)
    return np.stack(candidates)[best, np.arange(len(u))]


def _newton(g: FloatArray, A: FloatArray, held: BoolArray, s: FloatArray) -> FloatArray:
    """Return the minimiser of g·s + sᵀAs/2, (n, ndim), with the `held` coordinates fixed at the values in `s`."""
    i = np.arange(g.shape[1])
    s = np.where(held, s, 0.0)
    # identity rows for held coordinates keep the size of the system the same for the whole batch
    B = np.where(held[:, :, None] | held[:, None, :], 0.0, A)
    B[:, i, i] = np.where(held, 1.0, B[:, i, i])
    right = np.where(held, 0.0, -(g + np.einsum("nij,nj->ni", A, s)))
    return np.where(held, s, np.linalg.solve(B, right[..., None])[..., 0])


def _predicted_decrease(s: FloatArray, g: FloatArray, A: FloatArray) -> FloatArray:
    """Return the decrease of the quadratic model in the step `s`, shape (n,)."""
    return -np.sum(g * s, axis=1) - 0.5 * np.einsum("ni,nij,nj->n", s, A, s)


def _invertible(H: FloatArray) -> FloatArray:
    """Return H with a small multiple of the identity added, which regularises undetermined directions."""
    n = H.shape[1]
    return H + (1e-12 * (1.0 + np.trace(H, axis1=1, axis2=2)))[:, None, None] * np.eye(n)
