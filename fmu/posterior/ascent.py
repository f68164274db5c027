"""Gauss–Newton ascents of a log-density within a box. Ascents from many starting points advance as one array."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fmu.posterior.density import Posterior
from fmu.posterior.scaled import ScaledDensity
from fmu.progress.phases import advance_phase
from fmu.types import BoolArray, FloatArray

Quadratic = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
"""A function of u (n, ndim) that returns V = −log P (n,), its gradient and its Gauss–Newton Hessian."""

FIRST_DAMPING, MOST_DAMPING = 1e-2, 1e12
_JOINS, _MOST_JOINED = 0.25, 8
"""Nats within which an ascent has joined another one, and number of finished ascents that others can join."""


@dataclass(frozen=True)
class Ascent:
    """Results of `ascend` for the function V = −log P.

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
        Number of steps of the longest ascent.
    """

    position: FloatArray
    value: FloatArray
    hessian: FloatArray
    stationary: BoolArray
    steps: int


class GaussNewton:
    """The function V = −log P of a problem, in the coordinates u of a `ScaledDensity`.

    By default u = (θ − offset)/scale. With the residuals r (errors divided by their standard deviations) and their
    Jacobian J, ∇²V is approximated by JᵀJ plus the prior's curvature; the terms r_i ∇²r_i are neglected (Nocedal &
    Wright 2006, section 10.3). Inferred error parameters contribute their Fisher information (Fisher scoring).
    """

    def __init__(self, problem: Posterior, scaled: ScaledDensity | None = None) -> None:
        self.problem = problem
        self._scaled = ScaledDensity(problem) if scaled is None else scaled

    def __call__(self, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return V (n,), its gradient (n, ndim) and its Gauss–Newton Hessian (n, ndim, ndim) at u (n, ndim).

        Where V or its gradient is not finite, V is infinite, the gradient is 0, and the Hessian is the identity.
        """
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
    *,
    join: bool = False,
) -> Ascent:
    """Ascend from every starting point to a local maximum of log P = −V within a box.

    This is the Levenberg–Marquardt method. Each step approximately minimises a quadratic model of V within the
    box. The diagonal of the model's Hessian is enlarged (damped) by an amount that depends on the ratio of actual
    to predicted decrease in the last step (Nocedal & Wright 2006, sections 4.1 and 10.3). At a kink, where
    computed modes swap, the quadratic model is invalid. The ascent then ends at a point that is not stationary.

    Parameters
    ----------
    quadratic : callable
        Returns V, its gradient and its Hessian.
    start : ndarray, shape (n, ndim)
        Starting points within the box. A point with infinite V is returned unchanged, marked as not stationary.
    lower, upper : ndarray, shape (ndim,)
        Limits of the box.
    tolerance : float
        A point is stationary if the predicted decrease of V is smaller than this, in nats.
    max_steps : int
        Largest number of steps.
    join : bool
        Whether an ascent also ends, without being stationary, if it comes within a quarter of a nat of one of the
        eight highest stationary points (`is_close`).

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
    steps = 0
    while True:
        stationary[going] = decrement(u[going], g[going], H[going], lower, upper) < tolerance
        on = going[~stationary[going] & (damping[going] < MOST_DAMPING)]
        if join:
            arrived = np.flatnonzero(stationary)
            for k in arrived[np.argsort(V[arrived])][:_MOST_JOINED]:
                on = on[~is_close(u[on], V[on], u[k], V[k], H[k], _JOINS)]
        advance_phase(len(going) - len(on))
        going = on
        if not going.size or steps == max_steps:
            break
        damped = _invertible(H[going])
        damped[:, i, i] *= 1.0 + damping[going, None]
        s = _box_step(u[going], g[going], damped, lower, upper)
        new_V, new_g, new_H = quadratic(u[going] + s)
        predicted = np.maximum(_predicted_decrease(s, g[going], H[going]), np.finfo(float).tiny)
        with np.errstate(over="ignore"):  # an infinite ratio has the same effect as a large one
            ratio = (V[going] - new_V) / predicted
        better, damping[going] = adjust_damping(damping[going], ratio)
        moved = going[better]
        u[moved] += s[better]
        V[moved], g[moved], H[moved] = new_V[better], new_g[better], new_H[better]
        steps += 1
    return Ascent(np.clip(u, lower, upper), V, H, stationary, steps)


def is_close(
    u: FloatArray, V: FloatArray, centre: FloatArray, lowest: float, hessian: FloatArray, nats: float
) -> BoolArray:
    """Return whether points are close to an end point, by value and by the quadratic model there, shape (n,).

    Parameters
    ----------
    u, V : ndarray, shape (n, ndim) and (n,)
        Points, and the values of V = −log P there.
    centre, lowest, hessian : ndarray (ndim,), float and ndarray (ndim, ndim)
        The end point, and the value and Hessian of V there.
    nats : float
        Largest difference of the values, and largest value of the quadratic form of the Hessian, divided by 2.
    """
    away = u - centre
    return np.asarray((0.5 * np.einsum("ni,ij,nj->n", away, hessian, away) <= nats) & (np.abs(V - lowest) <= nats))


def adjust_damping(damping: ArrayLike, ratio: ArrayLike) -> tuple[BoolArray, FloatArray]:
    """Decide which steps are accepted, and adapt the damping for the next steps.

    Parameters
    ----------
    damping : array_like
        Relative enlargement of the diagonal in the last steps.
    ratio : array_like
        Ratio of actual to predicted change of V in the last steps.

    Returns
    -------
    accepted : ndarray of bool
    damping : ndarray
        Both have the shape of `ratio`.
    """
    ratio = np.asarray(ratio)
    better = ratio > 1e-4
    change = np.where(better, np.where(ratio > 0.75, 0.2, np.where(ratio < 0.25, 3.0, 1.0)), 5.0)
    return better, np.maximum(damping * change, 1e-10)


def find_pressed(u: FloatArray, g: FloatArray, lower: FloatArray, upper: FloatArray) -> BoolArray:
    """Return a mask (n, ndim) of the coordinates that are at a bound beyond which V would decrease further."""
    return ((u <= lower) & (g > 0)) | ((u >= upper) & (g < 0))


def decrement(u: FloatArray, g: FloatArray, H: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return the decrease of V, (n,), predicted for an undamped step in which pressed coordinates stay fixed.

    `find_pressed` defines the pressed coordinates.
    """
    held = find_pressed(u, g, lower, upper)
    s = _newton(g, _invertible(H), held, np.zeros_like(u))
    return -0.5 * np.sum(np.where(held, 0.0, g) * s, axis=1)


