"""Gauss–Newton ascent to local maxima of a posterior, all starts in lockstep as one array."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.posterior.protocol import Problem
from fmu.posterior.scaled import ScaledDensity
from fmu.progress.phases import advanced
from fmu.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from fmu.posterior.parameters import Parameter


Quadratic = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
"""Maps (n, ndim) to V = −log P, shape (n,), its gradient (n, ndim) and Gauss–Newton Hessian (n, ndim, ndim)."""

_FIRST_DAMPING, _MOST_DAMPING = 1e-2, 1e12


@dataclass(frozen=True)
class Ascent:
    """Where the ascents ended: points (n, ndim), whether each is stationary, how many steps were made."""

    position: FloatArray
    stationary: BoolArray
    steps: int


class GaussNewton:
    """V = −log P of a problem, in the coordinates u = (θ − offset)/scale.

    With the residuals r, the errors over their standard deviations, and their slopes J, ∇²V is taken for JᵀJ plus
    the curvature of the prior: the terms r_i ∇²r_i are left out (Nocedal & Wright 2006, section 10.3). Standard
    deviations that are inferred contribute the information about them (Fisher scoring). For likelihoods
    of modes, see `fmu.posterior.errors.base.Likelihood.quadratic`.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._scaled = ScaledDensity(problem)

    def __call__(self, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return V, its gradient and its Gauss–Newton Hessian; V is infinite where the model fails."""
        p, scale = self.problem, self._scaled.scale
        theta = self._scaled.to_theta(u)
        log_likelihood, slope, information = p.likelihood.quadratic(theta)
        value = -log_likelihood - np.asarray(p.log_prior(theta))
        prior_slope, prior_curvature = self._prior(theta)
        gradient = -slope * scale - prior_slope
        hessian = information * np.outer(scale, scale)
        i = np.arange(p.ndim)
        hessian[:, i, i] += prior_curvature
        failed = ~(np.isfinite(value) & np.all(np.isfinite(gradient), axis=1))
        hessian[failed] = np.eye(p.ndim)
        return np.where(failed, np.inf, value), np.where(failed[:, None], 0.0, gradient), hessian

    def _prior(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return slope and curvature −∂² of the log-prior in u, each (n, ndim); the parameters are independent."""
        slope, curvature = np.empty_like(theta), np.empty_like(theta)
        for k, parameter in enumerate(self.problem.parameters):
            slope[:, k], curvature[:, k] = _prior_in_one(parameter, theta[:, k], self._scaled.scale[k])
        return slope, curvature


def _prior_in_one(parameter: Parameter, x: FloatArray, scale: float) -> tuple[FloatArray, FloatArray]:
    """Return slope and curvature of one parameter's log-prior, the curvature by differences of the slope."""
    h = 1e-4 * scale
    low, high = parameter.prior.support
    near = np.clip(x, low + 2.0 * h, high - 2.0 * h)
    ahead, behind = (parameter.prior.log_pdf_gradient(near + step) for step in (h, -h))
    curvature = np.maximum(0.0, (behind - ahead) / (2.0 * h)) * scale**2
    return parameter.prior.log_pdf_gradient(x) * scale, curvature


def ascend(
    quadratic: Quadratic,
    start: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    tolerance: float = 1e-9,
    max_steps: int = 100,
) -> Ascent:
    """Climb from every start to a local maximum of −V within a box.

    Levenberg–Marquardt: the step minimises the quadratic model with its diagonal enlarged, within the box, and the
    enlargement follows the ratio of actual and predicted decrease (Nocedal & Wright 2006, sections 4.1 and 10.3).
    At a kink, where computed modes swap, the model predicts in vain: such an ascent is not stationary at its end.

    Parameters
    ----------
    quadratic : callable
    start : ndarray, shape (n, ndim)
        Within the box. A start at which V is not finite stays where it is.
    lower, upper : ndarray, shape (ndim,)
    tolerance : float
        A point is stationary where the model promises less than this; V is in units of log-probability.
    max_steps : int

    Returns
    -------
    Ascent
    """
    u = start.copy()
    V, g, H = quadratic(u)
    damping = np.full(len(u), _FIRST_DAMPING)
    stationary = np.zeros(len(u), dtype=bool)
    i = np.arange(u.shape[1])
    going = np.flatnonzero(np.isfinite(V))
    advanced(len(u) - len(going))
    step = 0
    for step in range(max_steps):  # noqa: B007
        stationary[going] = decrement(u[going], g[going], H[going], lower, upper) < tolerance
        on = going[~stationary[going] & (damping[going] < _MOST_DAMPING)]
        advanced(len(going) - len(on))
        going = on
        if not going.size:
            break
        damped = _invertible(H[going])
        damped[:, i, i] *= 1.0 + damping[going, None]
        s = _box_step(u[going], g[going], damped, lower, upper)
        new_V, new_g, new_H = quadratic(u[going] + s)
        predicted = np.maximum(_predicted_decrease(s, g[going], H[going]), np.finfo(float).tiny)
        ratio = (V[going] - new_V) / predicted
        better = ratio > 1e-4
        change = np.where(better, np.where(ratio > 0.75, 0.2, np.where(ratio < 0.25, 3.0, 1.0)), 5.0)
        damping[going] = np.maximum(damping[going] * change, 1e-10)
        moved = going[better]
        u[moved] += s[better]
        V[moved], g[moved], H[moved] = new_V[better], new_g[better], new_H[better]
    return Ascent(np.clip(u, lower, upper), stationary, step)


def pressed(u: FloatArray, g: FloatArray, lower: FloatArray, upper: FloatArray) -> BoolArray:
    """Return which coordinates are held at a wall, V falling beyond it; shapes (n, ndim)."""
    return ((u <= lower) & (g > 0)) | ((u >= upper) & (g < 0))


def decrement(u: FloatArray, g: FloatArray, H: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return how much the undamped model of V promises with the pressed coordinates held, shape (n,)."""
    held = pressed(u, g, lower, upper)
    s = _newton(g, _invertible(H), held, np.zeros_like(u))
    return -0.5 * np.sum(np.where(held, 0.0, g) * s, axis=1)


def _box_step(u: FloatArray, g: FloatArray, A: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return steps that lower g·s + sᵀAs/2 within the box, shape (n, ndim).

    The best of three: the Newton step clipped, the Newton step cut at the first wall, and the one that puts
    coordinates on the walls they would cross and solves for the others again until none is left outside.
    """
    s = np.zeros_like(u)
    held = pressed(u, g, lower, upper)
    s = _newton(g, A, held, s)
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(s > 0, (upper - u) / s, np.where(s < 0, (lower - u) / s, np.inf))
    cut = s * np.clip(room.min(axis=1), 0.0, 1.0)[:, None]
    candidates = [np.clip(u + s, lower, upper) - u, cut]
    for _ in range(u.shape[1]):
        outside = ((u + s < lower) | (u + s > upper)) & ~held
        if not outside.any():
            break
        held = held | outside
        s = _newton(g, A, held, np.where(outside, np.clip(u + s, lower, upper) - u, s))
    candidates.append(np.clip(u + s, lower, upper) - u)
    best = np.argmax([_predicted_decrease(c, g, A) for c in candidates], axis=0)
    return np.stack(candidates)[best, np.arange(len(u))]


def _newton(g: FloatArray, A: FloatArray, held: BoolArray, s: FloatArray) -> FloatArray:
    """Return `s` with the coordinates that are not held at the minimum of g·s + sᵀAs/2."""
    i = np.arange(g.shape[1])
    s = np.where(held, s, 0.0)
    B = np.where(held[:, :, None] | held[:, None, :], 0.0, A)
    B[:, i, i] = np.where(held, 1.0, B[:, i, i])
    right = np.where(held, 0.0, -(g + np.einsum("nij,nj->ni", A, s)))
    return np.where(held, s, np.linalg.solve(B, right[..., None])[..., 0])


def _predicted_decrease(s: FloatArray, g: FloatArray, A: FloatArray) -> FloatArray:
    """Return by how much the model falls along `s`, shape (n,)."""
    return -np.sum(g * s, axis=1) - 0.5 * np.einsum("ni,nij,nj->n", s, A, s)


def _invertible(H: FloatArray) -> FloatArray:
    """Return H with what rounding needs added to its diagonal, for directions that nothing determines."""
    n = H.shape[1]
    return H + (1e-12 * (1.0 + np.trace(H, axis1=1, axis2=2)))[:, None, None] * np.eye(n)