def _box_step(u: FloatArray, g: FloatArray, A: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return steps (n, ndim) that decrease the quadratic model g·s + sᵀAs/2 within the box.

    Finding the exact minimum in the box would require quadratic programming. Three cheap candidates are enough,
    since the damping corrects a poor step: the Newton step clipped to the box, the Newton step shortened to the
    first bound, and an active-set step. The active-set step places each coordinate that would leave the box on its
    bound, and solves for the remaining coordinates. This is repeated until all are inside. The candidate with the
    largest decrease is returned.
    """
    # fix coordinates that are at a bound while V decreases outwards
    held = find_pressed(u, g, lower, upper)
    s = _newton(g, A, held, np.zeros_like(u))
    # the fraction of the step at which the first coordinate reaches its bound
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        room = np.where(s > 0, (upper - u) / s, np.where(s < 0, (lower - u) / s, np.inf))
    cut = s * np.clip(room.min(axis=1), 0.0, 1.0)[:, None]
    candidates = [np.clip(u + s, lower, upper) - u, cut]
    for _ in range(u.shape[1]):  # each pass fixes at least one more coordinate
        outside = ((u + s < lower) | (u + s > upper)) & ~held
        if not outside.any():
            break
        held = held | outside
        s = _newton(g, A, held, np.where(outside, np.clip(u + s, lower, upper) - u, s))
    candidates.append(np.clip(u + s, lower, upper) - u)
    best = np.argmax([_predicted_decrease(c, g, A) for c in candidates], axis=0)
    return np.stack(candidates)[best, np.arange(len(u))]


def _newton(g: FloatArray, A: FloatArray, held: BoolArray, s: FloatArray) -> FloatArray:
    """Return the minimiser of g·s + sᵀAs/2, (n, ndim). Coordinates that are `held` keep their values in `s`."""
    i = np.arange(g.shape[1])
    s = np.where(held, s, 0.0)
    # identity rows for fixed coordinates keep the system size the same for the whole batch
    B = np.where(held[:, :, None] | held[:, None, :], 0.0, A)
    B[:, i, i] = np.where(held, 1.0, B[:, i, i])
    right = np.where(held, 0.0, -(g + np.einsum("nij,nj->ni", A, s)))
    return np.where(held, s, np.linalg.solve(B, right[..., None])[..., 0])


def _predicted_decrease(s: FloatArray, g: FloatArray, A: FloatArray) -> FloatArray:
    """Return the decrease of the quadratic model in the step `s`, shape (n,)."""
    return -np.sum(g * s, axis=1) - 0.5 * np.einsum("ni,nij,nj->n", s, A, s)


def _invertible(H: FloatArray) -> FloatArray:
    """Return H (n, ndim, ndim) plus a small multiple of the identity, so that it can be inverted."""
    n = H.shape[1]
    return H + (1e-12 * (1.0 + np.trace(H, axis1=1, axis2=2)))[:, None, None] * np.eye(n)
